"""What the LiDAR saw, one small row a scan: for the waterfall and the map of the report. Bounded, and allocated once.

The recording keeps the scans themselves; here a beam is one byte, so that an hour takes some 15 MB.
"""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safety.messages import LidarScan, VehicleState

MAX_COLUMNS = 192
NEAR, STEPS, NOTHING, UNKNOWN = 0, 250, 254, 255
"""Codes of a beam: nearer than the device measures, 1 to STEPS the range, nothing within range, unknown."""

HIT_CELL_M = 0.05
MAX_HIT_CELLS = 100_000
_HIT_EVERY_S = 0.2
_CHUNK_ROWS = 1000
_MAX_FILE_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class Scans:
    """Scans as they are kept. `poses` [n, 4]: time s, x, y m, yaw rad (corridor frame, pose NaN where it was not known).

    `codes` uint8 [n, columns]; `bearings_rad` [columns], 0 ahead, positive left; `range_max_m` what code STEPS means.
    """

    poses: NDArray[np.float64]
    codes: NDArray[np.uint8]
    bearings_rad: NDArray[np.float64]
    range_max_m: float

    def ranges_m(self) -> NDArray[np.float64]:
        """[n, columns] ranges: 0 too near, inf nothing there, NaN unknown."""
        meanings: NDArray[np.float64] = (np.arange(256, dtype=np.float64) - 0.5) * (self.range_max_m / STEPS)
        meanings[NEAR], meanings[STEPS + 1 : UNKNOWN], meanings[UNKNOWN] = 0.0, math.inf, math.nan
        ranges: NDArray[np.float64] = meanings[self.codes]
        return ranges

    def hit_points_m(self) -> NDArray[np.float64]:
        """[n, 2] corridor x, y of the cells in which something was seen, taking the scan plane as horizontal; oldest first."""
        cells: NDArray[np.int64] = np.zeros((0, 2), dtype=np.int64)
        chosen = _every(self.poses[:, 0], _HIT_EVERY_S)
        for start in range(0, len(chosen), _CHUNK_ROWS):
            if len(cells) >= MAX_HIT_CELLS:
                break
            cells = _first_seen(np.vstack((cells, self._cells(chosen[start : start + _CHUNK_ROWS]))))
        return (cells[:MAX_HIT_CELLS].astype(np.float64) + 0.5) * HIT_CELL_M

    def _cells(self, rows: NDArray[np.intp]) -> NDArray[np.int64]:
        codes, poses = self.codes[rows], self.poses[rows]
        hit = (codes > NEAR) & (codes <= STEPS) & np.isfinite(poses[:, 1:].sum(axis=1))[:, None]
        row, column = np.nonzero(hit)
        ranges = (codes[row, column] - 0.5) * (self.range_max_m / STEPS)
        angles = poses[row, 3] + self.bearings_rad[column]
        points = np.column_stack((poses[row, 1] + ranges * np.cos(angles), poses[row, 2] + ranges * np.sin(angles)))
        return np.floor(points / HIT_CELL_M).astype(np.int64)


class ScanLog:
    """At most `max_rows` scans, oldest first; later ones are only counted in `dropped`.

    The first scan fixes the geometry; a scan of another geometry is counted as dropped too. Memory is there from the start
    (`reserve` makes the system hand it over), and grows no more.
    """

    def __init__(self, max_rows: int) -> None:
        self.dropped = 0
        self._poses = np.zeros((max_rows, 4))
        self._codes = np.zeros((max_rows, MAX_COLUMNS), dtype=np.uint8)
        self._rows = 0
        self._time_s = -math.inf
        self._geometry: tuple[int, float, float, float] | None = None
        self._starts: NDArray[np.intp] = np.zeros(0, dtype=np.intp)

    def __len__(self) -> int:
        return self._rows

    def reserve(self) -> None:
        """Touch every page now instead of in flight."""
        self._poses.fill(0.0)
        self._codes.fill(0)

    def add(self, scan: LidarScan | None, state: VehicleState | None) -> None:
        """Keep a scan that is newer than the one before, with the pose of the tick."""
        if scan is None or not scan.time_s > self._time_s:
            return
        self._time_s = scan.time_s
        geometry = (scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad, scan.range_max_m)
        if self._geometry is None and scan.ranges_m.size > 0:
            self._geometry = geometry
            columns = min(scan.ranges_m.size, MAX_COLUMNS)
            self._starts = np.arange(columns) * scan.ranges_m.size // columns
        if geometry != self._geometry or self._rows >= len(self._poses):
            self.dropped += 1
            return
        position = (state.position.x, state.position.y, state.yaw_rad) if state is not None else (math.nan,) * 3
        self._poses[self._rows] = (scan.time_s, *position)
        self._codes[self._rows, : self._starts.size] = np.minimum.reduceat(_codes(scan), self._starts)
        self._rows += 1

    def scans(self) -> Scans:
        """What was kept; views, no copies."""
        count, first_rad, increment_rad, range_max_m = self._geometry or (0, 0.0, 0.0, 1.0)
        ends = np.append(self._starts[1:], count)
        bearings = first_rad + increment_rad * 0.5 * (self._starts + ends - 1)
        return Scans(self._poses[: self._rows], self._codes[: self._rows, : self._starts.size], bearings, range_max_m)


def _codes(scan: LidarScan) -> NDArray[np.uint8]:
    """One byte a beam. The smallest code of a group is its nearest return; unknown gives way to everything."""
    ranges = scan.ranges_m
    known = np.where(np.isfinite(ranges), ranges, 0.0)
    codes = np.clip(1.0 + np.floor(known * np.float32(STEPS / scan.range_max_m)), 1.0, float(STEPS)).astype(np.uint8)
    codes[ranges < scan.range_min_m] = NEAR
    codes[np.isposinf(ranges)] = NOTHING
    codes[np.isnan(ranges)] = UNKNOWN
    return codes


def _every(times_s: NDArray[np.float64], period_s: float) -> NDArray[np.intp]:
    """Indices of rows at least `period_s` apart."""
    chosen, last_s = [], -math.inf
    for index, time_s in enumerate(times_s.tolist()):
        if time_s - last_s >= period_s - 1e-9:
            chosen.append(index)
            last_s = time_s
    return np.array(chosen, dtype=np.intp)


def _first_seen(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Unique rows in the order of their first appearance."""
    _, first = np.unique(cells, axis=0, return_index=True)
    return cells[np.sort(first)]


def write_scans(path: Path, scans: Scans, start_s: float) -> None:
    """Write the scans as a compressed .npz, times from `start_s`."""
    poses = scans.poses - (start_s, 0.0, 0.0, 0.0)
    np.savez_compressed(path, poses=poses, codes=scans.codes, bearings_rad=scans.bearings_rad, range_max_m=scans.range_max_m)


def read_scans(path: Path) -> Scans | None:
    """What `write_scans` wrote; None where there is no such file, or it is damaged or far too large."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(item.file_size for item in archive.infolist()) > _MAX_FILE_BYTES:
                return None
        with np.load(path, allow_pickle=False) as file:
            scans = Scans(
                np.asarray(file["poses"], dtype=np.float64),
                np.asarray(file["codes"], dtype=np.uint8),
                np.asarray(file["bearings_rad"], dtype=np.float64),
                float(file["range_max_m"]),
            )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
    rows, columns = len(scans.poses), scans.bearings_rad.size
    fits = scans.poses.shape == (rows, 4) and scans.codes.shape == (rows, columns) and scans.bearings_rad.ndim == 1
    return scans if fits and 0.0 < scans.range_max_m < math.inf else None
