"""Which places were recently seen free: a map of cells around the vehicle, in fixed space.

A cell counts as seen when a scan's beams went through all of it, or the vehicle itself was there; what was never seen, or too
long ago, is not free. Cells near a known return belong to that return, whose distance is checked to the millimetre elsewhere.
Obstacles count as columns, so the map is flat. With moving obstacles the unseen grows into the seen at their speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.lidar import SeenScan
from safety.unseen_cells import CELL_M, Counts, Known, Patch, Window, boxes_within, cells_in, cells_of, surfaces, window_around

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]
Booleans = NDArray[np.bool_]

SIDE_CELLS = 128
CARVE_M = 2.5  # a scan is taken in up to this far: a brake tube and the hull need less
RECENTRE_CELLS = 8  # the map follows the vehicle in steps of this size
TAKE_OFF_M = 0.9  # at engaging nothing may stand nearer to the vehicle's centre than this, unseen by the LiDAR
VICINITY_CELLS = 2  # around the swept hull: what is known there stays known while the vehicle stands
STEP_M = 0.2  # between the discs that stand for a swept hull
PATCH_CELLS = 12  # a patch is made so much wider than what is asked first: the tubes of a tick lie close together
_REACH_ERROR_M = CELL_M * math.sqrt(2.0)  # of a cell's far corner, seen from anywhere in the cell of the LiDAR
_WIDEST_RAD = math.radians(60.0)  # nearer cells fill more of the view: they are the vehicle's own
NOWHERE = np.empty((2, 0))


class FreeSpace:
    """When each cell was last seen free, and how many unseen cells the hull would touch at given places."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        self._seen_s = np.empty((SIDE_CELLS, SIDE_CELLS), dtype=np.float32)  # since the first scan; -inf = never
        self._spare = np.empty_like(self._seen_s)
        hull = config.vehicle_radius_m + config.position_error_m + config.velocity_error_m_s * config.delay_s + _sagitta_m(config)
        self._kernels = (boxes_within(hull + CELL_M), boxes_within(hull))
        self._rims = tuple(int(boxes.max()) for boxes in self._kernels)
        self._rim = self._rims[0]
        self._touched = cells_in(self._kernels[1], self._rims[1])
        vicinity_m = hull + (1 + VICINITY_CELLS) * CELL_M
        self._half = math.floor(max(CARVE_M, TAKE_OFF_M, vicinity_m) / CELL_M)  # of the window that a scan changes, in cells
        self._view = _ViewTemplate(self._half)
        self._take_off = _disc(TAKE_OFF_M, self._half)
        self._hull = _disc(config.vehicle_radius_m, self._half)
        self._vicinity = _disc(vicinity_m, self._half)
        self.clear()

    def clear(self) -> None:
        """Nothing was ever seen."""
        self._seen_s.fill(-np.inf)
        self._known: Known | None = None
        self._patches: dict[float, Patch] = {}
        self._corner = (0, 0)
        self._began_s: float | None = None
        self._shrunk_s = 0.0

    def forget(self) -> None:
        """Nothing is known any more, in flight: unlike at engaging, nothing is taken for granted around the vehicle."""
        self._known = None
        self._seen_s.fill(-np.inf)

    def update(self, seen: SeenScan) -> None:
        """Take in a scan: what its beams went through, and where the vehicle is."""
        self._known = None
        if self._began_s is None:
            self._began_s, self._shrunk_s = seen.time_s, seen.time_s
            self._corner = (_cell(seen.origin_x_m) - SIDE_CELLS // 2, _cell(seen.origin_y_m) - SIDE_CELLS // 2)
            own = self._take_off
        else:
            self._follow(seen.origin_x_m, seen.origin_y_m)
            own = self._hull
        time_s = seen.time_s - self._began_s
        i, j = self._corner_cells((seen.origin_x_m, seen.origin_y_m))
        half = self._half
        window = self._seen_s[i - half : i + half + 1, j - half : j + half + 1]
        free = window >= time_s - self._config.memory_s
        free &= self._vicinity
        free |= own
        free |= self._view.visible(seen, self._config)
        if self._config.obstacle_speed_m_s > 0.0:
            self._shrink(seen.time_s)
        window[free] = time_s

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

    def unseen(self, places_m: Floats, near_m: Floats, now_s: float, wide: bool, spared_m: Floats = NOWHERE) -> Counts:
        """How many unseen cells the hull touches with its centre at places [2, ...]; weighted, 0 = none.

        The hull with its errors, one cell more when `wide`. `near_m` [2, k]: known returns, whose surroundings count as known.
        `spared_m` [2, n]: cells that the hull touches with its centre there do not count.
        """
        kernel = 0 if wide else 1
        boxes, rim = self._kernels[kernel], self._rims[kernel]
        cells = cells_of(places_m)
        window = window_around(cells, rim)
        patch = self._patch_of(window, near_m, now_s)
        if patch is None:
            return np.full(places_m.shape[1:], SIDE_CELLS * SIDE_CELLS, dtype=np.intp)
        if spared_m.shape[1]:
            patch = patch.sparing(spared_m, boxes)
        if not np.count_nonzero(patch.part(*window)):
            return np.zeros(places_m.shape[1:], dtype=np.int32)
        return patch.counted(cells, boxes, rim, wide)

    def all_seen_around(self, x_m: float, y_m: float, now_s: float) -> bool:
        """Whether every cell that the hull could touch around a place was seen: quick, and False where it must be counted."""
        return self.all_seen_between((x_m, y_m), (x_m, y_m), now_s)

    def all_seen_between(self, low_m: Sequence[float], high_m: Sequence[float], now_s: float) -> bool:
        """The same for all places of a rectangle between two corners (x, y)."""
        (left, below), (right, above), rim = self._corner_cells(low_m), self._corner_cells(high_m), self._rim
        if min(left, below) < rim or max(right, above) >= SIDE_CELLS - rim or self._began_s is None:
            return False
        around = self._seen_s[left - rim : right + rim + 1, below - rim : above + rim + 1]
        return bool(around.min() >= now_s - self._began_s - self._config.memory_s)

    def none_hidden(self, low_m: Sequence[float], high_m: Sequence[float], near_m: Floats, now_s: float) -> bool:
        """The same where cells of known returns are seen, too."""
        (left, below), (right, above), rim = map(_cell, low_m[:2]), map(_cell, high_m[:2]), self._rim
        window = (left - rim, below - rim, right + rim + 1, above + rim + 1)
        patch = self._patch_of(window, near_m, now_s)
        return patch is not None and not np.count_nonzero(patch.part(*window))

    def hull_touches(self, x_m: float, y_m: float, near_m: Floats, now_s: float) -> bool:
        """Whether the hull with its errors touches an unseen cell, its centre at a place."""
        i, j, rim = _cell(x_m), _cell(y_m), self._rims[1]
        window = (i - rim, j - rim, i + rim + 1, j + rim + 1)
        patch = self._patch_of(window, near_m, now_s)
        return patch is None or bool(np.count_nonzero(patch.part(*window) & self._touched))

    def gap_m(self, places_m: Floats, near_m: Floats, now_s: float) -> Floats:
        """Distance from places [2, n] to the nearest unseen cell, m; what is further than the hull needs reads as that."""
        rim = self._rim
        window = window_around(cells_of(places_m), rim)
        patch = self._patch_of(window, near_m, now_s)
        if patch is None:
            return np.zeros(places_m.shape[1])
        i, j = np.nonzero(patch.part(*window))
        dx = np.abs(places_m[0, :, None] - CELL_M * (i + (window[0] + 0.5))) - 0.5 * CELL_M
        dy = np.abs(places_m[1, :, None] - CELL_M * (j + (window[1] + 0.5))) - 0.5 * CELL_M
        gaps: Floats = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0)).min(axis=1, initial=rim * CELL_M)
        return gaps

    def _corner_cells(self, place_m: Sequence[float]) -> tuple[int, int]:
        return _cell(place_m[0]) - self._corner[0], _cell(place_m[1]) - self._corner[1]

    def _patch_of(self, window: Window, near_m: Floats, now_s: float) -> Patch | None:
        """A patch of the map that holds a window (one of this tick when it does); None for a window that is not on the map."""
        (left, below), (low_x, low_y, high_x, high_y) = self._corner, window
        right, above = left + SIDE_CELLS, below + SIDE_CELLS
        if low_x < left or low_y < below or high_x > right or high_y > above or self._began_s is None:
            return None
        if self._known is None or not self._known.holds(*window, near_m):
            low_x, low_y = max(low_x - PATCH_CELLS, left), max(low_y - PATCH_CELLS, below)
            high_x, high_y = min(high_x + PATCH_CELLS, right), min(high_y + PATCH_CELLS, above)
            self._known = Known(near_m, low_x, low_y, surfaces(near_m, low_x, low_y, (high_x - low_x, high_y - low_y)))
            self._patches.clear()
        patch = self._patches.get(now_s)
        if patch is None:
            patch = self._patches[now_s] = Patch(
                self._known, self._hidden(self._known, now_s - self._began_s - self._config.memory_s)
            )
        return patch

    def _hidden(self, known: Known, oldest_s: float) -> Booleans:
        """The unseen cells of a window of the map that belong to no known return."""
        low_x, low_y, (rows, columns) = known.low_x - self._corner[0], known.low_y - self._corner[1], known.mask.shape
        high_x, high_y = low_x + rows, low_y + columns
        unseen: Booleans = self._seen_s[low_x:high_x, low_y:high_y] < oldest_s
        return unseen & ~known.mask


