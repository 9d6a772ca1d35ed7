"""Far inside the fence: its room from the few pieces that can be nearest, without measuring all of them at every tick.

Distances change no faster than the place. So what was measured somewhere tells, for all places within `WITHIN_M` of it, which
edges and vertices can be the nearest one, and how far away everything is at least. The few are then measured exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from safety.fence import Measured, PolygonFence, Vertex

WITHIN_M = 0.5
_ROUNDING_M = 1e-6


@dataclass(frozen=True, slots=True)
class _Piece:
    """An edge of the fence as plain numbers; a vertex where `vertex`, and then direction and length do not matter."""

    x_m: float
    y_m: float
    ux: float
    uy: float
    length_m: float
    erosion_m: float
    vertex: bool

    def room_m(self, x_m: float, y_m: float) -> float:
        """Distance of a place less the erosion, in the very steps of `Segments` and `PolygonFence.measured`."""
        rx, ry = x_m - self.x_m, y_m - self.y_m
        if self.vertex:
            return math.sqrt(rx * rx + ry * ry) - self.erosion_m
        along, across = rx * self.ux + ry * self.uy, ry * self.ux - rx * self.uy
        beyond = max(-along, along - self.length_m, 0.0)
        return math.sqrt(across * across + beyond * beyond) - self.erosion_m


@dataclass(frozen=True, slots=True)
class FarInside:
    """What was measured at a place inside the fence. `edge_m`: to the nearest edge there; `pieces`: all that can be nearest."""

    x_m: float
    y_m: float
    edge_m: float
    pieces: tuple[_Piece, ...]

    @staticmethod
    def at(place: Vertex, measured: Measured, row: int, fence: PolygonFence) -> FarInside:
        """Kept from a row of points measured, which must lie inside."""
        rooms = (measured.edge_m[row] - fence.edges.erosion_m, measured.vertex_m[row] - fence.vertices.erosion_m)
        most = min(float(room.min()) for room in rooms) + 2.0 * WITHIN_M + _ROUNDING_M
        pieces: list[_Piece] = []
        for segments, room, vertex in zip((fence.edges, fence.vertices), rooms, (False, True), strict=True):
            few = segments.taken(room <= most)
            columns = (few.x_m, few.y_m, few.ux, few.uy, few.length_m, few.erosion_m)
            for x, y, ux, uy, length, erosion in np.stack(columns, axis=1).tolist():
                pieces.append(_Piece(x, y, ux, uy, length, erosion, vertex))
        return FarInside(*place, float(measured.edge_m[row].min()), tuple(pieces))

    def clear_of(self, distance_m: float, place: Vertex) -> bool:
        """Whether every edge is further than a distance from a place near by, which is then inside like this one."""
        moved = math.dist((self.x_m, self.y_m), place)
        return moved < WITHIN_M and self.edge_m - moved > distance_m + _ROUNDING_M

    def room_m(self, place: Vertex) -> float:
        """Least room of a place near by, m: what `Measured.room_m` says there."""
        return min(piece.room_m(*place) for piece in self.pieces)
