"""The fence as the judge sees it: rings, floor and ceiling. Written for this campaign alone, shares no code with `safety`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
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
        found = _turning(self.outer, -1.0)
        for hole in self.holes:
            found += _turning(hole, 1.0)
        return np.array(found, dtype=np.float64).reshape(-1, 2)

    def inside(self, x: float, y: float) -> bool:
        """Whether a point lies in the free area, by the even-odd rule over all rings."""
        return bool(_boundary(self.edges, x, y)[2])

    def nearest(self, x: float, y: float) -> Point:
        """The point of the boundary nearest to (x, y)."""
        foot_x, foot_y, _ = _boundary(self.edges, x, y)
        return float(foot_x), float(foot_y)

    def margin_m(self, place: Place | Array, radius_m: float, half_height_m: float) -> float:
        """Distance of an upright cylinder inside the fence, negative where any part of it is outside, m."""
        x, y, z = place
        foot_x, foot_y, inside = _boundary(self.edges, x, y)
        side = math.hypot(x - foot_x, y - foot_y) * (1.0 if inside else -1.0)
        return min(side - radius_m, z - half_height_m - self.z_low_m, self.z_high_m - z - half_height_m)


@njit(cache=True)
def _boundary(edges: Array, x: float, y: float) -> tuple[float, float, bool]:
    """Nearest point of the edges [e, 4] to (x, y), and whether (x, y) is inside, by crossings of a ray along x."""
    best, foot_x, foot_y, inside = math.inf, 0.0, 0.0, False
    for i in range(edges.shape[0]):
        ax, ay, bx, by = edges[i]
        dx, dy = bx - ax, by - ay
        share = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)))
        px, py = ax + share * dx, ay + share * dy
        distance = (x - px) ** 2 + (y - py) ** 2
        if distance < best:
            best, foot_x, foot_y = distance, px, py
        if (ay > y) != (by > y) and x < ax + (y - ay) / dy * dx:
            inside = not inside
    return foot_x, foot_y, inside


@njit(cache=True)
def to_nearest_box(boxes: Array, x: float, y: float) -> tuple[float, float]:
    """Horizontal vector from (x, y) to the nearest surface of `boxes` [n, 6]; zero inside one."""
    best, best_x, best_y = math.inf, math.inf, math.inf
    for i in range(boxes.shape[0]):
        dx, dy = min(max(x, boxes[i, 0]), boxes[i, 3]) - x, min(max(y, boxes[i, 1]), boxes[i, 4]) - y
        if dx * dx + dy * dy < best:
            best, best_x, best_y = dx * dx + dy * dy, dx, dy
    return best_x, best_y


def _turning(ring: Ring, sense: float) -> list[Point]:
    """Vertices at which a ring, walked counter-clockwise, turns to the left (`sense` 1) or to the right (-1)."""
    points = np.array(ring)
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    nxt = np.roll(points, -1, axis=0)
    area = float((points[:, 0] * nxt[:, 1] - nxt[:, 0] * points[:, 1]).sum())
    return [ring[i] for i in range(len(ring)) if turn[i] * math.copysign(1.0, area) * sense > 0.0]
