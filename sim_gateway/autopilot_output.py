"""What the autopilot gives out: its setpoint for the velocity loop, its texts, and the record of its modes."""

from __future__ import annotations

from dataclasses import dataclass

from sim_gateway.attitude_setpoints import Thrust
from sim_gateway.flight_modes import FlightMode
from sim_gateway.local_frame import Vector


@dataclass(frozen=True, slots=True)
class StatusText:
    """One STATUSTEXT: `severity` is MAV_SEVERITY."""

    time_s: float
    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class ModeChange:
    """The mode from `time_s` on, and whether the vehicle is armed and in failsafe."""

    time_s: float
    mode: FlightMode
    intended: FlightMode
    armed: bool
    failsafe: bool


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """What the vehicle's velocity loop shall fly: NED m/s, clockwise rad/s. With motors off the rest is zero.

    `thrust`: past the velocity loop, this instead of a velocity.
    """

    motors_on: bool
    velocity: Vector = (0.0, 0.0, 0.0)
    yaw_rate_rad_s: float = 0.0
    thrust: Thrust | None = None


MOTORS_OFF = ControlOutput(False)
