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
        x, y = np.array((position.x,)), np.array((position.y,))
        return bool(view.free.unseen(x, y, view.near_m, view.now_s, wide=False)[0])

    def hidden(self, tube: Tubes, view: View, brake: Hidden | None = None) -> Hidden:
        """The unseen cells on each tube, of both models. Without `brake` the last tube is braking's own.

        Where braking touches nothing unseen nothing else may, and only `wide` is counted.
        """
        leg = tube.stop_m - tube.turn_m
        x, y = (tube.turn_m[..., axis, None] + leg[..., axis, None] * self._shares for axis in (0, 1))
        wide = view.free.unseen(x, y, view.near_m, view.now_s, wide=True).max(axis=(0, 2))
        if (wide if brake is None else brake.wide)[-1] == 0:
            return Hidden(wide, wide, np.zeros(wide.shape))
        exact = view.free.unseen(x, y, view.near_m, view.now_s, wide=False).max(axis=(0, 2))
        stop_x, stop_y = tube.stop_m[..., 0].reshape(-1), tube.stop_m[..., 1].reshape(-1)
        gaps = view.free.gap_m(stop_x, stop_y, view.near_m, view.now_s).reshape(2, -1).min(axis=0)
        return Hidden(wide, exact, gaps)
