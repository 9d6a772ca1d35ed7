"""How much unseen space a brake tube leads through, compared with what braking itself would need.

A command may lead through no unseen cell, or, when braking itself does (start in the unseen, drift, memory run out), through no
more than braking. Counted with one cell to spare, so that the grid's own steps are no breach: only the exact count slows down.
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
OUT_M = 0.3  # how far ahead fewer unseen cells must lie: several cells, since a tick moves the stop point by a fraction of one
LEAST_WAY_M = 1e-6


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
    """Unseen cells on tubes [c], at the worst place of each: with one cell to spare, and exactly (0 where `wide` is)."""

    wide: Integers
    exact: Integers

    def rows(self, chosen: slice) -> Hidden:
        """The counts of some tubes."""
        return Hidden(self.wide[chosen], self.exact[chosen])

    def permits(self, others: Hidden) -> Booleans:
        """Which tubes lead through no more than this one."""
        permitted: Booleans = (others.wide <= self.wide) & (others.exact <= self.exact)
        return permitted


class Sight:
    """Counts unseen cells under the hull."""

    def __init__(self, config: SafetyConfig) -> None:
        longest = config.stop_distance_m(2.0 * config.max_horizontal_speed_m_s)
        self._shares = np.linspace(0.0, 1.0, math.ceil(longest / STEP_M) + 1)

    def lost(self, position: CorridorVector, view: View) -> bool:
        """Whether the vehicle is in unseen space."""
        x, y = np.array((position.x,)), np.array((position.y,))
        return bool(view.free.unseen(x, y, view.near_m, view.now_s, wide=False)[0])

    def permitted(self, brake: Hidden, tube: Tubes, hidden: Hidden, brake_stop_m: Floats, view: View) -> Booleans:
        """Which tubes, with their counts, may be flown: where braking leads through unseen cells, only those that lead out.

        Without that, commands each too small to reach another cell would carry the stop point on for ever. `brake_stop_m`
        [2 models, 3].
        """
        passed = brake.permits(hidden)
        if brake.exact[0] == 0 or not passed.any():
            return passed
        leading: Booleans = passed & ((hidden.exact == 0) | self._leads_out(tube, brake_stop_m[0, :2], view))
        return leading

    @staticmethod
    def _leads_out(tube: Tubes, stop_m: Floats, view: View) -> Booleans:
        """Which tubes move the stop point towards where fewer cells are unseen, or not at all."""
        way = tube.stop_m[0, :, :2] - stop_m
        length = np.hypot(way[:, 0], way[:, 1])
        ahead = np.concatenate((stop_m[None], stop_m + OUT_M * way / np.maximum(length, LEAST_WAY_M)[:, None]))
        count = view.free.unseen(ahead[:, 0], ahead[:, 1], view.near_m, view.now_s, wide=False)
        out: Booleans = (count[1:] < count[0]) | (length <= LEAST_WAY_M)
        return out

    def hidden(self, tube: Tubes, view: View) -> Hidden:
        """The unseen cells on each tube, of both models."""
        leg = tube.stop_m - tube.turn_m
        x, y = (tube.turn_m[..., axis, None] + leg[..., axis, None] * self._shares for axis in (0, 1))
        wide = view.free.unseen(x, y, view.near_m, view.now_s, wide=True).max(axis=(0, 2))
        if not wide.any():
            return Hidden(wide, wide)
        return Hidden(wide, view.free.unseen(x, y, view.near_m, view.now_s, wide=False).max(axis=(0, 2)))
