"""One flight of the whole stack in lockstep: policy file, safety filter, six-degree-of-freedom vehicle, LiDAR device.

The same `Pilot.tick` as on the vehicle, driven by vehicle time instead of a clock: as fast as the machine goes, and bit for
bit the same for the same seeds. The simulated vehicle hovers at the start; the scan is older than the tick, and the command
reaches the autopilot later than the tick, as over a real link.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from campaigns.statistics import EpisodeResult
from flight.tick import Pilot, TickRecord
from flight.trajectory import FlightLog
from policy_export.runner import PolicyRunner
from safety.config import SafetyConfig
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import BRAKE, Health, LidarScan, SafeCommand, VehicleState, VelocityCommand, Verdict
from sim_gateway.collision import clearance_m
from sim_gateway.errors import DivergedError
from sim_gateway.lidar import LidarConfig
from sim_gateway.paths import shortest_path_length
from sim_gateway.readings import Motion, Scan
from sim_gateway.scene import World
from sim_gateway.simulation import Simulation, WindConfig, step_at
from sim_gateway.vehicle import STEP_S
from sim_gateway.vehicle_params import PROFILES

TICK_S = 0.05
_OVERRULED = Health(overruled=True, inference_s=0.0)  # zero was sent last; the computer's own times are not judged here
BRAKE_AFTER_GOAL_S = 1.0
"""As `fly` does on arrival, before it asks the autopilot to hold."""
SUCCESS_RADIUS_M = 0.3
"""Of the task (the article's Eq. 10), 3D, of the true position. The stack itself only knows its estimate of it."""
WALL_LENGTH_M = 4.0
"""A fixed box longer than this along x or y is a wall, not a pillar."""


@dataclass(frozen=True, slots=True)
class StackConfig:
    """What is flown and under which conditions. Without `filtered` the policy's command goes out as it is, for comparison.

    `arrival_radius_m`: estimated distance at which the stack says it has arrived, as in the mission file; smaller than the task's
    radius, because the estimate is not the truth.
    """

    policy: Path
    safety: SafetyConfig
    filtered: bool = True
    takeoff_height_m: float = 2.0
    arrival_radius_m: float = 0.2
    time_limit_s: float = 90.0
    estimate: str = "nominal"
    dynamics: str = "internal"
    vehicle: str = "iris"
    wind: WindConfig = field(default_factory=WindConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig.device)
    scan_age_s: float = 0.02
    command_delay_s: float = 0.012


class Unfiltered(SafetyFilter):
    """Stands where the safety filter stands, and passes everything: only to measure what the filter costs and saves."""

    def apply(
        self,
        command: VelocityCommand | None,
        state: VehicleState | None,
        scan: LidarScan | None,
        now_s: float,
        health: Health | None = None,
    ) -> tuple[SafeCommand, Verdict]:
        """The command as it is; BRAKE without one."""
        wanted = command or BRAKE
        return SafeCommand(wanted.velocity, wanted.yaw_rate_rad_s), Verdict(braking=command is None)


@dataclass(slots=True)
class _Watch:
    """What is noted while flying: from the truth, which the stack never sees."""

    least_distance_m: float = math.inf
    task_done: tuple[float, float] | None = None
    """Vehicle time, s, and metres flown when the goal's radius was first reached."""
    first_contact: str | None = None
    left_fence: bool = False
    diverged: bool = False
    velocities: list[tuple[float, float, float]] = field(default_factory=list)


class LockstepFlight:
    """One vehicle in one world under one policy. `run` flies it to its end; `log` then holds every tick."""

    def __init__(self, world: World, config: StackConfig, runner: PolicyRunner | None = None, seed: int | None = None) -> None:
        self.world, self.config = world, config
        self.simulation = Simulation(
            world,
            PROFILES[config.vehicle],
            lidar=config.lidar,
            estimate=config.estimate,
            wind=config.wind,
            seed=world.seed if seed is None else seed,
            hover_height_m=config.takeoff_height_m,
            dynamics=config.dynamics,
        )
        self.goal = CorridorVector(*world.goal)
        self.filter = (SafetyFilter if config.filtered else Unfiltered)(config.safety)
        self.pilot = Pilot(runner or PolicyRunner.load(config.policy), self.filter, self.goal, config.arrival_radius_m)
        self.log = FlightLog(max_ticks=round((config.time_limit_s + BRAKE_AFTER_GOAL_S) / TICK_S) + 2)
        self._command = self._next = SafeCommand(BRAKE.velocity, 0.0)
        self._scans = 0
        self._take_scan()
        self._watch = _Watch()
        self._braked = False

    def run(self) -> EpisodeResult:
        """Fly until the goal (and one second of braking) or until the time is up; contacts are counted and flown through.

        A vehicle that can no longer be simulated ends the flight as a failure.
        """
        self.pilot.reset()
        reached_s = stopped_s = math.inf
        tick = 0
        while True:
            now_s = tick * TICK_S
            record = self._tick(now_s, braking=now_s >= reached_s)
            if record.goal_reached and not math.isfinite(reached_s):
                reached_s = now_s
                stopped_s = now_s + BRAKE_AFTER_GOAL_S
            if now_s >= min(stopped_s, self.config.time_limit_s):
                break
            try:
                self._fly_to((tick + 1) * TICK_S)
            except DivergedError:
                self._watch.diverged = True
                break
            tick += 1
        return self._result(reached_s, tick)

    def _tick(self, now_s: float, *, braking: bool) -> TickRecord:
        """Sample, tick, and put the command on its way. Vehicle time stands at `now_s` before and after."""
        health = _OVERRULED if self._braked else None
        record = self.pilot.tick(self._latest, vehicle_state(self.simulation.estimate(), now_s), now_s, health)
        self.log.append(record, now_s)
        self._braked = braking
        self._next = SafeCommand(BRAKE.velocity, 0.0) if braking else record.sent
        return record

    def _take_scan(self) -> None:
        self._latest = lidar_scan(self.simulation.scan(), self._scans)
        self._scans += 1

    def _fly_to(self, next_s: float) -> None:
        """One tick of vehicle time: the old command until the new one has arrived, the next scan just before the next tick."""
        arrival = step_at(next_s - TICK_S + self.config.command_delay_s)
        scan_at = step_at(next_s - self.config.scan_age_s)
        end = step_at(next_s)
        for until in sorted({arrival, scan_at, end}):
            if self.simulation.steps >= arrival:
                self._command = self._next
            velocity = self._command.velocity
            steps = until - self.simulation.steps
            self.simulation.advance(max(steps, 0), (velocity.x, velocity.y, velocity.z), self._command.yaw_rate_rad_s)
            if until == scan_at:
                self._take_scan()
        self._observe_truth()

    def _observe_truth(self) -> None:
        truth, watch = self.simulation.truth, self._watch
        watch.least_distance_m = min(watch.least_distance_m, math.dist(truth.position_m, self.world.goal))
        watch.velocities.append(truth.velocity_m_s)
        if watch.task_done is None and watch.least_distance_m <= SUCCESS_RADIUS_M:
            watch.task_done = self.simulation.time_s, self.simulation.flown_m
        if self.simulation.contacts and watch.first_contact is None:
            boxes, fixed = self.simulation.boxes(), len(self.world.static_boxes)
            watch.first_contact = what_was_hit(boxes, fixed, truth.position_m, self.simulation.contact_radius_m)
        fence = self.config.safety.fence
        watch.left_fence = watch.left_fence or fence.margin_m(*truth.position_m) < 0.0

    def _result(self, reached_s: float, ticks: int) -> EpisodeResult:
        simulation, watch = self.simulation, self._watch
        success = not watch.diverged and math.isfinite(reached_s) and watch.least_distance_m <= SUCCESS_RADIUS_M
        failure = "diverged" if watch.diverged else watch.first_contact or ("fence" if watch.left_fence else None)
        if failure is None and not success:
            failure = "missed_goal" if math.isfinite(reached_s) else "timeout"
        # the task ends at the goal's radius: what lies inside it, the stack's own arrival and braking, counts in neither path
        duration_s, flown_m = watch.task_done or (min(reached_s, ticks * TICK_S), simulation.flown_m)
        start = (*self.world.start[:2], self.config.takeoff_height_m)
        shortest_m = shortest_path_length(self.world.static_boxes, start, self.world.goal, simulation.contact_radius_m)
        return EpisodeResult(
            seed=self.world.seed,
            success=success,
            arrived=math.isfinite(reached_s),
            contacts=simulation.contacts,
            failure=failure,
            ticks=ticks,
            duration_s=duration_s,
            path_length_m=flown_m,
            shortest_path_m=max(0.0, shortest_m - SUCCESS_RADIUS_M),
            min_clearance_m=simulation.min_clearance_m,
            mean_jerk_m_s3=mean_jerk(np.array(watch.velocities)),
            interventions=count_interventions(self.log, reached_s),
        )


def what_was_hit(boxes: NDArray[np.float64], fixed: int, position_m: tuple[float, float, float], radius_m: float) -> str:
    """The failure's name for a contact at `position_m`: the nearest of `boxes` [m, 6], the first `fixed` of which stand still."""
    position = np.array(position_m)
    nearest = min(range(len(boxes)), key=lambda i: clearance_m(boxes[i : i + 1], position, radius_m))
    if nearest >= fixed:
        return "hit_moving"
    size = boxes[nearest, 3:] - boxes[nearest, :3]
    return "wall" if max(size[0], size[1]) > WALL_LENGTH_M else "hit_static"


def vehicle_state(motion: Motion, time_s: float) -> VehicleState:
    """The simulator's estimate as the flight stack gets it."""
    return VehicleState(
        time_s=time_s,
        position=CorridorVector(*motion.position_m),
        velocity=CorridorVector(*motion.velocity_m_s),
        acceleration=CorridorVector(*motion.acceleration_m_s2),
        roll_rad=motion.roll_rad,
        pitch_rad=motion.pitch_rad,
        yaw_rad=motion.yaw_rad,
        yaw_rate_rad_s=motion.angular_rate_rad_s[2],
    )


def lidar_scan(scan: Scan, sequence: int) -> LidarScan:
    """The simulator's scan as the flight stack gets it."""
    angles = (scan.angle_min_rad, scan.angle_increment_rad)
    return LidarScan(scan.time_s, scan.ranges_m, *angles, scan.range_min_m, scan.range_max_m, sequence)


def mean_jerk(velocities: NDArray[np.float64]) -> float:
    """Mean norm of the jerk, m/s3, of velocities [ticks, 3] at 20 Hz."""
    if len(velocities) < 3:
        return 0.0
    jerk = np.diff(velocities, n=2, axis=0) / TICK_S**2
    return float(np.linalg.norm(jerk, axis=1).mean())


def count_interventions(log: FlightLog, until_s: float = math.inf) -> dict[str, int]:
    """Ticks up to `until_s` in which each rule of the safety filter spoke."""
    counts: dict[str, int] = {}
    for record in (r for r in log.records if r.now_s <= until_s):
        for rule in {item.rule for item in record.verdict.interventions}:
            counts[rule] = counts.get(rule, 0) + 1
    return counts


assert math.isclose(TICK_S / STEP_S, 12.5)  # `step_at` alternates 12 and 13 steps
