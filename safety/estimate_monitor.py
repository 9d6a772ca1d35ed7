"""Does the estimate agree with itself and with what the autopilot says about it?

A vehicle cannot be somewhere else than its velocity took it. What the velocity leaves unexplained between two samples is a jump,
and its mean over a short window is the error of the velocity (or a drift of the position; one cannot tell which).
"""

from __future__ import annotations

import math
from collections import deque

from safety.messages import Health, Intervention, VehicleState
from safety.monitor_config import MonitorConfig

WINDOW_SAMPLES = 64
ROUNDING_S = 1e-6  # time stamps are differences of large numbers
_Drift = tuple[float, float, float, float]


class EstimateMonitor:
    """Judges each new sample against the earlier ones; fixed memory. All rules need `state` to be finite and in order."""

    def __init__(self, config: MonitorConfig) -> None:
        self._config = config
        self._drift: deque[_Drift] = deque(maxlen=WINDOW_SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Forget earlier samples."""
        self._last: VehicleState | None = None
        self._moved_s = -math.inf
        self._stuck = False
        self._jump_s = -math.inf
        self._inaccurate_s: float | None = None
        self._drift.clear()

    def judge(self, state: VehicleState, health: Health, commanded_m_s: float, now_s: float, found: list[Intervention]) -> None:
        """Add what is wrong to `found`. `commanded_m_s`: length of the velocity sent last."""
        self._judge_tilt(state, found)
        self._judge_report(health, now_s, found)
        last, self._last = self._last, state
        if last is None:
            self._anchor(state)
        elif state.time_s > last.time_s:
            if not self._judge_step(last, state, found):
                self._judge_velocity(found)
            self._judge_frozen(last, state, commanded_m_s, found)

    def _judge_tilt(self, state: VehicleState, found: list[Intervention]) -> None:
        """V9: the thrust axis further from the vertical than the autopilot ever commands."""
        upright = math.cos(state.roll_rad) * math.cos(state.pitch_rad)
        tilt = math.acos(max(-1.0, min(1.0, upright)))
        if tilt > self._config.tumbling_rad:
            found.append(Intervention("tumbling", tilt, self._config.tumbling_rad))
        elif tilt > self._config.tilt_rad:
            found.append(Intervention("tilt", tilt, self._config.tilt_rad))

    def _judge_report(self, health: Health, now_s: float, found: list[Intervention]) -> None:
        """E11, E5: what the estimator says about itself."""
        if health.estimate_valid is False:
            found.append(Intervention("estimate_invalid", 0.0, 1.0))
        if not health.accuracy_m > self._config.accuracy_m:  # NaN: unknown
            self._inaccurate_s = None
            return
        self._inaccurate_s = now_s if self._inaccurate_s is None else self._inaccurate_s
        if now_s - self._inaccurate_s > self._config.accuracy_s:
            found.append(Intervention("estimate_inaccurate", health.accuracy_m, self._config.accuracy_m))

    def _judge_step(self, last: VehicleState, state: VehicleState, found: list[Intervention]) -> bool:
        """E1, E8, E9: the step since the last sample; True when it starts a new history."""
        config, dt = self._config, state.time_s - last.time_s
        counted = last.reset_counter is not None and state.reset_counter is not None
        reset = counted and last.reset_counter != state.reset_counter
        if reset:
            found.append(Intervention("estimate_reset", float(state.reset_counter or 0), float(last.reset_counter or 0)))
        a, b, v, w = last.position, state.position, last.velocity, state.velocity
        dx, dy = b.x - a.x - 0.5 * (v.x + w.x) * dt, b.y - a.y - 0.5 * (v.y + w.y) * dt
        dz = b.z - a.z - 0.5 * (v.z + w.z) * dt
        step, noise = math.hypot(dx, dy), config.velocity_mismatch_m_s * dt
        if step > config.position_jump_m + noise:
            again = state.time_s - self._jump_s <= config.jumps_window_s
            found.append(Intervention("estimate_jump_again" if again else "estimate_jump", step, config.position_jump_m + noise))
            self._jump_s, reset = state.time_s, True
        if abs(dz) > config.altitude_jump_m + noise:
            found.append(Intervention("altitude_jump", abs(dz), config.altitude_jump_m + noise))
            reset = True
        if reset:
            self._anchor(state)
        else:
            _, x, y, z = self._drift[-1]
            self._drift.append((state.time_s, x + dx, y + dy, z + dz))
        return reset

    def _anchor(self, state: VehicleState) -> None:
        """Begin the comparison of velocity and position anew."""
        self._drift.clear()
        self._drift.append((state.time_s, 0.0, 0.0, 0.0))

    def _judge_velocity(self, found: list[Intervention]) -> None:
        """E6: mean of what the velocity left unexplained over the window."""
        drift, config = self._drift, self._config
        newest = drift[-1]
        begin = newest[0] - config.velocity_window_s + ROUNDING_S
        while len(drift) > 1 and drift[1][0] <= begin:
            drift.popleft()
        oldest = drift[0]
        if oldest[0] > begin:
            return
        span_s = newest[0] - oldest[0]
        across, up = math.dist(newest[1:3], oldest[1:3]) / span_s, abs(newest[3] - oldest[3]) / span_s
        if max(across, up) > config.velocity_mismatch_m_s:
            found.append(Intervention("velocity_mismatch", max(across, up), config.velocity_mismatch_m_s))

    def _judge_frozen(self, last: VehicleState, state: VehicleState, commanded_m_s: float, found: list[Intervention]) -> None:
        """E2: the same position and velocity in every bit, under fresh stamps, while motion is commanded.

        Once seen it lasts until a bit changes, although nothing is commanded any more.
        """
        moved = state.position != last.position or state.velocity != last.velocity
        if moved or (commanded_m_s < self._config.frozen_command_m_s and not self._stuck):
            self._moved_s, self._stuck = state.time_s, False
            return
        self._moved_s = max(self._moved_s, last.time_s) if math.isinf(self._moved_s) else self._moved_s
        still_s = state.time_s - self._moved_s
        if still_s > self._config.frozen_state_s + ROUNDING_S:
            self._stuck = True
            found.append(Intervention("estimate_frozen", still_s, self._config.frozen_state_s))
