"""What the loop hands to the safety layer's monitors besides scan and estimate."""

from __future__ import annotations

import math

from flight.authority import Authority
from flight.px4 import LANDED_STATE_ON_GROUND
from flight.telemetry import Telemetry
from safety.frames import CorridorFrame
from safety.messages import Health


def health_of(
    telemetry: Telemetry, frame: CorridorFrame, lateness_s: float, authority: Authority | None = None, *, overruled: bool = False
) -> Health:
    """The newest of everything. Without `authority` (a pilot flies) nobody asks who has the vehicle and whether it has landed."""
    report, battery = telemetry.report, telemetry.battery_fraction
    echo = report.echo
    return Health(
        lateness_s=lateness_s,
        link_delay_s=report.round_trip_s,
        battery_fraction=math.nan if battery is None else battery,
        in_control=None if authority is None else authority.lost is None,
        landed=None if authority is None else telemetry.landed_state == LANDED_STATE_ON_GROUND,
        boots=telemetry.clock.reboots,
        estimate_valid=report.estimate_valid,
        accuracy_m=report.accuracy_m,
        echo=None if echo is None or authority is None else frame.vector_to_corridor(echo.velocity),
        echo_time_s=math.nan if echo is None else echo.time_s,
        overruled=overruled,
    )
