"""PX4's own reaction to a stream that stops: written, read back, and what it means in metres."""

from __future__ import annotations

from flight.errors import VehicleCommandError
from flight.guard.core import Timing
from flight.link import VehicleLink
from flight.mission import Mission
from flight.preflight import Check, Level

NAME = "setpoint loss"


def set_loss_action(link: VehicleLink, mission: Mission) -> Check:
    """Write COM_OF_LOSS_T and COM_OBL_RC_ACT; `set_parameter` reads each back from the vehicle. The mission bounds them."""
    failsafe = mission.failsafe
    try:
        link.set_parameter("COM_OF_LOSS_T", failsafe.setpoint_loss_timeout_s)
        link.set_parameter("COM_OBL_RC_ACT", int(failsafe.loss_action))
    except VehicleCommandError as error:
        return Check(NAME, Level.FAIL, str(error), "fly engages only when PX4's own failsafe is known")
    braked_m, unbraked_m = stopping_ways_m(mission)
    seen = f"{failsafe.setpoint_loss_action} after {failsafe.setpoint_loss_timeout_s:g} s"
    return Check(
        NAME, Level.PASS, f"{seen}; at full speed it stands within {braked_m:.2f} m, {unbraked_m:.2f} m without the guard"
    )


def stopping_ways_m(mission: Mission) -> tuple[float, float]:
    """The longest way from full speed when the program dies, and when the guard or the whole computer dies with it, m.

    The last command flies on until the guard's first zero, or until PX4 misses the stream; then the vehicle stops as the safety
    layer assumes it to (PX4's Hold brakes no worse than a zero velocity setpoint).
    """
    safety = mission.safety
    speed = safety.max_horizontal_speed_m_s
    stop_m = safety.stop_distance_m(speed)
    return speed * Timing().beat_s + stop_m, speed * mission.failsafe.setpoint_loss_timeout_s + stop_m
