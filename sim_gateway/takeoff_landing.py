"""When a vehicle counts as in the air and when as landed: spool-up, takeoff ramp, landing detection, the disarm timers.

Delays as recorded (px4_reference: lifecycle.json, modes.json). Called by `Autopilot.step`, which owns `landed` itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim_gateway.autopilot_output import ControlOutput
from sim_gateway.flight_modes import INFO, FlightMode
from sim_gateway.flight_tasks import MotionCommand

if TYPE_CHECKING:
    from sim_gateway.autopilot import Autopilot

_LANDING_DETECT_S = 1.8  # recorded 1.7 to 2.3 s from touch down to "Landing detected"
_CLIMB_WANTED_M_S = 0.05
_LIFT_OFF_S = 0.35  # recorded: takeoff is detected about that long after the motors have spooled up,
_LIFT_OFF_OFFBOARD_S = 0.65  # and that long in OFFBOARD by velocity
_RAMP_START_M_S = 0.9  # the takeoff ramp starts as if descending, so that thrust comes up from its minimum


class TakeoffLanding:
    """The way off the ground and back of one vehicle. `flown`: it has been in the air since it was armed."""

    def __init__(self, pilot: Autopilot) -> None:
        self._pilot = pilot
        self._get = pilot.parameters.get
        self.flown = False
        self._armed_at_s = 0.0
        self._landed_at_s = 0.0
        self._ramp_start_s: float | None = None
        self._ground_since_s: float | None = None

    def armed(self) -> None:
        """The motors start now."""
        self.flown, self._armed_at_s = False, self._pilot.now_s

    def stopped(self) -> None:
        """The motors are off: no ramp and no landing is under way."""
        self._ramp_start_s = self._ground_since_s = None

    def output(self, command: MotionCommand) -> ControlOutput:
        """What the vehicle shall fly of what its mode wants."""
        return self._through_ramp(command) if command.thrust is None else self._on_thrust(command)

    def _through_ramp(self, command: MotionCommand) -> ControlOutput:
        """Hold a climb back while motors spool up (COM_SPOOLUP_TIME), then let its speed grow over MPC_TKO_RAMP_T."""
        pilot, get, now_s = self._pilot, self._get, self._pilot.now_s
        north, east, down = command.velocity
        wants_climb = down < -_CLIMB_WANTED_M_S
        lift_off_s = _LIFT_OFF_OFFBOARD_S if pilot.mode is FlightMode.OFFBOARD else _LIFT_OFF_S
        if pilot.landed and not (wants_climb and now_s - self._armed_at_s >= get("COM_SPOOLUP_TIME") + lift_off_s):
            return ControlOutput(True)
        if pilot.landed:
            self._ramp_start_s = now_s
            self._take_off()
        if self._ramp_start_s is not None:
            share = (now_s - self._ramp_start_s) / max(get("MPC_TKO_RAMP_T"), 0.02)
            climb_limit = -_RAMP_START_M_S + share * (_RAMP_START_M_S + get("MPC_TKO_SPEED"))
            down = max(down, -climb_limit)
            if share >= 1.0:
                self._ramp_start_s = None
        return ControlOutput(True, (north, east, down), command.yaw_rate_rad_s)

    def _on_thrust(self, command: MotionCommand) -> ControlOutput:
        """A thrust of the client's own: no ramp, only the time the motors need to spool up."""
        pilot = self._pilot
        if pilot.landed and pilot.now_s - self._armed_at_s < self._get("COM_SPOOLUP_TIME"):
            return ControlOutput(True)
        if pilot.landed and not pilot.state.on_ground:
            self._take_off()
        return ControlOutput(True, yaw_rate_rad_s=command.yaw_rate_rad_s, thrust=command.thrust)

    def _take_off(self) -> None:
        self._pilot.landed, self.flown = False, True
        self._pilot.say(INFO, "Takeoff detected")

    def watch(self) -> None:
        """Landed after a while on the ground without wanting up; then the disarm timers run."""
        if self._pilot.landed:
            self._disarm_in_time()
        else:
            self._detect_landing()

    def _disarm_in_time(self) -> None:
        delay_s = self._get("COM_DISARM_LAND") if self.flown else self._get("COM_DISARM_PRFLT")
        ready_s = self._landed_at_s if self.flown else self._armed_at_s + self._get("COM_SPOOLUP_TIME")
        if delay_s > 0.0 and self._pilot.now_s - ready_s >= delay_s:
            self._pilot.stop_motors("landing" if self.flown else "auto preflight disarming")

    def _detect_landing(self) -> None:
        pilot, now_s = self._pilot, self._pilot.now_s
        resting = pilot.state.on_ground and pilot.output.velocity[2] > -_CLIMB_WANTED_M_S and self._ramp_start_s is None
        if not resting:
            self._ground_since_s = None
        elif self._ground_since_s is None:
            self._ground_since_s = now_s
        elif now_s - self._ground_since_s >= _LANDING_DETECT_S:
            pilot.landed, self._landed_at_s, self._ground_since_s = True, now_s, None
            pilot.say(INFO, "Landing detected")
