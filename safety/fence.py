"""The fence from above: one inclusion polygon less any number of exclusion polygons, with exact distances to its true edges.

Allowed is what lies inside the inclusion polygon and in no exclusion polygon. There is one inclusion polygon only: with several,
older PX4 wants a vehicle inside any of them and newer PX4 inside all, so one is what both judge the same. Polygons are simple,
may be concave, in either order; exclusions may overlap each other and the inclusion's edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Vertex = tuple[float, float]
Ring = tuple[Vertex, ...]
SEARCH_STEP_M = 0.005  # a place left over by erosion that is smaller than this is not looked for
SEARCH_SHARE = 2.0**-11  # the same, of the fence's longer side
MOST_CELLS = 256.0  # along one side, to begin with


def signed_area_m2(ring: Sequence[Vertex]) -> float:
    """Area of a polygon, positive when its vertices go counter-clockwise (shoelace formula about the first vertex)."""
    x0, y0 = ring[0]
    return 0.5 * sum((ax - x0) * (by - y0) - (bx - x0) * (ay - y0) for (ax, ay), (bx, by) in pairwise(ring))


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight pieces of outline [s]: begin, unit direction, length (0: a lone vertex), the ring each belongs to.

    Allowed space is on the left. `erosion_m`: how far the vehicle's centre stays away.
    """

    x_m: Floats
    y_m: Floats
    ux: Floats
    uy: Floats
    length_m: Floats
    ring: NDArray[np.intp]
    erosion_m: Floats

    def taken(self, which: Booleans) -> Segments:
        """Only some of them."""
        return Segments(*(getattr(self, name)[which] for name in self.__slots__))

    def followed_by(self, other: Segments) -> Segments:
        """These, then others."""
        return Segments(*(np.concatenate((getattr(self, name), getattr(other, name))) for name in self.__slots__))

    def along_across(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Points [...] seen from each segment [..., s]: how far along its direction, and how far to the left of its line, m."""
        rx, ry = x_m[..., None] - self.x_m, y_m[..., None] - self.y_m
        return rx * self.ux + ry * self.uy, ry * self.ux - rx * self.uy

    def distances_m(self, along_m: Floats, across_m: Floats) -> Floats:
        """Distances to the segments themselves, never to their lines, m."""
        beyond = np.maximum(np.maximum(-along_m, along_m - self.length_m), 0.0)
        distance: Floats = np.sqrt(across_m * across_m + beyond * beyond)
        return distance


@dataclass(frozen=True, slots=True)
class Measured:
    """Points [...] against a fence: signed margin per ring [..., r], distance to each edge and its first vertex [..., e], m."""

    margin_m: Floats
    edge_m: Floats
    vertex_m: Floats

    def room_m(self, fence: PolygonFence) -> Floats:
        """Least room beyond the erosion [...], m."""
        edge, vertex = self.edge_m - fence.edges.erosion_m, self.vertex_m - fence.vertices.erosion_m
        worst = self.margin_m.min(axis=-1)
        inside = np.minimum(edge, vertex).min(axis=-1)
        room: Floats = np.where(worst >= 0.0, inside, worst - fence.edges.erosion_m.min())
        return room


class PolygonFence:
    """Inclusion and exclusion polygons as segments: `edges` ring after ring, the inclusion first, and one vertex per edge.

    The vehicle is a circle of `radius_m`. `slack_m` is a bound per axis of what else is kept free (position error and margin): it
    counts by its extent across an edge, and by its diagonal at a vertex. The polygons must have passed `fence_rules`.
    """

    def __init__(self, inclusion: Ring, exclusions: Sequence[Ring], radius_m: float = 0.0, slack_m: float = 0.0) -> None:
        rings = [np.array(_turned(inclusion, 1.0))] + [np.array(_turned(ring, -1.0)) for ring in exclusions]
        begin = np.concatenate(rings)
        end = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
        way = end - begin
        length = np.hypot(way[:, 0], way[:, 1])
        ux, uy = way[:, 0] / length, way[:, 1] / length
        ring = np.repeat(np.arange(len(rings)), [len(r) for r in rings])
        erosion = radius_m + slack_m * (np.abs(ux) + np.abs(uy))
        corner = np.full(length.shape, radius_m + slack_m * math.sqrt(2.0))
        self.edges = Segments(begin[:, 0], begin[:, 1], ux, uy, length, ring, erosion)
        self.vertices = Segments(begin[:, 0], begin[:, 1], ux, uy, np.zeros(length.shape), ring, corner)
        self._end_y = end[:, 1]
        self._first = np.flatnonzero(np.diff(ring, prepend=-1))
        self._keeps_in = np.arange(len(rings)) == 0

    def ring_margins_m(self, points_m: Floats) -> Floats:
        """Distance of points [..., 2] to the nearest edge of each ring [..., r], negative on its forbidden side, m."""
        return self.measured(np.asarray(points_m, dtype=np.float64)).margin_m

    def signed_margin_m(self, points_m: Floats) -> Floats:
        """Distance of points [..., 2] to the nearest edge [...], negative outside: deepest breach of any polygon, m."""
        margin: Floats = self.ring_margins_m(points_m).min(axis=-1)
        return margin

    def room_m(self, points_m: Floats) -> Floats:
        """How much further points [..., 2] are inside than the erosion asks [...], negative where too little, m."""
        return self.measured(np.asarray(points_m, dtype=np.float64)).room_m(self)

    def measured(self, points: Floats) -> Measured:
        """Points [..., 2] against everything. Inside a polygon is where a way towards +x meets an odd number of its edges."""
        edges = self.edges
        rx, ry = points[..., 0, None] - edges.x_m, points[..., 1, None] - edges.y_m
        across = ry * edges.ux - rx * edges.uy
        edge = edges.distances_m(rx * edges.ux + ry * edges.uy, across)
        begins_below, ends_below = ry >= 0.0, points[..., 1, None] >= self._end_y
        crossed = (begins_below != ends_below) & ((across > 0.0) == begins_below) & (across != 0.0)
        enclosed = np.logical_xor.reduceat(crossed, self._first, axis=-1)
        nearest = np.minimum.reduceat(edge, self._first, axis=-1)
        return Measured(np.where(enclosed == self._keeps_in, nearest, -nearest), edge, np.sqrt(rx * rx + ry * ry))

    def roomiest(self) -> Vertex | None:
        """A place with room for the vehicle, or None: cells are halved as long as room may hide in them (room is 1-Lipschitz)."""
        edges = self.edges
        low = np.array((edges.x_m.min(), edges.y_m.min()))
        size = np.array((edges.x_m.max(), edges.y_m.max())) - low
        smallest = max(SEARCH_STEP_M, SEARCH_SHARE * float(size.max()))
        counts = np.minimum(np.ceil(size / size.min()), MOST_CELLS)
        steps = size / counts
        grid = np.stack(np.meshgrid(*(np.arange(count) + 0.5 for count in counts), indexing="ij"), axis=-1).reshape(-1, 2)
        cells = low + grid * steps
        while cells.shape[0]:
            room = self.room_m(cells)
            best = int(np.argmax(room))
            if room[best] > 0.0:
                return float(cells[best, 0]), float(cells[best, 1])
            if steps.max() < smallest:
                return None
            hopeful = cells[room + 0.5 * math.hypot(*steps) > 0.0]
            steps = 0.5 * steps
            quarters = 0.5 * steps * np.array(((-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)))
            cells = (hopeful[:, None, :] + quarters).reshape(-1, 2)
        return None


@lru_cache(maxsize=64)
def polygon_fence(inclusion: Ring, exclusions: tuple[Ring, ...], radius_m: float = 0.0, slack_m: float = 0.0) -> PolygonFence:
    """The same fence again costs nothing."""
    return PolygonFence(inclusion, exclusions, radius_m, slack_m)


def _turned(ring: Ring, sense: float) -> Ring:
    """The ring counter-clockwise (sense 1) or clockwise (-1)."""
    return ring if signed_area_m2(ring) * sense > 0.0 else ring[::-1]
