"""Checks before arming: each one a named line with what was seen, and what to do when it is not enough.

The functions judge values that somebody else read, so each rule is tested without a vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from flight.errors import RefusedError
from flight.gateway_process import Box
from flight.lidar.driver import LidarHealth
from flight.px4 import LANDED_STATE_ON_GROUND, mode_name
from flight.telemetry import Telemetry
from policy_export.contract import PolicyMetadata
from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.messages import LidarScan

LOOP_RATE_HZ = 20.0
MIN_BATTERY_FRACTION = 0.2
MAX_SAMPLE_AGE_S = 0.2
MIN_KNOWN_BEAMS = 0.5
MIN_LIDAR_RATE_HZ = 0.5 * LOOP_RATE_HZ


class Level(Enum):
    """How a check ended."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "FAIL"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the preflight table. `advice`: what to change, empty when nothing."""

    name: str
    level: Level
    seen: str
    advice: str = ""


def require(checks: Sequence[Check]) -> None:
    """Raise `RefusedError` with the first failed check in one line."""
    for check in checks:
        if check.level is Level.FAIL:
            raise RefusedError(f"preflight refused: {check.name}: {check.seen}; {check.advice}")


def check_vehicle(telemetry: Telemetry, now_s: float) -> list[Check]:
    """Disarmed, on the ground, telling where it is, battery not empty."""
    return [
        _disarmed(telemetry),
        _estimate(telemetry, now_s),
        _battery(telemetry.battery_fraction),
    ]


def _disarmed(telemetry: Telemetry) -> Check:
    on_ground = telemetry.landed_state in (None, LANDED_STATE_ON_GROUND)
    armed, place = "armed" if telemetry.armed else "disarmed", "on the ground" if on_ground else "in the air"
    seen = f"{armed}, {place}, {mode_name(telemetry.mode)}"
    if telemetry.armed or not on_ground:
        return Check("vehicle", Level.FAIL, seen, "land and disarm it first: fly takes no vehicle over in the air")
    return Check("vehicle", Level.PASS, seen)


def _estimate(telemetry: Telemetry, now_s: float) -> Check:
    samples = {"LOCAL_POSITION_NED": telemetry.position, "ATTITUDE": telemetry.attitude, "HIGHRES_IMU": telemetry.imu}
    for name, sample in samples.items():
        if sample is None:
            return Check("estimate", Level.FAIL, f"no {name}", "wait for the EKF, or enable this message on PX4's companion link")
        if now_s - sample.time_s > MAX_SAMPLE_AGE_S:
            return Check(
                "estimate", Level.FAIL, f"{name} is {now_s - sample.time_s:.2f} s old", "check rate and latency of the link"
            )
    return Check("estimate", Level.PASS, "position, attitude and IMU arrive")


def _battery(fraction: float | None) -> Check:
    if fraction is None:
        return Check("battery", Level.WARN, "charge unknown", "check the battery by hand")
    if fraction < MIN_BATTERY_FRACTION:
        return Check("battery", Level.FAIL, f"{fraction:.0%}", f"charge it: at least {MIN_BATTERY_FRACTION:.0%} is wanted")
    return Check("battery", Level.PASS, f"{fraction:.0%}")


def check_lidar(scan: LidarScan | None, health: LidarHealth, now_s: float) -> list[Check]:
    """Scans arrive often and fresh enough, and enough beams say something."""
    if scan is None:
        return [Check("lidar", Level.FAIL, "no scan", "check the `lidar` section and the device")]
    age_s = now_s - scan.time_s
    known = float(np.mean(~np.isnan(scan.ranges_m)))
    seen = f"{health.rate_hz:.1f} Hz, age {1e3 * age_s:.0f} ms, {known:.0%} of beams known"
    if health.rate_hz < MIN_LIDAR_RATE_HZ:
        return [Check("lidar", Level.FAIL, seen, f"at least {MIN_LIDAR_RATE_HZ:g} Hz is needed: check device settings and link")]
    if age_s > MAX_SAMPLE_AGE_S:
        return [Check("lidar", Level.FAIL, seen, "scans arrive too late: check the network to the device")]
    if known < MIN_KNOWN_BEAMS:
        return [Check("lidar", Level.FAIL, seen, "most beams are unknown: check mounting, cover and blind sectors")]
    return [Check("lidar", Level.PASS, seen)]


def check_policy(metadata: PolicyMetadata, safety: SafetyConfig) -> list[Check]:
    """The policy's own limits against the safety filter's: larger ones are clipped, which the policy was not trained for."""
    low, high = metadata.action.low, metadata.action.high
    horizontal = math.hypot(max(abs(low[0]), abs(high[0])), max(abs(low[1]), abs(high[1])))
    pairs = (
        ("horizontal speed", horizontal, safety.max_horizontal_speed_m_s, "m/s"),
        ("vertical speed", max(abs(low[2]), abs(high[2])), safety.max_vertical_speed_m_s, "m/s"),
        ("yaw rate", max(abs(low[3]), abs(high[3])), safety.max_yaw_rate_rad_s, "rad/s"),
    )
    over = [f"{name} up to {value:.2f} > {limit:.2f} {unit}" for name, value, limit, unit in pairs if value > limit + 1e-9]
    if over:
        return [
            Check("policy limits", Level.WARN, "; ".join(over), "the safety filter will clip it; raise the limit if it may be")
        ]
    return [Check("policy limits", Level.PASS, f"within the safety limits, {metadata.rate_hz:g} Hz, {metadata.name}")]


def check_start(point: tuple[float, float], height_m: float, boxes: Sequence[Box], safety: SafetyConfig) -> list[Check]:
    """Takeoff column (ground to takeoff height, vehicle's radius) against the simulated world's boxes."""
    x, y = point
    keep_out = safety.vehicle_radius_m
    for box in boxes:
        gap = math.hypot(max(box[0] - x, 0.0, x - box[3]), max(box[1] - y, 0.0, y - box[4]))
        if gap < keep_out and box[2] < height_m + safety.vehicle_half_height_m:
            where = "inside an obstacle" if gap == 0.0 else f"{gap:.2f} m from an obstacle"
            return [
                Check(
                    "start",
                    Level.FAIL,
                    f"takeoff point ({x:g}, {y:g}) is {where}",
                    "move frame.takeoff_point_m or choose another sim.seed",
                )
            ]
    return [Check("start", Level.PASS, f"({x:.2f}, {y:.2f}) is clear up to {height_m:g} m")]


def check_goal_clear(goal: CorridorVector, boxes: Sequence[Box], safety: SafetyConfig) -> list[Check]:
    """The goal against the simulated world's boxes: a goal inside one cannot be reached."""
    for box in boxes:
        outside = (
            max(low - value, 0.0, value - high)
            for low, value, high in zip(box[:3], (goal.x, goal.y, goal.z), box[3:], strict=True)
        )
        if math.hypot(*outside) < safety.vehicle_radius_m:
            seen = f"({goal.x:g}, {goal.y:g}, {goal.z:g}) is at or in an obstacle"
            return [Check("goal", Level.FAIL, seen, "move goal.position_m or choose another sim.seed")]
    return [Check("goal", Level.PASS, f"({goal.x:.2f}, {goal.y:.2f}, {goal.z:.2f}) is free")]
