"""One 20 Hz tick: sample, observe, decide, judge. No I/O, the clock is an argument.

The same function is driven by the MAVSDK loop in real time, by the simulator in lockstep and by replay: the same scans,
states and times give the same records, bit for bit (apart from `inference_s`, which an injected timer measures).
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flight.lidar.reduce import BeamReducer, fill_unknown, levelled
from policy_export.errors import PolicyInputError, PolicyOutputError
from policy_export.observation import ObservationBuilder
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter
from safety.frames import CorridorVector, HeadingVector, heading_to_corridor
from safety.lidar import scan_problem
from safety.messages import Health, LidarScan, SafeCommand, VehicleState, VelocityCommand, Verdict


@dataclass(frozen=True, slots=True)
class TickRecord:
    """Everything about one tick. Corridor frame, SI units; without a usable state, `position` is None, yaw and distance NaN.

    `scan_time_s`, `state_time_s`: when the samples used were measured, NaN without one. `wanted`: the policy's command,
    None where the policy was not asked or not believed. `sent`: what the safety filter lets out. `hidden_reset`: the
    recurrent state was zero before or after this tick's step. `inference_s`: NaN where the policy was not stepped.
    `health`: what the filter was told besides, None where the loop told nothing.
    """

    now_s: float
    scan_time_s: float
    state_time_s: float
    position: CorridorVector | None
    velocity: CorridorVector | None
    yaw_rad: float
    wanted: VelocityCommand | None
    sent: SafeCommand
    verdict: Verdict
    distance_to_goal_m: float
    goal_reached: bool
    inference_s: float
    hidden_norm: float
    hidden_reset: bool
    health: Health | None = None


class Pilot:
    """Policy and safety filter around one goal.

    `goal`: corridor frame. `timer`: seconds, only for `inference_s`. Samples that the filter's limits call stale are not
    shown to the policy either. Call `reset` on OFFBOARD entry.
    """

    def __init__(
        self,
        policy: PolicyRunner,
        safety: SafetyFilter,
        goal: CorridorVector,
        goal_radius_m: float,
        *,
        level_scans: bool = False,
        timer: Callable[[], float] = time.perf_counter,
    ) -> None:
        if not (_finite(goal) and 0.0 < goal_radius_m < math.inf):
            raise ValueError(f"goal {goal} and radius {goal_radius_m} m must be finite, and the radius positive")
        layout = policy.metadata.observation
        self.goal = goal
        self.goal_radius_m = goal_radius_m
        self._policy = policy
        self._safety = safety
        self._level_scans = level_scans
        self._timer = timer
        self._limits = safety.config
        self._in_heading_frame = policy.metadata.action.frame == "heading"
        self._reducer = BeamReducer(layout.lidar.beams, layout.lidar.fov_rad, layout.lidar.range_max_m)
        self._builder = ObservationBuilder(layout)

    def reset(self) -> None:
        """Forget the recurrent state and the filter's memory: OFFBOARD entry."""
        self._safety.reset()
        self._policy.reset("offboard_entry")

    def set_goal(self, goal: CorridorVector) -> None:
        """Fly to another goal; the recurrent state starts again from zero."""
        if not _finite(goal):
            raise ValueError(f"goal {goal} must be finite")
        if goal != self.goal:
            self.goal = goal
            self._policy.reset("goal_change")

    def tick(self, scan: LidarScan | None, state: VehicleState | None, now_s: float, health: Health | None = None) -> TickRecord:
        """One step of the whole stack at `now_s`. Never raises for bad samples: they end in a braking command.

        `health`: what the loop knows besides. Where it lacks the inference time, that of this tick is judged; without any
        `health` no time is judged, because lockstep measures the computer, not the flight.
        """
        known = state if _usable(state) else None
        observation = self._observe(scan, known, now_s)
        wanted, inference_s, hidden_reset = self._decide(observation, known, now_s)
        judged = self._complete(health, inference_s)
        sent, verdict = self._safety.apply(wanted, state, scan, now_s, judged)
        if verdict.fault == "hidden_exploded":
            self._policy.reset("bad_output")
        distance_m = _distance_m(known.position, self.goal) if known is not None else math.nan
        return TickRecord(
            now_s=now_s,
            scan_time_s=scan.time_s if scan is not None else math.nan,
            state_time_s=state.time_s if state is not None else math.nan,
            position=known.position if known is not None else None,
            velocity=known.velocity if known is not None else None,
            yaw_rad=known.yaw_rad if known is not None else math.nan,
            wanted=wanted,
            sent=sent,
            verdict=verdict,
            distance_to_goal_m=distance_m,
            goal_reached=distance_m <= self.goal_radius_m,
            inference_s=inference_s,
            hidden_norm=judged.hidden_norm,
            hidden_reset=hidden_reset,
            health=None if health is None else judged,
        )

    def _complete(self, health: Health | None, inference_s: float) -> Health:
        """What the loop knows, and what is known here."""
        if health is None:
            return Health(hidden_norm=self._policy.hidden_norm)
        measured = health.inference_s if math.isfinite(health.inference_s) else inference_s
        return dataclasses.replace(health, hidden_norm=self._policy.hidden_norm, inference_s=measured)

    def _observe(self, scan: LidarScan | None, state: VehicleState | None, now_s: float) -> NDArray[np.float32] | None:
        """The policy's observation, or None when a sample is missing, stale or says nothing."""
        ranges = self._sample(scan, state, now_s)
        if ranges is None or state is None:
            return None
        goal, position, velocity, acceleration = self.goal, state.position, state.velocity, state.acceleration
        try:
            return self._builder.build(
                ranges,
                (position.x, position.y, position.z),
                (velocity.x, velocity.y, velocity.z),
                (acceleration.x, acceleration.y, acceleration.z),
                state.yaw_rad,
                (goal.x, goal.y, goal.z),
            )
        except PolicyInputError:
            return None

    def _sample(self, scan: LidarScan | None, state: VehicleState | None, now_s: float) -> NDArray[np.float32] | None:
        """The scan in the policy's beams; None unless scan and state are fresh and at least one beam knows something."""
        limits = self._limits
        if scan is None or state is None or scan_problem(scan) is not None:
            return None
        if not -limits.future_tolerance_s <= now_s - scan.time_s <= limits.scan_stale_s:
            return None
        if not -limits.future_tolerance_s <= now_s - state.time_s <= limits.state_stale_s:
            return None
        ranges = self._reducer.reduce(levelled(scan, state.roll_rad, state.pitch_rad) if self._level_scans else scan)
        return None if np.isnan(ranges).all() else fill_unknown(ranges, self._reducer.range_max_m)

    def _decide(
        self, observation: NDArray[np.float32] | None, state: VehicleState | None, now_s: float
    ) -> tuple[VelocityCommand | None, float, bool]:
        """(wanted command, inference time in s, whether the recurrent state started from zero)."""
        if observation is None or state is None:
            return None, math.nan, False
        before_s = self._timer()
        try:
            action = self._policy.step(observation, now_s)
        except (PolicyOutputError, PolicyInputError):
            self._policy.reset("bad_output")
            return None, self._timer() - before_s, True
        inference_s = self._timer() - before_s
        return self._to_command(action, state.yaw_rad), inference_s, self._policy.step_count == 1

    def _to_command(self, action: NDArray[np.float32], yaw_rad: float) -> VelocityCommand:
        vx, vy, vz, yaw_rate_rad_s = (float(value) for value in action)
        if self._in_heading_frame:
            return VelocityCommand(heading_to_corridor(HeadingVector(vx, vy, vz), yaw_rad), yaw_rate_rad_s)
        return VelocityCommand(CorridorVector(vx, vy, vz), yaw_rate_rad_s)


def _usable(state: VehicleState | None) -> bool:
    if state is None:
        return False
    scalars = (state.time_s, state.roll_rad, state.pitch_rad, state.yaw_rad, state.yaw_rate_rad_s)
    return all(map(math.isfinite, scalars)) and all(map(_finite, (state.position, state.velocity, state.acceleration)))


def _finite(vector: CorridorVector) -> bool:
    return math.isfinite(vector.x) and math.isfinite(vector.y) and math.isfinite(vector.z)


def _distance_m(a: CorridorVector, b: CorridorVector) -> float:
    return math.dist((a.x, a.y, a.z), (b.x, b.y, b.z))
