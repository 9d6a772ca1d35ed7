"""What only the loop knows: does it run in time, is the vehicle still ours, does the link answer, does the battery last?"""

from __future__ import annotations

import math
from collections import deque

from safety.braking import CommandHistory
from safety.frames import CorridorVector
from safety.messages import Health, Intervention
from safety.monitor_config import MonitorConfig

MISSES_WITHIN_S = 1.0
FOREIGN_WITHIN_S = 1.0
FOREIGN_ECHOES = 6  # of them within that time: another sender's setpoints may stand between ours
MAX_FOREIGN = 128
ROUNDING_S = 1e-6
ZERO = CorridorVector(0.0, 0.0, 0.0)


class LoopMonitor:
    """Judges timing, authority, link and battery of each tick. Fixed memory."""

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._misses: deque[float] = deque(maxlen=config.late_ticks)
        self._foreign: deque[float] = deque(maxlen=MAX_FOREIGN)
        self.reset()

    def reset(self) -> None:
        """Forget earlier ticks."""
        self._last_s: float | None = None
        self._boots: int | None = None
        self._slow_since_s: float | None = None
        self._foreign.clear()
        self._echo_s = -math.inf
        self._misses.clear()

    def judge(self, health: Health, history: CommandHistory, now_s: float, found: list[Intervention]) -> None:
        """Add what is wrong to `found`. `history`: what was sent; `now_s`: finite and in order."""
        self._judge_authority(health, found)
        self._judge_timing(health, now_s, found)
        self._judge_link(health, now_s, found)
        self._judge_echo(health, history, found)
        self._judge_battery(health, found)

    def _judge_authority(self, health: Health, found: list[Intervention]) -> None:
        """V1 to V4, K10, V9: the vehicle is not ours any more."""
        if health.in_control is False:
            found.append(Intervention("control_lost", 0.0, 1.0))
        if health.boots is not None:
            self._boots = health.boots if self._boots is None else self._boots
            if health.boots != self._boots:
                found.append(Intervention("autopilot_rebooted", float(health.boots), float(self._boots)))
        if health.landed is True:
            found.append(Intervention("landed", 1.0, 0.0))

    def _judge_timing(self, health: Health, now_s: float, found: list[Intervention]) -> None:
        """C4, C8: a pause between two calls, or ticks that begin late."""
        config, last = self._config, self._last_s
        self._last_s = now_s
        if last is not None and now_s - last > config.gap_s + ROUNDING_S:
            found.append(Intervention("tick_gap", now_s - last, config.gap_s))
        if not health.lateness_s > config.late_s:  # NaN: unknown
            return
        self._misses.append(now_s)
        if len(self._misses) == config.late_ticks and now_s - self._misses[0] <= MISSES_WITHIN_S:
            found.append(Intervention("loop_late", health.lateness_s, config.late_s))

    def _judge_link(self, health: Health, now_s: float, found: list[Intervention]) -> None:
        """K4: answers come back too late, for too long."""
        config = self._config
        if not health.link_delay_s > config.link_delay_s:  # NaN: unknown
            self._slow_since_s = None
            return
        self._slow_since_s = now_s if self._slow_since_s is None else self._slow_since_s
        if now_s - self._slow_since_s >= config.link_delay_lasts_s - ROUNDING_S:
            found.append(Intervention("link_slow", health.link_delay_s, config.link_delay_s))

    def _judge_echo(self, health: Health, history: CommandHistory, found: list[Intervention]) -> None:
        """K6: the autopilot follows setpoints that we did not send, between ours or alone. Zero velocity accuses nobody."""
        config, echo, time_s = self._config, health.echo, health.echo_time_s
        if echo is None or not time_s > self._echo_s:
            return
        self._echo_s = time_s
        error = min(_distance(echo, velocity) for velocity in (ZERO, *history.sent(time_s - config.echo_s, time_s)))
        if not error > config.echo_error_m_s:
            return
        self._foreign.append(time_s)
        recent = [then_s for then_s in self._foreign if time_s - then_s <= FOREIGN_WITHIN_S]
        if len(recent) >= FOREIGN_ECHOES and time_s - recent[0] >= config.echo_s - ROUNDING_S:
            found.append(Intervention("foreign_setpoint", error, config.echo_error_m_s))

    def _judge_battery(self, health: Health, found: list[Intervention]) -> None:
        """V6: NaN is unknown."""
        config, charge = self._config, health.battery_fraction
        if charge < config.battery_critical:
            found.append(Intervention("battery_critical", charge, config.battery_critical))
        elif charge < config.battery_low:
            found.append(Intervention("battery_low", charge, config.battery_low))


def _distance(a: CorridorVector, b: CorridorVector) -> float:
    return math.dist((a.x, a.y, a.z), (b.x, b.y, b.z))
