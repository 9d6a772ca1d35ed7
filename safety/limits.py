"""Vector limits on the wanted command, relative to the command last sent. They come before fence and obstacles, never after."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig, speed_cap_m_s
from safety.frames import CorridorVector
from safety.messages import BRAKE, Intervention, VelocityCommand

Floats = NDArray[np.float64]
ROUNDING_M_S = 1e-9  # the time between two ticks is a difference of large numbers


@dataclass(frozen=True, slots=True)
class LastSent:
    """The command last sent: its velocity, and what it had added to the one before, per second (zero after slowing down)."""

    velocity: CorridorVector
    acceleration: CorridorVector


class _Vector(NamedTuple):
    """A vector on the way to a result: made in a third of the time of a frozen message."""

    x: float
    y: float
    z: float


_Any = CorridorVector | _Vector
AT_REST = LastSent(BRAKE.velocity, BRAKE.velocity)


def sent_after(last: LastSent, velocity: CorridorVector, dt_s: float) -> LastSent:
    """What is to be remembered of a velocity command sent `dt_s` > 0 after the last one."""
    added = _minus(velocity, _scaled(last.velocity, _kept_share(velocity, last.velocity)))
    return LastSent(velocity, CorridorVector(*_scaled(added, 1.0 / dt_s)))


def limit_command(
    command: VelocityCommand, last: LastSent, dt_s: float, range_max_m: float, config: SafetyConfig
) -> tuple[VelocityCommand, tuple[Intervention, ...]]:
    """Scale a finite command into speed, sight, acceleration, jerk and yaw-rate limits; returned as it is when it obeys all."""
    found: list[Intervention] = []
    velocity = _limit_speed(command.velocity, range_max_m, config, found)
    velocity = _limit_growth(velocity, last, dt_s, config, found)
    yaw_rate = command.yaw_rate_rad_s
    if abs(yaw_rate) > config.max_yaw_rate_rad_s:
        found.append(Intervention("yaw_rate_limit", abs(yaw_rate), config.max_yaw_rate_rad_s))
        yaw_rate = math.copysign(config.max_yaw_rate_rad_s, yaw_rate)
    if not found:
        return command, ()
    return VelocityCommand(velocity, yaw_rate), tuple(found)


def within_limits(candidates_m_s: Floats, last: LastSent, dt_s: float, config: SafetyConfig) -> NDArray[np.bool_]:
    """Which velocities [c, 3] may be sent `dt_s` after the last one: what evades an obstacle keeps to all limits too."""
    added = candidates_m_s - _towards(candidates_m_s, last.velocity, 1.0)
    change = added - _towards(added, last.acceleration, dt_s)
    slow = np.hypot(candidates_m_s[:, 0], candidates_m_s[:, 1]) <= config.max_horizontal_speed_m_s + ROUNDING_M_S
    level = np.abs(candidates_m_s[:, 2]) <= config.max_vertical_speed_m_s
    grown = np.sqrt((added * added).sum(axis=1)) <= config.max_acceleration_m_s2 * dt_s + ROUNDING_M_S
    within: NDArray[np.bool_] = slow & level & grown & (
        np.sqrt((change * change).sum(axis=1)) <= config.max_jerk_m_s3 * dt_s * dt_s + ROUNDING_M_S
    )  # fmt: skip
    return within


def _towards(points: Floats, end: CorridorVector, scale: float) -> Floats:
    """The places nearest to points [c, 3] on the straight way from zero to `end` times `scale`."""
    way = scale * np.array((end.x, end.y, end.z))
    share = points @ way / max(float(way @ way), ROUNDING_M_S**2)
    nearest: Floats = np.minimum(np.maximum(share, 0.0), 1.0)[:, None] * way
    return nearest


def _limit_speed(velocity: CorridorVector, range_max_m: float, config: SafetyConfig, found: list[Intervention]) -> CorridorVector:
    """Keep the direction, shorten the horizontal vector; never faster than can be stopped within sight."""
    sight = speed_cap_m_s(range_max_m - config.keep_out_m, config.delay_s, config.braking_m_s2)
    limit, speed = min(config.max_horizontal_speed_m_s, sight), math.hypot(velocity.x, velocity.y)
    x, y, z = velocity.x, velocity.y, velocity.z
    if speed > limit:
        found.append(Intervention("speed_limit", speed, limit))
        # huge finite values overflow in a division: the direction first, then the length
        scale = max(abs(x), abs(y))
        x, y = x / scale, y / scale
        norm = math.hypot(x, y)
        x, y = limit * (x / norm), limit * (y / norm)
    if abs(z) > config.max_vertical_speed_m_s:
        found.append(Intervention("vertical_speed_limit", abs(z), config.max_vertical_speed_m_s))
        z = math.copysign(config.max_vertical_speed_m_s, z)
    return CorridorVector(x, y, z) if found else velocity


def _limit_growth(
    velocity: CorridorVector, last: LastSent, dt_s: float, config: SafetyConfig, found: list[Intervention]
) -> CorridorVector:
    """Shorten what is added to the part of the last command that is kept; slowing down, and adding less than before, is free."""
    kept = _scaled(last.velocity, _kept_share(velocity, last.velocity))
    added = _minus(velocity, kept)
    step = _length(added)
    limit = config.max_acceleration_m_s2 * dt_s
    fits = step <= limit + ROUNDING_M_S
    if not fits:
        found.append(Intervention("acceleration_limit", step, limit))
        added = _scaled(added, limit / step)
    before, change = _scaled(last.acceleration, dt_s), config.max_jerk_m_s3 * dt_s * dt_s
    share = _share_within(added, before, change)
    if share < 1.0:
        found.append(Intervention("jerk_limit", _length(added), share * _length(added)))
        added, fits = _scaled(added, share), False
    return velocity if fits else CorridorVector(*_minus(kept, _scaled(added, -1.0)))


def _share_within(added: _Any, before: _Any, change: float) -> float:
    """Largest share (up to 1) of `added` that is no further than `change` from the way between zero and `before`."""
    size2, before2 = _dot(added, added), _dot(before, before)
    along = _dot(added, before)
    nearest = _scaled(before, min(max(along / before2, 0.0), 1.0) if before2 > 0.0 else 0.0)
    if _length(_minus(added, nearest)) <= change + ROUNDING_M_S:
        return 1.0
    if along <= 0.0 or before2 <= 0.0:  # squares of tiny numbers are zero
        return change / math.sqrt(size2)
    across2 = max(size2 - along * along / before2, 0.0)
    beside = change / math.sqrt(across2) if across2 > 0.0 else math.inf
    if beside * along <= before2:
        return beside
    return (along + math.sqrt(max(along * along - size2 * (before2 - change * change), 0.0))) / size2


def _kept_share(velocity: CorridorVector, last: CorridorVector) -> float:
    """How much of the last command a new one keeps, 0 to 1."""
    length2 = _dot(last, last)
    return min(max(_dot(velocity, last) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0


def _dot(a: _Any, b: _Any) -> float:
    return a.x * b.x + a.y * b.y + a.z * b.z


def _length(a: _Any) -> float:
    return math.sqrt(_dot(a, a))


def _minus(a: _Any, b: _Any) -> _Vector:
    return _Vector(a.x - b.x, a.y - b.y, a.z - b.z)


def _scaled(a: _Any, factor: float) -> _Vector:
    return _Vector(a.x * factor, a.y * factor, a.z * factor)
