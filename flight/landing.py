"""From wherever a flight ended to the ground: brake, hold, land, wait for disarm. Nothing here raises or gives up early.

Pilot first holds here too: once the vehicle is in a mode that `fly` did not command, nothing more is commanded.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from flight.authority import ControlLostError
from flight.errors import VehicleCommandError
from flight.interrupt import Interrupt
from flight.link import VehicleLink
from flight.px4 import FlightMode, mode_name
from flight.status import Status

LAND_TRIES = 3
FOREIGN_MODE_S = 1.5


class Landing:
    """Brings an armed vehicle down. `land` returns whether it is disarmed; `events` says what went wrong on the way."""

    def __init__(
        self,
        link: VehicleLink,
        status: Status,
        interrupt: Interrupt,
        land_timeout_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.events: list[str] = []
        self._link, self._status, self._interrupt = link, status, interrupt
        self._land_timeout_s, self._clock, self._sleep = land_timeout_s, clock, sleep

    def land(self, keep_alive: Callable[[], None] | None = None) -> bool:
        """Hold, then land. `keep_alive` keeps the setpoint stream up until PX4 has left OFFBOARD."""
        if self._link.telemetry.armed is False:
            return True
        try:
            self._command(FlightMode.HOLD, 1, keep_alive)
            self._status.phase("landing")
            accepted = self._command(FlightMode.LAND, LAND_TRIES, None)
        except ControlLostError as error:
            return not self._link.armed or self._yield(str(error))
        if not accepted:
            self.events.append("the vehicle did not accept the landing: take over and land by hand")
            self._status.phase(self.events[-1])
            return False
        return self._wait_for_disarm()

    def _command(self, mode: FlightMode, tries: int, keep_alive: Callable[[], None] | None) -> bool:
        """Whether PX4 took the mode. Raises `ControlLostError`: nothing more may be commanded."""
        for _ in range(tries):
            if self._link.in_control and self._link.mode == mode:
                return True
            try:
                self._link.set_mode(mode, keep_alive)
                return True
            except ControlLostError:
                raise
            except (VehicleCommandError, RuntimeError) as error:
                self.events.append(str(error))
        return False

    def _wait_for_disarm(self) -> bool:
        """Until the heartbeat says disarmed. A second signal ends the waiting: by then the landing is PX4's alone."""
        deadline = self._clock() + self._land_timeout_s
        signals = self._interrupt.count
        foreign_since = None
        while self._clock() < deadline:
            if self._link.telemetry.armed is False:
                return True
            if self._link.guard.lost is not None:
                self.events.append(self._link.guard.lost)
                return False
            if self._interrupt.count > max(signals, 1):
                self.events.append("not waited for: PX4 is landing")
                return False
            if self._link.mode == FlightMode.LAND:
                foreign_since = None
            elif foreign_since is None:
                foreign_since = self._clock()
            elif self._clock() - foreign_since > FOREIGN_MODE_S:
                return self._yield(f"mode {mode_name(self._link.mode)} was not commanded by fly")
            self._sleep(0.02)
        self.events.append(f"not disarmed {self._land_timeout_s:g} s after the landing command: check the vehicle")
        self._status.phase(self.events[-1])
        return False

    def _yield(self, why: str) -> bool:
        self.events.append(f"{why}: it is the pilot's vehicle now")
        self._status.phase(self.events[-1])
        return False
