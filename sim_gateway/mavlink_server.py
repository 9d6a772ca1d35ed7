"""MAVLink 2 over UDP on loopback: parses what clients send, streams telemetry, answers commands and parameters.

Two links as in PX4's SITL: onboard (14580 -> 14540) and ground station (18570 -> 14550). Each sends to its default client port
and to every loopback address that has spoken to it lately. Nothing blocks; everything that could grow is bounded.
"""

from __future__ import annotations

import errno
import logging
import math
import socket
import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot import CRITICAL, Autopilot, StatusText
from sim_gateway.commands import Command, CommandHandler
from sim_gateway.fence import FENCE, FenceStore
from sim_gateway.flight_modes import FlightMode, Result
from sim_gateway.local_frame import LocalFrame
from sim_gateway.parameters import HASH_INDEX, HASH_NAME, UINT32, ParameterStore
from sim_gateway.setpoints import NAN, NOTHING, SetpointRefusedError, read_setpoint
from sim_gateway.sticks import from_manual_control
from sim_gateway.telemetry import COMPONENT_ID, GROUND, ONBOARD, STREAM_RATES_HZ, SYSTEM_ID, Message, Telemetry

LOOPBACK = "127.0.0.1"
ONBOARD_PORTS = (14580, 14540)  # own port, client's port
GROUND_PORTS = (18570, 14550)
_MAX_DATAGRAM = 4096
_DATAGRAMS_PER_POLL = 100  # more wait in the socket's own, bounded, buffer
_PEERS_PER_LINK = 8
_PEER_TIMEOUT_S = 10.0
_GCS_TIMEOUT_S = 5.0
_TEXT_CHUNK = 50
_PARAMS_PER_POLL = 5
_MIN_INTERVAL_US = 1000.0
_GLOBAL_FRAMES = (0, 5, 3, 6)  # absolute and relative altitude
_RELATIVE_FRAMES = (3, 6)

_WIRE_LOG = 20_000  # a quarter of an hour of setpoints at 20 Hz
_WIRE_SENDERS = 1_000  # kinds of message and sender that are counted
_COMMANDS_LOGGED = {
    mav.MAV_CMD_DO_SET_MODE: "DO_SET_MODE",
    mav.MAV_CMD_COMPONENT_ARM_DISARM: "ARM_DISARM",
    mav.MAV_CMD_NAV_TAKEOFF: "NAV_TAKEOFF",
    mav.MAV_CMD_NAV_LAND: "NAV_LAND",
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: "NAV_RETURN_TO_LAUNCH",
    mav.MAV_CMD_DO_REPOSITION: "DO_REPOSITION",
}
_SETPOINTS_LOGGED = (
    "SET_POSITION_TARGET_LOCAL_NED",
    "SET_POSITION_TARGET_GLOBAL_INT",
    "SET_ATTITUDE_TARGET",
    "SET_ACTUATOR_CONTROL_TARGET",
    "SET_MODE",
    "PARAM_SET",
)

_log = logging.getLogger("sim_gateway.mavlink")


class PortInUseError(OSError):
    """A port the gateway needs is taken; the message names it."""


@dataclass(frozen=True, slots=True)
class Received:
    """One message that moves, arms or configures the vehicle, as it came off the wire. `what`: message or command name."""

    time_s: float
    what: str
    sender: tuple[int, int]


@dataclass(slots=True)
class _Stream:
    interval_s: float
    due_s: float


