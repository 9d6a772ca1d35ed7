"""The brake tube: where the vehicle goes when a command is sent for one tick and zero velocity ever after.

Two models of the velocity loop bound the real one: a slow one (it keeps flying longer) and a fast one (it speeds up sooner);
both brake with the slow one. For a first-order lag tau the stop point is exact and linear: p + v tau + (integral of the commands
still in flight), so braking never moves it, which makes "brake" the trajectory already proved.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.messages import VehicleState

Floats = NDArray[np.float64]
HISTORY = 64
STANDSTILL_M_S = 0.1  # moving obstacles: slower than this counts as standing
ZERO = CorridorVector(0.0, 0.0, 0.0)
_Triple = tuple[float, float, float]


class CommandHistory:
    """The commands already sent, newest last, in fixed space: those still in flight are part of the state."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, CorridorVector]] = deque(maxlen=HISTORY)

    def clear(self) -> None:
        """Forget everything: the vehicle was not under this filter's command."""
        self._sent.clear()

    def add(self, time_s: float, velocity: CorridorVector) -> None:
        """Remember a velocity command sent at a time."""
        self._sent.append((time_s, velocity))

    def overrule(self) -> None:
        """Zero velocity was sent instead of the newest command."""
        if self._sent:
            self._sent[-1] = (self._sent[-1][0], ZERO)

    def newest(self) -> CorridorVector:
        """The velocity command sent last; zero before the first."""
        return self._sent[-1][1] if self._sent else ZERO

    def sent(self, begin_s: float, end_s: float) -> list[CorridorVector]:
        """The commands that were the newest one at some time of [begin_s, end_s]."""
        result: list[CorridorVector] = []
        for time_s, velocity in reversed(self._sent):
            if time_s <= end_s:
                result.append(velocity)
            if time_s <= begin_s:
                break
        return result

    def phases(self, begin_s: float, end_s: float, before: CorridorVector) -> list[tuple[float, CorridorVector]]:
        """Durations and commands that cover [begin_s, end_s]; `before` is taken for times older than the history."""
        result: list[tuple[float, CorridorVector]] = []
        end = end_s
        for time_s, velocity in reversed(self._sent):
            start = max(time_s, begin_s)
            if start < end:
                result.append((end - start, velocity))
                end = start
            if end <= begin_s:
                break
        if end > begin_s:
            result.append((end - begin_s, before))
        result.reverse()
        return result


@dataclass(frozen=True, slots=True)
class Start:
    """Where a new command begins to act: position and velocity [2 models, 3], corridor frame. Row 0 slow, row 1 fast."""

    position_m: Floats
    velocity_m_s: Floats


@dataclass(frozen=True, slots=True)
class Tubes:
    """Brake tubes of c candidates: `turn_m` is the end of the tick, `stop_m` the standstill, [2 models, c, 3], corridor frame."""

    turn_m: Floats
    stop_m: Floats

    def rows(self, chosen: slice | NDArray[np.intp]) -> Tubes:
        """The tubes of some candidates."""
        return Tubes(self.turn_m[:, chosen], self.stop_m[:, chosen])


def predict_start(state: VehicleState, history: CommandHistory, now_s: float, config: SafetyConfig) -> Start:
    """Fly the estimate through the commands already sent, up to the moment at which a command sent now begins to act."""
    phases = history.phases(state.time_s - config.dead_time_s, now_s, state.velocity)
    position, velocity = np.empty((2, 3)), np.empty((2, 3))
    for row, lag_s in enumerate((config.lag_s, config.lag_min_s)):
        position[row], velocity[row] = _flown(state, phases, lag_s)
    return Start(position, velocity)


