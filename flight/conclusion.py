"""From arming on, every way out goes through here: what a flight came to, however it ended, and the way to the ground."""

from __future__ import annotations

import logging
from collections.abc import Callable

from flight.authority import ControlLostError
from flight.errors import ExitCode, VehicleCommandError
from flight.guard.client import GuardLostError
from flight.landing import Landing
from flight.link import VehicleLink
from flight.offboard import Ending, OffboardFlight
from flight.px4 import FlightMode

log = logging.getLogger("flight.session")

BRAKE_S = 1.0


def ending_of(fly: Callable[[], Ending], link: VehicleLink) -> Ending:
    """How the flight ended, exceptions included. Raises nothing."""
    try:
        return fly()
    except ControlLostError as error:
        outcome = link.authority.outcome if link.authority is not None else "pilot_took_over"
        return Ending(outcome, ExitCode.NOT_REACHED, str(error), in_control=False)
    except GuardLostError as error:
        return Ending("guard_lost", ExitCode.SAFETY_ENDED, str(error), in_control=False)
    except VehicleCommandError as error:
        return Ending("vehicle_refused", ExitCode.NOT_REACHED, str(error))
    except Exception as error:  # armed: whatever it is, the vehicle must come down
        log.exception("unexpected error in flight")
        return Ending("internal_error", ExitCode.SAFETY_ENDED, f"{type(error).__name__}: {error}")


def bring_down(ending: Ending, link: VehicleLink, flight: OffboardFlight, landing: Landing) -> bool:
    """Brake, hold and land, unless the vehicle is somebody else's now; whether it is disarmed in the end."""
    if not (ending.in_control and link.in_control):
        link.close_stream()
        return link.telemetry.armed is False
    if link.mode == FlightMode.OFFBOARD:
        flight.brake(BRAKE_S)
    landed = landing.land(flight.stay if link.mode == FlightMode.OFFBOARD else None)
    link.close_stream()
    return landed
