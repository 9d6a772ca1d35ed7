"""Brake tubes against the polygon fence: exact distances between the legs of a tube and the edges and vertices of the fence.

A tube's leg (turn to stop) is straight, since braking only shortens the velocity. Its least distance to an edge is at an end of
the leg, at an end of the edge, or zero where they cross; so edges are judged at the leg's ends, vertices along the whole leg, and
crossings on the whole way from the start of control. Only where something is outside already are signed depths needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.braking import Start, Tubes
from safety.fence import Booleans, PolygonFence, Segments
from safety.fence_far import FarInside
from safety.frames import CorridorVector

Floats = NDArray[np.float64]
_LEAST_M2 = 1e-12


@dataclass(frozen=True, slots=True)
class Room:
    """How much further than the erosion asks the vehicle is from the polygons, floor and ceiling, negative where too near, m."""

    sideways_m: float
    below_m: float
    above_m: float

    @property
    def least_m(self) -> float:
        """The least of them."""
        return min(self.sideways_m, self.below_m, self.above_m)


@dataclass(frozen=True, slots=True)
class NearFence:
    """The part of the fence that matters this tick.

    `edges` [e], `vertices` [e]: within reach; `pieces` [2 e]: both. `outside`: control begins on the forbidden side of some
    polygon.
    """

    edges: Segments
    vertices: Segments
    pieces: Segments
    outside: bool


@dataclass(frozen=True, slots=True)
class WaysOut:
    """Near pieces of the fence as braking meets them: unit vectors [2, h] to the allowed side, room beyond the erosion [h], m."""

    normals: Floats
    room_m: Floats


NO_WAYS = WaysOut(np.empty((2, 0)), np.empty(0))


class FenceGuard:
    """An eroded fence between two heights, asked about brake tubes."""

    def __init__(self, fence: PolygonFence, low_z_m: float, high_z_m: float) -> None:
        self._fence, self._low_z, self._high_z = fence, low_z_m, high_z_m
        self._corner_m = float(fence.vertices.erosion_m[0])
        self._nothing = self._take(np.zeros(fence.edges.length_m.shape, dtype=np.bool_))
        self._taken, self._taken_key = self._nothing, b""
        self._far: FarInside | None = None

    def here(self, position: CorridorVector) -> Room:
        """What room the vehicle has now. Measured anew only where it may be outside, or has left what was measured last."""
        place = (position.x, position.y)
        below, above = position.z - self._low_z, self._high_z - position.z
        if self._far is None or not self._far.clear_of(0.0, place):
            measured = self._fence.measured(np.array((place,)))
            self._far = FarInside.at(place, measured, 0, self._fence) if measured.margin_m.min() > 0.0 else None
            if self._far is None:
                return Room(float(measured.room_m(self._fence)[0]), below, above)
        return Room(self._far.room_m(place), below, above)

    def look(self, position: CorridorVector, start: Start, reach_m: float) -> NearFence:
        """Take what tubes from `start` can come near to when they reach `reach_m`, and all of a polygon already breached."""
        fence, place, within_m = self._fence, (position.x, position.y), reach_m + self._corner_m
        begins = start.position_m[:, :2]
        far_m = within_m + max(math.dist(place, begin) for begin in begins.tolist())
        if self._far is not None and self._far.clear_of(far_m, place):
            return NearFence(*self._nothing, outside=False)
        measured = fence.measured(begins)
        near = measured.edge_m.min(axis=0) < within_m
        breached = measured.margin_m.min(axis=0) < 0.0
        outside = bool(breached.any())
        if outside:
            near |= breached[fence.edges.ring]
        if near.tobytes() != self._taken_key:  # mostly the same pieces as a tick ago: kept
            self._taken, self._taken_key = self._take(near), near.tobytes()
        return NearFence(*self._taken, outside)

    def _take(self, near: Booleans) -> tuple[Segments, Segments, Segments]:
        """Some edges, their first vertices, and both."""
        edges, vertices = self._fence.edges.taken(near), self._fence.vertices.taken(near)
        return edges, vertices, edges.followed_by(vertices)

    def rooms_m(self, tube: Tubes, start: Start, near: NearFence) -> Floats:
        """Least room beyond the erosion of tubes at each near edge and vertex, then floor and ceiling, [c, 2 e + 2], m."""
        z = np.concatenate((tube.turn_m[..., 2], tube.stop_m[..., 2]))
        heights = np.array((z.min(axis=0) - self._low_z, self._high_z - z.max(axis=0))).T
        if near.edges.length_m.shape[0] == 0:
            return heights
        return np.concatenate((self._sideways_m(tube, start, near), heights), axis=1)

    def _sideways_m(self, tube: Tubes, start: Start, near: NearFence) -> Floats:
        edges, ends = near.edges, np.stack((tube.turn_m[..., :2], tube.stop_m[..., :2]))
        along, across = edges.along_across(ends[..., 0], ends[..., 1])
        to_edges = edges.distances_m(along, across).min(axis=0)
        to_vertices = _leg_to_vertices_m(ends, near.vertices)
        crossed = _crossed(edges, along, across, start)
        distance = np.concatenate((np.where(crossed, 0.0, to_edges), to_vertices), axis=-1).min(axis=0)
        rooms: Floats = distance - near.pieces.erosion_m
        if near.outside or crossed.any():
            return self._with_depths(rooms, ends, near)
        return rooms

    def _with_depths(self, rooms: Floats, ends: Floats, near: NearFence) -> Floats:
        """Rooms where a tube's leg may end outside: a breached polygon counts by its depth alone, at all its edges alike."""
        pieces = near.pieces
        depth = self._fence.ring_margins_m(ends).min(axis=(0, 1))[:, pieces.ring]
        signed: Floats = np.where(depth < 0.0, depth - pieces.erosion_m, rooms)
        return signed

    def ways_out(self, tube: Tubes, near: NearFence) -> WaysOut:
        """For each near edge and vertex, where the last tube (braking) is nearest to it: the way to the allowed side, and room.

        Of a polygon that is breached there, only the nearest piece counts.
        """
        pieces = near.pieces
        if pieces.length_m.shape[0] == 0:
            return NO_WAYS
        points = np.concatenate((tube.turn_m[:, -1, :2], tube.stop_m[:, -1, :2]))
        along, across = pieces.along_across(points[:, 0], points[:, 1])
        distance = pieces.distances_m(along, across)
        breached = (self._fence.ring_margins_m(points) < 0.0)[:, pieces.ring]
        signed = np.where(breached, -distance, distance)
        signed[breached & ~_nearest_of_its_ring(distance, pieces.ring)] = np.inf
        worst, column = np.argmin(signed, axis=0), np.arange(pieces.length_m.shape[0])
        normals = _normals(points[worst], along[worst, column], pieces, breached[worst, column])
        room = signed[worst, column] - pieces.erosion_m
        met = np.isfinite(room)
        return WaysOut(normals[:, met], room[met])