def _bind(port: int, purpose: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    try:
        sock.bind((LOOPBACK, port))
    except OSError as error:
        sock.close()
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        raise PortInUseError(f"UDP port {port} ({purpose}) {reason}") from error
    return sock


class MavlinkLink:
    """One UDP link: its peers, its streams, its parser."""

    def __init__(self, name: str, own_port: int, client_port: int, column: int, now_s: Callable[[], float]) -> None:
        self.name = name
        self.socket = _bind(own_port, f"{name} link")
        self._client = (LOOPBACK, client_port)
        self._now_s = now_s
        self._column = column
        self._peers: dict[tuple[str, int], float] = {}
        self._packer = mav.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=COMPONENT_ID)
        self._defaults = {n: 1.0 / rates[column] for n, rates in STREAM_RATES_HZ.items() if rates[column] > 0}
        self.streams = {name: _Stream(interval, 0.0) for name, interval in self._defaults.items()}
        self.parameter_queue: deque[str] = deque()
        self.gcs_heard_s = -math.inf
        self._text_id = 0

    @property
    def has_gcs(self) -> bool:
        """Whether a ground station's heartbeat came lately: only then PX4 sends STATUSTEXT here."""
        return self._now_s() - self.gcs_heard_s < _GCS_TIMEOUT_S

    def close(self) -> None:
        """Free the port."""
        self.socket.close()

    # ---- out

    def send(self, message: Message) -> None:
        """Send to all peers; a full or unreachable socket loses the message, as UDP does."""
        try:
            data = message.pack(self._packer)
        except (struct.error, OverflowError, ValueError) as error:
            _log.error("message %s has a value outside its field: %s", message.get_type(), error)
            return
        for peer in (self._client, *self._peers):
            try:
                self.socket.sendto(data, peer)
            except OSError as error:
                _log.debug("%s to %s lost: %s", message.get_type(), peer, error)

    def send_text(self, text: StatusText) -> None:
        """STATUSTEXT in pieces of 50 characters; like PX4's, a text that fills its last piece is followed by an empty one."""
        data = text.text.encode("ascii", "replace")
        if len(data) < _TEXT_CHUNK:
            self.send(mav.MAVLink_statustext_message(text.severity, data))
            return
        self._text_id = self._text_id % 0xFFFF + 1
        for chunk in range(min(len(data) // _TEXT_CHUNK + 1, 255)):
            piece = data[chunk * _TEXT_CHUNK : (chunk + 1) * _TEXT_CHUNK]
            self.send(mav.MAVLink_statustext_message(text.severity, piece, self._text_id, chunk))

    def set_interval(self, name: str, interval_us: float) -> None:
        """Stream `name` at this interval: 0 its default, negative off. Faster than 1 kHz is not possible."""
        interval_s = self._defaults.get(name, -1.0) if interval_us == 0 else max(interval_us, _MIN_INTERVAL_US) * 1e-6
        if interval_us < 0 or interval_s < 0:
            self.streams.pop(name, None)
        else:
            self.streams[name] = _Stream(interval_s, self._now_s())

    def interval_us(self, name: str) -> int:
        """The interval in force; -1 when the message is not streamed."""
        stream = self.streams.get(name)
        return -1 if stream is None else round(stream.interval_s * 1e6)

    def due(self, available: Callable[[str], bool]) -> list[str]:
        """Names of the messages whose time has come. A stream that fell behind skips what it missed."""
        now_s, names = self._now_s(), []
        for name, stream in self.streams.items():
            if now_s >= stream.due_s - 1e-9 and available(name):
                names.append(name)
                behind = now_s - stream.due_s > stream.interval_s
                stream.due_s = now_s + stream.interval_s if behind else stream.due_s + stream.interval_s
        return names

    # ---- in

    def receive(self) -> list[Message]:
        """The valid messages that have arrived; bad bytes, wrong checksums and foreign hosts are dropped."""
        messages: list[Message] = []
        self._forget_silent_peers()
        for _ in range(_DATAGRAMS_PER_POLL):
            try:
                data, peer = self.socket.recvfrom(_MAX_DATAGRAM)
            except BlockingIOError:
                break
            except OSError as error:
                _log.debug("receiving on the %s link: %s", self.name, error)
                continue
            found = _parse(data)
            if found:
                self._remember(peer)
            messages.extend(found)
        return messages

    def _remember(self, peer: tuple[str, int]) -> None:
        """Answer a client on another port too, for as long as it speaks."""
        known = peer in self._peers or len(self._peers) < _PEERS_PER_LINK
        if peer != self._client and known and peer[0].startswith("127."):
            self._peers[peer] = self._now_s()

    def _forget_silent_peers(self) -> None:
        if self._peers:
            oldest_s = self._now_s() - _PEER_TIMEOUT_S
            self._peers = {peer: heard_s for peer, heard_s in self._peers.items() if heard_s >= oldest_s}


def _parse(data: bytes) -> list[Message]:
    """Messages of one datagram. A fresh parser each time: a truncated frame cannot swallow the next datagram."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    try:
        found = parser.parse_buffer(data) or []
    except (mav.MAVError, struct.error, ValueError, IndexError) as error:
        _log.debug("datagram dropped: %s", error)
        return []
    return [message for message in found if message.get_type() != "BAD_DATA" and not message.get_type().startswith("UNKNOWN")]


class MavlinkServer:
    """The vehicle's MAVLink side. Call `poll` after every physics step: it reads, acts and sends what is due."""

    def __init__(
        self,
        autopilot: Autopilot,
        frame: LocalFrame,
        telemetry: Telemetry,
        onboard_ports: tuple[int, int] = ONBOARD_PORTS,
        ground_ports: tuple[int, int] | None = GROUND_PORTS,
    ) -> None:
        self._autopilot, self._frame, self._telemetry = autopilot, frame, telemetry
        self._now = telemetry.now_s
        self._commands = CommandHandler(autopilot, telemetry, frame)
        self.links = [MavlinkLink("onboard", *onboard_ports, ONBOARD, self._now)]
        try:
            if ground_ports is not None:
                self.links.append(MavlinkLink("ground station", *ground_ports, GROUND, self._now))
        except PortInUseError:
            self.links[0].close()
            raise
        self._shown_mode: tuple[FlightMode, FlightMode] | None = None
        self._shown_landed = -1
        self.fence = FenceStore(self._now)
        self.counts: Counter[tuple[str, int, int]] = Counter()
        self.wire_log: deque[Received] = deque(maxlen=_WIRE_LOG)
        self._handlers: dict[str, Callable[[Message, MavlinkLink], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "COMMAND_LONG": self._on_command_long,
            "COMMAND_INT": self._on_command_int,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_local_setpoint,
            "SET_POSITION_TARGET_GLOBAL_INT": self._on_global_setpoint,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_SET": self._on_param_set,
            "MISSION_REQUEST_LIST": self._on_mission_list,
            "MISSION_COUNT": self._on_mission_count,
            "MISSION_CLEAR_ALL": self._on_mission_clear,
            "MISSION_ITEM_INT": self._on_fence_message(self.fence.on_item),
            "MISSION_REQUEST_INT": self._on_fence_message(self.fence.on_request),
            "MISSION_ACK": self._on_fence_message(self.fence.on_ack),
            "MANUAL_CONTROL": self._on_manual_control,
            "TIMESYNC": self._on_timesync,
            "PING": self._on_ping,
        }

    def close(self) -> None:
        """Free the ports."""
        for link in self.links:
            link.close()

    def poll(self) -> None:
        """Handle everything that has arrived and send everything that is due. Never blocks."""
        for link in self.links:
            for message in link.receive():
                self._dispatch(message, link)
        self._send_changes()
        for link in self.links:
            self.fence.poll(link.send)
            for name in link.due(self._telemetry.available):
                link.send(self._telemetry.build(name))
            for _ in range(min(_PARAMS_PER_POLL, len(link.parameter_queue))):
                self._send_parameter(link.parameter_queue.popleft(), link)

    def _send_changes(self) -> None:
        """What PX4 sends at once: texts, a new mode, a new landed state."""
        pilot = self._autopilot
        while pilot.texts:
            text = pilot.texts.popleft()
            _log.info("vehicle says: %s", text.text)
            for link in self.links:
                if link.has_gcs:
                    link.send_text(text)
        mode, landed = (pilot.mode, pilot.intended), int(pilot.landed_state)
        for name, changed in (("CURRENT_MODE", mode != self._shown_mode), ("EXTENDED_SYS_STATE", landed != self._shown_landed)):
            if changed and self._telemetry.available(name):
                for link in self.links:
                    link.send(self._telemetry.build(name))
        self._shown_mode, self._shown_landed = mode, landed

    def _dispatch(self, message: Message, link: MavlinkLink) -> None:
        if message.get_srcSystem() == SYSTEM_ID or getattr(message, "target_system", 0) not in (0, SYSTEM_ID):
            return
        self._count(message)
        handler = self._handlers.get(message.get_type())
        if handler is None:
            return
        if getattr(message, "target_component", 0) in (0, COMPONENT_ID):
            handler(message, link)

    def _count(self, message: Message) -> None:
        """Count by kind and sender; log what moves, arms or configures the vehicle."""
        name, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if (name, *sender) in self.counts or len(self.counts) < _WIRE_SENDERS:
            self.counts[name, *sender] += 1
        command = _COMMANDS_LOGGED.get(message.command) if name in ("COMMAND_LONG", "COMMAND_INT") else None
        if name in _SETPOINTS_LOGGED or command is not None:
            self.wire_log.append(Received(self._now(), command or name, sender))

    def _on_manual_control(self, m: Message, _: MavlinkLink) -> None:
        """A joystick. Its target field is a system id of its own name."""
        sticks = from_manual_control(self._now(), m.x, m.y, m.z, m.r) if m.target in (0, SYSTEM_ID) else None
        if sticks is not None:
            self._autopilot.set_sticks(sticks)

    def _on_heartbeat(self, message: Message, link: MavlinkLink) -> None:
        if message.type == mav.MAV_TYPE_GCS:
            link.gcs_heard_s = self._now()

    # ---- commands

    def _run(self, command: Command, message: Message, link: MavlinkLink) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())

        def acknowledge(result: Result) -> None:
            link.send(mav.MAVLink_command_ack_message(command.number, int(result), 0, 0, *sender))

        self._commands.run(command, link, acknowledge)

    def _on_command_long(self, m: Message, link: MavlinkLink) -> None:
        params = (m.param1, m.param2, m.param3, m.param4)
        self._run(Command(m.command, params, m.param5, m.param6, m.param7, _is_pilot(m)), m, link)

    def _on_command_int(self, m: Message, link: MavlinkLink) -> None:
        """COMMAND_INT: latitude and longitude as scaled integers (INT32_MAX: not given), altitude by frame."""
        given = m.frame in _GLOBAL_FRAMES and 2147483647 not in (m.x, m.y)
        latitude, longitude = (m.x * 1e-7, m.y * 1e-7) if given else (NAN, NAN)
        altitude = m.z + self._frame.altitude_m - self._autopilot.home[2] if m.frame in _RELATIVE_FRAMES else m.z
        params = (m.param1, m.param2, m.param3, m.param4)
        self._run(Command(m.command, params, latitude, longitude, altitude, _is_pilot(m)), m, link)

    def _on_set_mode(self, m: Message, link: MavlinkLink) -> None:
        """The old SET_MODE: answered with one acknowledgement of DO_SET_MODE, as recorded."""
        custom = int(m.custom_mode)
        result = self._autopilot.set_mode_numbers(custom >> 16 & 0xFF, custom >> 24 & 0xFF, _is_pilot(m))
        sender = (m.get_srcSystem(), m.get_srcComponent())
        link.send(mav.MAVLink_command_ack_message(mav.MAV_CMD_DO_SET_MODE, int(result), 0, 0, *sender))

    # ---- setpoints

    def _on_local_setpoint(self, m: Message, _: MavlinkLink) -> None:
        self._take_setpoint(m, m.coordinate_frame, (m.x, m.y, m.z), "SET_POSITION_TARGET_LOCAL_NED")

    def _on_global_setpoint(self, m: Message, _: MavlinkLink) -> None:
        """Global position setpoints: altitude above sea level (frames 0, 5) or above home (3, 6)."""
        position, frame = NOTHING, 1
        if m.coordinate_frame in _GLOBAL_FRAMES:
            relative = m.coordinate_frame in _RELATIVE_FRAMES
            altitude = m.alt + (self._frame.altitude_m - self._autopilot.home[2] if relative else 0.0)
            position = self._frame.from_global(m.lat_int * 1e-7, m.lon_int * 1e-7, altitude)
        else:
            frame = -1
        self._take_setpoint(m, frame, position, "SET_POSITION_TARGET_GLOBAL_INT")

    def _take_setpoint(self, m: Message, frame: int, position: tuple[float, float, float], name: str) -> None:
        pilot = self._autopilot
        try:
            setpoint = read_setpoint(
                frame,
                m.type_mask,
                position,
                (m.vx, m.vy, m.vz),
                (m.afx, m.afy, m.afz),
                m.yaw,
                m.yaw_rate,
                vehicle_yaw_rad=pilot.state.yaw_rad,
                message=name,
            )
        except SetpointRefusedError as error:
            pilot.say(CRITICAL, str(error))
            return
        pilot.set_setpoint(setpoint)

    # ---- parameters

    def _send_parameter(self, name: str, link: MavlinkLink) -> None:
        store: ParameterStore = self._autopilot.parameters
        if name == HASH_NAME:
            fields = (store.hash_wire_value(), UINT32, len(store), HASH_INDEX)
        else:
            fields = (store.wire_value(name), store.type_of(name), len(store), store.index_of(name))
        link.send(mav.MAVLink_param_value_message(name.encode("ascii"), *fields))

    def _on_param_list(self, _: Message, link: MavlinkLink) -> None:
        """Queue all parameters; a repeated request starts over instead of adding to the queue."""
        link.parameter_queue = deque((*self._autopilot.parameters.names, HASH_NAME))

    def _on_param_read(self, m: Message, link: MavlinkLink) -> None:
        store = self._autopilot.parameters
        name = _text(m.param_id)
        if 0 <= m.param_index < len(store):
            name = store.names[m.param_index]
        if name in store or name == HASH_NAME:
            self._send_parameter(name, link)

    def _on_param_set(self, m: Message, link: MavlinkLink) -> None:
        name = _text(m.param_id)
        if self._autopilot.parameters.set_from_wire(name, m.param_value, m.param_type):
            for other in (link, *(x for x in self.links if x is not link)):
                self._send_parameter(name, other)

    # ---- a fence is stored; missions are not flown: a client that asks gets an empty list

    @staticmethod
    def _on_fence_message(
        handler: Callable[[Message, Callable[[Message], None]], None],
    ) -> Callable[[Message, MavlinkLink], None]:
        def handle(m: Message, link: MavlinkLink) -> None:
            if m.mission_type == FENCE:
                handler(m, link.send)

        return handle

    def _on_mission_list(self, m: Message, link: MavlinkLink) -> None:
        if m.mission_type == FENCE:
            self.fence.on_list(m, link.send)
            return
        link.send(mav.MAVLink_mission_count_message(m.get_srcSystem(), m.get_srcComponent(), 0, m.mission_type))

    def _on_mission_count(self, m: Message, link: MavlinkLink) -> None:
        if m.mission_type == FENCE:
            self.fence.on_count(m, link.send)
            return
        result = mav.MAV_MISSION_ACCEPTED if m.count == 0 else mav.MAV_MISSION_UNSUPPORTED
        link.send(mav.MAVLink_mission_ack_message(m.get_srcSystem(), m.get_srcComponent(), result, m.mission_type))

    def _on_mission_clear(self, m: Message, link: MavlinkLink) -> None:
        if m.mission_type == FENCE:
            self.fence.on_clear(m, link.send)
            return
        ack = mav.MAV_MISSION_ACCEPTED
        link.send(mav.MAVLink_mission_ack_message(m.get_srcSystem(), m.get_srcComponent(), ack, m.mission_type))

    # ---- time

    def _on_timesync(self, m: Message, link: MavlinkLink) -> None:
        if m.tc1 == 0:
            link.send(mav.MAVLink_timesync_message(int(self._now() * 1e9), m.ts1))

    def _on_ping(self, m: Message, link: MavlinkLink) -> None:
        if m.target_system == 0 and m.target_component == 0:
            link.send(mav.MAVLink_ping_message(m.time_usec, m.seq, m.get_srcSystem(), m.get_srcComponent()))


def _is_pilot(message: Message) -> bool:
    """Whether a ground station's own ids sent it."""
    return bool(message.get_srcSystem() == 255)


def _text(raw: str | bytes) -> str:
    return raw if isinstance(raw, str) else raw.split(b"\0")[0].decode("ascii", "replace")
