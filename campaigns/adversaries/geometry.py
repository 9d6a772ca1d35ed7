"""The fence as the judge sees it: rings, floor and ceiling. Written for this campaign alone, shares no code with `safety`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Point = tuple[float, float]
Ring = tuple[Point, ...]
Place = tuple[float, float, float]


@dataclass(frozen=True)
class FenceShape:
    """Stay inside `outer`, outside every one of `holes`, between `z_low_m` and `z_high_m`. Rings in either sense, not closed."""

    outer: Ring
    z_low_m: float
    z_high_m: float
    holes: tuple[Ring, ...] = ()

    @staticmethod
    def box(low: Place, high: Place) -> FenceShape:
        """An upright box between two corners."""
        ring = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        return FenceShape(ring, low[2], high[2])

    @cached_property
    def edges(self) -> Array:
        """All edges of all rings [e, 4]: x, y of begin, x, y of end."""
        rings = [np.array(ring) for ring in (self.outer, *self.holes)]
        return np.concatenate([np.hstack((ring, np.roll(ring, -1, axis=0))) for ring in rings])

    @cached_property
    def corners(self) -> Array:
        """All vertices [n, 2]."""
        return np.array([point for ring in (self.outer, *self.holes) for point in ring])

    @cached_property
    def reflex_corners(self) -> Array:
        """Vertices [r, 2] that stick into the free space: where a path can be cut short."""
        found = [point for point in _turning(self.outer, -1.0)]
        for hole in self.holes:
            found += _turning(hole, 1.0)
        return np.array(found, dtype=np.float64).reshape(-1, 2)

    def inside(self, x: float, y: float) -> bool:
        """Whether a point lies in the free area, by the even-odd rule over all rings."""
        crossings = 0
        for ax, ay, bx, by in self.edges.tolist():
            if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
                crossings += 1
        return crossings % 2 == 1

    def nearest(self, x: float, y: float) -> Point:
        """The point of the boundary nearest to (x, y)."""
        a, b = self.edges[:, :2], self.edges[:, 2:]
        leg, to = b - a, np.array((x, y)) - a
        share = np.clip((to * leg).sum(axis=1) / (leg * leg).sum(axis=1), 0.0, 1.0)
        feet = a + share[:, None] * leg
        best = feet[int(np.argmin(((feet - (x, y)) ** 2).sum(axis=1)))]
        return float(best[0]), float(best[1])

    def margin_m(self, place: Place, radius_m: float, half_height_m: float) -> float:
        """Distance of an upright cylinder inside the fence, negative where any part of it is outside, m."""
        x, y, z = place
        foot = self.nearest(x, y)
        side = math.hypot(x - foot[0], y - foot[1]) * (1.0 if self.inside(x, y) else -1.0)
        return min(side - radius_m, z - half_height_m - self.z_low_m, self.z_high_m - z - half_height_m)


def _turning(ring: Ring, sense: float) -> list[Point]:
    """Vertices at which a ring, walked counter-clockwise, turns to the left (`sense` 1) or to the right (-1)."""
    points = np.array(ring)
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    nxt = np.roll(points, -1, axis=0)
    area = float((points[:, 0] * nxt[:, 1] - nxt[:, 0] * points[:, 1]).sum())
    return [ring[i] for i in range(len(ring)) if turn[i] * math.copysign(1.0, area) * sense > 0.0]
