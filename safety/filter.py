"""`SafetyFilter`: the last word between policy and vehicle. Pure, deterministic, bounded, fails closed.

Stages: validate -> staleness -> limits -> fence and obstacles together -> final gate. Whatever is missing, stale, not finite or
raises ends in BRAKE (zero velocity) with a reason.
"""

from __future__ import annotations

import math

from safety.braking import CommandHistory, predict_start
from safety.caps import cap_speed
from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.lidar import BeamTable, SeenScan, see
from safety.limits import AT_REST, limit_command, sent_after, within_limits
from safety.memory import ObstacleMemory
from safety.messages import BRAKE, Health, Intervention, LidarScan, SafeCommand, VehicleState, VelocityCommand, Verdict
from safety.monitors import REANCHORING, InputMonitor, Judgement
from safety.shield import Decision, Shield, Surroundings
from safety.sight import View

MAX_GAP_TICKS = 2.0  # a longer gap between calls allows no larger step of the command
GATE_SLACK = 1e-9  # rounding of the limits, relative
MEMORY_REACH_M = 1.5  # kept around the vehicle beyond stop distance and keep-out


class SafetyFilter:
    """Turns any command into one that is safe under the assumptions of its `SafetyConfig`.

    Not thread-safe; one instance per vehicle. `reset()` when control is taken over (OFFBOARD entry, new flight).
    """

    def __init__(self, config: SafetyConfig) -> None:
        self.config = config
        self.last_error: str | None = None
        self._monitor = InputMonitor(config)
        self._history = CommandHistory()
        self._memory = ObstacleMemory()
        self._free = FreeSpace(config)
        self._table = BeamTable()
        self._shield = Shield(config)
        self._reach_m = config.stop_distance_m(2.0 * config.max_horizontal_speed_m_s) + config.keep_out_m + MEMORY_REACH_M
        self.reset()

    def reset(self) -> None:
        """Forget everything of the flight so far."""
        self._monitor.reset()
        self._history.clear()
        self._memory.clear()
        self._free.clear()
        self._last = AT_REST
        self._last_time_s: float | None = None
        self._seen: SeenScan | None = None
        self.last_error = None

    def apply(
        self,
        command: VelocityCommand | None,
        state: VehicleState | None,
        scan: LidarScan | None,
        now_s: float,
        health: Health | None = None,
    ) -> tuple[SafeCommand, Verdict]:
        """The command to send now, and why.

        `command`: wanted, corridor frame; `state`, `scan`: the newest ones, stamped on the clock of `now_s`; None = none came.
        `health`: what the loop knows besides; None = nothing.
        Never raises: whatever goes wrong is a BRAKE whose `Verdict.fault` names the rule (`last_error`: an exception's text).
        """
        try:
            sent, verdict = self._apply(command, state, scan, now_s, health)
        except Exception as error:  # noqa: BLE001  fails closed: an unforeseen error must brake, not end the control loop
            self.last_error = f"{type(error).__name__}: {error}"
            sent, verdict = _braked(Intervention("internal_error", math.nan, math.nan))
        self._remember(sent, now_s)
        return sent, verdict

    def _apply(
        self,
        command: VelocityCommand | None,
        state: VehicleState | None,
        scan: LidarScan | None,
        now_s: float,
        health: Health | None,
    ) -> tuple[SafeCommand, Verdict]:
        if health is not None and health.overruled:
            self._history.overrule()
            self._last = AT_REST
        judged = self._monitor.judge(command, state, scan, now_s, self._history, health)
        if any(fault.rule in REANCHORING for fault in judged.faults):
            self._memory.clear()
            self._free.forget()
            self._seen = None
        if judged.faults or command is None or state is None or judged.scan is None:
            sent, verdict = _braked(*(judged.faults or (Intervention("input_missing", math.nan, math.nan),)))
        else:
            sent, verdict = self._steer(command, state, judged.scan, now_s, judged)
        told, ages = verdict.interventions + judged.notices, (_age(scan, now_s), _age(state, now_s))
        return sent, Verdict(verdict.braking, told, *ages, verdict.clearance_m, verdict.fence_margin_m, verdict.fault)

    def _steer(
        self, command: VelocityCommand, state: VehicleState, scan: LidarScan, now_s: float, judged: Judgement
    ) -> tuple[SafeCommand, Verdict]:
        """All inputs are fit: caps and limits, then the shield, then the gate."""
        capped, caps = cap_speed(command, judged.cap, self.config)
        dt_s = self._dt_s(now_s)
        limited, limits = limit_command(capped, self._last, dt_s, scan.range_max_m, self.config)
        around = self._look(state, scan, now_s)
        decision = self._shield.choose(limited.velocity, around, lambda few: within_limits(few, self._last, dt_s, self.config))
        sent = SafeCommand(decision.velocity, limited.yaw_rate_rad_s)
        problem = gate_problem(sent, self.config)
        if problem is not None:
            return _braked(problem)
        return sent, _verdict(limited, sent, caps + limits, decision)

    def _look(self, state: VehicleState, scan: LidarScan, now_s: float) -> Surroundings:
        """Take in a scan once, and gather what the shield needs at this tick."""
        if self._seen is None or scan.time_s > self._seen.time_s:
            self._seen = see(scan, state, self._table, self.config)
            self._memory.update(self._seen, self._reach_m, self.config)
            self._free.update(self._seen)
        x, y, extra = self._memory.points(now_s, self.config)
        start = predict_start(state, self._history, now_s, self.config)
        return Surroundings(x, y, extra, View(self._free, self._memory.places_m, now_s), state.position, start)

    def _dt_s(self, now_s: float) -> float:
        """Time since the last command, bounded so that a pause allows no jump."""
        longest = MAX_GAP_TICKS * self.config.tick_s
        return longest if self._last_time_s is None else min(now_s - self._last_time_s, longest)

    def _remember(self, sent: SafeCommand, now_s: float) -> None:
        """Add what was sent to the commands in flight. A clock that is not usable adds nothing."""
        dt_s = self.config.tick_s
        if math.isfinite(now_s) and (self._last_time_s is None or now_s >= self._last_time_s):
            dt_s = max(self._dt_s(now_s), dt_s)
            self._last_time_s = now_s
            self._history.add(now_s, sent.velocity)
        self._last = sent_after(self._last, sent.velocity, dt_s)


