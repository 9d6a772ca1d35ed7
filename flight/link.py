"""The vehicle as `fly` commands it: one-shot velocity setpoints, arming, takeoff and modes, each only while it is ours.

Setpoints go to the guard, not to MAVSDK. The guard sends each one once, only while it is young; when this program stops, hangs or
dies, it brakes and falls silent, so that PX4's own offboard-loss action comes. MAVSDK's Offboard plugin is never used: it repeats
the last setpoint by itself for ever.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from flight.authority import Authority
from flight.connection import COMMAND_DEADLINE_S, VehicleConnection
from flight.errors import VehicleCommandError
from flight.guard.client import GuardLostError
from flight.guard.core import State
from flight.mavsdk_support import Answer
from flight.px4 import COMMAND_DO_SET_MODE, MODE_FLAG_CUSTOM, RESULT_ACCEPTED, FlightMode, mode_name
from safety.frames import CorridorFrame
from safety.messages import SafeCommand

MODE_DEADLINE_S = 3.0


class VehicleLink(VehicleConnection):
    """A connection that commands the vehicle: `open_stream` and `send_velocity`, `arm`, `take_off`, `set_mode`.

    With an `authority`, the link itself is the last gate of "pilot first": once control is lost, every setpoint, mode command,
    arming and takeoff raises `ControlLostError` before anything is sent.
    """

    def __init__(
        self,
        url: str,
        clock: Callable[[], float] = time.monotonic,
        *,
        guard_priority: int = 0,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """See `VehicleConnection`."""
        super().__init__(url, clock, guard_priority=guard_priority, sleep=sleep)
        self.setpoints_sent = 0
        self.authority: Authority | None = None

    # -- setpoints ----------------------------------------------------------------------------------------------

    def open_stream(self) -> None:
        """Begin an engagement: without it the guard sends no setpoint. Raises `VehicleCommandError` when the guard is gone."""
        self.require_control()
        self.guard.engage(self._target)

    def close_stream(self) -> None:
        """No setpoint from now on, not even a braking one. Never raises."""
        self.guard.disengage()

    def send_velocity(self, command: SafeCommand, frame: CorridorFrame, decided_s: float | None = None) -> float | None:
        """Send one velocity setpoint; returns when it went out, None where the guard held it back (too old, stream closed).

        `decided_s`: when the inputs were read that led to it, now if not given; the guard sends nothing decided too long ago.
        The last gate before the wire: raises `ValueError` on a number that is not finite, `ControlLostError` when the vehicle is
        not ours any more, `GuardLostError` when the guard is gone.
        """
        self.require_control()
        velocity = frame.vector_to_ned(command.velocity)
        yaw_rate = frame.yaw_rate_to_ned(command.yaw_rate_rad_s)
        if not (math.isfinite(velocity.x + velocity.y + velocity.z) and math.isfinite(yaw_rate)):
            raise ValueError(f"refusing to send a setpoint that is not finite: {command}")
        setpoint = (velocity.x, velocity.y, velocity.z, yaw_rate)
        sent_s = self.guard.command(setpoint, self._clock() if decided_s is None else decided_s)
        self.setpoints_sent += sent_s is not None
        return sent_s

    # -- commands -----------------------------------------------------------------------------------------------

    def arm(self, keep_alive: Callable[[], None] | None = None) -> None:
        """Arm, and wait until the heartbeat says so."""
        self.require_control()
        self._act("arm", "arm", keep_alive)
        if not self.wait_until(lambda: self.armed, 2.5, keep_alive):
            raise VehicleCommandError("the vehicle accepted arming, but its heartbeat does not say armed")

    def disarm(self) -> None:
        """Disarm on the ground. PX4 refuses in the air."""
        self._act("disarm", "disarm", None)

    def take_off(self, height_m: float, keep_alive: Callable[[], None] | None = None) -> None:
        """Set MIS_TAKEOFF_ALT and start PX4's own takeoff; returns when PX4 accepted it, not when the height is reached."""
        self.require_control()
        self.set_parameter("MIS_TAKEOFF_ALT", float(height_m))
        if self.authority is not None:
            self.authority.expect(FlightMode.TAKEOFF)
        self._act("takeoff", "take off", keep_alive)

    def set_mode(self, mode: FlightMode, keep_alive: Callable[[], None] | None = None) -> None:
        """Command `mode` and wait until PX4 reports it. PX4's first ack of this command is always `accepted`: not believed."""
        authority = self.authority
        if authority is not None:
            authority.expect(mode)
        try:
            self._command_mode(mode, keep_alive)
        except VehicleCommandError:
            if authority is not None:
                authority.require()
                authority.refused()
            raise
        self.require_control()

    def _command_mode(self, mode: FlightMode, keep_alive: Callable[[], None] | None) -> None:
        self.command_long(
            COMMAND_DO_SET_MODE, MODE_FLAG_CUSTOM, mode.main, mode.sub, what=f"mode {mode.name}", keep_alive=keep_alive
        )
        if not self.wait_until(lambda: self.mode == mode or not self.in_control, MODE_DEADLINE_S, keep_alive):
            raise VehicleCommandError(f"PX4 did not enter {mode.name}: it stays in {mode_name(self.mode)}{self._last_words()}")

    @property
    def stream_open(self) -> bool:
        """Whether the guard still takes setpoints: not after it has fallen silent, for whatever reason."""
        return self.guard.state in (State.FOLLOW, State.BRAKE)

    @property
    def in_control(self) -> bool:
        """False once a pilot, PX4 or a restart has taken the vehicle from us, or the guard is gone."""
        return self.guard.lost is None and (self.authority is None or self.authority.lost is None)

    def require_control(self) -> None:
        """Raise `GuardLostError` or `ControlLostError` when nothing may be sent any more; then the guard is silent as well."""
        if self.guard.lost is not None:
            raise GuardLostError(self.guard.lost)
        if self.authority is not None and self.authority.lost is not None:
            self.close_stream()
            self.authority.require()

    def _act(self, method: str, what: str, keep_alive: Callable[[], None] | None) -> None:
        answer = Answer()
        getattr(self._action, f"{method}_async")(answer.on_action)
        if not self.wait_until(answer.done.is_set, COMMAND_DEADLINE_S, keep_alive):
            raise VehicleCommandError(f"the vehicle did not answer the command to {what} within {COMMAND_DEADLINE_S:g} s")
        if answer.result != RESULT_ACCEPTED:
            raise VehicleCommandError(f"the vehicle refused to {what}: {answer.text}{self._last_words()}")
