"""Offboard setpoints: what PX4 makes of SET_POSITION_TARGET_LOCAL_NED, with all the odd ones (odd_setpoints.json)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_gateway.local_frame import Vector

FRAME_LOCAL_NED, FRAME_BODY_NED = 1, 8
# POSITION_TARGET_TYPEMASK
_X, _VX, _AX, FORCE, YAW_IGNORE, YAW_RATE_IGNORE = 1, 8, 64, 512, 1024, 2048
NAN = math.nan
NOTHING: Vector = (NAN, NAN, NAN)


class SetpointRefusedError(ValueError):
    """PX4 ignores this setpoint message; the text is what it says in STATUSTEXT."""


@dataclass(frozen=True, slots=True)
class OffboardSetpoint:
    """One setpoint in local NED. A component that is not finite is not given."""

    position: Vector = NOTHING
    velocity: Vector = NOTHING
    acceleration: Vector = NOTHING
    yaw_rad: float = NAN
    yaw_rate_rad_s: float = NAN

    @property
    def only_acceleration(self) -> bool:
        """Whether it asks for an acceleration and nothing else."""
        others = (*self.position, *self.velocity)
        return all(map(math.isfinite, self.acceleration)) and not any(map(math.isfinite, others))

    @property
    def flyable(self) -> bool:
        """Whether each axis is controlled, and x and y by the same kind. PX4 hovers on a setpoint that is not."""
        kinds = (self.position, self.velocity, self.acceleration)
        horizontal = any(math.isfinite(kind[0]) and math.isfinite(kind[1]) for kind in kinds)
        return horizontal and any(math.isfinite(kind[2]) for kind in kinds)


def _masked(values: Vector, type_mask: int, first_bit: int) -> Vector:
    x, y, z = (NAN if type_mask & first_bit << i else value for i, value in enumerate(values))
    return (x, y, z)


def _any_finite(values: Vector) -> bool:
    return any(math.isfinite(value) for value in values)


def _turned(body: Vector, yaw_rad: float) -> Vector:
    """Body NED (turned by yaw only) to local NED."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return (cos * body[0] - sin * body[1], sin * body[0] + cos * body[1], body[2])


def read_setpoint(
    frame: int,
    type_mask: int,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
    yaw_rad: float,
    yaw_rate_rad_s: float,
    *,
    vehicle_yaw_rad: float,
    message: str = "SET_POSITION_TARGET_LOCAL_NED",
) -> OffboardSetpoint:
    """The setpoint a message asks for; raises `SetpointRefusedError` where PX4 drops the message.

    A body-frame vector is turned by the vehicle's yaw at the moment the message arrives, and a body-frame position is ignored.
    """
    if frame not in (FRAME_LOCAL_NED, FRAME_BODY_NED):
        raise SetpointRefusedError(f"{message} coordinate frame {frame} unsupported")
    position, velocity = _masked(position, type_mask, _X), _masked(velocity, type_mask, _VX)
    acceleration = _masked(acceleration, type_mask, _AX)
    if frame == FRAME_BODY_NED:
        position, velocity = NOTHING, _turned(velocity, vehicle_yaw_rad)
        acceleration = _turned(acceleration, vehicle_yaw_rad)
    if not (_any_finite(position) or _any_finite(velocity) or _any_finite(acceleration)):
        raise SetpointRefusedError(f"{message} invalid")
    if type_mask & FORCE:
        raise SetpointRefusedError(f"{message} force not supported")
    yaw = NAN if type_mask & YAW_IGNORE else yaw_rad
    return OffboardSetpoint(position, velocity, acceleration, yaw, NAN if type_mask & YAW_RATE_IGNORE else yaw_rate_rad_s)
