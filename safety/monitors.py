"""Is the input fit to fly on? Freshness, finiteness and plausibility of command, state and scan, each with its own rule name.

`InputMonitor.judge` names every fault of a tick. A fault always means BRAKE, some mean more (`safety.reactions`); what follows is
told in `safety.escalation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.braking import CommandHistory
from safety.caps import cap_factor, extra_delay_s
from safety.config import SafetyConfig
from safety.estimate_monitor import EstimateMonitor
from safety.frames import CorridorVector
from safety.lidar import scan_problem
from safety.loop_monitor import LoopMonitor
from safety.messages import Health, Intervention, LidarScan, VehicleState, VelocityCommand
from safety.policy_monitor import PolicyMonitor
from safety.reactions import level_of
from safety.residual import MotionMonitor
from safety.scan_monitor import ScanMonitor

FROZEN_SCANS = 3
FROZEN_SPEED_M_S = 0.3
FROZEN_YAW_RATE_RAD_S = 0.2
MOST_BEAMS = 0.5  # share of beams that no real scene turns unknown or touching at once
WALL_SHARE = 0.1  # a scan with at least this share of near returns cannot be followed by an empty one
WALL_RANGE = 0.75  # near, as a share of range_max


def _finite(vector: CorridorVector) -> bool:
    return math.isfinite(vector.x) and math.isfinite(vector.y) and math.isfinite(vector.z)


def command_fault(command: VelocityCommand | None) -> Intervention | None:
    """A missing or non-finite policy command (P1, P4)."""
    if command is None:
        return Intervention("command_missing", math.nan, math.nan)
    if not (_finite(command.velocity) and math.isfinite(command.yaw_rate_rad_s)):
        return Intervention("command_not_finite", math.nan, math.nan)
    return None


def age_fault(name: str, age_s: float, stale_s: float, future_s: float) -> Intervention | None:
    """A stamp that is too old (L1, E3) or ahead of the clock (L10)."""
    if not age_s <= stale_s:  # NaN fails too
        return Intervention(f"{name}_stale", age_s, stale_s)
    if age_s < -future_s:
        return Intervention(f"{name}_future", age_s, -future_s)
    return None


def state_fault(state: VehicleState | None, now_s: float, config: SafetyConfig) -> Intervention | None:
    """A missing, non-finite (E4), stale or future state estimate."""
    if state is None:
        return Intervention("state_missing", math.nan, math.nan)
    angles = (state.roll_rad, state.pitch_rad, state.yaw_rad, state.yaw_rate_rad_s)
    vectors = (state.position, state.velocity, state.acceleration)
    if not (all(map(_finite, vectors)) and all(map(math.isfinite, angles))):
        return Intervention("state_not_finite", math.nan, math.nan)
    return age_fault("state", now_s - state.time_s, config.state_stale_s, config.future_tolerance_s)


@dataclass(frozen=True, slots=True)
class Judgement:
    """One tick's input. `faults`: most severe first. `notices`: only told. `scan`: with what is known to be wrong in it unknown.

    `cap`: share of the speed limits that the assumptions, as they stand now, support.
    """

    faults: tuple[Intervention, ...]
    notices: tuple[Intervention, ...] = ()
    scan: LidarScan | None = None
    cap: float = 1.0


UNKNOWN = Health()
REANCHORING = frozenset({"estimate_jump", "estimate_jump_again", "altitude_jump", "estimate_reset"})
"""Rules after which positions from before mean something else."""


class InputMonitor:
    """Judges one tick's input; keeps the previous stamps and the previous scan, and the monitors' fixed memories."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        self._estimate = EstimateMonitor(config.monitors)
        self._motion = MotionMonitor(config)
        self._scans = ScanMonitor(config)
        self._policy = PolicyMonitor(config)
        self._loop = LoopMonitor(config.monitors)
        self.reset()

    def reset(self) -> None:
        """Forget earlier input."""
        for monitor in (self._estimate, self._motion, self._scans, self._policy, self._loop):
            monitor.reset()
        self._now_s = -math.inf
        self._state_time_s = -math.inf
        self._scan_time_s = -math.inf
        self._ranges: NDArray[np.floating] | None = None
        self._frozen = 0
        self._stuck = False
        self._walled = False

    def judge(
        self,
        command: VelocityCommand | None,
        state: VehicleState | None,
        scan: LidarScan | None,
        now_s: float,
        history: CommandHistory,
        health: Health | None = None,
    ) -> Judgement:
        """Everything that is wrong with this tick. `now_s`: the caller's monotonic clock; `history`: the commands sent."""
        if not now_s >= self._now_s:  # NaN fails too
            return Judgement((Intervention("clock_backwards", now_s, self._now_s),))
        if not math.isfinite(now_s):
            return Judgement((Intervention("clock_not_finite", now_s, math.nan),))
        self._now_s = now_s
        known, found, notices = health or UNKNOWN, list[Intervention](), list[Intervention]()
        self._loop.judge(known, history, now_s, found)
        self._policy.judge_memory(known, found)
        fit = self._judge_state(state, now_s, history, known, found)
        scan = self._judge_scan(scan, fit, now_s, found, notices)
        self._judge_command(command, now_s, found, notices)
        if len(found) > 1:
            found.sort(key=lambda fault: -level_of(fault.rule))
        return Judgement(tuple(found), tuple(notices), scan, self._cap(state, scan, now_s, known))

    def _judge_state(
        self, state: VehicleState | None, now_s: float, history: CommandHistory, health: Health, found: list[Intervention]
    ) -> VehicleState | None:
        """The state where it can be believed, else None."""
        fault = state_fault(state, now_s, self._config) or self._order_fault(state)
        if fault is not None or state is None:
            found.extend([fault] if fault is not None else [])
            return None
        self._estimate.judge(state, health, _length(history.newest()), now_s, found)
        self._motion.judge(state, history, found)
        return state

    def _judge_scan(
        self,
        scan: LidarScan | None,
        fit: VehicleState | None,
        now_s: float,
        found: list[Intervention],
        notices: list[Intervention],
    ) -> LidarScan | None:
        """The scan as it may be used."""
        fault = self._scan_fault(scan, fit, now_s)
        if fault is not None or scan is None:
            found.extend([fault] if fault is not None else [])
            return scan
        if fit is not None:
            self._scans.judge(scan, fit, found)
        return self._scans.masked(scan, notices)

    def _judge_command(
        self, command: VelocityCommand | None, now_s: float, found: list[Intervention], notices: list[Intervention]
    ) -> None:
        """A command is missing by right where the samples were not fit to ask the policy."""
        fault = command_fault(command)
        if fault is None:
            assert command is not None  # judged in the line before
            self._policy.judge(command, now_s, notices)
            return
        if not found:
            self._policy.judge_bad(now_s, found)
        found.append(fault)

    def _cap(self, state: VehicleState | None, scan: LidarScan | None, now_s: float, health: Health) -> float:
        if state is None or scan is None:
            return 1.0
        extra_s = extra_delay_s(now_s - state.time_s, now_s - scan.time_s, health, self._config)
        return cap_factor(extra_s, self._motion.cap, self._config)

    def _order_fault(self, state: VehicleState | None) -> Intervention | None:
        """A state older than one already used (K5): the estimate went back in time."""
        assert state is not None  # judged before
        if state.time_s < self._state_time_s:
            return Intervention("state_backwards", state.time_s, self._state_time_s)
        self._state_time_s = state.time_s
        return None

    def _scan_fault(self, scan: LidarScan | None, state: VehicleState | None, now_s: float) -> Intervention | None:
        if scan is None:
            return Intervention("scan_missing", math.nan, math.nan)
        problem = scan_problem(scan)
        if problem is not None:
            return Intervention(problem, math.nan, math.nan)
        fault = age_fault("scan", now_s - scan.time_s, self._config.scan_stale_s, self._config.future_tolerance_s)
        if fault is not None:
            return fault
        if scan.time_s < self._scan_time_s:
            return Intervention("scan_backwards", scan.time_s, self._scan_time_s)
        return self._content_fault(scan) or self._frozen_fault(scan, state)

    def _content_fault(self, scan: LidarScan) -> Intervention | None:
        """Whole-scan failures: mostly NaN (L6), mostly touching (L5), suddenly empty although walls were near (L4)."""
        ranges, beams = scan.ranges_m, scan.ranges_m.shape[0]
        unknown = int(np.count_nonzero(np.isnan(ranges))) / beams
        if unknown > MOST_BEAMS:
            return Intervention("scan_unknown", unknown, MOST_BEAMS)
        touching = int(np.count_nonzero(ranges < scan.range_min_m)) / beams
        if touching > MOST_BEAMS:
            return Intervention("scan_touching", touching, MOST_BEAMS)
        near = int(np.count_nonzero(ranges < WALL_RANGE * scan.range_max_m)) / beams
        if self._walled and near == 0.0 and bool(np.all(ranges >= scan.range_max_m)):
            return Intervention("scan_blank", near, WALL_SHARE)
        self._walled = near >= WALL_SHARE
        return None

    def _shows_something(self, scan: LidarScan) -> bool:
        """Whether there is a return from outside the vehicle: parts of itself look the same for ever."""
        return bool((np.isfinite(scan.ranges_m) & (scan.ranges_m > self._config.vehicle_radius_m)).any())

    def _frozen_fault(self, scan: LidarScan, state: VehicleState | None) -> Intervention | None:
        """Bit-identical scans with new stamps while the vehicle moves (L2). Empty scans are alike by right.

        Once seen in motion it lasts until a scan differs: a vehicle that has braked must not fly on by a frozen picture.
        """
        if scan.time_s > self._scan_time_s:
            same = self._ranges is not None and _alike(scan.ranges_m, self._ranges) and self._shows_something(scan)
            self._frozen = self._frozen + 1 if same else 0
            self._ranges = scan.ranges_m.copy()
            self._scan_time_s = scan.time_s
        if state is None:
            return None
        speed = math.hypot(state.velocity.x, state.velocity.y)
        moving = speed > FROZEN_SPEED_M_S or abs(state.yaw_rate_rad_s) > FROZEN_YAW_RATE_RAD_S
        self._stuck = self._frozen >= FROZEN_SCANS and (moving or self._stuck)
        if self._stuck:
            return Intervention("scan_frozen", float(self._frozen), float(FROZEN_SCANS))
        return None


def _alike(first: NDArray[np.floating], second: NDArray[np.floating]) -> bool:
    """Whether two scans are the same in every range; two unknown ranges are not the same."""
    return first.shape == second.shape and not np.count_nonzero(first != second)


def _length(vector: CorridorVector) -> float:
    return math.sqrt(vector.x * vector.x + vector.y * vector.y + vector.z * vector.z)
