"""The flight computer in lockstep: its clock, and the ends of its two wires. All of `flight` runs on it as it is.

`Computer.sleep` is where time passes. Faults of the computer itself (a stall, starvation, a hang) are time that passes elsewhere.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from pymavlink.dialects.v20 import development as mav

from campaigns.faults.air import DOWNLINK_S, Air
from flight.connection import OWN_COMPONENT_ID, OWN_SYSTEM_ID
from flight.guard.core import STILL, Command, GuardCore, Reason, State, Velocity
from flight.guard.wire import ModeReport
from flight.lidar.config import LidarSource
from flight.lidar.driver import BREAKS, LidarHealth
from flight.lidar.inbox import Inbox
from flight.lidar.scip_session import ScipSession
from flight.lidar.session import Host
from flight.link import VehicleLink
from safety.messages import LidarScan
from sim_gateway.link_faults import RawBytes
from sim_gateway.vehicle import STEP_S

CLOCK_OFFSET_S = 1000.0
GUARD_COMPONENT = 192
RESEND_S, RESENDS = 0.5, 3
LOOK_S = 0.05
_VELOCITY_AND_YAW_RATE = 0x5C7
_MODE_MESSAGES = ("HEARTBEAT", "CURRENT_MODE")


class CurtainFallError(BaseException):
    """The scene is over: unwinds the flight code from inside its own sleep."""


class Computer:
    """Time and wires. `stall(now_s)` may return seconds by which the next wake-up is late; `frozen` threads hear nothing."""

    def __init__(self, air: Air, end_s: float) -> None:
        self.air = air
        self.end_s = end_s
        self.now_s = CLOCK_OFFSET_S + air.time_s
        self.oversleep: Callable[[float], float] = lambda _now_s: 0.0
        self.frozen = False
        self.heard_since_s = math.inf
        self.first_heard_s: dict[str, float] = {}
        self.on_message: Callable[[str, int, str], None] = lambda *_: None
        self.every_step: list[Callable[[], None]] = []

    def clock(self) -> float:
        """Monotonic seconds."""
        return self.now_s

    def sleep(self, seconds: float) -> None:
        """Let time pass; more of it when this computer is late. Raises `CurtainFallError` at the end of the scene."""
        self.pass_time(max(seconds, 0.0))
        late_s = self.oversleep(self.air.time_s)
        if late_s > 0.0:
            self.frozen = True
            self.pass_time(late_s)
            self.frozen = False
            self._hear()

    def pass_time(self, seconds: float) -> None:
        """Time passes for everyone."""
        until_s = self.now_s + seconds
        while CLOCK_OFFSET_S + self.air.time_s + STEP_S <= until_s + 1e-9:
            self.air.step()
            self.now_s = max(self.now_s, CLOCK_OFFSET_S + self.air.time_s)
            for call in self.every_step:
                call()
            self._hear()
            if self.air.time_s >= self.end_s:
                raise CurtainFallError
        self.now_s = until_s

    def _hear(self) -> None:
        """Hand over what has arrived, as MAVSDK's thread would."""
        downlink = self.air.downlink
        while not self.frozen and downlink and downlink[0][0] <= self.air.time_s:
            message = downlink.popleft()[1]
            if isinstance(message, RawBytes):
                self.on_message("LOCAL_POSITION_NED", 1, message.data.decode("latin-1"))
            else:
                self._note(message.get_type())
                self.on_message(message.get_type(), message.get_srcComponent() or 1, fields_json(message))

    def _note(self, name: str) -> None:
        """When each kind of message, sent since the fault's begin, came first."""
        if self.air.time_s - DOWNLINK_S >= self.heard_since_s:
            self.first_heard_s.setdefault(name, self.air.time_s)


def fields_json(message: Any) -> str:
    """The fields as MAVSDK hands them over: JSON, in which what is not finite is null. Arrays are left out: nobody reads them."""
    fields = {name: value for name in message.fieldnames if not isinstance(value := getattr(message, name), list)}
    text = fields.get("text")
    if isinstance(text, bytes):
        fields["text"] = text.decode("ascii", "replace")
    return json.dumps(fields).replace("NaN", "null").replace("-Infinity", "null").replace("Infinity", "null")


