"""How much unseen space a brake tube leads through, compared with what braking itself would need.

A command may lead through no unseen cell, or, when braking itself does (start in the unseen, drift, memory lost), through none
that braking keeps clear of, through no more than braking, and to a stop no nearer to any: without that, small steps would add up.
Counted with one cell to spare, so that the grid's own steps are no breach: only the exact count slows down. What will be
forgotten before the vehicle stands is forgotten already for a command, not yet for braking: no command runs after old memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.braking import Tubes
from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.free_space import NOWHERE, STEP_M, FreeSpace
from safety.unseen_cells import Counts

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
ROUNDING_M = 1e-9
STANDING_AFTER = 2.0  # blind times until less of the way is left than what stays known around a vehicle


@dataclass(frozen=True, slots=True)
class View:
    """The map of free space at a moment, and the known returns [2, k]."""

    free: FreeSpace
    near_m: Floats
    now_s: float

    def unseen(self, places_m: Floats, wide: bool, ahead_s: float = 0.0, spared_m: Floats = NOWHERE) -> Counts:
        """How many unseen cells the hull touches at places [2, ...], now or some time ahead."""
        return self.free.unseen(places_m, self.near_m, self.now_s + ahead_s, wide, spared_m)

    def all_seen(self, begin_m: Floats, end_m: Floats, ahead_s: float) -> bool:
        """Whether all is seen around straight legs [..., 3]: quick, and False where it must be counted."""
        ends = np.concatenate((begin_m, end_m)).reshape(-1, 3)
        low, high = np.minimum.reduce(ends).tolist(), np.maximum.reduce(ends).tolist()
        return self.free.all_seen_between(low, high, self.now_s + ahead_s)


@dataclass(frozen=True, slots=True)
class Hidden:
    """Unseen cells on tubes [c], at the worst place of each: with one cell to spare, and exactly.

    `soon`: the same as `wide`, when the vehicle will stand. `more`: exactly and then, without those that braking touches.
    `gap_m` [c]: from the stop points to the nearest unseen cell. `brake_m` [2, n]: places on the way of braking.
    """

    soon: Counts
    wide: Counts
    exact: Counts
    more: Counts
    gap_m: Floats
    brake_m: Floats

    def rows(self, chosen: slice) -> Hidden:
        """The counts of some tubes."""
        counts = (self.soon[chosen], self.wide[chosen], self.exact[chosen], self.more[chosen])
        return Hidden(*counts, self.gap_m[chosen], self.brake_m)

    def permits(self, others: Hidden) -> Booleans:
        """Which tubes see enough: they touch nothing unseen, or this one does and they lead no further in."""
        no_more = (others.more == 0) & (others.wide <= self.wide) & (others.exact <= self.exact)
        permitted: Booleans = (others.soon == 0) | (no_more & (others.gap_m >= self.gap_m - ROUNDING_M))
        return permitted


class Sight:
    """Counts unseen cells under the hull."""

    def __init__(self, config: SafetyConfig) -> None:
        longest = config.stop_distance_m(2.0 * config.max_horizontal_speed_m_s)
        self._shares = np.linspace(0.0, 1.0, math.ceil(longest / STEP_M) + 1)
        self._ahead_s = min(STANDING_AFTER * config.delay_s, 0.5 * config.memory_s)

    def lost(self, position: CorridorVector, view: View) -> bool:
        """Whether the vehicle is in unseen space."""
        if view.free.all_seen_around(position.x, position.y, view.now_s):  # the usual case
            return False
        return view.free.hull_touches(position.x, position.y, view.near_m, view.now_s)

    def all_clear(self, low_m: Sequence[float], high_m: Sequence[float], view: View) -> bool:
        """Whether nothing unseen is near any place between two corners (x, y), now or when the vehicle will stand."""
        ahead_s = view.now_s + self._ahead_s
        return view.free.all_seen_between(low_m, high_m, ahead_s) or view.free.none_hidden(low_m, high_m, view.near_m, ahead_s)

    def hidden(self, tube: Tubes, view: View, brake: Hidden | None = None) -> Hidden:
        """The unseen cells on each tube, of both models. Without `brake` the last tube is braking's own.

        Where braking touches nothing unseen nothing else may, and only `soon` is counted.
        """
        leg = tube.stop_m - tube.turn_m
        if view.all_seen(tube.turn_m, tube.stop_m, self._ahead_s):  # the usual case
            return _seen(np.zeros(leg.shape[1], dtype=np.int32))
        places = leg.transpose(2, 0, 1)[:2, :, :, None] * self._shares
        places += tube.turn_m.transpose(2, 0, 1)[:2, :, :, None]
        soon = view.unseen(places, True, self._ahead_s).max(axis=(0, 2))
        if (soon if brake is None else brake.soon)[-1] == 0:
            return _seen(soon)
        braking = places[:, :, -1].reshape(2, -1) if brake is None else brake.brake_m
        wide, exact = (view.unseen(places, far).max(axis=(0, 2)) for far in (True, False))
        more = view.unseen(places, False, self._ahead_s, braking).max(axis=(0, 2))
        gaps = view.free.gap_m(tube.stop_m.reshape(-1, 3).T[:2], view.near_m, view.now_s).reshape(2, -1).min(axis=0)
        return Hidden(soon, wide, exact, more, gaps, braking)


def _seen(soon: Counts) -> Hidden:
    """Where braking touches nothing unseen, one count is enough."""
    return Hidden(soon, soon, soon, soon, np.zeros(soon.shape), NOWHERE)
