"""Does the vehicle still brake and move as assumed (A1, A3)? What it did lately, against the slowest assumed vehicle.

The velocity of a moment ago is flown on through the commands sent since, with the assumed dead time and the slowest assumed lag.
A vehicle inside the assumptions has slowed down at least that much. The share that it managed, braking only, weighted by how
much was expected and slowly forgotten, is the residual: 1 = exactly as assumed, more = better, less = the assumption is broken.
Not reaching a commanded speed (V10) is no fault and counts nowhere.
"""

from __future__ import annotations

import math
from collections import deque

from safety.braking import CommandHistory, flown_velocity
from safety.config import SafetyConfig
from safety.messages import Intervention, VehicleState

SAMPLES = 64
LEAST_SPEED_M_S = 0.2  # slower than this, noise decides in which direction the vehicle brakes
LEAST_CHANGE_M_S = 0.1  # expected slowing down that says something
EVIDENCE = 0.08  # (m/s)^2 s of expected slowing down before the share is believed: one stop from about 1 m/s
SHARE_MOST = 2.0
ROUNDING_S = 1e-6


class MotionMonitor:
    """Follows braking and direction of motion; fixed memory. `braking_share`: see the module, NaN before there is evidence."""

    def __init__(self, config: SafetyConfig) -> None:
        self._assumed, self._config = config, config.monitors
        self._samples: deque[VehicleState] = deque(maxlen=SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Forget the flight so far."""
        self._samples.clear()
        self._seen = self._expected = 0.0
        self._course = (0.0, 0.0)
        self._astray_s: float | None = None
        self._failed_s = 0.0
        self._weak = False

    @property
    def braking_share(self) -> float:
        """Slowing down seen, over slowing down expected of the slowest assumed vehicle; at most `SHARE_MOST`."""
        return min(self._seen / self._expected, SHARE_MOST) if self._expected >= EVIDENCE else math.nan

    @property
    def cap(self) -> float:
        """Share of the speed limit that the braking seen supports: 1, or less from `braking_weak` until `braking_healthy`."""
        return min(1.0, max(self.braking_share, 0.0)) if self._weak else 1.0

    def judge(self, state: VehicleState, history: CommandHistory, found: list[Intervention]) -> None:
        """Add what is wrong to `found`. `state`: finite and in order; `history`: the commands sent."""
        last = self._samples[-1] if self._samples else None
        if last is not None and state.time_s <= last.time_s:
            return
        self._samples.append(state)
        if last is None:
            return
        dt = state.time_s - last.time_s
        self._follow_course(state, history, dt)
        self._judge_direction(state, found)
        self._judge_braking(state, history, dt, found)

    def _follow_course(self, state: VehicleState, history: CommandHistory, dt: float) -> None:
        """The velocity that the commands alone would give: a low-pass of what was sent, dead time left out."""
        wanted, share = history.newest(), 1.0 - math.exp(-dt / self._assumed.lag_s)
        x, y = self._course
        self._course = (x + (wanted.x - x) * share, y + (wanted.y - y) * share)

    def _judge_direction(self, state: VehicleState, found: list[Intervention]) -> None:
        """E7: the vehicle moves across or against its commands. Slow or still says nothing: it may be held."""
        config, (x, y), v = self._config, self._course, state.velocity
        speed = math.hypot(x, y)
        if speed < config.direction_speed_m_s:
            self._astray_s = None
            return
        across, along = abs(v.y * x - v.x * y) / speed, (v.x * x + v.y * y) / speed
        error = max(across, -along)
        if not error > config.direction_error_m_s:
            self._astray_s = None
            return
        self._astray_s = state.time_s if self._astray_s is None else self._astray_s
        if state.time_s - self._astray_s > config.direction_s + ROUNDING_S:
            found.append(Intervention("motion_direction", error, config.direction_error_m_s))

    def _judge_braking(self, state: VehicleState, history: CommandHistory, dt: float, found: list[Intervention]) -> None:
        """A1, A3, V7: gather evidence; braking far weaker than assumed is a fault when braking has shown it for long enough."""
        braked = self._gather(state, history, dt)
        config, share = self._config, self.braking_share
        self._weak = share < (config.braking_healthy if self._weak else config.braking_weak)
        if not share < config.braking_failed:  # NaN: no evidence
            self._failed_s = 0.0
            return
        self._failed_s += dt if braked else 0.0
        if self._failed_s > config.braking_failed_s + ROUNDING_S:
            found.append(Intervention("braking_weak", share, config.braking_failed))

    def _gather(self, state: VehicleState, history: CommandHistory, dt: float) -> bool:
        """Compare with the newest sample that is at least the horizon old; True where braking was to be seen."""
        kept = math.exp(-dt / self._config.braking_memory_s)
        self._seen, self._expected = self._seen * kept, self._expected * kept
        samples, begin_s = self._samples, state.time_s - self._config.braking_horizon_s + ROUNDING_S
        while len(samples) > 1 and samples[1].time_s <= begin_s:
            samples.popleft()
        start, dead_s = samples[0], self._assumed.dead_time_s
        speed = math.hypot(start.velocity.x, start.velocity.y)
        if start.time_s > begin_s or speed < LEAST_SPEED_M_S:
            return False
        phases = history.phases(start.time_s - dead_s, state.time_s - dead_s, start.velocity)
        expected_x, expected_y, _ = flown_velocity(start.velocity, phases, self._assumed.lag_s)
        ux, uy = start.velocity.x / speed, start.velocity.y / speed
        expected = min(speed - (expected_x * ux + expected_y * uy), speed)
        if expected <= LEAST_CHANGE_M_S:
            return False
        seen = speed - (state.velocity.x * ux + state.velocity.y * uy)
        self._seen += seen * expected * dt
        self._expected += expected * expected * dt
        return True
