"""Faults that are deeds: of the pilot, of another program, of the autopilot itself. And the events that faults wait for."""

from __future__ import annotations

from collections.abc import Callable

from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot import Autopilot
from sim_gateway.faults import INCIDENT, Active, FaultSchedule
from sim_gateway.flight_modes import FlightMode
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.sticks import Sticks
from sim_gateway.telemetry import COMPONENT_ID, Telemetry

STICK_INTERVAL_S = 0.05
ROGUE = (200, 191)  # system and component id of the other program
_VELOCITY_AND_YAW_RATE = 0x5C7
_CUSTOM_MODE = 1


class Incidents:
    """Let faults happen to one vehicle. Call `step` after every physics step."""

    def __init__(self, vehicle: PilotedVehicle, server: MavlinkServer, telemetry: Telemetry) -> None:
        self._vehicle, self._server, self._telemetry = vehicle, server, telemetry
        self._schedule: FaultSchedule = vehicle.simulation.faults
        self._done: set[int] = set()
        self._next_s: dict[int, float] = {}
        self._rogue = mav.MAVLink(None, srcSystem=ROGUE[0], srcComponent=ROGUE[1])
        self._handlers: dict[str, Callable[[Active, float], None]] = {
            "pilot_mode": self._once(self._pilot_mode),
            "pilot_sticks": self._pilot_sticks,
            "disarm": self._once(lambda _: self._pilot.disarm(force=True)),
            "px4_failsafe": self._once(lambda item: self._pilot.failsafes.fail_into(_mode(item))),
            "reboot": self._once(self._reboot),
            "battery": self._once(self._drain),
            "rogue": self._rogue_setpoint,
            "rogue_mode": self._once(self._rogue_mode),
        }

    @property
    def _pilot(self) -> Autopilot:
        return self._vehicle.autopilot

    def step(self) -> None:
        """Note events, begin what has become due, go on with what lasts."""
        now_s, pilot = self._vehicle.time_s, self._pilot
        if pilot.armed:
            self._schedule.happened("armed", now_s)
        if pilot.armed and pilot.mode is FlightMode.OFFBOARD:
            self._schedule.happened("offboard", now_s)
        if not self._schedule.placed:
            return
        pilot.refuses_offboard = self._schedule.active("refuse_offboard", now_s) is not None
        pilot.gps_fix = self._schedule.active("gps_loss", now_s) is None
        for item in self._schedule.group(INCIDENT, now_s):
            if item.kind in self._handlers:
                self._handlers[item.kind](item, now_s)

    def _once(self, deed: Callable[[Active], object]) -> Callable[[Active, float], None]:
        def do(item: Active, _now_s: float) -> None:
            if item.number not in self._done:
                self._done.add(item.number)
                deed(item)

        return do

    def _is_due(self, item: Active, now_s: float, interval_s: float) -> bool:
        due_s = self._next_s.get(item.number, item.begin_s)
        if now_s < due_s - 1e-9:
            return False
        self._next_s[item.number] = due_s + interval_s
        return True

    def _pilot_mode(self, item: Active) -> None:
        mode = _mode(item)
        if mode.needs_pilot:
            self._pilot.set_sticks(Sticks(self._vehicle.time_s))
        self._pilot.set_mode(mode, from_pilot=True)

    def _pilot_sticks(self, item: Active, now_s: float) -> None:
        """A joystick at 20 Hz: centred for half a second, then pushed."""
        if self._is_due(item, now_s, STICK_INTERVAL_S):
            pushed = now_s - item.begin_s >= 0.5
            ahead, right = (item["ahead"], item["right"]) if pushed else (0.0, 0.0)
            self._pilot.set_sticks(Sticks(now_s, ahead, right))

    def _reboot(self, _: Active) -> None:
        self._telemetry.booted_s = self._vehicle.time_s
        self._pilot.restart()

    def _drain(self, item: Active) -> None:
        self._pilot.battery.fail(item["fraction"], shown_at_once=item["slowly"] == 0.0)

    def _rogue_setpoint(self, item: Active, now_s: float) -> None:
        if not self._is_due(item, now_s, 1.0 / item["rate_hz"]):
            return
        nothing = (0.0, 0.0, 0.0)
        message = mav.MAVLink_set_position_target_local_ned_message(
            *(round(1e3 * now_s), self._telemetry.system_id, COMPONENT_ID, mav.MAV_FRAME_LOCAL_NED, _VELOCITY_AND_YAW_RATE),
            *(*nothing, item["x_m_s"], item["y_m_s"], 0.0, *nothing, 0.0, 0.0),
        )
        message.pack(self._rogue)
        self._server.take(message)

    def _rogue_mode(self, item: Active) -> None:
        params = (_CUSTOM_MODE, item["main"], item["sub"], 0.0, 0.0, 0.0, 0.0)
        target = (self._telemetry.system_id, COMPONENT_ID)
        message = mav.MAVLink_command_long_message(*target, mav.MAV_CMD_DO_SET_MODE, 0, *params)
        message.pack(self._rogue)
        self._server.take(message)


def _mode(item: Active) -> FlightMode:
    """The flight mode of PX4's main and sub mode numbers; Hold for numbers that are no mode."""
    return FlightMode.from_numbers(round(item["main"]), round(item["sub"])) or FlightMode.LOITER