class LockstepGuard:
    """`flight.guard`'s state machine on the simulated clock: what the guard's process does with it, without the process."""

    def __init__(self, computer: Computer) -> None:
        self.core = GuardCore()
        self.lost: str | None = None
        self.dead = False
        self.sent: list[tuple[float, Velocity]] = []
        self._computer = computer
        self._engagement = self._sequence = 0
        self._packer = mav.MAVLink(None, srcSystem=OWN_SYSTEM_ID, srcComponent=GUARD_COMPONENT)
        self._target = (1, 1)
        computer.every_step.append(self._step)

    @property
    def state(self) -> State:
        """What it is doing."""
        return self.core.state

    @property
    def reason(self) -> Reason:
        """Why it brakes or is silent."""
        return self.core.reason

    def look(self) -> None:
        """Nothing to read: it is in this process."""

    def engage(self, target: tuple[int, int]) -> None:
        """Begin a new engagement."""
        self._engagement += 1
        self._sequence, self._target = 0, target
        self.core.engage(self._engagement)

    def command(self, setpoint: Velocity, stamp_s: float) -> float | None:
        """As `SetpointGuard.command`."""
        self._sequence += 1
        command = Command(self._engagement, self._sequence, stamp_s, setpoint)
        if self.dead or not self.core.admit(command, self._computer.now_s):
            return None
        self._send(setpoint)
        return self._computer.now_s

    def disengage(self) -> None:
        """Silence."""
        if self._engagement:
            self.core.disengage()

    def heard(self, name: str, fields: dict[str, Any]) -> None:
        """A mode report on the wire."""
        armed = bool(fields["base_mode"] & 0x80) if name == "HEARTBEAT" else None
        self.core.heard(ModeReport(1, fields["custom_mode"] >> 16 & 0xFF, armed))

    def _step(self) -> None:
        if not self.dead and self.core.brake_due(self._computer.now_s):
            self._send(STILL)

    def _send(self, setpoint: Velocity) -> None:
        north, east, down, yaw_rate = setpoint
        nothing = (0.0, 0.0, 0.0)
        message = mav.MAVLink_set_position_target_local_ned_message(
            *(int(self._computer.now_s * 1e3) & 0xFFFFFFFF, *self._target, mav.MAV_FRAME_LOCAL_NED, _VELOCITY_AND_YAW_RATE),
            *(*nothing, north, east, down, *nothing, 0.0, yaw_rate),
        )
        message.pack(self._packer)
        self.sent.append((self._computer.air.time_s, setpoint))
        self._computer.air.send_up(message)


@dataclass(frozen=True, slots=True)
class _Named:
    """Stands for MAVSDK's enumerations and messages: what `flight.link` reads of them."""

    name: str
    fields_json: str = ""


class LockstepDirect:
    """MAVSDK's direct-message plugin on the simulated wire: sends, and repeats commands until they are acknowledged."""

    def __init__(self, computer: Computer) -> None:
        self._computer = computer
        self._packer = mav.MAVLink(None, srcSystem=OWN_SYSTEM_ID, srcComponent=OWN_COMPONENT_ID)
        self._waiting: list[tuple[int, Any, Callable[..., None], float, int]] = []
        self.commands: list[tuple[float, int, float, float]] = []
        computer.every_step.append(self._repeat)

    def send_message(self, message: tuple[str, str]) -> None:
        """Once, not acknowledged."""
        name, fields = message
        self._pack(name, json.loads(fields))

    def send_command_async(self, message: tuple[str, str], on_ack: Callable[..., None]) -> None:
        """A command; `on_ack` is called with its final acknowledgement."""
        fields = json.loads(message[1])
        numbers = (float(fields["param2"]), float(fields["param3"]))
        self.commands.append((self._computer.air.time_s, int(fields["command"]), *numbers))
        self._pack(message[0], fields)
        self._waiting.append((int(fields["command"]), fields, on_ack, self._computer.now_s + RESEND_S, RESENDS))

    def on_ack(self, fields: dict[str, Any]) -> None:
        """A COMMAND_ACK came."""
        for item in [item for item in self._waiting if item[0] == fields["command"]]:
            self._waiting.remove(item)
            item[2](_Named("SUCCESS"), _Named("", json.dumps(fields)), None)

    def _repeat(self) -> None:
        now_s = self._computer.now_s
        for item in [item for item in self._waiting if item[3] <= now_s]:
            self._waiting.remove(item)
            command, fields, on_ack, _, left = item
            if left == 0:
                on_ack(_Named("TIMEOUT"), _Named(""), None)
            else:
                self._pack("COMMAND_LONG", fields)
                self._waiting.append((command, fields, on_ack, now_s + RESEND_S, left - 1))

    def _pack(self, name: str, fields: dict[str, Any]) -> None:
        message = getattr(mav, f"MAVLink_{name.lower()}_message")(**fields)
        message.pack(self._packer)
        self._computer.air.send_up(message)