class _ViewTemplate:
    """For each cell of a square around the LiDAR: its bearing, how far a beam must have gone, and how many beams look at it."""

    def __init__(self, half: int) -> None:
        self._half = half
        self._key: tuple[float, int] | None = None

    def _prepare(self, seen: SeenScan) -> None:
        key = (seen.angle_increment_rad, seen.free_m.shape[0])
        if key == self._key:
            return
        self._key, increment = key, seen.angle_increment_rad
        self._turn = math.ceil(2.0 * math.pi / increment - 1e-6)
        i, j, distance = _around(self._half)
        fits = (distance >= _REACH_ERROR_M / math.sin(_WIDEST_RAD)) & (distance + _REACH_ERROR_M <= CARVE_M)
        width = np.arcsin(_REACH_ERROR_M / np.where(fits, distance, CARVE_M))
        beams = np.ceil(width / increment) + 1.0  # half a beam of rounding, one of the turn's end
        level = np.ceil(np.log2(beams)).astype(np.intp)
        self._minima = np.zeros((int(level.max()) + 1, 3 * self._turn), dtype=np.float32)
        self._beam = (np.remainder(np.arctan2(j, i), 2.0 * math.pi) / increment + 0.5).astype(np.float32)
        self._row = level * self._minima.shape[1]
        self._needed_m = np.where(fits, distance + _REACH_ERROR_M, np.inf).astype(np.float32)

    def visible(self, seen: SeenScan, config: SafetyConfig) -> Booleans:
        """The cells of the square through all of which the beams of a scan went."""
        self._prepare(seen)
        self._fill_minima(_reaches(seen, config))
        first = (seen.yaw_rad + seen.angle_min_rad) / seen.angle_increment_rad
        beam = (self._beam + (self._turn - first % self._turn)).astype(np.intp)
        beam += self._row
        free: Booleans = self._minima.take(beam) >= self._needed_m
        return free

    def _fill_minima(self, reach_m: Floats) -> None:
        """Row k: the shortest reach within 2^k beams on either side, over three turns so that no index wraps."""
        table, count = self._minima, min(reach_m.shape[0], self._turn)
        turns = np.zeros((3, self._turn), dtype=np.float32)
        turns[:, :count] = reach_m[:count]
        around = turns.reshape(-1)
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


def _around(half: int) -> tuple[Integers, Integers, Floats]:
    """Offsets and distance of the cells of a square from its middle one, [2 half + 1, 2 half + 1] each."""
    i, j = np.meshgrid(*[np.arange(-half, half + 1)] * 2, indexing="ij")
    return i, j, CELL_M * np.hypot(i, j)


def _disc(radius_m: float, half: int) -> Booleans:
    """The cells of a square whose centre is within a radius of the middle cell's."""
    within: Booleans = _around(half)[2] <= radius_m
    return within
