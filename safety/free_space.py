"""Which places were recently seen free: a map of cells around the vehicle, in fixed space.

A cell counts as seen when a scan's beams went through all of it, or the vehicle itself was there; what was never seen, or too
long ago, is not free. Cells near a known return belong to that return, whose distance is checked to the millimetre elsewhere.
Obstacles count as columns, so the map is flat. With moving obstacles the unseen grows into the seen at their speed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.lidar import SeenScan

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]
Booleans = NDArray[np.bool_]

CELL_M = 0.1
SIDE_CELLS = 128
CARVE_M = 2.5  # a scan is taken in up to this far: a brake tube and the hull need less
RECENTRE_CELLS = 8  # the map follows the vehicle in steps of this size
SURFACE_CELLS = 2  # cells this near to a known return belong to it
TAKE_OFF_M = 0.9  # at engaging nothing may stand nearer to the vehicle's centre than this, unseen by the LiDAR
VICINITY_CELLS = 2  # around the swept hull: what is known there stays known while the vehicle stands
STEP_M = 0.2  # between the discs that stand for a swept hull
_REACH_ERROR_M = CELL_M * math.sqrt(2.0)  # of a cell's far corner, seen from anywhere in the cell of the LiDAR
_WIDEST_RAD = math.radians(60.0)  # nearer cells fill more of the view: they are the vehicle's own
NOWHERE = np.empty((2, 0))


class FreeSpace:
    """When each cell was last seen free, and how many unseen cells the hull would touch at given places."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        self._view = _ViewTemplate()
        self._seen_s = np.empty((SIDE_CELLS, SIDE_CELLS), dtype=np.float32)  # since the first scan; -inf = never
        self._spare = np.empty_like(self._seen_s)
        hull = config.vehicle_radius_m + config.position_error_m + config.velocity_error_m_s * config.delay_s + _sagitta_m(config)
        self._kernels = (_boxes(hull + CELL_M), _boxes(hull))
        self._rim = int(self._kernels[0].max())
        self._hull = _disc(config.vehicle_radius_m)
        self._vicinity = _disc(hull + (1 + VICINITY_CELLS) * CELL_M)
        self.clear()

    def clear(self) -> None:
        """Nothing was ever seen."""
        self._seen_s.fill(-np.inf)
        self._corner = (0, 0)
        self._began_s: float | None = None
        self._shrunk_s = 0.0

    def forget(self) -> None:
        """Nothing is known any more, in flight: unlike at engaging, nothing is taken for granted around the vehicle."""
        self._seen_s.fill(-np.inf)

    def update(self, seen: SeenScan) -> None:
        """Take in a scan: what its beams went through, and where the vehicle is."""
        if self._began_s is None:
            self._began_s, self._shrunk_s = seen.time_s, seen.time_s
            self._corner = (_cell(seen.origin_x_m) - SIDE_CELLS // 2, _cell(seen.origin_y_m) - SIDE_CELLS // 2)
            own = _disc(TAKE_OFF_M)
        else:
            self._follow(seen.origin_x_m, seen.origin_y_m)
            own = self._hull
        time_s = seen.time_s - self._began_s
        here = (_cell(seen.origin_x_m) - self._corner[0]) * SIDE_CELLS + _cell(seen.origin_y_m) - self._corner[1]
        cells = self._seen_s.reshape(-1)
        near = here + self._vicinity
        known = near[cells[near] >= time_s - self._config.memory_s]
        if self._config.obstacle_speed_m_s > 0.0:
            self._shrink(seen.time_s)
        cells[known] = time_s
        cells[here + own] = time_s
        cells[here + self._view.visible(seen, self._config)] = time_s

    def _follow(self, x_m: float, y_m: float) -> None:
        """Move the map by whole steps once the vehicle is more than a step off its centre."""
        shift = [
            int((_cell(p) - corner - SIDE_CELLS // 2) / RECENTRE_CELLS) * RECENTRE_CELLS
            for p, corner in zip((x_m, y_m), self._corner, strict=True)
        ]
        if not any(shift):
            return
        self._spare.fill(-np.inf)
        if max(abs(step) for step in shift) < SIDE_CELLS:
            (to_x, from_x), (to_y, from_y) = (_overlap(step) for step in shift)
            self._spare[to_x, to_y] = self._seen_s[from_x, from_y]
        self._seen_s, self._spare = self._spare, self._seen_s
        self._corner = (self._corner[0] + shift[0], self._corner[1] + shift[1])

    def _shrink(self, time_s: float) -> None:
        """A moving obstacle may have come out of the unseen: one cell from all sides per cell that it can have moved."""
        step_s = CELL_M / self._config.obstacle_speed_m_s
        steps = min(int((time_s - self._shrunk_s) / step_s), SIDE_CELLS)
        self._shrunk_s += steps * step_s
        for _ in range(steps):
            for grid in (self._seen_s, self._seen_s.T):
                np.minimum(grid[:-1], grid[1:], out=self._spare[:-1])
                np.minimum(self._spare[:-2], grid[2:], out=grid[1:-1])

    def unseen(self, x_m: Floats, y_m: Floats, near_m: Floats, now_s: float, wide: bool, spared_m: Floats = NOWHERE) -> Integers:
        """How many unseen cells the hull touches with its centre at x, y [...]; weighted, 0 = none.

        The hull with its errors, one cell more when `wide`. `near_m` [2, k]: known returns, whose surroundings count as known.
        `spared_m` [2, n]: cells that the hull touches with its centre there do not count.
        """
        boxes = self._kernels[0 if wide else 1]
        rim = int(boxes.max())
        ix, iy = self._indices(x_m, 0), self._indices(y_m, 1)
        low_x, low_y = int(ix.min()) - rim, int(iy.min()) - rim
        hidden = self._hidden(low_x, low_y, int(ix.max()) + rim + 1, int(iy.max()) + rim + 1, near_m, now_s)
        if hidden is None:
            return np.full(x_m.shape, SIDE_CELLS * SIDE_CELLS, dtype=np.intp)
        _clear(hidden, boxes, self._indices(spared_m[0], 0) - low_x, self._indices(spared_m[1], 1) - low_y)
        if not hidden.any():
            return np.zeros(x_m.shape, dtype=np.intp)
        counts: Integers = _box_counts(hidden, boxes, rim)[ix - (low_x + rim), iy - (low_y + rim)]
        return counts

    def all_seen_around(self, x_m: float, y_m: float, now_s: float) -> bool:
        """Whether every cell that the hull could touch around a place was seen: quick, and False where it must be counted."""
        i, j, rim = _cell(x_m) - self._corner[0], _cell(y_m) - self._corner[1], self._rim
        if min(i, j) < rim or max(i, j) >= SIDE_CELLS - rim or self._began_s is None:
            return False
        around = self._seen_s[i - rim : i + rim + 1, j - rim : j + rim + 1]
        return bool(around.min() >= now_s - self._began_s - self._config.memory_s)

    def gap_m(self, x_m: Floats, y_m: Floats, near_m: Floats, now_s: float) -> Floats:
        """Distance from places x, y [n] to the nearest unseen cell, m; what is further than the hull needs reads as that."""
        rim = self._rim
        ix, iy = self._indices(x_m, 0), self._indices(y_m, 1)
        low_x, low_y = int(ix.min()) - rim, int(iy.min()) - rim
        hidden = self._hidden(low_x, low_y, int(ix.max()) + rim + 1, int(iy.max()) + rim + 1, near_m, now_s)
        if hidden is None:
            return np.zeros(x_m.shape)
        i, j = np.nonzero(hidden)
        dx = np.abs(x_m[:, None] - CELL_M * (i + (low_x + self._corner[0] + 0.5))) - 0.5 * CELL_M
        dy = np.abs(y_m[:, None] - CELL_M * (j + (low_y + self._corner[1] + 0.5))) - 0.5 * CELL_M
        gaps: Floats = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0)).min(axis=1, initial=rim * CELL_M)
        return gaps

    def _indices(self, places_m: Floats, axis: int) -> Integers:
        cells: Integers = np.floor(places_m / CELL_M).astype(np.intp) - self._corner[axis]
        return cells

    def _hidden(self, low_x: int, low_y: int, high_x: int, high_y: int, near_m: Floats, now_s: float) -> Booleans | None:
        """The unseen cells of a window of the map that belong to no known return; None for a window that is not on the map."""
        if min(low_x, low_y) < 0 or max(high_x, high_y) > SIDE_CELLS or self._began_s is None:
            return None
        oldest_s = now_s - self._began_s - self._config.memory_s
        hidden: Booleans = self._seen_s[low_x:high_x, low_y:high_y] < oldest_s
        if near_m.shape[1] and hidden.any():
            hidden &= ~self._surfaces(near_m, low_x, low_y, hidden.shape)
        return hidden

    def _surfaces(self, near_m: Floats, low_x: int, low_y: int, shape: tuple[int, ...]) -> Booleans:
        """Cells of a window that belong to known returns."""
        border = SURFACE_CELLS
        mask = np.zeros((shape[0] + 2 * border, shape[1] + 2 * border), dtype=np.bool_)
        ix = self._indices(near_m[0], 0) - (low_x - border)
        iy = self._indices(near_m[1], 1) - (low_y - border)
        inside = (ix >= 0) & (iy >= 0) & (ix < mask.shape[0]) & (iy < mask.shape[1])
        mask[ix[inside], iy[inside]] = True
        rows = mask[: shape[0]].copy()
        for k in range(1, 2 * border + 1):
            rows |= mask[k : k + shape[0]]
        grown = rows[:, : shape[1]].copy()
        for k in range(1, 2 * border + 1):
            grown |= rows[:, k : k + shape[1]]
        return grown


class _ViewTemplate:
    """For each cell around the LiDAR: its bearing, how far a beam must have gone, and how many beams look at it."""

    def __init__(self) -> None:
        self._key: tuple[float, int] | None = None

    def _prepare(self, seen: SeenScan) -> None:
        key = (seen.angle_increment_rad, seen.free_m.shape[0])
        if key == self._key:
            return
        self._key, increment = key, seen.angle_increment_rad
        self._turn = math.ceil(2.0 * math.pi / increment - 1e-6)
        span = np.arange(-math.floor(CARVE_M / CELL_M), math.floor(CARVE_M / CELL_M) + 1)
        i, j = (part.reshape(-1) for part in np.meshgrid(span, span, indexing="ij"))
        distance = CELL_M * np.hypot(i, j)
        fits = (distance >= _REACH_ERROR_M / math.sin(_WIDEST_RAD)) & (distance + _REACH_ERROR_M <= CARVE_M)
        i, j, distance = i[fits], j[fits], distance[fits]
        beams = np.ceil(np.arcsin(_REACH_ERROR_M / distance) / increment) + 1.0  # half a beam of rounding, one of the turn's end
        level = np.ceil(np.log2(beams)).astype(np.intp)
        self._minima = np.zeros((int(level.max()) + 1, 3 * self._turn), dtype=np.float32)
        self._beam = (np.remainder(np.arctan2(j, i), 2.0 * math.pi) / increment + 0.5).astype(np.float32)
        self._row = level * self._minima.shape[1]
        self._needed_m = (distance + _REACH_ERROR_M).astype(np.float32)
        self._cell = i * SIDE_CELLS + j

    def visible(self, seen: SeenScan, config: SafetyConfig) -> Integers:
        """Offsets of the cells, relative to the LiDAR's, through all of which the beams of a scan went."""
        self._prepare(seen)
        self._fill_minima(_reaches(seen, config))
        first = (seen.yaw_rad + seen.angle_min_rad) / seen.angle_increment_rad
        beam = (self._beam + (self._turn - first % self._turn)).astype(np.intp)
        beam += self._row
        free: Integers = self._cell[self._minima.reshape(-1)[beam] >= self._needed_m]
        return free

    def _fill_minima(self, reach_m: Floats) -> None:
        """Row k: the shortest reach within 2^k beams on either side, over three turns so that no index wraps."""
        table, count = self._minima, min(reach_m.shape[0], self._turn)
        circle = np.zeros(self._turn)
        circle[:count] = reach_m[:count]
        around = np.concatenate((circle, circle, circle)).astype(np.float32)
        np.minimum(np.minimum(around[:-2], around[2:]), around[1:-1], out=table[0, 1:-1])
        for k in range(1, table.shape[0]):
            step = 1 << (k - 1)
            np.minimum(table[k - 1, : -2 * step], table[k - 1, 2 * step :], out=table[k, step:-step])


def _reaches(seen: SeenScan, config: SafetyConfig) -> Floats:
    """How far each beam [n] shows free space, m: 0 near the edges of the view and where too much is unknown.

    A single lost beam counts as the shorter of its neighbours.
    """
    reach = seen.free_m
    if seen.unseen is not None:
        reach = reach.copy()
        lost = np.flatnonzero(np.isnan(reach))
        last = reach.shape[0] - 1
        reach[lost] = np.fmin(reach[np.maximum(lost - 1, 0)], reach[np.minimum(lost + 1, last)])
        reach[seen.unseen | np.isnan(reach)] = 0.0
    if not seen.all_round:
        edge = math.ceil(config.fov_margin_rad / seen.angle_increment_rad - 0.5)
        reach = reach.copy()
        reach[:edge] = 0.0
        reach[reach.shape[0] - edge :] = 0.0
    return reach


def _cell(metres: float) -> int:
    return math.floor(metres / CELL_M)


def _sagitta_m(config: SafetyConfig) -> float:
    """What discs `STEP_M` apart leave of the band that the hull sweeps, m."""
    radius = config.vehicle_radius_m
    return radius - math.sqrt(max(radius * radius - 0.25 * STEP_M * STEP_M, 0.0))


def _overlap(step: int) -> tuple[slice, slice]:
    """Target and source slices of one axis for a map whose corner moves by a step."""
    if step >= 0:
        return slice(0, SIDE_CELLS - step), slice(step, SIDE_CELLS)
    return slice(-step, SIDE_CELLS), slice(0, SIDE_CELLS + step)


def _disc(radius_m: float) -> Integers:
    """Offsets of the cells whose centre is within a radius of the middle cell's."""
    reach = math.floor(radius_m / CELL_M)
    i, j = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij")
    within = CELL_M * np.hypot(i, j) <= radius_m
    offsets: Integers = (i * SIDE_CELLS + j)[within]
    return offsets


def _boxes(radius_m: float) -> Integers:
    """Half sides [b, 2], in cells, of boxes that together are all cells within a radius of any point of the middle cell."""
    reach = radius_m / CELL_M
    widths = [(i, 1 + math.floor(math.sqrt(reach * reach - max(i - 1, 0) ** 2))) for i in range(math.floor(reach) + 2)]
    corners = [box for box, after in zip(widths, [*widths[1:], (0, -1)], strict=True) if after[1] < box[1]]
    return np.array(corners)


def _clear(hidden: Booleans, boxes: Integers, i: Integers, j: Integers) -> None:
    """Take the cells of the boxes around middle cells i, j [n], which may lie outside the window, out of the hidden ones."""
    for row, column in set(zip(i.tolist(), j.tolist(), strict=True)):
        for a, b in boxes.tolist():
            hidden[max(row - a, 0) : max(row + a + 1, 0), max(column - b, 0) : max(column + b + 1, 0)] = False


def _box_counts(hidden: Booleans, boxes: Integers, rim: int) -> Integers:
    """Sum over the boxes of the hidden cells inside, for each middle cell at least `rim` from the border."""
    total = np.zeros((hidden.shape[0] + 1, hidden.shape[1] + 1), dtype=np.intp)
    np.cumsum(np.cumsum(hidden, axis=0, dtype=np.intp), axis=1, out=total[1:, 1:])
    rows, columns = hidden.shape[0] - 2 * rim, hidden.shape[1] - 2 * rim
    counts = np.zeros((rows, columns), dtype=np.intp)
    for a, b in boxes:
        top, bottom = slice(rim - a, rim - a + rows), slice(rim + a + 1, rim + a + 1 + rows)
        left, right = slice(rim - b, rim - b + columns), slice(rim + b + 1, rim + b + 1 + columns)
        counts += total[bottom, right] - total[top, right]
        counts += total[top, left] - total[bottom, left]
    return counts
