"""A scan as text: a polar plot in braille dots, the vehicle in the middle, ahead up, left left."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from safety.messages import LidarScan

_BRAILLE = 0x2800
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])  # [row, column] in one character
_RINGS = 4
_RING_DOTS = 90


def polar_plot(scan: LidarScan, columns: int, rows: int, reach_m: float) -> list[str]:
    """`rows` lines of `columns` characters; the nearer edge is `reach_m` away. Returns as dots, rings every quarter of it.

    Bearings that are unknown are shaded at the rim: missing is shown, not left empty like far.
    """
    dots = np.zeros((4 * rows, 2 * columns), dtype=bool)
    scale = min(2 * columns, 4 * rows) / 2.0 / reach_m
    ring = np.linspace(0.0, 2.0 * math.pi, _RING_DOTS, endpoint=False)
    for number in range(1, _RINGS + 1):
        _set(dots, reach_m * number / _RINGS * np.cos(ring), reach_m * number / _RINGS * np.sin(ring), scale)
    bearings = scan.angle_min_rad + scan.angle_increment_rad * np.arange(scan.ranges_m.size)
    ranges = scan.ranges_m.astype(np.float64)
    hit = np.isfinite(ranges) & (ranges <= reach_m)
    for inside_m in (0.0, 1.0 / scale):  # two dots deep, so that walls stand out from the rings
        reach = np.maximum(ranges[hit] - inside_m, 0.0)
        _set(dots, reach * np.cos(bearings[hit]), reach * np.sin(bearings[hit]), scale)
    unknown = np.isnan(ranges)
    for share in np.linspace(0.9, 1.0, 6):
        _set(dots, share * reach_m * np.cos(bearings[unknown]), share * reach_m * np.sin(bearings[unknown]), scale)
    return _as_text(dots, rows, columns)


def _set(dots: NDArray[np.bool_], ahead_m: NDArray[np.float64], left_m: NDArray[np.float64], scale: float) -> None:
    row = np.rint(0.5 * dots.shape[0] - 0.5 - ahead_m * scale).astype(int)
    column = np.rint(0.5 * dots.shape[1] - 0.5 - left_m * scale).astype(int)
    inside = (row >= 0) & (row < dots.shape[0]) & (column >= 0) & (column < dots.shape[1])
    dots[row[inside], column[inside]] = True


def _as_text(dots: NDArray[np.bool_], rows: int, columns: int) -> list[str]:
    cells = dots.reshape(rows, 4, columns, 2).transpose(0, 2, 1, 3)
    codes = _BRAILLE + (cells * _DOTS).sum(axis=(2, 3))
    lines = ["".join(map(chr, row)) for row in codes]
    middle, centre = rows // 2, columns // 2
    lines[middle] = lines[middle][:centre] + "▲" + lines[middle][centre + 1 :]
    return lines
