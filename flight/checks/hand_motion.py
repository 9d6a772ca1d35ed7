"""Frame self-test: the vehicle is moved by hand, and odometry, LiDAR and setpoint axes must tell the same story.

The person is told what to do (turn left, push forward, move left, lift), so odometry is compared with what really happened. The
LiDAR is compared with odometry: under the right mounting, a scan taken before a motion predicts the one after it. All mountings,
turned by any angle and mirrored, are tried on the recorded pairs; the one that predicts best must be the mission's own.
Rotation shows a mirrored LiDAR, translation a turned one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flight.preflight import Check, Level
from safety.frames import (
    CorridorFrame,
    CorridorVector,
    HeadingVector,
    corridor_to_heading,
    heading_to_corridor,
    wrap_angle_rad,
)
from safety.messages import LidarScan, VehicleState

TURN_RAD = math.radians(40.0)
MOVE_M, LIFT_M = 0.5, 0.3
AXIS_TOLERANCE_RAD = math.radians(30.0)
SAMPLE_S, STEP_DEADLINE_S = 0.1, 60.0
MAX_SAMPLES, MAX_PAIRS = 600, 24
CANDIDATE_STEP_RAD = math.radians(5.0)
YAW_TOLERANCE_RAD = math.radians(12.0)
CLIP_M = 0.5
CONTRAST_M = 0.03
LEVEL_RAD = math.radians(15.0)

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Sample:
    """A scan and where the vehicle was, by its own odometry. Corridor frame."""

    scan: LidarScan
    state: VehicleState


@dataclass(frozen=True, slots=True)
class HandStep:
    """One motion asked for. `done(first, now)` says whether it has been made, in either direction."""

    name: str
    prompt: str
    done: Callable[[VehicleState, VehicleState], bool]


@dataclass(frozen=True, slots=True)
class Mounting:
    """How the LiDAR seems to sit, against the mission's `lidar` section. Residuals in m; `yaw_rad` is counter-clockwise."""

    mirrored: bool
    yaw_rad: float
    residual_m: float
    as_configured_m: float
    mirror_known: bool
    yaw_known: bool


def _turned(first: VehicleState, now: VehicleState) -> bool:
    return abs(wrap_angle_rad(now.yaw_rad - first.yaw_rad)) > TURN_RAD


def _moved(first: VehicleState, now: VehicleState) -> bool:
    return math.hypot(now.position.x - first.position.x, now.position.y - first.position.y) > MOVE_M


def _lifted(first: VehicleState, now: VehicleState) -> bool:
    return abs(now.position.z - first.position.z) > LIFT_M


STEPS = (
    HandStep("turn", "turn the vehicle slowly to its LEFT (counter-clockwise), about 60 degrees", _turned),
    HandStep("forward", "push it FORWARD along its nose, about 0.7 m, without turning", _moved),
    HandStep("left", "move it to its LEFT, about 0.7 m, without turning", _moved),
    HandStep("lift", "LIFT it about half a metre", _lifted),
)


class HandTest:
    """Prompts, watches, records. `scan` and `state` give the newest samples, `prompt` tells the person."""

    def __init__(
        self,
        scan: Callable[[], LidarScan | None],
        state: Callable[[], VehicleState | None],
        prompt: Callable[[str], None],
        keep_waiting: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
        deadline_s: float = STEP_DEADLINE_S,
    ) -> None:
        self.samples: list[Sample] = []
        self._scan, self._state, self._prompt, self._keep_waiting, self._clock = scan, state, prompt, keep_waiting, clock
        self._deadline_s = deadline_s

    def run(self, frame: CorridorFrame) -> list[Check]:
        """All steps in turn; the first that is not made ends it."""
        checks: list[Check] = []
        for step in STEPS:
            ends = self._make(step)
            if ends is None:
                seen = f"not done within {self._deadline_s:g} s, or the odometry did not follow"
                checks.append(
                    Check(f"axes: {step.name}", Level.FAIL, seen, "repeat it; if the vehicle did move, check its position source")
                )
                return checks
            checks.append(judge_step(step.name, *ends, frame))
        return checks + judge_mounting(find_mounting(self.samples))

    def _make(self, step: HandStep) -> tuple[VehicleState, VehicleState] | None:
        self._prompt(step.prompt)
        first, deadline = self._state(), self._clock() + self._deadline_s
        while self._clock() < deadline:
            self._keep_waiting()
            now = self._state()
            first = first or now
            self._note(now)
            if first is not None and now is not None and step.done(first, now):
                return first, now
            time.sleep(SAMPLE_S)
        return None

    def _note(self, state: VehicleState | None) -> None:
        scan = self._scan()
        level = state is not None and math.hypot(state.roll_rad, state.pitch_rad) < LEVEL_RAD
        if scan is not None and state is not None and level and len(self.samples) < MAX_SAMPLES:
            self.samples.append(Sample(scan, state))


