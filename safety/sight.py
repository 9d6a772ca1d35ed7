"""How much unseen space a brake tube leads through, compared with what braking itself would need.

A command may lead through no unseen cell, or, when braking itself does (start in the unseen, drift, memory run out), through no
more than braking, and to a stop no nearer to any: without that, small steps would add up. Counted with one cell to spare, so that
the grid's own steps are no breach: only the exact count slows down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.braking import Tubes
from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.free_space import STEP_M, FreeSpace

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]
Booleans = NDArray[np.bool_]
ROUNDING_M = 1e-9


@dataclass(frozen=True, slots=True)
class View:
    """The map of free space at a moment, and the known returns [2, k] near the vehicle."""

    free: FreeSpace
    near_m: Floats
    now_s: float

    def beside(self, near_m: Floats) -> View:
        """The same with other returns."""
        return View(self.free, near_m, self.now_s)

    def unseen(self, places_m: Floats, wide: bool) -> Integers:
        """How many unseen cells the hull touches at places [2, ...]."""
        return self.free.unseen(places_m, self.near_m, self.now_s, wide)

    def all_seen(self, begin_m: Floats, end_m: Floats) -> bool:
        """Whether all is seen around straight legs [..., 3]: quick, and False where it must be counted."""
        ends = np.concatenate((begin_m, end_m)).reshape(-1, 3)
        return self.free.all_seen_between(ends.min(axis=0).tolist(), ends.max(axis=0).tolist(), self.now_s)


@dataclass(frozen=True, slots=True)
class Hidden:
    """Unseen cells on tubes [c], at the worst place of each: with one cell to spare, and exactly.

    `gap_m` [c]: from the stop points to the nearest unseen cell.
    """

    wide: Integers
    exact: Integers
    gap_m: Floats

    def rows(self, chosen: slice) -> Hidden:
        """The counts of some tubes."""
        return Hidden(self.wide[chosen], self.exact[chosen], self.gap_m[chosen])

    def permits(self, others: Hidden) -> Booleans:
        """Which tubes see enough: they touch nothing unseen, or this one does and they lead no further in."""
        no_more = (others.wide <= self.wide) & (others.exact <= self.exact) & (others.gap_m >= self.gap_m - ROUNDING_M)
        permitted: Booleans = (others.wide == 0) | no_more
        return permitted


class Sight:
    """Counts unseen cells under the hull."""

    def __init__(self, config: SafetyConfig) -> None:
        longest = config.stop_distance_m(2.0 * config.max_horizontal_speed_m_s)
        self._shares = np.linspace(0.0, 1.0, math.ceil(longest / STEP_M) + 1)

    def lost(self, position: CorridorVector, view: View) -> bool:
        """Whether the vehicle is in unseen space."""
        if view.free.all_seen_around(position.x, position.y, view.now_s):  # the usual case
            return False
        place = np.array(((position.x,), (position.y,)))
        # with one cell to spare first: the tubes need those sums anyway, and where they are zero so are the exact ones
        return all(view.unseen(place, wide)[0] > 0 for wide in (True, False))

    def hidden(self, tube: Tubes, view: View, brake: Hidden | None = None) -> Hidden:
        """The unseen cells on each tube, of both models. Without `brake` the last tube is braking's own.

        Where braking touches nothing unseen nothing else may, and only `wide` is counted.
        """
        leg = tube.stop_m - tube.turn_m
        if view.all_seen(tube.turn_m, tube.turn_m + leg):  # the usual case
            none = np.zeros(leg.shape[1], dtype=np.intp)
            return Hidden(none, none, np.zeros(none.shape))
        along = leg.transpose(2, 0, 1)[:2, :, :, None] * self._shares
        places = tube.turn_m.transpose(2, 0, 1)[:2, :, :, None] + along
        wide = view.unseen(places, wide=True).max(axis=(0, 2))
        if (wide if brake is None else brake.wide)[-1] == 0:
            return Hidden(wide, wide, np.zeros(wide.shape))
        exact = view.unseen(places, wide=False).max(axis=(0, 2))
        stops = tube.stop_m.reshape(-1, 3).T[:2]
        return Hidden(wide, exact, view.free.gap_m(stops, view.near_m, view.now_s).reshape(2, -1).min(axis=0))
