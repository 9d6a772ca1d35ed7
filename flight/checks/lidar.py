"""The LiDAR as it is mounted: coverage of the policy's field of view, ranges, and scans that really change."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flight.preflight import Check, Level
from policy_export.contract import PolicyMetadata
from safety.messages import LidarScan

SAME_SCANS = 5
SEE_NOTHING = 0.02
TOO_NEAR = 0.2
EDGE_RAD = math.radians(2.0)


def check_coverage(scan: LidarScan, metadata: PolicyMetadata) -> list[Check]:
    """Field of view and range against what the policy was trained with."""
    wanted = metadata.observation.lidar
    last_rad = scan.angle_min_rad + (scan.ranges_m.size - 1) * scan.angle_increment_rad
    half_rad = 0.5 * wanted.fov_rad - EDGE_RAD
    seen = f"{math.degrees(scan.angle_min_rad):.0f} to {math.degrees(last_rad):.0f} deg, {scan.range_max_m:g} m"
    full_turn = last_rad - scan.angle_min_rad >= 2.0 * math.pi - 2.0 * scan.angle_increment_rad - 1e-6
    if not full_turn and (scan.angle_min_rad > -half_rad or last_rad < half_rad):
        advice = f"the policy looks {math.degrees(wanted.fov_rad):.0f} deg wide: check lidar.mount_yaw_deg and the device"
        return [Check("LiDAR coverage", Level.FAIL, seen, advice)]
    if scan.range_max_m < wanted.range_max_m - 1e-6:
        return [Check("LiDAR coverage", Level.WARN, seen, f"the policy was trained with {wanted.range_max_m:g} m")]
    return [Check("LiDAR coverage", Level.PASS, seen)]


def check_content(scans: Sequence[LidarScan]) -> list[Check]:
    """Several scans of a standing vehicle: neither frozen, nor blind, nor looking at the vehicle itself."""
    if len(scans) < SAME_SCANS:
        return [Check("LiDAR content", Level.FAIL, f"{len(scans)} scans", "check the device: scans do not keep coming")]
    ranges = np.stack([scan.ranges_m for scan in scans if scan.ranges_m.size == scans[-1].ranges_m.size])
    returns = float(np.mean(np.isfinite(ranges) & (ranges > 0.0)))
    near = float(np.mean(ranges == 0.0))
    seen = f"{returns:.0%} of beams with a return, {near:.0%} too near"
    if near > TOO_NEAR:
        return [
            Check("LiDAR content", Level.FAIL, seen, "something covers the device, or set lidar.blind_sectors_deg for the frame")
        ]
    finite = np.isfinite(ranges).any()
    if finite and all(np.array_equal(ranges[0], row, equal_nan=True) for row in ranges[1:]):
        return [Check("LiDAR content", Level.FAIL, f"{len(ranges)} identical scans", "the device has frozen: restart it")]
    if returns < SEE_NOTHING:
        return [Check("LiDAR content", Level.WARN, seen, "it sees nothing: stand near a wall and check that it is seen")]
    return [Check("LiDAR content", Level.PASS, seen)]
