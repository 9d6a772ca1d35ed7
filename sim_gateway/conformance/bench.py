"""A vehicle and its MAVLink server in lockstep with two clients on links in memory: companion 245/191, ground station 255/190."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot import CONTROL_PERIOD_S
from sim_gateway.flight_modes import FlightMode
from sim_gateway.gateway import connect_faults
from sim_gateway.mavlink_links import MavlinkLink, MemoryLink
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.parameters import ParameterStore
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.scene import World
from sim_gateway.simulation import Simulation
from sim_gateway.stream_rates import GROUND, ONBOARD
from sim_gateway.telemetry import Message, Telemetry
from sim_gateway.vehicle import STEP_S
from sim_gateway.vehicle_params import SIH_QUADX

FIELD = World("field", 0, 400.0, 400.0, 100.0, np.empty((0, 6)), (), (200.0, 200.0, 0.0), 0.0, (300.0, 200.0, 2.0))
VELOCITY_AND_YAW_RATE = 0x5C7
STREAM_S = 0.05
BOOTED_S = -20.0  # unless its start-up is watched, the autopilot has been on for a while
WATCHED = ("HEARTBEAT", "CURRENT_MODE", "EXTENDED_SYS_STATE", "BATTERY_STATUS", "ESTIMATOR_STATUS", "GPS_RAW_INT")
WATCHED_US = 100_000
Texts = list[tuple[float, int, str]]


class Client:
    """One program on one link. `seen`: everything that came, with the vehicle time of its arrival."""

    def __init__(self, link: MemoryLink, system: int, component: int, kind: int) -> None:
        self.link = link
        self._packer = mav.MAVLink(None, srcSystem=system, srcComponent=component)
        self._kind = kind
        self.seen: list[tuple[float, Message]] = []

    def send(self, message: Message) -> None:
        """Put a message on the link."""
        message.pack(self._packer)
        self.link.inbox.append(message)

    def heartbeat(self) -> None:
        """What a client of its kind sends once a second."""
        self.send(mav.MAVLink_heartbeat_message(self._kind, mav.MAV_AUTOPILOT_INVALID, 0, 0, mav.MAV_STATE_ACTIVE, 3))

    def collect(self, now_s: float) -> None:
        """Take what has come."""
        while self.link.outbox:
            self.seen.append((now_s, self.link.outbox.popleft()))


class Bench:
    """`height_m` 0: on the ground, disarmed; else it hovers there, armed, in Hold, with home on the ground below."""

    def __init__(
        self,
        height_m: float = 0.0,
        *,
        parameters: dict[str, float] | None = None,
        ready_after_s: float | None = 0.0,
        ground_station: bool = True,
        everything: bool = False,
    ) -> None:
        simulation = Simulation(FIELD, params=SIH_QUADX, estimate="none", hover_height_m=height_m or None)
        self.vehicle = PilotedVehicle(simulation, ParameterStore(parameters), ready_after_s=ready_after_s)
        self.pilot = self.vehicle.autopilot
        self.telemetry = Telemetry(self.pilot, self.vehicle.frame, self.vehicle.snapshot, lambda: self.time_s)
        if ready_after_s == 0.0:
            self.telemetry.booted_s = BOOTED_S
        onboard = MemoryLink("onboard", ONBOARD, lambda: self.time_s)
        ground = MemoryLink("ground station", GROUND, lambda: self.time_s)
        links: list[MavlinkLink] = [onboard, ground]
        self.server = MavlinkServer(self.pilot, self.vehicle.frame, self.telemetry, links=links)
        self.incidents = connect_faults(self.vehicle, self.server, self.telemetry, 0)
        self.onboard = Client(onboard, 245, 191, mav.MAV_TYPE_ONBOARD_CONTROLLER)
        self.ground = Client(ground, 255, 190, mav.MAV_TYPE_GCS)
        self.clients = [self.onboard, self.ground] if ground_station else [self.onboard]
        self.stream: Callable[[], Message] | None = None
        self.sticks: tuple[int, int, int, int] | None = None
        self._next_stream_s = self._next_heartbeat_s = 0.0
        self.poll_steps = 1 if everything else round(CONTROL_PERIOD_S / STEP_S)
        if not everything:
            self._only_watched(links)
        if height_m > 0.0:
            self._take_off()
        self.run(0.1)

    def _only_watched(self, links: list[MavlinkLink]) -> None:
        for link in links:
            for name in set(link.streams) - set(WATCHED):
                link.set_interval(name, -1)
            for name in WATCHED[3:]:
                link.set_interval(name, WATCHED_US)

    def _take_off(self) -> None:
        self.pilot.begin_in_air(self.vehicle.ned_state(), home=(0.0, 0.0, 0.0))

    @property
    def time_s(self) -> float:
        """Vehicle time."""
        return self.vehicle.time_s

    @property
    def mode(self) -> str:
        """The mode's name in the recordings."""
        return self.pilot.mode.px4_name

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> Self:
        """Let vehicle time pass, or stop when `until` says so; clients send what they send regularly."""
        for _ in range(round(seconds / (self.poll_steps * STEP_S))):
            if until():
                break
            self._send_regularly()
            self.vehicle.advance(self.poll_steps)
            self.incidents.step()
            self.server.poll()
            for client in (self.onboard, self.ground):
                client.collect(self.time_s)
        return self

    def _send_regularly(self) -> None:
        if self.time_s >= self._next_heartbeat_s:
            self._next_heartbeat_s += 1.0
            for client in self.clients:
                client.heartbeat()
        if self.time_s >= self._next_stream_s:
            self._next_stream_s = self.time_s + STREAM_S - 1e-9
            if self.stream is not None:
                self.onboard.send(self.stream())
            if self.sticks is not None:
                self.ground.send(mav.MAVLink_manual_control_message(1, *self.sticks, 0))

    # ---- what clients do

    def fly(self, north: float, east: float = 0.0, down: float = 0.0, yaw_rate: float = 0.0) -> Self:
        """Stream a velocity from now on."""
        return self.set_stream(1, VELOCITY_AND_YAW_RATE, (0, 0, 0, north, east, down, 0, 0, 0, 0, yaw_rate))

    def set_stream(self, frame: int, mask: int, values: tuple[float, ...], target_system: int = 1) -> Self:
        """Stream any SET_POSITION_TARGET_LOCAL_NED from now on."""

        def setpoint() -> Message:
            now_ms = round(1e3 * self.time_s)
            return mav.MAVLink_set_position_target_local_ned_message(now_ms, target_system, 1, frame, mask, *values)

        self.stream, self._next_stream_s = setpoint, 0.0
        return self

    def command(self, number: int, *params: float, client: Client | None = None, component: int = 1) -> Self:
        """Send a COMMAND_LONG."""
        values = (*params, *[0.0] * (7 - len(params)))
        (client or self.onboard).send(mav.MAVLink_command_long_message(1, component, number, 0, *values))
        return self

    def offboard(self, north: float = 0.0, east: float = 0.0, down: float = 0.0) -> Self:
        """Stream, then OFFBOARD."""
        self.fly(north, east, down).run(0.3)
        self.pilot.set_mode(FlightMode.OFFBOARD)
        return self.run(0.1)

    # ---- what came

    def named(self, name: str, since_s: float = 0.0, client: Client | None = None) -> list[tuple[float, Any]]:
        """Messages of a name, with times relative to `since_s`."""
        found = (client or self.onboard).seen
        return [(at - since_s, message) for at, message in found if at >= since_s - 1e-9 and message.get_type() == name]

    def acks(self, number: int, since_s: float, client: Client | None = None) -> list[str]:
        """Results of a command's acknowledgements, by name."""
        acks = self.named("COMMAND_ACK", since_s, client)
        return [mav.enums["MAV_RESULT"][m.result].name.removeprefix("MAV_RESULT_") for _, m in acks if m.command == number]

    def texts(self, since_s: float) -> Texts:
        """STATUSTEXT as the ground station got it."""
        return [(at, m.severity, m.text) for at, m in self.named("STATUSTEXT", since_s, self.ground)]

    def modes(self, since_s: float) -> list[tuple[float, str, str]]:
        """Changes of mode as CURRENT_MODE told them: time, mode, intended mode."""
        changes: list[tuple[float, str, str]] = []
        last = None
        for at, message in self.named("CURRENT_MODE"):
            now = (name_of(message.custom_mode), name_of(message.intended_custom_mode))
            if last is not None and now[0] != last[0] and at >= since_s - 1e-9:
                changes.append((at - since_s, *now))
            last = now
        return changes

    def heartbeat(self) -> Message:
        """The vehicle's next heartbeat."""
        since_s = self.time_s
        self.run(1.2, until=lambda: bool(self.named("HEARTBEAT", since_s)))
        return self.named("HEARTBEAT", since_s)[-1][1]


def name_of(custom_mode: int) -> str:
    """PX4's name of a custom mode."""
    mode = FlightMode.from_custom_mode(custom_mode)
    return f"mode {custom_mode}" if mode is None else mode.px4_name