class LockstepLink(VehicleLink):
    """`VehicleLink` with MAVSDK and the guard's process replaced by simulated wires; all its logic is its own."""

    def __init__(self, computer: Computer) -> None:
        super().__init__("lockstep", computer.clock, sleep=computer.sleep)
        self.lockstep_guard = LockstepGuard(computer)
        self.guard = self.lockstep_guard  # type: ignore[assignment]
        self.direct = LockstepDirect(computer)
        self._direct = self.direct
        self.system_id, self._target = 1, (1, 1)
        self._message = lambda name, _s, _c, _ts, _tc, fields: (name, fields)
        computer.on_message = self._take

    def _take(self, name: str, component: int, text: str) -> None:
        if name == "COMMAND_ACK":
            self.direct.on_ack(json.loads(text))
            return
        if name in _MODE_MESSAGES:
            self.lockstep_guard.heard(name, json.loads(text))
        self.telemetry.feed(name, component, text, self._clock())

    def close(self) -> None:
        """Nothing to drop."""


class _Wire:
    """The byte stream to the SCIP device."""

    def __init__(self, computer: Computer) -> None:
        self._computer = computer
        self._replies = bytearray()

    def read(self, _timeout_s: float) -> bytes:
        data, arrived = bytes(self._replies), self._computer.air.lidar_bytes
        self._replies.clear()
        while arrived and arrived[0][0] <= self._computer.air.time_s:
            data += arrived.popleft()[1]
        return data

    def write(self, data: bytes, _timeout_s: float) -> None:
        for line in data.splitlines():
            self._replies += self._computer.air.device.handle(line)

    def close(self) -> None:
        self._computer.air.device.disconnect()


class LockstepLidar:
    """What `LidarDriver` gives, without its thread: the real session on simulated bytes, reconnecting as the driver does."""

    def __init__(self, computer: Computer, config: LidarSource) -> None:
        self.inbox = Inbox()
        self.scans = 0
        self.first_scan_s: dict[str, float] = {}
        self._computer, self._config = computer, config
        self._scan: LidarScan | None = None
        self._session: ScipSession | None = None
        self._retry_s = -math.inf
        self._pause_s = config.reconnect_min_s
        self._stop = threading.Event()
        self._look_s = -math.inf
        computer.every_step.append(self._listen)

    def latest(self) -> LidarScan | None:
        """The newest scan."""
        return self._scan

    def wait_for_scan(self, timeout_s: float) -> LidarScan | None:
        """The next scan to arrive."""
        before, deadline = self.scans, self._computer.now_s + timeout_s
        while self._computer.now_s < deadline:
            if self.scans != before:
                return self._scan
            self._computer.sleep(STEP_S)
        return None

    def health(self) -> LidarHealth:
        """What preflight reads."""
        age_s = self._computer.now_s - self._scan.time_s if self._scan is not None else math.nan
        return LidarHealth(self._session is not None, 20.0, age_s, self.scans, 0, 0, 0, 0.0, 0.0, "", "")

    def _listen(self) -> None:
        """As the driver's thread: at once when bytes arrive, and now and then to see that none do."""
        computer, arrived = self._computer, self._computer.air.lidar_bytes
        due = bool(arrived) and arrived[0][0] <= computer.air.time_s
        if not computer.frozen and (due or computer.now_s >= self._look_s):
            self._look_s = computer.now_s + LOOK_S
            self._read()

    def _read(self) -> None:
        if self._computer.now_s < self._retry_s:
            return
        try:
            session = self._session or self._open()
            while (scan := session.poll()) is not None:
                self._scan, self.scans = replace(scan, sequence=self.scans), self.scans + 1
                self._pause_s = self._config.reconnect_min_s
        except BREAKS:
            if self._session is not None:
                self._session.close()
            self._session = None
            self._retry_s = self._computer.now_s + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, self._config.reconnect_max_s)

    def _open(self) -> ScipSession:
        wire, now_s = _Wire(self._computer), self._computer.clock
        wire.close()
        self._computer.air.lidar_bytes.clear()
        session = ScipSession(wire, Host(self._config, now_s, self._stop, lambda *_: None, self.inbox, lambda: None))
        session.open()
        session.begin()
        self._session = session
        return session
