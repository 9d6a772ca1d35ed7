"""What the vehicle says of itself beyond the messages that the loop lives on: newest of each kind, and parameters."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from flight.errors import VehicleCommandError
from flight.link import VehicleLink
from flight.px4 import MESSAGE_ID

LISTENED = (
    "SYS_STATUS",
    "ESTIMATOR_STATUS",
    "GPS_RAW_INT",
    "GLOBAL_POSITION_INT",
    "SYSTEM_TIME",
    "AUTOPILOT_VERSION",
    "RC_CHANNELS",
    "OPTICAL_FLOW_RAD",
)
Fields = dict[str, Any]
Value = int | float


class VehicleFacts:
    """Listens from now on. `newest(name)` gives the last message of a kind, `rate_hz(name)` how often it came."""

    def __init__(self, link: VehicleLink, clock: Callable[[], float] = time.monotonic) -> None:
        self._link, self._clock = link, clock
        self._newest: dict[str, tuple[float, Fields]] = {}
        self._started_s = clock()
        self._before = dict(link.telemetry.counts)
        self.round_trip_s: float | None = None
        for name in LISTENED:
            link.listen(name, self._keeper(name))

    def _keeper(self, name: str) -> Callable[[Fields], None]:
        def keep(fields: Fields) -> None:
            self._newest[name] = (self._clock(), fields)

        return keep

    def newest(self, name: str) -> Fields | None:
        """Fields of the newest message, None before the first."""
        found = self._newest.get(name)
        return found[1] if found is not None else None

    def rate_hz(self, name: str) -> float:
        """Mean rate since listening began, of the messages that telemetry counts."""
        elapsed_s = max(self._clock() - self._started_s, 1e-3)
        return (self._link.telemetry.counts.get(name, 0) - self._before.get(name, 0)) / elapsed_s

    @property
    def heartbeat_age_s(self) -> float:
        """Since the autopilot's last heartbeat."""
        return self._clock() - self._link.telemetry.heartbeat_s

    def ask_version(self) -> None:
        """Request AUTOPILOT_VERSION and measure how long a command takes. No answer leaves both empty."""
        before_s = self._clock()
        try:
            self._link.request_message(MESSAGE_ID["AUTOPILOT_VERSION"])
        except VehicleCommandError:
            return
        self.round_trip_s = self._clock() - before_s
        self._link.wait_until(lambda: self.newest("AUTOPILOT_VERSION") is not None, 2.0)

    def read_parameters(self, wanted: Iterable[tuple[str, type[int] | type[float]]]) -> dict[str, Value]:
        """Values by name; what the vehicle does not have is left out."""
        values: dict[str, Value] = {}
        for name, kind in wanted:
            try:
                values[name] = self._link.get_parameter(name, kind)
            except VehicleCommandError:
                continue
        return values
