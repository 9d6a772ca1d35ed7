"""The connection to one PX4 vehicle over MAVSDK: messages in, messages, requests and parameters out, each with a deadline.

The wire belongs to a process of its own, the guard (`flight.guard`): MAVSDK talks through it. What commands the vehicle stands in
`flight.link`. Everything MAVSDK calls back arrives on its own thread and only replaces the newest sample (`flight.telemetry`).
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

from flight.errors import NoVehicleError, RefusedError, VehicleCommandError
from flight.guard.client import GuardLostError, SetpointGuard
from flight.mavsdk_support import Answer, check_port_is_free, route_mavsdk_log
from flight.px4 import (
    AUTOPILOT_COMPONENT,
    AUTOPILOT_PX4,
    COMMAND_REQUEST_MESSAGE,
    COMMAND_SET_MESSAGE_INTERVAL,
    MESSAGE_ID,
    RESULT_ACCEPTED,
)
from flight.telemetry import MESSAGES, Telemetry
from safety.frames import CorridorFrame
from safety.messages import VehicleState

log = logging.getLogger("flight.connection")

COMMAND_DEADLINE_S = 3.0
POLL_S = 0.01
REPORT_RATE_HZ = 10.0
"""Of what the autopilot says about itself: often enough for the safety layer's bounds."""
OWN_SYSTEM_ID = 245
OWN_COMPONENT_ID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER


