"""One flight of one adversary: policy, filter, delays, vehicle, and the judge that looks at the truth alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from campaigns.adversaries.disturbance import Conditions, Disturbance
from campaigns.adversaries.policies import Policy, View
from campaigns.adversaries.scenes import Scene
from campaigns.lockstep import TICK_S, lidar_scan, vehicle_state
from safety.config import SafetyConfig
from safety.filter import MAX_GAP_TICKS, SafetyFilter
from safety.messages import BRAKE, LidarScan, SafeCommand, Verdict
from sim_gateway.simulation import step_at
from sim_gateway.vehicle import POS, VEL

Array = NDArray[np.float64]
ROUNDING = 1e-6
MOVING_M_S = 0.1  # passive safety: what runs into a standing vehicle is not its doing
SETTLE_S = 10.0
HULL_RADIUS_M, HULL_HALF_HEIGHT_M = 0.35, 0.1  # the true hull, whatever the filter is told


@dataclass
class Outcome:
    """What a flight came to. Distances of the true hull, m, negative = inside an obstacle, outside the fence.

    `events`: kind of violation to how often it began. `first_s`: when the first one did.
    """

    ticks: int = 0
    clearance_m: float = math.inf
    fence_m: float = math.inf
    events: dict[str, int] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    first_s: float | None = None
    changed: int = 0
    braking: int = 0

    @property
    def worst_m(self) -> float:
        """The lesser of both distances."""
        return min(self.clearance_m, self.fence_m)

    def note(self, kind: str, now_s: float) -> None:
        """A violation begins."""
        self.events[kind] = self.events.get(kind, 0) + 1
        self.first_s = now_s if self.first_s is None else self.first_s


class Judge:
    """Watches hull and commands. Limits are worked out again here, not taken from `safety.limits`."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._config, self.outcome = scene, scene.safety, Outcome()
        self._last, self._added = np.zeros(3), np.zeros(3)
        self._since_s = MAX_GAP_TICKS * TICK_S  # the first command counts as one after a pause
        self._touching = self._outside = False

    def sent(self, command: SafeCommand, now_s: float) -> None:
        """A command leaves: is it inside every limit?"""
        v = command.velocity
        velocity = np.array((v.x, v.y, v.z))
        added = velocity - _on_the_way(velocity, self._last)
        for kind in broken_limits(velocity, command.yaw_rate_rad_s, self._config):
            self.outcome.note(kind, now_s)
        if np.linalg.norm(added) > self._config.max_acceleration_m_s2 * self._since_s + ROUNDING:
            self.outcome.note("acceleration", now_s)
        change = added - _on_the_way(added, self._since_s * self._added)
        if np.linalg.norm(change) > self._config.max_jerk_m_s3 * self._since_s**2 + ROUNDING:
            self.outcome.note("jerk", now_s)
        self._last, self._added, self._since_s = velocity, added / self._since_s, TICK_S

    def flown(self, place: Array, clearance_m: float, velocity: Array, now_s: float) -> None:
        """Where the vehicle is now, [3] each, and how clear of the nearest box."""
        outcome, fence_m = self.outcome, self._scene.fence.margin_m(place, HULL_RADIUS_M, HULL_HALF_HEIGHT_M)
        outcome.clearance_m, outcome.fence_m = min(outcome.clearance_m, clearance_m), min(outcome.fence_m, fence_m)
        touching, outside = clearance_m < 0.0, fence_m < 0.0
        if touching and not self._touching:
            moving = math.hypot(velocity[0], velocity[1]) > MOVING_M_S
            outcome.note("contact" if moving else "contact at rest", now_s)
        if outside and not self._outside:
            outcome.note("fence", now_s)
        self._touching, self._outside = touching, outside


def broken_limits(velocity: Array, yaw_rate_rad_s: float, config: SafetyConfig) -> list[str]:
    """Names of the speed limits that a command breaks."""
    if not (np.isfinite(velocity).all() and math.isfinite(yaw_rate_rad_s)):
        return ["not finite"]
    checks = (
        ("speed", math.hypot(velocity[0], velocity[1]), config.max_horizontal_speed_m_s),
        ("vertical speed", abs(velocity[2]), config.max_vertical_speed_m_s),
        ("yaw rate", abs(yaw_rate_rad_s), config.max_yaw_rate_rad_s),
    )
    return [name for name, value, limit in checks if value > limit + ROUNDING]


