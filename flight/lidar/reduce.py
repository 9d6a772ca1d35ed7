"""Device scan to vehicle scan (mounting, blind sectors), and vehicle scan to the policy's beams.

Bearings in rad, 0 ahead, positive left. In a scan `inf` is "nothing within range", `nan` "unknown", 0 "nearer than
the device can measure". Missing is never turned into far here.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flight.lidar.config import LidarSource
from safety.messages import LidarScan

_EDGE = 1e-4  # rad: beams that only touch a sector do not belong to it


class Mounting:
    """Turns device ranges into a vehicle-centred scan of the same beam count.

    `angle_min_rad`, `angle_increment_rad`, `beams`: the device's own geometry.
    """

    def __init__(self, config: LidarSource, angle_min_rad: float, angle_increment_rad: float, beams: int) -> None:
        last_rad = angle_min_rad + (beams - 1) * angle_increment_rad
        first_rad = -last_rad if config.mirror else angle_min_rad
        self.angle_min_rad = config.mount_yaw_rad + first_rad
        self.angle_increment_rad = angle_increment_rad
        self._mirror = config.mirror
        self._offset = (config.mount_x_m, config.mount_y_m)
        self._bearings: NDArray[np.float64] = self.angle_min_rad + angle_increment_rad * np.arange(beams, dtype=np.float64)
        self._blind = in_sectors(self._bearings, config.blind_sectors_deg)

    def apply(self, ranges_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """float32 [beams] in device order to float32 [beams] by increasing vehicle bearing."""
        ranges = ranges_m[::-1].copy() if self._mirror else ranges_m.copy()
        ranges[self._blind] = np.nan
        if self._offset == (0.0, 0.0):
            return ranges
        return _seen_from_centre(ranges, self._bearings, self._offset, self.angle_increment_rad)


def in_sectors(bearings: NDArray[np.float64], sectors_deg: tuple[tuple[float, float], ...]) -> NDArray[np.bool_]:
    """Which bearings [n], rad, lie in one of the sectors [from, to], degrees, counter-clockwise."""
    blind = np.zeros(bearings.shape, dtype=bool)
    for start_deg, stop_deg in sectors_deg:
        width_rad = math.radians((stop_deg - start_deg) % 360.0)
        blind |= np.mod(bearings - math.radians(start_deg) + _EDGE, 2.0 * math.pi) <= width_rad + 2.0 * _EDGE
    return blind


def _seen_from_centre(
    ranges: NDArray[np.float32], bearings: NDArray[np.float64], offset: tuple[float, float], increment_rad: float
) -> NDArray[np.float32]:
    """The returns as seen from the vehicle's centre, each in the two beams next to its new bearing.

    A beam that gets no return keeps "nothing" or "unknown"; where its own return moved away (an occlusion edge
    opened), it takes the nearer neighbour.
    """
    hit = np.isfinite(ranges)
    x = offset[0] + ranges[hit] * np.cos(bearings[hit])
    y = offset[1] + ranges[hit] * np.sin(bearings[hit])
    turned = np.mod(np.arctan2(y, x) - bearings[0] + 0.5 * increment_rad, 2.0 * math.pi) - 0.5 * increment_rad
    place = turned / increment_rad
    moved = np.full(ranges.shape, np.inf, dtype=np.float32)
    for index in (np.floor(place).astype(np.intp), np.ceil(place).astype(np.intp)):
        inside = (index >= 0) & (index < ranges.size)
        np.minimum.at(moved, index[inside], np.hypot(x, y)[inside].astype(np.float32))
    empty = np.isinf(moved)
    moved[empty & ~hit] = ranges[empty & ~hit]
    padded = np.pad(moved, 1, mode="edge")
    neighbour = np.fmin(padded[:-2], padded[2:])
    opened = empty & hit
    moved[opened] = np.where(np.isinf(neighbour[opened]), np.nan, neighbour[opened])
    return moved


class BeamReducer:
    """Any scan to the policy's beams by the nearest valid return per beam sector.

    A scan beam belongs to every sector that its own width overlaps, so nothing falls between two sectors. Without a
    return, a sector with an unknown beam is `nan`; only one whose beams all saw nothing is `inf`.
    """

    def __init__(self, beams: int, fov_rad: float, range_max_m: float) -> None:
        self.beams = beams
        self.angle_increment_rad = fov_rad / beams
        self.angle_min_rad = -0.5 * fov_rad + 0.5 * self.angle_increment_rad
        self.range_max_m = range_max_m
        self._geometry: tuple[int, float, float] | None = None
        self._members = np.zeros((beams, 1), dtype=np.intp)
        self._outside = np.ones(beams, dtype=bool)

    def reduce(self, scan: LidarScan) -> NDArray[np.float32]:
        """float32 [beams]: ranges in m, `inf`, `nan` or 0 as in `LidarScan`; never past `range_max_m`."""
        geometry = (scan.ranges_m.size, scan.angle_min_rad, scan.angle_increment_rad)
        if geometry != self._geometry:
            self._index(*geometry)
            self._geometry = geometry
        gathered = scan.ranges_m[self._members]
        nearest: NDArray[np.float32] = np.fmin.reduce(gathered, axis=1)
        no_return = ~(nearest <= self.range_max_m)
        nearest[no_return] = np.inf
        nearest[no_return & np.isnan(gathered).any(axis=1)] = np.nan
        nearest[self._outside] = np.nan
        return nearest

    def _index(self, beams: int, angle_min_rad: float, increment_rad: float) -> None:
        centres = self.angle_min_rad + self.angle_increment_rad * np.arange(self.beams)
        bearings = angle_min_rad + increment_rad * np.arange(beams)
        apart = np.abs(np.remainder(bearings[None, :] - centres[:, None] + math.pi, 2.0 * math.pi) - math.pi)
        member = apart < 0.5 * (self.angle_increment_rad + abs(increment_rad)) - _EDGE
        counts = member.sum(axis=1)
        self._outside = counts == 0
        self._members = np.zeros((self.beams, max(1, int(counts.max()))), dtype=np.intp)
        for row, selected in zip(self._members, member, strict=True):
            indices = np.flatnonzero(selected)
            row[:] = np.resize(indices, row.size) if indices.size else 0


def levelled(scan: LidarScan, roll_rad: float, pitch_rad: float) -> LidarScan:
    """The scan with horizontal distances instead of those along the tilted beams (roll right side down, pitch nose up).

    For the policy only: the safety filter takes the tilt out by itself and must get the scan as measured. Bearings move by
    less than half a degree for tilts up to 7 degrees and are left alone.
    """
    bearings = scan.angle_min_rad + scan.angle_increment_rad * np.arange(scan.ranges_m.size)
    along, across = np.cos(bearings), np.sin(bearings)
    up = along * math.sin(pitch_rad) + across * math.sin(roll_rad) * math.cos(pitch_rad)
    shorter = np.sqrt(np.maximum(0.0, 1.0 - up * up)).astype(np.float32)
    return replace(scan, ranges_m=scan.ranges_m * shorter)


def fill_unknown(ranges_m: NDArray[np.float32], range_max_m: float) -> NDArray[np.float32]:
    """What the policy is shown: `nan` and `inf` become `range_max_m`.

    Only the policy may take unknown for far (it was trained without a third value); the safety filter gets the
    scan itself, where unknown stays unknown.
    """
    return np.where(np.isfinite(ranges_m), ranges_m, np.float32(range_max_m)).astype(np.float32, copy=False)
