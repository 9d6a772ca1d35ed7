"""The vehicle's MAVLink side: hands each message to who answers it, streams telemetry, answers parameters and setpoints.

Two links as in PX4's SITL: onboard (14580 -> 14540) and ground station (18570 -> 14550), see `mavlink_links`.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable

from pymavlink.dialects.v20 import development as mav

from sim_gateway.attitude_setpoints import read_attitude_target
from sim_gateway.autopilot import Autopilot
from sim_gateway.commands import Command, CommandHandler
from sim_gateway.fence import MISSION, RALLY, ItemStore, legs, shapes
from sim_gateway.file_server import FileServer
from sim_gateway.flight_modes import CRITICAL, FlightMode, Result
from sim_gateway.local_frame import LocalFrame
from sim_gateway.log_server import LogServer
from sim_gateway.mavlink_links import MavlinkLink, PortInUseError, UdpLink
from sim_gateway.parameters import HASH_INDEX, HASH_NAME, UINT32, ParameterStore
from sim_gateway.setpoints import NAN, NOTHING, SetpointRefusedError, read_setpoint
from sim_gateway.sticks import from_manual_control
from sim_gateway.stream_rates import GROUND, ONBOARD
from sim_gateway.telemetry import COMPONENT_ID, Message, Telemetry
from sim_gateway.vehicle_log import VehicleLog
from sim_gateway.wire_log import WireLog

ONBOARD_PORTS = (14580, 14540)  # own port, client's port
GROUND_PORTS = (18570, 14550)
_PARAMS_PER_POLL = 5
_GLOBAL_FRAMES = (0, 5, 3, 6)  # absolute and relative altitude
_RELATIVE_FRAMES = (3, 6)

_log = logging.getLogger("sim_gateway.mavlink")


class MavlinkServer:
    """The vehicle's MAVLink side. Call `poll` after every physics step: it reads, acts and sends what is due."""

    def __init__(
        self,
        autopilot: Autopilot,
        frame: LocalFrame,
        telemetry: Telemetry,
        onboard_ports: tuple[int, int] = ONBOARD_PORTS,
        ground_ports: tuple[int, int] | None = GROUND_PORTS,
        links: list[MavlinkLink] | None = None,
    ) -> None:
        """`links`: these instead of UDP on the ports."""
        self._autopilot, self._frame, self._telemetry = autopilot, frame, telemetry
        self._now = telemetry.now_s
        self._system_id = telemetry.system_id
        self.commands = CommandHandler(autopilot, telemetry, frame)
        self.links = links if links is not None else self._udp_links(onboard_ports, ground_ports)
        self._shown_mode: tuple[FlightMode, FlightMode] | None = None
        self._shown_landed = -1
        self.fence = ItemStore(self._now, lambda items: autopilot.failsafes.geofence.set_shapes(shapes(items, frame)))
        self.mission = ItemStore(self._now, lambda items: autopilot.mission.replace(legs(items, frame)), MISSION)
        rally = ItemStore(self._now, mission_type=RALLY)
        self._stores = {store.mission_type: store for store in (self.fence, self.mission, rally)}
        self.vehicle_log = VehicleLog(autopilot)
        self._log_server = LogServer(self.vehicle_log)
        self._file_server = FileServer(self.vehicle_log)
        self.wire_log = WireLog(self._now)
        self._handlers: dict[str, Callable[[Message, MavlinkLink], None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "COMMAND_LONG": self._on_command_long,
            "COMMAND_INT": self._on_command_int,
            "SET_MODE": self._on_set_mode,
            "SET_POSITION_TARGET_LOCAL_NED": self._on_local_setpoint,
            "SET_POSITION_TARGET_GLOBAL_INT": self._on_global_setpoint,
            "SET_ATTITUDE_TARGET": self._on_attitude_target,
            "PARAM_REQUEST_LIST": self._on_param_list,
            "PARAM_REQUEST_READ": self._on_param_read,
            "PARAM_SET": self._on_param_set,
            "MISSION_REQUEST_LIST": self._for_store(ItemStore.on_list),
            "MISSION_COUNT": self._for_store(ItemStore.on_count),
            "MISSION_CLEAR_ALL": self._on_mission_clear,
            "MISSION_SET_CURRENT": self._on_mission_set_current,
            "MISSION_ITEM_INT": self._for_store(ItemStore.on_item),
            "MISSION_REQUEST_INT": self._for_store(ItemStore.on_request),
            "MISSION_ACK": self._for_store(ItemStore.on_ack),
            "LOG_REQUEST_LIST": lambda m, link: self._log_server.on_list(m, link.send),
            "LOG_REQUEST_DATA": lambda m, link: self._log_server.on_data(m, link.send),
            "LOG_REQUEST_END": lambda m, link: self._log_server.on_end(m, link.send),
            "LOG_ERASE": lambda m, link: self._log_server.on_erase(m, link.send),
            "FILE_TRANSFER_PROTOCOL": lambda m, link: self._file_server.on_request(m, link.send),
            "MANUAL_CONTROL": self._on_manual_control,
            "TIMESYNC": self._on_timesync,
            "PING": self._on_ping,
        }

    def _udp_links(self, onboard_ports: tuple[int, int], ground_ports: tuple[int, int] | None) -> list[MavlinkLink]:
        links: list[MavlinkLink] = [UdpLink("onboard", *onboard_ports, ONBOARD, self._now, self._system_id)]
        try:
            if ground_ports is not None:
                links.append(UdpLink("ground station", *ground_ports, GROUND, self._now, self._system_id))
        except PortInUseError:
            links[0].close()
            raise
        return links

    def close(self) -> None:
        """Free the ports."""
        for link in self.links:
            link.close()

    def take(self, message: Message) -> None:
        """A packed message from somebody who is on no link of its own (`incidents`)."""
        self._dispatch(message, self.links[0])

    def poll(self) -> None:
        """Handle everything that has arrived and send everything that is due. Never blocks."""
        for link in self.links:
            for message in link.receive():
                self._dispatch(message, link)
        self._send_changes()
        self.vehicle_log.watch()
        self._log_server.poll()
        self._file_server.poll()
        for store in self._stores.values():
            store.poll()
        for link in self.links:
            for name in link.due(self._telemetry.available):
                link.send(self._telemetry.build(name))
            for _ in range(min(_PARAMS_PER_POLL, len(link.parameter_queue))):
                if link.has_room:
                    self._send_parameter(link.parameter_queue.popleft(), link)
            link.flush()

    def _send_changes(self) -> None:
        """What PX4 sends at once: texts, a new mode, a new landed state."""
        pilot = self._autopilot
        while pilot.texts:
            text = pilot.texts.popleft()
            _log.info("vehicle says: %s", text.text)
            for link in self.links:
                if link.has_gcs:
                    link.send_text(text)
        while pilot.mission.reached:
            number = pilot.mission.reached.popleft()
            for link in self.links:
                link.send(mav.MAVLink_mission_item_reached_message(number))
        mode, landed = (pilot.mode, pilot.intended), int(pilot.landed_state)
        for name, changed in (("CURRENT_MODE", mode != self._shown_mode), ("EXTENDED_SYS_STATE", landed != self._shown_landed)):
            if changed and self._telemetry.available(name):
                for link in self.links:
                    link.send(self._telemetry.build(name))
        self._shown_mode, self._shown_landed = mode, landed

    def _dispatch(self, message: Message, link: MavlinkLink) -> None:
        own = self._system_id
        if message.get_srcSystem() == own or getattr(message, "target_system", 0) not in (0, own):
            return
        self.wire_log.note(message)
        handler = self._handlers.get(message.get_type())
        if handler is None:
            return
        if getattr(message, "target_component", 0) in (0, COMPONENT_ID):
            handler(message, link)

    def _on_manual_control(self, m: Message, _: MavlinkLink) -> None:
        """A joystick. Its target field is a system id of its own name."""
        sticks = from_manual_control(self._now(), m.x, m.y, m.z, m.r) if m.target in (0, self._system_id) else None
        if sticks is not None:
            self._autopilot.set_sticks(sticks)

    def _on_heartbeat(self, message: Message, link: MavlinkLink) -> None:
        if message.type == mav.MAV_TYPE_GCS:
            link.gcs_heard_s = self._now()

    # ---- commands

    def _run(self, command: Command, message: Message, link: MavlinkLink) -> None:
        injected = command.number == mav.MAV_CMD_INJECT_FAILURE  # PX4's simulator answers to everybody
        sender = (0, 0) if injected else (message.get_srcSystem(), message.get_srcComponent())

        def acknowledge(result: Result) -> None:
            link.send(mav.MAVLink_command_ack_message(command.number, int(result), 0, 0, *sender))

        self.commands.run(command, link, acknowledge)

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

    def _on_attitude_target(self, m: Message, _: MavlinkLink) -> None:
        rates = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
        setpoint = read_attitude_target(m.type_mask, tuple(m.q), rates, m.thrust)
        if setpoint is not None:
            self._autopilot.set_setpoint(setpoint)

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

    # ---- fence, mission and rally points

    def _for_store(
        self, handler: Callable[[ItemStore, Message, Callable[[Message], None]], None]
    ) -> Callable[[Message, MavlinkLink], None]:
        def handle(m: Message, link: MavlinkLink) -> None:
            if m.mission_type in self._stores:
                handler(self._stores[m.mission_type], m, link.send)

        return handle

    def _on_mission_clear(self, m: Message, link: MavlinkLink) -> None:
        if m.mission_type in self._stores:
            self._stores[m.mission_type].on_clear(m, link.send)
        elif m.mission_type == mav.MAV_MISSION_TYPE_ALL:
            for store in self._stores.values():
                store.clear()
            sender = (m.get_srcSystem(), m.get_srcComponent())
            link.send(mav.MAVLink_mission_ack_message(*sender, mav.MAV_MISSION_ACCEPTED, m.mission_type))

    def _on_mission_set_current(self, m: Message, _: MavlinkLink) -> None:
        if self._autopilot.mission.set_current(m.seq):
            for link in self.links:
                link.send(self._telemetry.build("MISSION_CURRENT"))

    # ---- time

    def _on_timesync(self, m: Message, link: MavlinkLink) -> None:
        if m.tc1 == 0:
            link.send(mav.MAVLink_timesync_message(int(self._telemetry.boot_s() * 1e9), m.ts1))

    def _on_ping(self, m: Message, link: MavlinkLink) -> None:
        if m.target_system == 0 and m.target_component == 0:
            link.send(mav.MAVLink_ping_message(m.time_usec, m.seq, m.get_srcSystem(), m.get_srcComponent()))


def _is_pilot(message: Message) -> bool:
    """Whether a ground station's own ids sent it."""
    return bool(message.get_srcSystem() == 255)


def _text(raw: str | bytes) -> str:
    return raw if isinstance(raw, str) else raw.split(b"\0")[0].decode("ascii", "replace")
