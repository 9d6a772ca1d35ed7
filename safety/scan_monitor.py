"""Does the scan come from one source, does it turn with the vehicle, and is part of it the vehicle itself?"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.messages import Intervention, LidarScan, VehicleState

REFERENCE_S = 1.0  # an older scan was taken from too far away to be compared
WRONG_SHARE = 0.5  # the mirrored comparison must be this much better than the right one ...
WRONG_M = 0.05  # ... and by this much more, or noise could decide
_Floats = NDArray[np.float64]


class ScanMonitor:
    """Judges each new scan against the earlier ones; keeps one reference scan and two numbers per beam."""

    def __init__(self, config: SafetyConfig) -> None:
        self._hull_m, self._config = config.vehicle_radius_m, config.monitors
        self.reset()

    def reset(self) -> None:
        """Forget earlier scans."""
        self._time_s = -math.inf
        self._sequence = 0
        self._geometry: tuple[int, float, float] | None = None
        self._reference: tuple[float, float, _Floats] | None = None
        self._votes = 0
        self._path = 0.0
        self._inside_s: _Floats | None = None
        self._inside_path: _Floats | None = None
        self._masked: NDArray[np.bool_] | None = None

    def judge(self, scan: LidarScan, state: VehicleState, found: list[Intervention]) -> None:
        """Add what is wrong to `found`. Both samples are sound and in order; a scan seen before changes nothing."""
        if scan.time_s <= self._time_s:
            return
        self._judge_source(scan, found)
        self._judge_turn(scan, state, found)
        self._watch_hull(scan, state)
        self._time_s = scan.time_s

    def masked(self, scan: LidarScan, notices: list[Intervention]) -> LidarScan:
        """The scan in which beams that see the vehicle itself are unknown; the very same where there are none (L15)."""
        if self._masked is None:
            return scan
        notices.append(Intervention("scan_sector_masked", float(np.count_nonzero(self._masked)), 0.0))
        ranges = scan.ranges_m.copy()
        ranges[self._masked] = np.nan
        return dataclasses.replace(scan, ranges_m=ranges)

    def _judge_source(self, scan: LidarScan, found: list[Intervention]) -> None:
        """L18, L8: another geometry, or numbers that do not count up, come from another sender."""
        geometry = (scan.ranges_m.shape[0], scan.angle_min_rad, scan.angle_increment_rad)
        numbered = scan.sequence != 0 or self._sequence != 0
        if self._geometry is not None and (geometry != self._geometry or (numbered and scan.sequence <= self._sequence)):
            found.append(Intervention("scan_source", float(scan.sequence), float(self._sequence)))
        if geometry != self._geometry:
            self._reference = self._inside_s = self._masked = None
        self._geometry, self._sequence = geometry, scan.sequence

    def _judge_turn(self, scan: LidarScan, state: VehicleState, found: list[Intervention]) -> None:
        """L9: when the vehicle turns left, everything it sees must move to the right."""
        yaw = state.yaw_rad - state.yaw_rate_rad_s * (state.time_s - scan.time_s)
        if self._reference is not None and scan.time_s - self._reference[0] <= REFERENCE_S:
            turn = math.remainder(yaw - self._reference[1], 2.0 * math.pi)
            if abs(turn) < self._config.mirror_turn_rad:
                return
            self._vote(scan, turn)
        self._reference = (scan.time_s, yaw, _limited(scan))
        if self._votes >= self._config.mirror_votes:
            found.append(Intervention("scan_mirrored", float(self._votes), float(self._config.mirror_votes)))

    def _vote(self, scan: LidarScan, turn_rad: float) -> None:
        """Compare the reference, shifted by the turn, with the scan: once as it should be, once mirrored."""
        assert self._reference is not None  # its caller looked
        shift = round(turn_rad / scan.angle_increment_rad)
        now, before = _limited(scan), self._reference[2]
        right, wrong = _difference(now, before, shift), _difference(now, before, -shift)
        if wrong + WRONG_M < WRONG_SHARE * right:
            self._votes += 1
        elif right <= wrong:
            self._votes = 0

    def _watch_hull(self, scan: LidarScan, state: VehicleState) -> None:
        """L15: what stays nearer than the hull at one bearing while the vehicle moves is part of the vehicle.

        An obstacle there would have been hit already, so nothing that can be avoided is ever taken for a part of the vehicle.
        """
        dt = scan.time_s - self._time_s if math.isfinite(self._time_s) else 0.0
        self._path += dt * (math.hypot(state.velocity.x, state.velocity.y) + abs(state.yaw_rate_rad_s))
        inside = scan.ranges_m < self._hull_m
        if not inside.any():
            self._inside_s = self._masked = None
            return
        if self._inside_s is None or self._inside_path is None:
            self._inside_s = np.full(inside.shape, np.inf)
            self._inside_path = np.full(inside.shape, np.inf)
        fresh = inside & np.isinf(self._inside_s)
        self._inside_s[fresh], self._inside_path[fresh] = scan.time_s, self._path
        self._inside_s[~inside] = self._inside_path[~inside] = np.inf
        lasting = (scan.time_s - self._inside_s > self._config.mask_s) & (
            self._path - self._inside_path > self._config.mask_motion_m
        )
        self._masked = lasting if lasting.any() else None


def _limited(scan: LidarScan) -> _Floats:
    """Ranges in which what is unknown or out of range counts as the sensor's range."""
    ranges = np.nan_to_num(scan.ranges_m.astype(np.float64), nan=scan.range_max_m, posinf=scan.range_max_m)
    return np.minimum(ranges, scan.range_max_m)


def _difference(now: _Floats, before: _Floats, shift: int) -> float:
    """Mean difference of `now[i]` and `before[i + shift]` where both exist; infinite where nothing overlaps."""
    count = now.shape[0] - abs(shift)
    if count <= 0:
        return math.inf
    a, b = (now[:count], before[shift:]) if shift >= 0 else (now[-shift:], before[:count])
    return float(np.abs(a - b).mean())
