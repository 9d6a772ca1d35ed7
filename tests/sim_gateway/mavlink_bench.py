"""A vehicle and its MAVLink side in lockstep, with a client on each link: all in one thread, over real UDP sockets."""

from __future__ import annotations

import socket
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.scene import World
from sim_gateway.simulation import Simulation
from sim_gateway.telemetry import Telemetry

EMPTY = World("empty", 0, 100.0, 100.0, 50.0, np.empty((0, 6)), (), (1.0, 2.0, 0.0), 0.0, (30.0, 0.0, 2.0))


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Client:
    """A MAVLink client on one UDP port."""

    def __init__(self, vehicle_port: int, system: int = 245, component: int = 191) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.port = self.socket.getsockname()[1]
        self.vehicle = ("127.0.0.1", vehicle_port)
        self.mav = mav.MAVLink(None, srcSystem=system, srcComponent=component)
        self.mav.robust_parsing = True
        self.seen: list[Any] = []

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), self.vehicle)

    def command(self, number: int, *params: float) -> None:
        values = (*params, *[0.0] * (7 - len(params)))
        self.send(mav.MAVLink_command_long_message(1, 1, number, 0, *values))

    def drain(self) -> None:
        while True:
            try:
                data = self.socket.recv(4096)
            except BlockingIOError:
                return
            self.seen.extend(self.mav.parse_buffer(data) or [])

    def named(self, name: str) -> list[Any]:
        return [message for message in self.seen if message.get_type() == name]


class Bench:
    """Vehicle, server, one onboard client and one ground station, all in this thread."""

    def __init__(self, ready_after_s: float | None = 0.0) -> None:
        self.vehicle = PilotedVehicle(Simulation(EMPTY, estimate="none"), ready_after_s=ready_after_s)
        self.pilot = self.vehicle.autopilot
        ports = (free_port(), free_port())
        self.onboard, self.ground = Client(ports[0]), Client(ports[1], 255, 190)
        telemetry = Telemetry(self.pilot, self.vehicle.frame, self.vehicle.snapshot, lambda: self.vehicle.time_s)
        links = ((ports[0], self.onboard.port), (ports[1], self.ground.port))
        self.server = MavlinkServer(self.pilot, self.vehicle.frame, telemetry, *links)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.004)):
            self.vehicle.advance(1)
            self.server.poll()
            self.onboard.drain()
            self.ground.drain()

    def acks(self, number: int, *params: float, within_s: float = 0.1) -> list[int]:
        self.onboard.seen.clear()
        self.onboard.command(number, *params)
        self.run(within_s)
        return [ack.result for ack in self.onboard.named("COMMAND_ACK") if ack.command == number]

    def close(self) -> None:
        self.server.close()
        self.onboard.socket.close()
        self.ground.socket.close()
