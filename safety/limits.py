"""Vector limits on the wanted command, relative to the command last sent. They come before fence and obstacles, never after."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig, speed_cap_m_s
from safety.frames import CorridorVector
from safety.messages import Intervention, VelocityCommand

ROUNDING_M_S = 1e-9  # the time between two ticks is a difference of large numbers


def limit_command(
    command: VelocityCommand, last: CorridorVector, dt_s: float, range_max_m: float, config: SafetyConfig
) -> tuple[VelocityCommand, tuple[Intervention, ...]]:
    """Scale a finite command into speed, sight, acceleration and yaw-rate limits; returned as it is when it obeys them all."""
    found: list[Intervention] = []
    velocity = _limit_speed(command.velocity, range_max_m, config, found)
    velocity = _limit_acceleration(velocity, last, dt_s, config, found)
    yaw_rate = command.yaw_rate_rad_s
    if abs(yaw_rate) > config.max_yaw_rate_rad_s:
        found.append(Intervention("yaw_rate_limit", abs(yaw_rate), config.max_yaw_rate_rad_s))
        yaw_rate = math.copysign(config.max_yaw_rate_rad_s, yaw_rate)
    if not found:
        return command, ()
    return VelocityCommand(velocity, yaw_rate), tuple(found)


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
    return CorridorVector(x, y, z)


def _limit_acceleration(
    velocity: CorridorVector, last: CorridorVector, dt_s: float, config: SafetyConfig, found: list[Intervention]
) -> CorridorVector:
    """Bound the step away from the part of the last command that is kept: slowing down along it is always free."""
    length2 = last.x * last.x + last.y * last.y + last.z * last.z
    along = velocity.x * last.x + velocity.y * last.y + velocity.z * last.z
    keep = min(max(along / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    bx, by, bz = last.x * keep, last.y * keep, last.z * keep
    dx, dy, dz = velocity.x - bx, velocity.y - by, velocity.z - bz
    step, limit = math.sqrt(dx * dx + dy * dy + dz * dz), config.max_acceleration_m_s2 * dt_s
    if step <= limit + ROUNDING_M_S:
        return velocity
    found.append(Intervention("acceleration_limit", step, limit))
    share = limit / step
    return CorridorVector(bx + dx * share, by + dy * share, bz + dz * share)


def within_limits(
    candidates_m_s: NDArray[np.float64], last: CorridorVector, dt_s: float, config: SafetyConfig
) -> NDArray[np.bool_]:
    """Which velocities [c, 3] obey the speed and acceleration limits: what evades an obstacle is bound by them too."""
    kept = np.array((last.x, last.y, last.z))
    along = candidates_m_s @ kept / max(float(kept @ kept), ROUNDING_M_S**2)
    step = candidates_m_s - np.clip(along, 0.0, 1.0)[:, None] * kept
    slow = np.hypot(candidates_m_s[:, 0], candidates_m_s[:, 1]) <= config.max_horizontal_speed_m_s
    near = np.einsum("ci,ci->c", step, step) <= (config.max_acceleration_m_s2 * dt_s + ROUNDING_M_S) ** 2
    within: NDArray[np.bool_] = slow & near & (np.abs(candidates_m_s[:, 2]) <= config.max_vertical_speed_m_s)
    return within