def judge_step(name: str, first: VehicleState, last: VehicleState, frame: CorridorFrame) -> Check:
    """What odometry made of one motion, and what a setpoint in that direction would be."""
    if name == "turn":
        turned_deg = math.degrees(wrap_angle_rad(last.yaw_rad - first.yaw_rad))
        seen = f"turned left by hand, odometry says {turned_deg:+.0f} deg"
        return _judged(name, turned_deg > 0.0, seen, "yaw runs the wrong way: check the autopilot's mounting (SENS_BOARD_ROT)")
    moved = CorridorVector(*(getattr(last.position, a) - getattr(first.position, a) for a in "xyz"))
    if name == "lift":
        return _judged(name, moved.z > 0.0, f"lifted by hand, odometry says {moved.z:+.2f} m", "height runs the wrong way")
    wanted = HeadingVector(1.0, 0.0, 0.0) if name == "forward" else HeadingVector(0.0, 1.0, 0.0)
    heading = corridor_to_heading(moved, first.yaw_rad)
    error_rad = abs(wrap_angle_rad(math.atan2(heading.y, heading.x) - math.atan2(wanted.y, wanted.x)))
    setpoint = frame.vector_to_ned(heading_to_corridor(wanted, first.yaw_rad))
    travelled = frame.vector_to_ned(moved)
    apart_rad = abs(wrap_angle_rad(math.atan2(travelled.y, travelled.x) - math.atan2(setpoint.y, setpoint.x)))
    seen = f"{name}: odometry is {math.degrees(error_rad):.0f} deg off, a setpoint {math.degrees(apart_rad):.0f} deg"
    advice = "odometry and body axes disagree: check heading, the position source's mounting, and frame.heading_deg"
    return _judged(name, max(error_rad, apart_rad) < AXIS_TOLERANCE_RAD, seen, advice)


def _judged(name: str, good: bool, seen: str, advice: str) -> Check:
    return Check(f"axes: {name}", Level.PASS, seen) if good else Check(f"axes: {name}", Level.FAIL, seen, advice)


def judge_mounting(found: Mounting | None) -> list[Check]:
    """The mounting that explains the scans best, against the mission's."""
    name = "LiDAR orientation"
    if found is None:
        return [Check(name, Level.WARN, "too little motion, or too few returns", "repeat it near walls and corners")]
    seen = f"best explained {'mirrored and ' if found.mirrored else ''}turned by {math.degrees(found.yaw_rad):.0f} deg "
    seen += f"({found.residual_m:.2f} m, as configured {found.as_configured_m:.2f} m)"
    better = found.as_configured_m - found.residual_m > CONTRAST_M
    if better and found.mirrored and found.mirror_known:
        return [Check(name, Level.FAIL, seen, "the scan is left-right reversed: change lidar.mirror in the mission")]
    if better and abs(found.yaw_rad) > YAW_TOLERANCE_RAD and found.yaw_known:
        advice = f"add {math.degrees(found.yaw_rad):.0f} deg to lidar.mount_yaw_deg in the mission"
        return [Check(name, Level.FAIL, seen, advice)]
    if not (found.mirror_known and found.yaw_known):
        return [
            Check(name, Level.WARN, "surroundings too plain to tell", "repeat it near walls and corners, with larger motions")
        ]
    return [Check(name, Level.PASS, f"scans follow the motion within {found.as_configured_m:.2f} m")]