class VehicleConnection:
    """One PX4 vehicle. `connect`, then read `state`, `mode`, `armed`, or ask for more.

    `url` is MAVSDK's (`udpin://127.0.0.1:14540`, `udpout://...`, `tcpout://...`, `serial:///dev/ttyAMA0:921600`).
    Every command has a deadline and raises `VehicleCommandError` with the vehicle's own words. `keep_alive`, where a
    method takes it, is called at least every 20 ms while waiting, so that a setpoint stream can go on meanwhile.
    """

    def __init__(
        self,
        url: str,
        clock: Callable[[], float] = time.monotonic,
        *,
        guard_priority: int = 0,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """`guard_priority`: SCHED_FIFO priority of the guard where it is permitted, 0 for usual scheduling."""
        self.url = url
        self.guard = SetpointGuard(url, guard_priority)
        self.telemetry = Telemetry()
        self.system: Any = None
        self.system_id = 0
        self._clock, self._sleep = clock, sleep
        self._mavsdk: Any = None
        self._direct: Any = None
        self._action: Any = None
        self._param: Any = None
        self._target = (0, 0)
        self._message: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    # -- connection ---------------------------------------------------------------------------------------------

    def connect(self, timeout_s: float = 10.0, keep_waiting: Callable[[], None] | None = None) -> None:
        """Wait for a PX4 autopilot's heartbeat. Raises `NoVehicleError` after `timeout_s`, `RefusedError` on a busy port."""
        from mavsdk import Configuration, ConnectionResult, Mavsdk  # noqa: PLC0415  (loads a 30 MB library)

        check_port_is_free(self.url)
        route_mavsdk_log()
        deadline = self._clock() + timeout_s
        self.guard.start(timeout_s, keep_waiting)
        configuration = Configuration.create_manual(OWN_SYSTEM_ID, OWN_COMPONENT_ID, True)
        self._mavsdk = Mavsdk(configuration)
        result = self._mavsdk.add_any_connection(self.guard.relay_url)
        if result != ConnectionResult.SUCCESS:
            raise RefusedError(f"MAVSDK cannot connect to the guard of {self.url}: {result.name}")
        system = self._wait_for_autopilot(deadline, keep_waiting)
        if system is None:
            raise NoVehicleError(
                f"no vehicle answering on {self.url} within {timeout_s:g} s: check that it is powered, that its MAVLink "
                "output goes to this port, and `vehicle.connection` in the mission"
            )
        self._open_plugins(system)
        self._wait_for_heartbeat(deadline + 2.0, keep_waiting)

    def _wait_for_autopilot(self, deadline: float, keep_waiting: Callable[[], None] | None) -> Any:
        while self._clock() < deadline:
            if keep_waiting is not None:
                keep_waiting()
            system = self._mavsdk.first_autopilot(0.1)
            if system is not None:
                return system
        return None

    def _open_plugins(self, system: Any) -> None:
        from mavsdk.plugins.action import Action  # noqa: PLC0415
        from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage  # noqa: PLC0415
        from mavsdk.plugins.param import Param  # noqa: PLC0415

        self.system = system
        self.system_id = int(system.get_system_id())
        self._target = (self.system_id, AUTOPILOT_COMPONENT)
        self._message = MavlinkMessage
        self._direct, self._action, self._param = MavlinkDirect(system), Action(system), Param(system)
        for name in MESSAGES:
            self._direct.subscribe_message(name, self._on_message)

    def _wait_for_heartbeat(self, deadline: float, keep_waiting: Callable[[], None] | None) -> None:
        if not self.wait_until(lambda: self.telemetry.autopilot is not None, deadline - self._clock(), keep_waiting):
            raise NoVehicleError(f"no heartbeat from an autopilot on {self.url}: check that system {self.system_id} runs PX4")
        if self.telemetry.autopilot != AUTOPILOT_PX4:
            raise RefusedError(
                f"the autopilot on {self.url} is not PX4 (MAV_AUTOPILOT {self.telemetry.autopilot}); use PX4 v1.14 or later"
            )

    def close(self) -> None:
        """Drop the connection. Idempotent. The vehicle then sees no setpoint and no heartbeat from us."""
        mavsdk, self._mavsdk, self.system = self._mavsdk, None, None
        self._direct = self._action = self._param = None
        if mavsdk is not None:
            mavsdk.destroy()
        self.guard.close()

    # -- telemetry ----------------------------------------------------------------------------------------------

    def _on_message(self, message: Any, _user_data: Any) -> None:
        if message.system_id == self.system_id:
            self.telemetry.feed(message.message_name, message.component_id, message.fields_json, self._clock())

    def listen(self, name: str, handler: Callable[[dict[str, Any]], None]) -> None:
        """Call `handler` with the fields of every message `name` of this vehicle's autopilot, on MAVSDK's thread."""

        def on_message(message: Any, _user_data: Any) -> None:
            if message.system_id == self.system_id and message.component_id == AUTOPILOT_COMPONENT:
                try:
                    handler(json.loads(message.fields_json))
                except (ValueError, KeyError, TypeError) as error:
                    log.debug("%s cannot be used: %s", name, error)

        self._direct.subscribe_message(name, on_message)

    def request_message(self, message_id: int) -> None:
        """Ask for one message, once. Raises `VehicleCommandError` when PX4 does not have it."""
        self.command_long(COMMAND_REQUEST_MESSAGE, float(message_id), what=f"message {message_id}")

    @property
    def target(self) -> tuple[int, int]:
        """System and component id of the autopilot."""
        return self._target

    @property
    def mode(self) -> int | None:
        """The newest mode PX4 reported (`FlightMode` numbering), None before the first."""
        return self.telemetry.mode

    @property
    def armed(self) -> bool:
        """Armed, by the newest heartbeat (1 Hz)."""
        return bool(self.telemetry.armed)

    def state(self, frame: CorridorFrame) -> VehicleState | None:
        """The newest estimate in the corridor frame; None before the first complete one."""
        return self.telemetry.state(frame)

    def subscribe(self, name: str, handler: Callable[[str, float, int], None]) -> None:
        """Hand every message `name` of this vehicle to `handler`: fields (JSON), arrival (monotonic s), component id.

        After `connect`. Called on MAVSDK's thread; it must neither block nor raise.
        """

        def forward(message: Any, _user_data: Any) -> None:
            if message.system_id == self.system_id:
                handler(message.fields_json, self._clock(), int(message.component_id))

        self._direct.subscribe_message(name, forward)

    def request_message_rate(self, name: str, rate_hz: float) -> None:
        """Ask for one message at `rate_hz`. Raises `VehicleCommandError` when PX4 refuses."""
        self.command_long(COMMAND_SET_MESSAGE_INTERVAL, MESSAGE_ID[name], 1e6 / rate_hz, what=f"the rate of {name}")

    def request_stream_rates(self, rate_hz: float = 50.0) -> None:
        """Ask for the messages the loop lives on at `rate_hz`. Raises `VehicleCommandError` when PX4 refuses."""
        for name in ("LOCAL_POSITION_NED", "ATTITUDE", "HIGHRES_IMU"):
            self.request_message_rate(name, rate_hz)
        for name in ("ODOMETRY", "ESTIMATOR_STATUS"):
            self.request_message_rate(name, REPORT_RATE_HZ)
        self.request_message_rate("POSITION_TARGET_LOCAL_NED", rate_hz)  # often enough to catch a setpoint between two of ours

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, keep_alive: Callable[[], None] | None = None) -> bool:
        """Poll `condition` every 10 ms until it holds (True) or `timeout_s` passed (False). Raises `GuardLostError`."""
        deadline = self._clock() + timeout_s
        while not condition():
            if self._clock() >= deadline:
                return False
            if self.guard.lost is not None:
                raise GuardLostError(self.guard.lost)
            if keep_alive is not None:
                keep_alive()
            self._sleep(POLL_S)
        return True

    # -- messages and commands out --------------------------------------------------------------------------------------

    def ask_time(self) -> None:
        """Ask the vehicle for its clock (TIMESYNC); the answer keeps `telemetry.clock` honest when the clock stood still."""
        self.send_message("TIMESYNC", f'{{"tc1":0,"ts1":{int(self._clock() * 1e9)}}}')

    def send_message(self, name: str, fields_json: str) -> None:
        """Send one message to the autopilot, once. Raises `VehicleCommandError` when the link cannot send."""
        from mavsdk import MavsdkError  # noqa: PLC0415

        try:
            self._direct.send_message(self._message(name, 0, 0, *self._target, fields_json))
        except (MavsdkError, RuntimeError) as error:
            raise VehicleCommandError(f"cannot send {name} on {self.url}: {error}") from None

    def command_long(self, command: int, *parameters: float, what: str, keep_alive: Callable[[], None] | None = None) -> None:
        """Send COMMAND_LONG, wait for the final COMMAND_ACK; raises `VehicleCommandError` unless it is accepted."""
        fields: dict[str, float] = {f"param{i + 1}": 0.0 for i in range(7)}
        fields.update({f"param{i + 1}": float(value) for i, value in enumerate(parameters)})
        fields |= {"target_system": self._target[0], "target_component": self._target[1], "command": command, "confirmation": 0}
        answer = Answer()
        message = self._message("COMMAND_LONG", 0, 0, *self._target, json.dumps(fields))
        self._direct.send_command_async(message, answer.on_ack)
        if not self.wait_until(answer.done.is_set, COMMAND_DEADLINE_S, keep_alive):
            raise VehicleCommandError(f"the vehicle did not answer the request for {what} within {COMMAND_DEADLINE_S:g} s")
        if answer.result != RESULT_ACCEPTED:
            raise VehicleCommandError(f"the vehicle refused {what}: {answer.text}{self._last_words()}")

    def _last_words(self) -> str:
        recent = [item.text for item in self.telemetry.texts if item.severity <= 4 and self._clock() - item.time_s < 5.0]
        return f' ("{recent[-1]}")' if recent else ""

    # -- parameters ---------------------------------------------------------------------------------------------

    def get_parameter(self, name: str, kind: type[int] | type[float]) -> int | float:
        """Read a PX4 parameter. Raises `VehicleCommandError` when it does not exist or is of another type."""
        from mavsdk import MavsdkError  # noqa: PLC0415

        try:
            return kind(self._param.get_param_int(name) if kind is int else self._param.get_param_float(name))
        except MavsdkError as error:
            raise VehicleCommandError(f"cannot read parameter {name} of the vehicle: {error}") from None

    def set_parameter(self, name: str, value: int | float) -> None:
        """Write a PX4 parameter and read it back. Raises `VehicleCommandError` when the vehicle holds another value."""
        from mavsdk import MavsdkError  # noqa: PLC0415

        try:
            if isinstance(value, int):
                self._param.set_param_int(name, value)
            else:
                self._param.set_param_float(name, value)
        except MavsdkError as error:
            raise VehicleCommandError(f"cannot set parameter {name} of the vehicle: {error}") from None
        held = self.get_parameter(name, type(value))
        if not math.isclose(held, value, rel_tol=1e-6):
            raise VehicleCommandError(
                f"parameter {name} reads back {held:g} after setting {value:g}; set it by hand in QGroundControl"
            )
