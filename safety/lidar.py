"""One LiDAR scan as the shield sees it: obstacle points in the corridor frame, and which bearings are unknown.

Nothing that is not a clean return or a clean "nothing within range" counts as free: NaN, impossible values and returns from
the ground are unknown; too-near and negative values are an obstacle touching the vehicle in that bearing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.messages import LidarScan, VehicleState

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
MAX_BEAMS = 4096
RANGE_SLACK_M = 0.1  # noise may carry a true return a little past range_max
UNKNOWN_WINDOW_RAD = 0.26  # a bearing is unseen when too many beams within this on either side are unknown
UNKNOWN_SHARE = 0.2
TILT_BAND_M = 0.3  # a beam shows free space only while it is this near to the height of the LiDAR
_LEVEL = 1e-6


@dataclass(frozen=True, slots=True)
class SeenScan:
    """A scan placed in the corridor frame.

    `x_m`, `y_m`, `spread_m` [k]: returns, and half the width between neighbouring beams there. `range_m` [n]: horizontal distance
    per beam, inf = free, nan = unknown. `free_m` [n]: horizontal distance up to which a beam went through free space at the
    height of the vehicle, nan = unknown. `unseen` [n]: bearings around which too much is unknown. Pose of the LiDAR at `time_s`.
    """

    time_s: float
    origin_x_m: float
    origin_y_m: float
    yaw_rad: float
    angle_min_rad: float
    angle_increment_rad: float
    x_m: Floats
    y_m: Floats
    spread_m: Floats
    range_m: Floats
    free_m: Floats
    unseen: Booleans | None

    @property
    def beams(self) -> int:
        """Number of beams."""
        return int(self.range_m.shape[0])

    @property
    def all_round(self) -> bool:
        """Whether the scan sees in all directions: then it has no edges."""
        return self.beams * self.angle_increment_rad > 2.0 * math.pi - self.angle_increment_rad


def scan_problem(scan: LidarScan) -> str | None:
    """Why a scan cannot be used at all, or None: shape, beam count, angles, range limits."""
    ranges = scan.ranges_m
    if not isinstance(ranges, np.ndarray) or ranges.ndim != 1 or not 2 <= ranges.shape[0] <= MAX_BEAMS:
        return "scan_shape"
    if ranges.dtype.kind != "f":
        return "scan_shape"
    numbers = (scan.time_s, scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m)
    if not all(math.isfinite(number) for number in numbers):
        return "scan_not_finite"
    span = scan.angle_increment_rad * ranges.shape[0]
    if scan.angle_increment_rad <= 0.0 or span > 2.0 * math.pi + 1e-3 or not 0.0 <= scan.range_min_m < scan.range_max_m:
        return "scan_geometry"
    return None


def clean_ranges(scan: LidarScan) -> Floats:
    """Ranges [n] in which every value is a distance > 0, inf (free) or nan (unknown), m.

    Zero, negative, -inf and anything below `range_min_m` touch the vehicle: they become half of `range_min_m`.
    A finite value beyond the sensor's range (65.535 m of an overflow, say) is unknown.
    """
    ranges = scan.ranges_m.astype(np.float64)
    ranges[ranges < scan.range_min_m] = 0.5 * scan.range_min_m
    ranges[np.isfinite(ranges) & (ranges > scan.range_max_m + RANGE_SLACK_M)] = np.nan
    return ranges


class BeamTable:
    """Cosines and sines of the bearings, made once per scan geometry."""

    def __init__(self) -> None:
        self._key: tuple[float, float, int] | None = None
        self.cos: Floats = np.empty(0)
        self.sin: Floats = np.empty(0)

    def prepare(self, scan: LidarScan) -> None:
        """Fill the table for the geometry of `scan`."""
        key = (scan.angle_min_rad, scan.angle_increment_rad, scan.ranges_m.shape[0])
        if key != self._key:
            bearings = key[0] + key[1] * np.arange(key[2])
            self.cos, self.sin = np.cos(bearings), np.sin(bearings)
            self._key = key


def see(scan: LidarScan, state: VehicleState, table: BeamTable, config: SafetyConfig) -> SeenScan:
    """Place a scan in the corridor frame, with the vehicle's tilt and its motion between scan and estimate taken out."""
    table.prepare(scan)
    back_s = state.time_s - scan.time_s
    x, y = state.position.x - state.velocity.x * back_s, state.position.y - state.velocity.y * back_s
    z = state.position.z - state.velocity.z * back_s
    yaw = state.yaw_rad - state.yaw_rate_rad_s * back_s
    ahead, left, up = _levelled(table, state.roll_rad, state.pitch_rad)
    ranges = clean_ranges(scan)
    level = np.sqrt(ahead * ahead + left * left)
    free = np.minimum(ranges, scan.range_max_m)
    steepest = abs(math.sin(state.roll_rad)) + abs(math.sin(state.pitch_rad))
    rise_m = (scan.range_max_m + RANGE_SLACK_M) * max(steepest, _LEVEL)  # no return is further above or below the LiDAR
    ground_m = config.ground_z_m + config.ground_band_m
    if rise_m >= TILT_BAND_M or z < ground_m + 2.0 * TILT_BAND_M:  # else tilt changes nothing
        free = np.minimum(free, TILT_BAND_M / np.maximum(np.abs(up), _LEVEL))
        hit = np.isfinite(ranges)
        ground = hit & (z + np.where(hit, ranges, 0.0) * up < ground_m)
        ranges[ground] = np.nan
    free *= level
    hit = np.isfinite(ranges)
    reach, cos, sin = ranges[hit], math.cos(yaw), math.sin(yaw)
    dx, dy = reach * ahead[hit], reach * left[hit]
    return SeenScan(
        scan.time_s, x, y, yaw, scan.angle_min_rad, scan.angle_increment_rad,
        x + cos * dx - sin * dy, y + sin * dx + cos * dy, reach * (0.5 * scan.angle_increment_rad),
        ranges * level, free, _unseen(free, scan.angle_increment_rad),
    )  # fmt: skip


def _levelled(table: BeamTable, roll_rad: float, pitch_rad: float) -> tuple[Floats, Floats, Floats]:
    """Unit beam directions [n] ahead, left, up in the level heading frame (roll right side down, pitch nose up)."""
    cos_r, sin_r, cos_p, sin_p = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    lift = table.sin * sin_r
    return table.cos * cos_p - lift * sin_p, table.sin * cos_r, table.cos * sin_p + lift * cos_p


def _unseen(ranges_m: Floats, increment_rad: float) -> Booleans | None:
    """Bearings [n] with too many unknown beams around them; None when every beam is known (the usual case)."""
    unknown = np.isnan(ranges_m)
    if not unknown.any():
        return None
    half = max(1, int(UNKNOWN_WINDOW_RAD / increment_rad))
    total = np.concatenate(([0], np.cumsum(unknown)))
    index = np.arange(unknown.shape[0])
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, unknown.shape[0])
    result: Booleans = (total[high] - total[low]) > UNKNOWN_SHARE * (high - low)
    return result


def scan_offset(seen: SeenScan, bearing_rad: Floats) -> Floats:
    """Angle from the first beam to bearings [c], counter-clockwise, from minus half a beam up to a full turn, rad."""
    half = 0.5 * seen.angle_increment_rad
    offset: Floats = np.remainder(bearing_rad - seen.angle_min_rad + half, 2.0 * math.pi) - half
    return offset