def find_mounting(samples: Sequence[Sample]) -> Mounting | None:
    """Try every mounting on pairs of samples. None without enough motion or returns."""
    pairs = _pairs(samples)
    if len(pairs) < 2:
        return None
    angles = np.arange(-math.pi + CANDIDATE_STEP_RAD, math.pi + 1e-9, CANDIDATE_STEP_RAD)
    costs = np.array([[_cost(pairs, mirrored, float(angle)) for angle in angles] for mirrored in (False, True)])
    if not np.isfinite(costs).any():
        return None
    costs = np.where(np.isfinite(costs), costs, CLIP_M)
    row, column = np.unravel_index(int(np.argmin(costs)), costs.shape)
    best = float(costs[row, column])
    far = np.abs(np.remainder(angles - angles[column] + math.pi, 2.0 * math.pi) - math.pi) > 2.0 * YAW_TOLERANCE_RAD
    return Mounting(
        mirrored=bool(row),
        yaw_rad=float(angles[column]),
        residual_m=best,
        as_configured_m=float(costs[0, int(np.argmin(np.abs(angles)))]),
        mirror_known=float(costs[1 - row].min()) - best > CONTRAST_M,
        yaw_known=float(costs[row][far].min()) - best > CONTRAST_M,
    )


def _pairs(samples: Sequence[Sample]) -> list[tuple[Sample, Sample]]:
    """Pairs far enough apart to tell and near enough to see the same walls, spread over the recording."""
    found = []
    gap = max(1, len(samples) // 40)
    for i in range(0, len(samples), gap):
        for j in range(i + 1, len(samples)):
            a, b = samples[i].state, samples[j].state
            apart_m = math.hypot(b.position.x - a.position.x, b.position.y - a.position.y)
            turned_rad = abs(wrap_angle_rad(b.yaw_rad - a.yaw_rad))
            if turned_rad > math.radians(20.0) or apart_m > 0.3:
                found.append((samples[i], samples[j]))
                break
    return found[:: max(1, len(found) // MAX_PAIRS)]


def _cost(pairs: Sequence[tuple[Sample, Sample]], mirrored: bool, yaw_rad: float) -> float:
    """Mean clipped difference between predicted and measured ranges under one mounting, m; NaN without common beams."""
    total, count = 0.0, 0
    for before, after in pairs:
        differences = _differences(before, after, mirrored, yaw_rad)
        total += float(np.minimum(differences, CLIP_M).sum())
        count += differences.size
    return total / count if count >= 30 else math.nan


def _differences(before: Sample, after: Sample, mirrored: bool, yaw_rad: float) -> FloatArray:
    side = -1.0 if mirrored else 1.0
    scan, ranges = before.scan, before.scan.ranges_m.astype(np.float64)
    raw = scan.angle_min_rad + scan.angle_increment_rad * np.arange(ranges.size)
    hit = np.isfinite(ranges) & (ranges > scan.range_min_m)
    bearing = before.state.yaw_rad + side * raw[hit] + yaw_rad
    x = before.state.position.x + ranges[hit] * np.cos(bearing) - after.state.position.x
    y = before.state.position.y + ranges[hit] * np.sin(bearing) - after.state.position.y
    seen_at = side * (np.arctan2(y, x) - after.state.yaw_rad - yaw_rad)
    target = after.scan
    turned = np.mod(seen_at - target.angle_min_rad + 0.5 * target.angle_increment_rad, 2.0 * math.pi)
    index = np.floor(turned / target.angle_increment_rad).astype(np.intp)
    inside = index < target.ranges_m.size
    measured = target.ranges_m[index[inside]].astype(np.float64)
    predicted = np.hypot(x, y)[inside]
    both = np.isfinite(measured) & (measured > target.range_min_m) & (predicted < target.range_max_m)
    return np.asarray(np.abs(predicted[both] - measured[both]), dtype=np.float64)