def _leg_to_vertices_m(ends: Floats, vertices: Segments) -> Floats:
    """Distances from straight legs [2 ends, ..., 2] to lone vertices [..., v], m."""
    rx, ry = vertices.x_m - ends[0, ..., 0, None], vertices.y_m - ends[0, ..., 1, None]
    leg = ends[1] - ends[0]
    dx, dy = leg[..., 0, None], leg[..., 1, None]
    share = np.clip((rx * dx + ry * dy) / np.maximum(dx * dx + dy * dy, _LEAST_M2), 0.0, 1.0)
    rx -= share * dx
    ry -= share * dy
    distance: Floats = np.sqrt(rx * rx + ry * ry)
    return distance


def _crossed(edges: Segments, along: Floats, across: Floats, start: Start) -> Booleans:
    """Which edges [2 models, c, e] are crossed on the way start, turn, stop; `along`, `across` [2 ends, 2 models, c, e]."""
    begin_along, begin_across = edges.along_across(start.position_m[:, None, 0], start.position_m[:, None, 1])
    step = _crossing(edges, begin_along, begin_across, along[0], across[0])
    return step | _crossing(edges, along[0], across[0], along[1], across[1])


def _crossing(edges: Segments, along_a: Floats, across_a: Floats, along_b: Floats, across_b: Floats) -> Booleans:
    """Whether straight ways from a to b cross the segments themselves."""
    changed: Booleans = (across_a < 0.0) != (across_b < 0.0)
    if not np.count_nonzero(changed):
        return changed
    share = across_a / np.where(changed, across_a - across_b, 1.0)
    at = along_a + share * (along_b - along_a)
    crossing: Booleans = changed & (at >= 0.0) & (at <= edges.length_m)
    return crossing


def _nearest_of_its_ring(distance: Floats, ring: NDArray[np.intp]) -> Booleans:
    """Which pieces [p, s] are the nearest one of their ring."""
    nearest = np.zeros(distance.shape, dtype=np.bool_)
    rows = np.arange(distance.shape[0])
    for which in np.unique(ring):
        own = np.flatnonzero(ring == which)
        nearest[rows, own[np.argmin(distance[:, own], axis=1)]] = True
    return nearest


def _normals(points: Floats, along: Floats, pieces: Segments, breached: Booleans) -> Floats:
    """Unit vectors [2, s] from the nearest place of each piece to its point [s, 2], turned round where breached."""
    share = np.minimum(np.maximum(along, 0.0), pieces.length_m)
    away = np.stack((points[:, 0] - pieces.x_m - share * pieces.ux, points[:, 1] - pieces.y_m - share * pieces.uy))
    length = np.sqrt((away * away).sum(axis=0))
    left = np.stack((-pieces.uy, pieces.ux))  # for a point right on the fence
    on_it = length * length < _LEAST_M2
    turned: Floats = np.where(on_it, left, np.where(breached, -1.0, 1.0) * away / np.where(on_it, 1.0, length))
    return turned