def _on_the_way(point: Array, end: Array) -> Array:
    """Nearest place to `point` [3] on the way from zero to `end` [3]: what is kept; slowing down along it costs nothing."""
    length2 = float(end @ end)
    share = min(1.0, max(0.0, float(point @ end) / length2)) if length2 > 0.0 else 0.0
    return share * end


Signs = Callable[[int], float]
Watcher = Callable[[View, SafeCommand, Verdict, Outcome], None]


class Duel:
    """A filter against a policy in a scene. `alter` may change what the filter is shown of a scan, at a time."""

    def __init__(self, scene: Scene, conditions: Conditions, seed: int, *, safety: SafetyFilter | None = None) -> None:
        self.scene, self.conditions = scene, conditions
        self.filter = safety or SafetyFilter(scene.safety)
        self.simulation = conditions.simulation(scene.world, scene.height_m, seed)
        self._random = np.random.default_rng((seed, 1))
        self._disturbance = Disturbance(conditions, scene.safety, self._random)
        self._judge, self.view = Judge(scene), View(scene, boxes=scene.boxes)
        self._command = self._next = SafeCommand(BRAKE.velocity, 0.0)
        self.alter: Callable[[LidarScan, float], LidarScan] | None = None
        self._settle()
        self._scans = 0
        self._scan = lidar_scan(self.simulation.scan(), 0)

    def _settle(self) -> None:
        """Hover until the controller is used to the wind, then start from the start: a wind that begins at once is no wind."""
        scene, simulation = self.scene, self.simulation
        simulation.disturb((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (*self.conditions.wind_m_s, 0.0))
        simulation.advance(step_at(SETTLE_S), (0.0, 0.0, 0.0), 0.0)
        simulation.carry((*scene.world.start[:2], scene.height_m), scene.world.start_yaw_rad)

    def fly(self, policy: Policy, ticks: int, errors: Signs | None = None, watch: Watcher | None = None) -> Outcome:
        """`ticks` ticks of the policy. `errors`: sign of the estimate's errors by tick, None = as the conditions say."""
        outcome = self._judge.outcome
        for tick in range(ticks):
            now_s = SETTLE_S + tick * TICK_S
            self._look(tick, now_s, errors)
            wanted = policy(self.view)
            sent, verdict = self.filter.apply(wanted, self.view.state, self.view.scan, now_s)
            self._judge.sent(sent, now_s - SETTLE_S)
            if verdict.fault is not None:
                outcome.faults[verdict.fault] = outcome.faults.get(verdict.fault, 0) + 1
            outcome.changed += sent.velocity != wanted.velocity
            outcome.braking += verdict.braking
            if watch is not None:
                watch(self.view, sent, verdict, outcome)
            self._next = sent
            self._fly_to(now_s)
        outcome.ticks = ticks
        return outcome

    def _look(self, tick: int, now_s: float, errors: Signs | None) -> None:
        """Take in the truth, disturb the estimate, and sample it."""
        view, truth = self.view, self.simulation.truth
        view.tick, view.yaw_rad = tick, truth.yaw_rad
        view.place, view.velocity = np.array(truth.position_m), np.array(truth.velocity_m_s)
        view.boxes = self.simulation.boxes() if self.scene.world.movers else self.scene.boxes
        self._disturbance.apply(self.simulation, view.threat(), None if errors is None else errors(tick))
        view.state, view.scan = vehicle_state(self.simulation.estimate(), now_s), self._altered(now_s)

    def _altered(self, now_s: float) -> LidarScan:
        return self._scan if self.alter is None else self.alter(self._scan, now_s - SETTLE_S)

    def _fly_to(self, now_s: float) -> None:
        """One tick of vehicle time: the command arrives late, the next scan is taken a little before the next tick."""
        simulation, next_s = self.simulation, now_s + TICK_S
        arrival, end = step_at(now_s + self.conditions.command_delay_s), step_at(next_s)
        scan_at = step_at(next_s - self.conditions.scan_age_s)
        for until in sorted({arrival, scan_at, end}):
            velocity = self._command.velocity
            simulation.advance(until - simulation.steps, (velocity.x, velocity.y, velocity.z), self._command.yaw_rate_rad_s)
            if until >= arrival:
                self._command = self._next
            if until == scan_at and self._random.random() >= self.conditions.lost_scans:
                self._scans += 1
                self._scan = lidar_scan(simulation.scan(), self._scans)
            row = simulation.state_row
            self._judge.flown(row[POS : POS + 3], simulation.clearance_m, row[VEL : VEL + 3], simulation.time_s - SETTLE_S)
