"""What stands in the world: boxes, boxes that move, start and goal. Data only; `corridor` and `world` make them.

A box is a float64 row (xmin, ymin, zmin, xmax, ymax, zmax) in the corridor frame, metres.
A mover is a float64 row (columns `MOVER_*`), so that compiled loops over many environments can place it without objects.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

Boxes = NDArray[np.float64]
Point = tuple[float, float, float]

# columns of a mover row: size 3 (m), centre x (m), centre z (m), lowest and highest centre y (m), speed (m/s), phase (m)
MOVER_SIZE, MOVER_X, MOVER_Z, MOVER_Y_LOW, MOVER_Y_HIGH, MOVER_SPEED, MOVER_PHASE = 0, 3, 4, 5, 6, 7, 8
MOVER_COLUMNS = 9


@njit(cache=True)
def place_movers(movers: NDArray[np.float64], count: int, time_s: float, out: Boxes) -> None:
    """Write the boxes of the first `count` rows of `movers` [>=count, 9] at `time_s` into `out` [>=count, 6]."""
    for i in range(count):
        row = movers[i]
        span = row[MOVER_Y_HIGH] - row[MOVER_Y_LOW]
        y = row[MOVER_Y_LOW]
        if span > 0.0:
            travelled = (row[MOVER_PHASE] + row[MOVER_SPEED] * time_s) % (2.0 * span)
            y += min(travelled, 2.0 * span - travelled)
        centre = (row[MOVER_X], y, row[MOVER_Z])
        for axis in range(3):
            out[i, axis] = centre[axis] - 0.5 * row[MOVER_SIZE + axis]
            out[i, 3 + axis] = centre[axis] + 0.5 * row[MOVER_SIZE + axis]


@dataclass(frozen=True, slots=True)
class Mover:
    """A box that goes back and forth along y at constant speed: its place is a triangle wave, a pure function of time.

    `size_m`: x, y, z. `x_m`, `z_m`: centre. `y_low_m`..`y_high_m`: where the centre turns. `phase_m`: distance already
    travelled at time 0, counted from `y_low_m` up to `y_high_m` and back.
    """

    size_m: Point
    x_m: float
    z_m: float
    y_low_m: float
    y_high_m: float
    speed_m_s: float
    phase_m: float = 0.0

    def as_row(self) -> NDArray[np.float64]:
        """The mover as one float64 row [9], see the `MOVER_*` columns."""
        return np.array([*self.size_m, self.x_m, self.z_m, self.y_low_m, self.y_high_m, self.speed_m_s, self.phase_m])

    def box_at(self, time_s: float) -> Boxes:
        """The box [6] at `time_s`."""
        out = np.empty((1, 6))
        place_movers(self.as_row()[None, :], 1, time_s, out)
        return np.asarray(out[0], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One world. The floor is the plane z = 0 and no box; walls are boxes among `static_boxes`.

    `static_boxes`: float64 [n, 6]. `start`: on the ground, z = 0. `goal`: in the air. Arrays are read-only.
    """

    name: str
    seed: int
    length_m: float
    width_m: float
    height_m: float
    static_boxes: Boxes
    movers: tuple[Mover, ...]
    start: Point
    start_yaw_rad: float
    goal: Point
    mover_rows: NDArray[np.float64] = field(init=False)

    def __post_init__(self) -> None:
        boxes = np.ascontiguousarray(self.static_boxes, dtype=np.float64).reshape(-1, 6).copy()
        if not np.isfinite(boxes).all() or (boxes[:, 3:] < boxes[:, :3]).any():
            raise ValueError("static_boxes: each row must be finite and have min <= max on every axis")
        rows = np.stack([m.as_row() for m in self.movers]) if self.movers else np.empty((0, MOVER_COLUMNS))
        for name, array in (("static_boxes", boxes), ("mover_rows", rows)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def boxes_at(self, time_s: float) -> Boxes:
        """All boxes at `time_s`, static ones first: float64 [n + movers, 6]."""
        fixed = len(self.static_boxes)
        out = np.empty((fixed + len(self.movers), 6))
        out[:fixed] = self.static_boxes
        place_movers(self.mover_rows, len(self.movers), time_s, out[fixed:])
        return out


def box_row(centre: Iterable[float], size: Iterable[float]) -> list[float]:
    """(xmin, ymin, zmin, xmax, ymax, zmax) of a box given by centre and size, metres."""
    pairs = list(zip(centre, size, strict=True))
    return [c - 0.5 * s for c, s in pairs] + [c + 0.5 * s for c, s in pairs]