def gate_problem(sent: SafeCommand, config: SafetyConfig) -> Intervention | None:
    """Final gate: every outgoing number finite and inside the limits, or the rule that it breaks."""
    v, slack = sent.velocity, 1.0 + GATE_SLACK
    if not all(math.isfinite(value) for value in (v.x, v.y, v.z, sent.yaw_rate_rad_s)):
        return Intervention("gate_not_finite", math.nan, math.nan)
    checks = (
        (math.hypot(v.x, v.y), config.max_horizontal_speed_m_s),
        (abs(v.z), config.max_vertical_speed_m_s),
        (abs(sent.yaw_rate_rad_s), config.max_yaw_rate_rad_s),
    )
    for value, limit in checks:
        if value > limit * slack:
            return Intervention("gate_limit", value, limit)
    return None


def _verdict(wanted: VelocityCommand, sent: SafeCommand, limits: tuple[Intervention, ...], decision: Decision) -> Verdict:
    stopped = _speed(sent.velocity) == 0.0 and _speed(wanted.velocity) > 0.0
    return Verdict(
        braking=stopped,
        interventions=limits + decision.interventions,
        clearance_m=decision.clearance_m,
        fence_margin_m=decision.fence_margin_m,
    )


def _braked(*faults: Intervention) -> tuple[SafeCommand, Verdict]:
    """BRAKE for faults, the most severe first."""
    verdict = Verdict(braking=True, interventions=faults, fault=faults[0].rule)
    return SafeCommand(BRAKE.velocity, BRAKE.yaw_rate_rad_s), verdict


def _age(sample: VehicleState | LidarScan | None, now_s: float) -> float:
    return math.nan if sample is None else now_s - sample.time_s


def _speed(velocity: CorridorVector) -> float:
    return math.hypot(velocity.x, velocity.y, velocity.z)
