"""Unseen cells in a window of the map, and how many of them the hull touches: sums over boxes, made once for many places."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]
Booleans = NDArray[np.bool_]
Counts = NDArray[np.signedinteger]
Window = tuple[int, int, int, int]  # of cells: the first ones, and those after the last

CELL_M = 0.1
SURFACE_CELLS = 2  # cells this near to a known return belong to it


@dataclass(frozen=True, slots=True)
class Known:
    """The cells of a window of the map, `low_x`, `low_y` its first cell, that belong to known returns [2, k]."""

    near_m: Floats
    low_x: int
    low_y: int
    mask: Booleans

    def holds(self, low_x: int, low_y: int, high_x: int, high_y: int, near_m: Floats) -> bool:
        """Whether it was made for the same returns and is large enough."""
        rows, columns = self.mask.shape
        inside = low_x >= self.low_x and low_y >= self.low_y and high_x <= self.low_x + rows and high_y <= self.low_y + columns
        return inside and near_m is self.near_m


@dataclass(frozen=True, slots=True)
class Patch:
    """The unseen cells of a window of the map at one moment. Every tube of a tick asks here, so sums are made once.

    `counts`: per kernel, what the hull would touch with its centre in each cell.
    """

    known: Known
    hidden: Booleans
    counts: dict[bool, Counts] = field(default_factory=dict)

    def sparing(self, places_m: Floats, boxes: Integers) -> Patch:
        """The same without the cells of the boxes around places [2, n]."""
        hidden, cells = self.hidden.copy(), cells_of(places_m)
        _clear(hidden, boxes, cells[0] - self.known.low_x, cells[1] - self.known.low_y)
        return Patch(self.known, hidden)

    def part(self, low_x: int, low_y: int, high_x: int, high_y: int) -> Booleans:
        """The unseen cells of a smaller window."""
        x, y = self.known.low_x, self.known.low_y
        return self.hidden[low_x - x : high_x - x, low_y - y : high_y - y]

    def counted(self, cells: Integers, boxes: Integers, rim: int, wide: bool) -> Counts:
        """The weighted sums of a kernel's boxes at cells [2, ...]."""
        if wide not in self.counts:
            self.counts[wide] = _box_counts(self.hidden, boxes, rim)
        found: Counts = self.counts[wide][cells[0] - (self.known.low_x + rim), cells[1] - (self.known.low_y + rim)]
        return found


def surfaces(near_m: Floats, low_x: int, low_y: int, shape: tuple[int, ...]) -> Booleans:
    """Cells of a window, whose first cell is given, that belong to known returns."""
    border = SURFACE_CELLS + 1  # what is further out than the border lands in its outermost cells, and those are left off
    rows, columns = shape[0] + 2 * border, shape[1] + 2 * border
    at = cells_of(near_m) - np.array(((low_x - border,), (low_y - border,)))
    at = np.minimum(np.maximum(at, 0), np.array(((rows - 1,), (columns - 1,))))
    mask = np.zeros((rows, columns), dtype=np.bool_)
    mask.reshape(-1)[at[0] * columns + at[1]] = True
    return _widened(_widened(mask[1:-1, 1:-1]).T).T


def _widened(mask: Booleans) -> Booleans:
    """Rows, less a border of `SURFACE_CELLS` on either side, in which a cell is set when one within the border's width was."""
    twice = mask[:-1] | mask[1:]
    four = twice[:-2] | twice[2:]
    return four[:-1] | mask[4:]


def cells_of(places_m: Floats) -> Integers:
    """The cells [2, ...] in which places [2, ...] lie."""
    cells: Integers = np.floor(places_m / CELL_M).astype(np.intp)
    return cells


def window_around(cells: Integers, rim: int) -> Window:
    """All that the hull could touch with its centre in cells [2, ...]."""
    flat = cells.reshape(2, -1)
    (low_x, low_y), (high_x, high_y) = np.minimum.reduce(flat, axis=1).tolist(), np.maximum.reduce(flat, axis=1).tolist()
    return low_x - rim, low_y - rim, high_x + rim + 1, high_y + rim + 1


def boxes_within(radius_m: float) -> Integers:
    """Half sides [b, 2], in cells, of boxes that together are all cells within a radius of any point of the middle cell."""
    reach = radius_m / CELL_M
    widths = [(i, 1 + math.floor(math.sqrt(reach * reach - max(i - 1, 0) ** 2))) for i in range(math.floor(reach) + 2)]
    corners = [box for box, after in zip(widths, [*widths[1:], (0, -1)], strict=True) if after[1] < box[1]]
    return np.array(corners)


def cells_in(boxes: Integers, rim: int) -> Booleans:
    """Which cells of a square, up to `rim` from the middle one, lie in any of the boxes around it."""
    middle = np.ones((2 * rim + 1, 2 * rim + 1), dtype=np.bool_)
    _clear(middle, boxes, np.array([rim]), np.array([rim]))
    return ~middle


def _clear(hidden: Booleans, boxes: Integers, i: Integers, j: Integers) -> None:
    """Take the cells of the boxes around middle cells i, j [n], which may lie outside the window, out of the hidden ones."""
    for row, column in set(zip(i.tolist(), j.tolist(), strict=True)):
        for a, b in boxes.tolist():
            hidden[max(row - a, 0) : max(row + a + 1, 0), max(column - b, 0) : max(column + b + 1, 0)] = False


def _box_counts(hidden: Booleans, boxes: Integers, rim: int) -> Counts:
    """Sum over the boxes of the hidden cells inside, for each middle cell at least `rim` from the border."""
    total = np.zeros((hidden.shape[0] + 1, hidden.shape[1] + 1), dtype=np.int32)
    hidden.cumsum(axis=0, dtype=np.int32).cumsum(axis=1, out=total[1:, 1:])
    rows, columns = hidden.shape[0] - 2 * rim, hidden.shape[1] - 2 * rim
    counts = np.zeros((rows, columns), dtype=np.int32)
    for a, b in boxes.tolist():
        top, bottom = slice(rim - a, rim - a + rows), slice(rim + a + 1, rim + a + 1 + rows)
        left, right = slice(rim - b, rim - b + columns), slice(rim + b + 1, rim + b + 1 + columns)
        counts += total[bottom, right] - total[top, right]
        counts += total[top, left] - total[bottom, left]
    return counts
