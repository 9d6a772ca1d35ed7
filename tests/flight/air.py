"""A gateway in this process, and one connection to it: tests set faults, take over as pilot, and count what came over the wire.

Real gateway, real sockets, real link and LiDAR driver. Only the clockwork is shared: the gateway runs on a thread.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import development as mav
from stand import free_port

from flight.interrupt import Interrupt
from flight.lidar import LidarDriver, open_lidar
from flight.link import VehicleLink
from flight.mission import Mission, load_mission
from flight.status import Status
from sim_gateway.gateway import Gateway, GatewayConfig, warm_up
from sim_gateway.scene import World
from sim_gateway.sticks import Sticks
from sim_gateway.telemetry import Telemetry

FLY = (245, 191), (245, 192)  # MAVSDK in `fly`, and the guard
# unequal walls near enough for 4 m of range: a mirrored or turned scan cannot look like the right one
WALLS = np.array(
    [
        [-6.0, 2.0, 0.0, 12.0, 2.2, 4.0],
        [-6.0, -3.2, 0.0, 12.0, -3.0, 4.0],
        [4.2, 0.6, 0.0, 4.8, 2.0, 4.0],
        [-1.2, -3.0, 0.0, -0.9, -1.4, 4.0],
    ]
)
MISSION = """\
name: air
vehicle: {{connection: "udpin://127.0.0.1:{onboard_port}"}}
policy: {{path: {policy}{sha}}}
frame: {{takeoff_point_m: [1.0, 0.0], heading_deg: 0}}
takeoff_height_m: 1.2
goal: {{position_m: [10.0, -0.4, 1.2], radius_m: 0.3}}
lidar: {{port: {lidar_port}}}
safety:
  fence: {{min_m: [-5.0, -2.9, 0.2], max_m: [11.5, 1.9, 3.0]}}
  max_horizontal_speed_m_s: 0.8
timeouts: {{connect_s: 10, lidar_s: 2, ready_s: 10, takeoff_s: 20, land_s: 20, pilot_s: 20, flight_s: 60}}
"""


def corridor() -> World:
    """A short corridor that is nowhere symmetric."""
    return World("air", 0, 16.0, 5.0, 4.0, WALLS, (), (1.0, 0.0, 0.0), 0.0, (10.0, -0.4, 1.2))


class Station:
    """A ground station with a joystick: 255/190 on the ground station link."""

    def __init__(self, gateway_port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._to = ("127.0.0.1", gateway_port)
        self._mav = mav.MAVLink(None, srcSystem=255, srcComponent=190)

    def close(self) -> None:
        self._socket.close()

    def send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._to)

    def command(self, number: int, *params: float) -> None:
        self.send(mav.MAVLink_command_long_message(1, 1, number, 0, *(*params, *[0.0] * (7 - len(params)))))

    def mode(self, main: int, sub: int = 0) -> None:
        self.command(176, 1, main, sub)

    def sticks(self, ahead: float = 0.0, right: float = 0.0, up: float = 0.0, turn: float = 0.0) -> None:
        axes = (round(1000 * ahead), round(1000 * right), round(500 + 500 * up), round(1000 * turn))
        self.send(mav.MAVLink_manual_control_message(1, *axes, 0))


@dataclass
class Air:
    """Gateway, connection and mission of one test module."""

    gateway: Gateway
    station: Station
    link: VehicleLink
    lidar: LidarDriver
    mission: Mission
    path: Path

    @property
    def autopilot(self) -> Any:
        return self.gateway.vehicle.autopilot

    @property
    def telemetry(self) -> Telemetry:
        return self.gateway.telemetry

    def wait(self, condition: Callable[[], bool], timeout_s: float = 15.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            time.sleep(0.002)

    def received(self, since_s: float = -math.inf) -> list[tuple[float, str]]:
        """What `fly` sent that moves, arms or configures, as it arrived at the vehicle: (vehicle time, what)."""
        log = tuple(self.gateway.server.wire_log.entries)
        return [(item.time_s, item.what) for item in log if item.sender in FLY and item.time_s > since_s]

    def put_back(self) -> None:
        """Motors off, back on the start, in Hold, estimate settled, no faults."""
        self.telemetry.silent.clear()
        self.telemetry.alter.clear()
        self.gateway.alter_scan = None
        self.link.authority = None
        self.autopilot.sticks = Sticks()  # a joystick seen once and gone would be a lost pilot: PX4's failsafe
        self.station.command(400, 0, 21196)
        self.wait(lambda: not self.autopilot.armed)
        self.gateway.carry = lambda _: ((1.0, 0.0, 0.0), 0.0)
        self.station.mode(4, 3)
        self.wait(lambda: self.autopilot.mode.px4_name == "AUTO.LOITER" and self.autopilot.landed)
        self.wait(lambda: math.dist(self.gateway.vehicle.simulation.truth.position_m, (1.0, 0.0, 0.0)) < 0.1)
        self.gateway.carry = None
        self.link.wait_until(lambda: self.link.armed is False and self.link.mode == 4 | 3 << 8, 5.0)


@contextmanager
def open_air(folder: Path, policy: Path, parameters: dict[str, float] | None = None) -> Iterator[Air]:
    """Start all of it; the vehicle stands on the ground, ready to arm."""
    onboard, ground = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    world = corridor()
    warm_up(world)
    stop = threading.Event()
    config = GatewayConfig(onboard_port=onboard, gcs_port=ground, lidar_port=0, estimate="none")
    with Gateway(world, config) as gateway:
        for name, value in (parameters or {}).items():
            gateway.vehicle.autopilot.parameters.set(name, value)
        thread = threading.Thread(target=gateway.run, args=(stop,), daemon=True)
        thread.start()
        path = folder / "mission.yaml"
        path.write_text(MISSION.format(onboard_port=onboard, policy=policy, sha="", lidar_port=gateway.lidar.port))
        mission, station = load_mission(path), Station(ground + 4020)
        try:
            with open_lidar(mission.lidar) as lidar, VehicleLink(mission.vehicle.connection) as link:
                link.connect(15.0)
                link.request_stream_rates(50.0)
                air = Air(gateway, station, link, lidar, mission, path)
                air.wait(lambda: air.autopilot.can_arm and link.telemetry.imu is not None and lidar.latest() is not None, 20.0)
                yield air
        finally:
            station.close()
            stop.set()
            thread.join(5.0)


def quiet() -> tuple[Status, Interrupt]:
    """A status that draws nothing, an interrupt that never comes."""
    return Status(machine_output=True), Interrupt()