def _flown(state: VehicleState, phases: list[tuple[float, CorridorVector]], lag_s: float) -> tuple[_Triple, _Triple]:
    """Position and velocity after the phases: a first-order velocity loop under one constant command after the other."""
    px, py, pz = state.position.x, state.position.y, state.position.z
    vx, vy, vz = state.velocity.x, state.velocity.y, state.velocity.z
    for duration_s, command in phases:
        left = math.exp(-duration_s / lag_s)
        gone = lag_s * (1.0 - left)
        dx, dy, dz = vx - command.x, vy - command.y, vz - command.z
        px += command.x * duration_s + dx * gone
        py += command.y * duration_s + dy * gone
        pz += command.z * duration_s + dz * gone
        vx, vy, vz = command.x + dx * left, command.y + dy * left, command.z + dz * left
    return (px, py, pz), (vx, vy, vz)


def flown_velocity(velocity: CorridorVector, phases: list[tuple[float, CorridorVector]], lag_s: float) -> _Triple:
    """Velocity after the phases, as in `predict_start`, m/s."""
    x, y, z = velocity.x, velocity.y, velocity.z
    for duration_s, command in phases:
        left = math.exp(-duration_s / lag_s)
        x, y, z = command.x + (x - command.x) * left, command.y + (y - command.y) * left, command.z + (z - command.z) * left
    return x, y, z


@lru_cache(maxsize=16)
def _tick_response(lag_s: float, lag_min_s: float, tick_s: float) -> tuple[Floats, Floats]:
    """Per model [2, 1, 1]: what is left of a velocity error after one tick, and its integral over the tick, s."""
    lags = np.array((lag_s, lag_min_s))[:, None, None]
    left = np.exp(-tick_s / lags)
    return left, lags * (1.0 - left)


def tubes(start: Start, candidates_m_s: Floats, config: SafetyConfig) -> Tubes:
    """Brake tubes of candidate velocity commands [c, 3] held for one tick from `start`."""
    left, gone = _tick_response(config.lag_s, config.lag_min_s, config.tick_s)
    begin = start.position_m[:, None, :]
    rest = start.velocity_m_s[:, None, :] - candidates_m_s
    turn = begin + candidates_m_s * config.tick_s + rest * gone
    velocity = candidates_m_s + rest * left
    return Tubes(turn, turn + velocity * _stop_times_s(velocity, config))


def _stop_times_s(velocity_m_s: Floats, config: SafetyConfig) -> Floats | float:
    """Braking distance over speed, vectors with last axis 3: the lag, more when the deceleration limit binds, s."""
    speed = np.sqrt(np.einsum("...i,...i->...", velocity_m_s, velocity_m_s))[..., None]
    knee = config.braking_m_s2 * config.lag_s
    if not np.count_nonzero(speed > knee):  # the usual case: the same for all
        return (knee * knee + knee * knee) / (2.0 * config.braking_m_s2 * knee)
    fast = np.maximum(speed, knee)
    times: Floats = (fast * fast + knee * knee) / (2.0 * config.braking_m_s2 * fast)
    return times


def stop_time_s(speed_m_s: float, config: SafetyConfig) -> float:
    """Bound on braking distance over speed, up to a speed, s."""
    knee = config.braking_m_s2 * config.lag_s
    fast = max(speed_m_s, knee)
    return (fast * fast + knee * knee) / (2.0 * config.braking_m_s2 * fast)


def stop_gain_s(config: SafetyConfig) -> float:
    """How far, at most, the stop point moves per m/s of a command held for one tick, s (unsaturated loop)."""
    gains = (
        config.tick_s + (1.0 - math.exp(-config.tick_s / lag)) * (config.lag_s - lag) for lag in (config.lag_s, config.lag_min_s)
    )
    return max(gains)


def slow_after_s(distance_m: Floats | float, config: SafetyConfig) -> Floats:
    """Bound on the time from the begin of braking over a distance until the vehicle is slower than `STANDSTILL_M_S`, s.

    A first-order lag is at the share 1 - exp(-t / tau) of its way after t, slower than w after tau ln(v / w). This bound is so
    much longer that its share of the way is never ahead of the time: obstacles may be moved in proportion to the way.
    """
    faster = np.maximum(np.asarray(distance_m) / (config.lag_s * STANDSTILL_M_S), 1.0)
    time_s: Floats = config.lag_s * (1.0 + np.log(faster))
    return time_s
