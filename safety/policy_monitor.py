"""Does the policy's output look like that of a healthy network? Broken, late, saturated, oscillating, memory exploded."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.messages import Health, Intervention, VelocityCommand

BAD_WITHIN_S = 1.0
FULL = 0.99  # share of a limit that counts as being at it
ROUNDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class _Swing:
    """The last command, how it differed from the one before (m/s), and how many times in a row that was a turning back."""

    velocity: CorridorVector
    step: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turns: int = 0


class PolicyMonitor:
    """Judges command, recurrent state and inference time of each tick. Fixed memory."""

    def __init__(self, config: SafetyConfig) -> None:
        self._limits, self._config = config, config.monitors
        self._bad: deque[float] = deque(maxlen=config.monitors.bad_commands)
        self.reset()

    def reset(self) -> None:
        """Forget earlier commands."""
        self._full_since_s: float | None = None
        self._swing: _Swing | None = None
        self._bad.clear()

    def judge_memory(self, health: Health, found: list[Intervention]) -> None:
        """P5, P7: the recurrent state and the time that the step took. An unknown norm is NaN; an infinite one is too large."""
        config = self._config
        if health.hidden_norm > config.hidden_norm_max:
            found.append(Intervention("hidden_exploded", health.hidden_norm, config.hidden_norm_max))
        if health.inference_s > config.inference_hung_s:
            found.append(Intervention("inference_hung", health.inference_s, config.inference_hung_s))

    def judge_bad(self, now_s: float, found: list[Intervention]) -> None:
        """P1: once more no usable command although the samples were good."""
        self._bad.append(now_s)
        self._swing, self._full_since_s = None, None
        if len(self._bad) == self._config.bad_commands and now_s - self._bad[0] <= BAD_WITHIN_S:
            found.append(Intervention("command_bad_again", float(len(self._bad)), float(self._config.bad_commands)))

    def judge(self, command: VelocityCommand, now_s: float, notices: list[Intervention]) -> None:
        """P2, P10: a finite command; only told, the limits alone keep it safe."""
        self._judge_saturation(command, now_s, notices)
        self._judge_oscillation(command.velocity, notices)

    def _judge_saturation(self, command: VelocityCommand, now_s: float, notices: list[Intervention]) -> None:
        v, limits = command.velocity, self._limits
        full = (
            max(abs(v.x), abs(v.y)) >= FULL * limits.max_horizontal_speed_m_s  # a long vector need not be a saturated one
            or abs(v.z) >= FULL * limits.max_vertical_speed_m_s
            or abs(command.yaw_rate_rad_s) >= FULL * limits.max_yaw_rate_rad_s
        )
        if not full:
            self._full_since_s = None
            return
        self._full_since_s = now_s if self._full_since_s is None else self._full_since_s
        if now_s - self._full_since_s >= self._config.saturated_s - ROUNDING_S:
            notices.append(Intervention("policy_saturated", now_s - self._full_since_s, self._config.saturated_s))

    def _judge_oscillation(self, velocity: CorridorVector, notices: list[Intervention]) -> None:
        """Steps of the command that turn back at every tick: half the sampling rate."""
        if (last := self._swing) is None:
            self._swing = _Swing(velocity)
            return
        a, b, before = last.velocity, velocity, last.step
        step = (b.x - a.x, b.y - a.y, b.z - a.z)
        back = step[0] * before[0] + step[1] * before[1] + step[2] * before[2] < 0.0
        turns = last.turns + 1 if back and math.hypot(*step) > self._config.oscillation_m_s else 0
        self._swing = _Swing(velocity, step, turns)
        if turns >= self._config.oscillation_ticks:
            notices.append(Intervention("policy_oscillating", float(turns), float(self._config.oscillation_ticks)))
