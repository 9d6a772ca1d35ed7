"""What OFFBOARD flies past the velocity loop: attitude or body rates with a thrust (SET_ATTITUDE_TARGET), and accelerations.

The recordings hold no attitude setpoints: those follow PX4's documentation. Body rates are flown by integrating them into an
attitude, so the vehicle lags them by the attitude loop instead of the rate loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_gateway.local_frame import Vector
from sim_gateway.vehicle_params import GRAVITY_M_S2

# ATTITUDE_TARGET_TYPEMASK
ROLL_RATE_IGNORE, PITCH_RATE_IGNORE, YAW_RATE_IGNORE, THRUST_IGNORE, ATTITUDE_IGNORE = 1, 2, 4, 64, 128

Quaternion = tuple[float, float, float, float]  # w x y z, body FRD to NED


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """`attitude` (None: fly the rates), body rates (rad/s, FRD; not finite: none) and thrust as a share of the motors'."""

    attitude: Quaternion | None
    rates: Vector
    thrust: float

    @property
    def yaw_rate_rad_s(self) -> float:
        """The rate about the body's z axis."""
        return self.rates[2]


@dataclass(frozen=True, slots=True)
class Thrust:
    """A collective thrust along a unit vector (NED; up is negative): a share of the motors', or of what hovers (`of_hover`)."""

    direction: Vector
    share: float
    of_hover: bool = False


def thrust_for(acceleration: Vector, tilt_max_rad: float) -> Thrust:
    """The thrust that gives an acceleration (NED, m/s2) to a vehicle without drag. The tilt limit cuts the horizontal part."""
    north, east, down = acceleration
    lift = max(GRAVITY_M_S2 - down, 0.1 * GRAVITY_M_S2)
    wanted, most = math.hypot(north, east), GRAVITY_M_S2 * math.tan(tilt_max_rad)
    kept = min(1.0, most / wanted) if wanted > 0.0 else 1.0
    force = (kept * north, kept * east, -lift)
    length = math.hypot(*force)
    return Thrust((force[0] / length, force[1] / length, force[2] / length), length / GRAVITY_M_S2, of_hover=True)


def read_attitude_target(type_mask: int, attitude: Quaternion, rates: Vector, thrust: float) -> AttitudeSetpoint | None:
    """The setpoint a message asks for; None where it asks for nothing that can be flown."""
    bits = (ROLL_RATE_IGNORE, PITCH_RATE_IGNORE, YAW_RATE_IGNORE)
    wanted_rates = tuple(math.nan if type_mask & bit else rate for bit, rate in zip(bits, rates, strict=True))
    length = math.hypot(*attitude)
    unit: Quaternion | None = None
    if not type_mask & ATTITUDE_IGNORE and math.isfinite(length) and length > 0.5:
        w, x, y, z = (value / length for value in attitude)
        unit = (w, x, y, z)
    some = unit is not None or any(map(math.isfinite, wanted_rates))
    if not some or type_mask & THRUST_IGNORE or not math.isfinite(thrust):
        return None
    return AttitudeSetpoint(unit, (wanted_rates[0], wanted_rates[1], wanted_rates[2]), min(max(thrust, 0.0), 1.0))


def yaw_of(attitude: Quaternion) -> float:
    """Heading of the body's x axis, clockwise from north."""
    w, x, y, z = attitude
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _up(attitude: Quaternion) -> Vector:
    """Where the rotors push, NED."""
    w, x, y, z = attitude
    return (-2.0 * (x * z + w * y), -2.0 * (y * z - w * x), -(1.0 - 2.0 * (x * x + y * y)))


def _turned(attitude: Quaternion, rates: Vector, dt_s: float) -> Quaternion:
    """The attitude after turning at these body rates."""
    w, x, y, z = attitude
    p, q, r = (0.5 * dt_s * rate if math.isfinite(rate) else 0.0 for rate in rates)
    turned = (w - x * p - y * q - z * r, x + w * p + y * r - z * q, y + w * q + z * p - x * r, z + w * r + x * q - y * p)
    length = math.hypot(*turned)
    return (turned[0] / length, turned[1] / length, turned[2] / length, turned[3] / length)


class AttitudeLaw:
    """From setpoints to thrusts. `yaw_rad`: the heading to turn to; not finite: none."""

    def __init__(self) -> None:
        self.yaw_rad = math.nan
        self._attitude: Quaternion | None = None

    def update(self, given: AttitudeSetpoint, heading_rad: float, dt_s: float) -> Thrust:
        """The thrust for this instant, `dt_s` after the last one. Rates begin level at the present heading."""
        if given.attitude is not None:
            self._attitude = given.attitude
            self.yaw_rad = math.nan if math.isfinite(given.yaw_rate_rad_s) else yaw_of(given.attitude)
        else:
            level = (math.cos(0.5 * heading_rad), 0.0, 0.0, math.sin(0.5 * heading_rad))
            self._attitude = _turned(self._attitude or level, given.rates, dt_s)
            self.yaw_rad = yaw_of(self._attitude)
        return Thrust(_up(self._attitude), given.thrust)
