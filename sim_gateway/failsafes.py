"""What takes the vehicle over although nobody asked: loss of setpoints, of the pilot, of GPS, of charge, and the geofence.

Texts, order and delays as recorded (px4_reference: offboard_loss, override, failures, geofence). Called by `Autopilot.step`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sim_gateway.battery import Charge
from sim_gateway.flight_modes import CRITICAL, EMERGENCY, WARNING, FlightMode
from sim_gateway.geofence_monitor import GeofenceMonitor
from sim_gateway.local_frame import Vector

if TYPE_CHECKING:
    from sim_gateway.autopilot import Autopilot

ACTIVATED = "Failsafe activated"
_OBL_ACTIONS = {4: FlightMode.LAND, 5: FlightMode.LOITER}  # COM_OBL_RC_ACT; all others fall back to RTL without a pilot
_OBL_STOP_MOTORS = (6, 7)
_EXCEPT_HOLD, _EXCEPT_OFFBOARD = 2, 4  # bits of COM_RCL_EXCEPT
_GPS_GIVEN_UP_S = 5.1  # recorded 5.1 and 5.2 s
_DEAD_RECKONING_S = 2.1  # and for so long the estimator still predicts after that
_LOW_BATTERY_ACTIONS = {2: FlightMode.LAND, 3: FlightMode.RTL}  # COM_LOW_BAT_ACT
_EMERGENCY_TOLD_S = 1.72  # recorded: the text comes that much later than the state
_RCL_ACTIONS = {2: FlightMode.RTL, 3: FlightMode.LAND}  # NAV_RCL_ACT; 1 stays in Hold
_FENCE_OFF, _FENCE_TERMINATE = 0, 4  # GF_ACTION; 1 only warns
_FENCE_ACTIONS = {2: FlightMode.LOITER, 3: FlightMode.RTL, 5: FlightMode.LAND}
_NEVER_GONE = -math.inf


class Failsafes:
    """The failsafes of one vehicle. `latched`: in one that a setpoint stream does not end."""

    def __init__(self, pilot: Autopilot) -> None:
        self._pilot = pilot
        self._get = pilot.parameters.get
        self.geofence = GeofenceMonitor(pilot.parameters)
        self.latched = False
        self._then: tuple[float, FlightMode] | None = None  # when Hold ends, and what follows
        self._fence_action: int | None = None
        self._gps_lost_s: float | None = None
        self._gps_told = False
        self._emergency_text_s = math.inf
        self._battery_worse = False

    # ---- what telemetry asks

    @property
    def gps_fix(self) -> bool:
        """Whether the receiver has a position."""
        return self._pilot.gps_fix and self._get("SIM_GPS_USED") >= 4

    @property
    def position_given_up(self) -> bool:
        """Whether GPS has been away for so long that the position estimate is no longer used."""
        return self._gps_gone_s() >= _GPS_GIVEN_UP_S

    @property
    def prediction_given_up(self) -> bool:
        """Whether not even dead reckoning is left."""
        return self._gps_gone_s() >= _GPS_GIVEN_UP_S + _DEAD_RECKONING_S

    def _gps_gone_s(self) -> float:
        return _NEVER_GONE if self._gps_lost_s is None else self._pilot.now_s - self._gps_lost_s

    # ---- the step

    def clear(self) -> None:
        """Somebody chose a mode: what was going on is over."""
        self.latched, self._then, self._fence_action = False, None, None

    def watch(self, dt_s: float) -> None:
        """What goes on whether armed or not."""
        pilot = self._pilot
        pilot.battery.step(pilot.armed, dt_s, pilot.parameters)
        self._tell_battery()
        if self.gps_fix:
            self._gps_lost_s = None
        elif self._gps_lost_s is None:
            self._gps_lost_s = pilot.now_s
        if self.gps_fix or pilot.armed:
            self._gps_told = False
        elif not self._gps_told and self.position_given_up:
            self._gps_told = True
            pilot.say(WARNING, "Preflight: GPS fix too low")

    def check(self) -> None:
        """Act on what is wrong, while armed."""
        self._check_pilot_loss()
        if self.position_given_up and not self.latched:
            self._enter(FlightMode.ALTCTL, ACTIVATED)
        self._check_battery()
        self._check_geofence()
        self._check_offboard_loss()
        if self._then is not None and self._pilot.now_s >= self._then[0]:
            self._follow(self._then[1])

    def fail_into(self, mode: FlightMode, text: str = ACTIVATED) -> None:
        """A failsafe of PX4's own takes the vehicle over; only a mode command ends it."""
        self._then = None
        self._enter(mode, text)

    def _enter(self, mode: FlightMode, text: str, at: Vector | None = None) -> None:
        self.latched = True
        self._pilot.say(CRITICAL, text)
        self._pilot.enter_failsafe(mode, at)

    def _hold_then(self, mode: FlightMode) -> None:
        """Hold for COM_FAIL_ACT_T, so that somebody can still choose something else, then `mode`."""
        seconds = self._get("COM_FAIL_ACT_T")
        self._then = (self._pilot.now_s + seconds, mode) if mode is not FlightMode.LOITER else None
        self._enter(FlightMode.LOITER, f"Failsafe activated: entering Hold for {seconds:.0f} seconds")

    def _follow(self, mode: FlightMode) -> None:
        empty = self._pilot.battery.charge_state is Charge.EMERGENCY
        self._then = None
        self._enter(FlightMode.LAND if empty else mode, ACTIVATED)

    # ---- setpoints and pilot

    def _check_offboard_loss(self) -> None:
        """The failsafe of OFFBOARD: acts when the stream is lost, gives the vehicle back when it resumes."""
        pilot = self._pilot
        if not pilot.armed or pilot.intended is not FlightMode.OFFBOARD or self.latched:
            return
        if pilot.failsafe and pilot.stream_alive:
            pilot.leave_failsafe()
        elif not pilot.failsafe and not pilot.stream_alive:
            pilot.say(CRITICAL, ACTIVATED)
            action = int(self._get("COM_OBL_RC_ACT"))
            fallback = FlightMode.POSCTL if action == 0 and pilot.has_pilot else FlightMode.RTL
            pilot.enter_failsafe(_OBL_ACTIONS.get(action, fallback))
            if action in _OBL_STOP_MOTORS:
                pilot.stop_motors("failsafe")

    def _check_pilot_loss(self) -> None:
        """The failsafe of a pilot who was there and is gone: Hold at once, NAV_RCL_ACT after COM_FAIL_ACT_T."""
        pilot, action = self._pilot, int(self._get("NAV_RCL_ACT"))
        gone = not pilot.has_pilot and math.isfinite(pilot.sticks.time_s)
        if gone and not self.latched and not self._pilot_may_be_absent(action):
            self._hold_then(_RCL_ACTIONS.get(action, FlightMode.LOITER))

    def _pilot_may_be_absent(self, action: int) -> bool:
        pilot = self._pilot
        if pilot.mode.needs_pilot:
            return False
        excepted = int(self._get("COM_RCL_EXCEPT"))
        if pilot.mode is FlightMode.OFFBOARD:
            return action == 0 or bool(excepted & _EXCEPT_OFFBOARD)
        return pilot.mode is not FlightMode.LOITER or action == 0 or pilot.failsafe or bool(excepted & _EXCEPT_HOLD)

    # ---- battery

    def _tell_battery(self) -> None:
        """Texts as the charge falls; an emergency is told late, after what shutting down would have been."""
        pilot, battery = self._pilot, self._pilot.battery
        before, battery.charge_state = battery.charge_state, battery.judge(pilot.parameters)
        if battery.charge_state is Charge.LOW and before is not Charge.LOW:
            pilot.say(CRITICAL, "Low battery")
        if battery.charge_state is Charge.EMERGENCY and before is not Charge.EMERGENCY:
            pilot.say(CRITICAL, "System does not support shutdown")
            self._emergency_text_s = pilot.now_s + _EMERGENCY_TOLD_S
        if pilot.now_s >= self._emergency_text_s:
            self._emergency_text_s = math.inf
            pilot.say(EMERGENCY, "Emergency battery level")
        self._battery_worse = battery.charge_state > before

    def _check_battery(self) -> None:
        """At critical, where COM_LOW_BAT_ACT says so, Hold, then its action; an emergency lands."""
        state, action = self._pilot.battery.charge_state, int(self._get("COM_LOW_BAT_ACT"))
        if not self._battery_worse or state < Charge.CRITICAL or action not in _LOW_BATTERY_ACTIONS:
            return
        if self._then is not None or self._pilot.mode is FlightMode.LAND or self.position_given_up:
            return
        if self._pilot.mode is FlightMode.RTL and state is Charge.EMERGENCY:
            self.fail_into(FlightMode.LAND)
        else:
            self._hold_then(_LOW_BATTERY_ACTIONS[action])

    # ---- geofence

    def _check_geofence(self) -> None:
        """Told at once where GF_ACTION is not 0; acted on one step later, as recorded."""
        pilot = self._pilot
        if self._fence_action is not None:
            action, self._fence_action = self._fence_action, None
            self._act_on_breach(action)
        text = None if pilot.landed else self.geofence.new_breach(pilot.now_s, pilot.state.position, pilot.home)
        action = int(self._get("GF_ACTION"))
        if text is not None and action != _FENCE_OFF:
            pilot.say(CRITICAL, text)
            self._fence_action = action

    def _act_on_breach(self, action: int) -> None:
        mode = _FENCE_ACTIONS.get(action)
        if action == _FENCE_TERMINATE:
            self._pilot.stop_motors("failsafe")
        elif mode is FlightMode.LOITER:  # where it was found outside: it comes back what it overshoots
            self._then = None
            self._enter(mode, ACTIVATED, self._pilot.state.position)
        elif mode is not None and self._pilot.mode is not mode:
            self._hold_then(mode)
