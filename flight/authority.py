"""Who has the vehicle. Pilot first: any mode that `fly` did not command ends its control at once, and for good.

`Authority` reads every mode change that telemetry recorded, not the mode of the moment: a pilot who takes over and goes back
to OFFBOARD between two looks is seen as well. Once lost, control never comes back in that flight; whoever wants to send asks
here first.
"""

from __future__ import annotations

from flight.errors import VehicleCommandError
from flight.px4 import LANDED_STATE_ON_GROUND, FlightMode, mode_name
from flight.telemetry import Telemetry


class ControlLostError(VehicleCommandError):
    """The vehicle is somebody else's now: nothing was and nothing will be sent."""


class Authority:
    """Watches one flight from before arming on. `expect` a mode before commanding it; everything else that appears is foreign.

    PX4's own step from TAKEOFF to HOLD at the end of a takeoff is expected too.
    """

    def __init__(self, telemetry: Telemetry) -> None:
        self._telemetry = telemetry
        self._seen = telemetry.mode_log[0]
        self._reboots = telemetry.clock.reboots
        self._current: int | None = telemetry.mode
        self._pending: FlightMode | None = None
        self._was_armed = False
        self._reason: str | None = None
        self._outcome = ""

    def expect(self, mode: FlightMode) -> None:
        """`fly` is about to command `mode`. Raises `ControlLostError` when it may not."""
        self.require()
        self._pending = mode

    def refused(self) -> None:
        """The mode expected was refused: should it appear later after all, it is foreign."""
        self._pending = None

    def require(self) -> None:
        """Raise `ControlLostError` when control is lost."""
        reason = self.lost
        if reason is not None:
            raise ControlLostError(reason)

    @property
    def lost(self) -> str | None:
        """Why control is lost, or None while `fly` has it. Latched."""
        if self._reason is None:
            self._look()
        return self._reason

    @property
    def outcome(self) -> str:
        """One word for the summary (`pilot_took_over`, `disarmed`, `vehicle_rebooted`, `landed_in_flight`), empty in control."""
        return self._outcome

    def _look(self) -> None:
        telemetry = self._telemetry
        if telemetry.clock.reboots != self._reboots:
            self._lose("vehicle_rebooted", "the autopilot restarted in flight: control given up")
            return
        self._was_armed = self._was_armed or telemetry.armed is True
        if self._was_armed and telemetry.armed is False:
            self._lose("disarmed", "the vehicle was disarmed in flight: control given up")
            return
        count, changes = telemetry.mode_log
        fresh = changes[max(0, len(changes) - (count - self._seen)) :] if count > self._seen else ()
        for _, mode in fresh:
            if not self._follow(mode):
                self._lose("pilot_took_over", f"mode {mode_name(mode)} was not commanded by fly: control given up")
                return
        self._seen = count
        if self._current == FlightMode.OFFBOARD and telemetry.landed_state == LANDED_STATE_ON_GROUND:
            self._lose("landed_in_flight", "the vehicle reports to be on the ground while the policy flies: control given up")

    def _follow(self, mode: int) -> bool:
        """Take note of a change; False when it is foreign."""
        if mode == self._pending:
            self._pending = None
        elif not (mode == self._current or (self._current == FlightMode.TAKEOFF and mode == FlightMode.HOLD)):
            return False
        self._current = mode
        return True

    def _lose(self, outcome: str, reason: str) -> None:
        self._outcome, self._reason = outcome, reason
