"""What each MAV_CMD does and which acknowledgements it gets (px4_reference/commands.json)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot import FORCE_MAGIC, Autopilot
from sim_gateway.faults import Fault, FaultSchedule
from sim_gateway.flight_modes import AUTO_MAIN_MODE, FlightMode, Result
from sim_gateway.local_frame import LocalFrame, Vector
from sim_gateway.telemetry import Message, Telemetry

_COMMAND_LONG_VERSION_REQUEST = 520  # MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, deprecated but answered
_CUSTOM_MODE_FLAG = 1
# MAV_CMD_INJECT_FAILURE: unit to faults. PX4's simplest simulator takes the motor and shows no effect.
_FAILURES: dict[int, tuple[tuple[str, dict[str, float]], ...]] = {
    mav.FAILURE_UNIT_SENSOR_GPS: (("gps_loss", {}),),
    mav.FAILURE_UNIT_SYSTEM_BATTERY: (("battery", {"fraction": 0.0, "slowly": 1.0}),),
    mav.FAILURE_UNIT_SYSTEM_MOTOR: (),
}


@dataclass(frozen=True, slots=True)
class Command:
    """A command with seven parameters. `latitude_deg` and `longitude_deg` are parameters 5 and 6 (COMMAND_INT: scaled)."""

    number: int
    params: tuple[float, float, float, float]
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    from_pilot: bool = False

    @property
    def p1(self) -> float:
        """Parameter 1."""
        return self.params[0]

    @property
    def p2(self) -> float:
        """Parameter 2."""
        return self.params[1]


class Link(Protocol):
    """The link a command came over."""

    def send(self, message: Message) -> None:
        """Send one message to everyone on the link."""

    def set_interval(self, name: str, interval_us: float) -> None:
        """Stream a message at this interval: 0 default, negative off."""

    def interval_us(self, name: str) -> int:
        """The interval in force; -1 off."""
        ...


def whole(value: float) -> int:
    """A parameter that should be a whole number; -1 if it is none."""
    return int(value) if math.isfinite(value) and value == int(value) else -1


class CommandHandler:
    """Runs commands. Each returns its acknowledgements in order; DO_SET_MODE gives two, as PX4 does."""

    def __init__(self, autopilot: Autopilot, telemetry: Telemetry, frame: LocalFrame) -> None:
        self._autopilot = autopilot
        self._telemetry = telemetry
        self._frame = frame
        self.schedule: FaultSchedule | None = None
        self._handlers: dict[int, Callable[[Command, Link], Result | None]] = {
            mav.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mav.MAV_CMD_NAV_TAKEOFF: lambda command, _: autopilot.takeoff(command.altitude_m),
            mav.MAV_CMD_NAV_LAND: lambda _, __: autopilot.land(),
            mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _, __: autopilot.return_to_launch(),
            mav.MAV_CMD_DO_SET_MODE: self._set_mode,
            mav.MAV_CMD_MISSION_START: lambda command, _: autopilot.set_mode(FlightMode.MISSION, command.from_pilot),
            mav.MAV_CMD_DO_SET_MISSION_CURRENT: self._set_mission_current,
            mav.MAV_CMD_DO_REPOSITION: self._reposition,
            mav.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
            mav.MAV_CMD_DO_SET_HOME: self._set_home,
            mav.MAV_CMD_DO_FLIGHTTERMINATION: self._terminate,
            mav.MAV_CMD_INJECT_FAILURE: self._inject_failure,
            mav.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            mav.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            _COMMAND_LONG_VERSION_REQUEST: self._request_version,
        }

    def run(self, command: Command, link: Link, acknowledge: Callable[[Result], None]) -> None:
        """Do it and acknowledge; what a request asks for follows its acknowledgement."""
        handler = self._handlers.get(command.number)
        if handler is None:
            acknowledge(Result.UNSUPPORTED)
            return
        if command.number == mav.MAV_CMD_DO_SET_MODE:
            acknowledge(Result.ACCEPTED)
        result = handler(command, link)
        if result is not None:
            acknowledge(result)

    def _arm_disarm(self, command: Command, _: Link) -> Result:
        force = whole(command.p2) == FORCE_MAGIC
        if command.p1 == 1.0:
            return self._autopilot.arm(force)
        return self._autopilot.disarm(force) if command.p1 == 0.0 else Result.UNSUPPORTED

    def _set_mode(self, command: Command, _: Link) -> Result:
        if not whole(command.p1) & _CUSTOM_MODE_FLAG:
            return Result.TEMPORARILY_REJECTED
        main, sub = whole(command.p2), whole(command.params[2])
        return self._autopilot.set_mode_numbers(main, sub if main == AUTO_MAIN_MODE else 0, command.from_pilot)

    def _reposition(self, command: Command, _: Link) -> Result:
        target: Vector = (math.nan, math.nan, math.nan)
        here = self._frame.to_global(self._autopilot.state.position)
        given = (command.latitude_deg, command.longitude_deg, command.altitude_m)
        if any(math.isfinite(value) for value in given):
            latitude, longitude, altitude = (v if math.isfinite(v) else here[i] for i, v in enumerate(given))
            target = self._frame.from_global(latitude, longitude, altitude)
        yaw = command.params[3]
        return self._autopilot.reposition(target, yaw if math.isfinite(yaw) else None)

    def _change_speed(self, command: Command, _: Link) -> Result:
        """Type 0 and 1 (air and ground speed) set the cruise speed; -1 means no change."""
        if math.isfinite(command.p2) and command.p2 > 0.0 and whole(command.p1) in (0, 1):
            self._autopilot.parameters.set("MPC_XY_CRUISE", command.p2)
        return Result.ACCEPTED

    def _set_home(self, command: Command, _: Link) -> Result:
        if command.p1 == 1.0:
            self._autopilot.home = self._autopilot.state.position
            return Result.ACCEPTED
        given = (command.latitude_deg, command.longitude_deg, command.altitude_m)
        if not all(math.isfinite(value) for value in given):
            return Result.DENIED
        self._autopilot.home = self._frame.from_global(*given)
        return Result.ACCEPTED

    def _terminate(self, command: Command, _: Link) -> Result:
        return self._autopilot.disarm(force=True) if command.p1 > 0.5 else Result.DENIED

    def _set_mission_current(self, command: Command, _: Link) -> Result:
        return Result.ACCEPTED if self._autopilot.mission.set_current(whole(command.p1)) else Result.DENIED

    def _inject_failure(self, command: Command, _: Link) -> Result | None:
        """Units that this vehicle can lose; for all others there is no acknowledgement, as recorded (failures.json)."""
        if self.schedule is None or int(self._autopilot.parameters.get("SYS_FAILURE_EN")) != 1:
            return Result.DENIED
        unit, kind = whole(command.p1), whole(command.p2)
        if unit not in _FAILURES or kind not in (mav.FAILURE_TYPE_OK, mav.FAILURE_TYPE_OFF):
            return None
        for name, parameters in _FAILURES[unit]:
            now_s = self._telemetry.now_s()
            if kind == mav.FAILURE_TYPE_OFF:
                self.schedule.add(Fault(kind=name, start_s=now_s, parameters=parameters))
            else:
                self.schedule.end(name, now_s)
                self._autopilot.battery.recover()
        return Result.ACCEPTED

    def _set_interval(self, command: Command, link: Link) -> Result:
        name = self._telemetry.name_of(whole(command.p1))
        if name in (None, "HEARTBEAT") or not math.isfinite(command.p2):
            return Result.FAILED
        assert name is not None
        link.set_interval(name, command.p2)
        return Result.ACCEPTED

    def _get_interval(self, command: Command, link: Link) -> Result:
        number = whole(command.p1)
        name = self._telemetry.name_of(number)
        link.send(mav.MAVLink_message_interval_message(number & 0xFFFF, 0 if name is None else link.interval_us(name)))
        return Result.ACCEPTED

    def _request_message(self, command: Command, link: Link) -> Result:
        name = self._telemetry.name_of(whole(command.p1))
        if name is None:
            return Result.DENIED
        link.send(self._telemetry.build(name))
        return Result.ACCEPTED

    def _request_version(self, _: Command, link: Link) -> Result:
        link.send(self._telemetry.build("AUTOPILOT_VERSION"))
        return Result.ACCEPTED
