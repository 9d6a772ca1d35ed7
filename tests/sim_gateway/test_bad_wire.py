"""Bad input at every socket of the gateway: it goes on, another client keeps its telemetry, memory stays where it is.

The gateway runs as it does for users, in real time in a thread of its own; the abuse comes from here.
"""

from __future__ import annotations

import os
import random
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from mavlink_bench import Client, free_port
from pymavlink.dialects.v20 import development as mav

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.gateway import Gateway, GatewayConfig, warm_up
from sim_gateway.open_links import ONBOARD_PORT_OFFSET

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(60)]

WORLD = generate_corridor(1, CorridorConfig())
DEADLINE_S = 5.0
MOST_GROWTH_MIB = 12.0
MULTI_SCAN = b"MD0180054001000\n"


@dataclass
class Running:
    """A running gateway with a well-behaved client on its default port."""

    gateway: Gateway
    good: Client
    thread: threading.Thread
    failures: list[BaseException] = field(default_factory=list)

    @property
    def address(self) -> tuple[str, int]:
        return "127.0.0.1", self.gateway.config.onboard_port + ONBOARD_PORT_OFFSET

    def _acks(self) -> list[int]:
        return [ack.result for ack in self.good.named("COMMAND_ACK")]

    def still_serves(self) -> None:
        """New telemetry arrives at the good client, and its command is answered, repeated as MAVLink asks for."""
        self.good.drain()
        self.good.seen.clear()
        deadline, next_try = time.monotonic() + DEADLINE_S, 0.0
        while time.monotonic() < deadline and not (self._acks() and len(self.good.named("ATTITUDE")) >= 10):
            if time.monotonic() >= next_try:
                self.good.command(512, 148.0)
                next_try = time.monotonic() + 0.5
            time.sleep(0.02)
            self.good.drain()
        assert len(self.good.named("ATTITUDE")) >= 10
        assert set(self._acks()) == {0}
        assert self.thread.is_alive()
        assert not self.failures
        assert not self.gateway.vehicle.autopilot.armed


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    warm_up(WORLD)
    port = free_port() % 20000 + 30000
    config = GatewayConfig(onboard_port=port, gcs_port=0, lidar_port=0, serial_lidar="ld06")
    with Gateway(WORLD, config) as gateway:
        stop = threading.Event()
        good = _client_on(port)
        running = Running(gateway, good, threading.Thread(target=lambda: _run(gateway, stop, running)))
        running.thread.start()
        deadline = time.monotonic() + 20.0
        while gateway.vehicle.time_s < 5.0:
            assert time.monotonic() < deadline, "the gateway does not get going"
            time.sleep(0.05)
        running.still_serves()
        yield running
        stop.set()
        running.thread.join(DEADLINE_S)
        assert not running.thread.is_alive()
        assert not running.failures
        good.socket.close()


def _run(gateway: Gateway, stop: threading.Event, running: Running) -> None:
    try:
        gateway.run(stop)
    except BaseException as error:
        running.failures.append(error)
        raise


def _client_on(port: int) -> Client:
    client = Client(port + ONBOARD_PORT_OFFSET)
    client.socket.close()
    client.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    client.socket.bind(("127.0.0.1", port))
    client.socket.setblocking(False)
    return client


def _resident_mib() -> float:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def _arm(system: int = 1, component: int = 1) -> bytes:
    packer = mav.MAVLink(None, srcSystem=200, srcComponent=1)
    return bytes(mav.MAVLink_command_long_message(system, component, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(packer))


def _wrong_checksum(frame: bytes) -> bytes:
    return frame[:-2] + bytes((frame[-2] ^ 0x5A, frame[-1]))


def _oversized() -> list[bytes]:
    """Frames that claim the largest payload, complete and not, and datagrams larger than the gateway reads."""
    claim = bytes((253, 255, 0, 0, 0, 200, 1, 76, 0, 0))
    large = [os.urandom(9000), _arm() + os.urandom(20_000), _arm() * 400, bytes(60_000)]
    return [claim, claim + bytes(300), claim + os.urandom(4000), *large]


def test_random_truncated_oversized_and_damaged_frames(running: Running) -> None:
    rng, frame = random.Random(5), _arm()
    bad = [rng.randbytes(rng.randrange(1, 600)) for _ in range(500)]
    bad += [frame[:cut] for cut in range(len(frame))]
    bad += [_wrong_checksum(frame)] * 50
    bad += [b"", b"\xfd", b"\xfe", b"\xfd" * 500, struct.pack("<B", 254) + bytes(7)]
    bad += _oversized()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as enemy:
        for data in bad:
            enemy.sendto(data, running.address)
    running.still_serves()


def test_commands_for_somebody_else_are_not_taken(running: Running) -> None:
    counted = sum(running.gateway.server.wire_log.counts.values())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as enemy:
        for system, component in ((2, 1), (255, 190), (1, 154), (77, 0)):
            enemy.sendto(_arm(system, component), running.address)
    running.still_serves()
    taken = sum(running.gateway.server.wire_log.counts.values()) - counted
    assert taken <= 1 + len(running.good.named("COMMAND_ACK")), "the one for another component of ours, and the good client's own"


def test_ten_thousand_messages_a_second(running: Running) -> None:
    """Heartbeats, parameter requests, setpoints and noise, as fast as that, for two seconds, from eleven sockets."""
    packer = mav.MAVLink(None, srcSystem=200, srcComponent=1)
    frames = [
        bytes(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(packer)),
        bytes(mav.MAVLink_param_request_list_message(1, 1).pack(packer)),
        bytes(mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x5C7, *[0.0] * 11).pack(packer)),
        bytes(mav.MAVLink_ping_message(0, 1, 0, 0).pack(packer)),
        os.urandom(100),
    ]
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(11)]
    before = _resident_mib()
    started, sent = time.monotonic(), 0
    while (elapsed := time.monotonic() - started) < 2.0:
        while sent < 10_000 * elapsed:
            sockets[sent % 11].sendto(frames[sent % len(frames)], running.address)
            sent += 1
        time.sleep(0.001)
    running.still_serves()
    for sock in sockets:
        sock.close()
    assert sent > 15_000
    assert _resident_mib() - before < MOST_GROWTH_MIB
    links = running.gateway.server.links
    assert all(len(link.parameter_queue) <= len(running.gateway.vehicle.autopilot.parameters) + 1 for link in links)


def test_clients_that_never_read(running: Running) -> None:
    """One on UDP, one on the LiDAR's port and one on the serial line: each is only its own loss."""
    before = _resident_mib()
    deaf = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.sendto(bytes(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav.MAVLink(None, 201, 1))), running.address)
    lidar = socket.socket()
    lidar.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    lidar.connect(("127.0.0.1", running.gateway.lidar.port))
    lidar.sendall(MULTI_SCAN)
    assert running.gateway.serial_lidar is not None
    port = running.gateway.serial_lidar.port
    line = os.open(running.gateway.serial_lidar.path, os.O_RDWR | os.O_NOCTTY)
    lost, deadline = port.lost_bytes, time.monotonic() + 10.0
    while (port.lost_bytes == lost or running.gateway.lidar.client is not None) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert port.lost_bytes > lost, "what the line cannot take is lost"
    assert running.gateway.lidar.client is None, "the deaf client of the LiDAR is dropped"
    running.still_serves()
    os.close(line)
    lidar.close()
    deaf.close()
    assert _resident_mib() - before < MOST_GROWTH_MIB
    with socket.create_connection(("127.0.0.1", running.gateway.lidar.port), timeout=DEADLINE_S) as next_one:
        next_one.sendall(b"VV\n")
        assert next_one.recv(64).startswith(b"VV\n00")


def test_sockets_closed_in_the_middle(running: Running) -> None:
    frame = _arm()
    for cut in (1, 5, 12, len(frame) - 1):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as quitter:
            quitter.sendto(
                bytes(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(mav.MAVLink(None, 202, 1))), running.address
            )
            quitter.sendto(frame[:cut], running.address)
    for request in (b"", b"M", b"MD01800540010", MULTI_SCAN, b"\xff" * 5000, b"VV\n" * 500):
        with socket.create_connection(("127.0.0.1", running.gateway.lidar.port), timeout=DEADLINE_S) as quitter:
            quitter.sendall(request)
            quitter.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset, no polite end
    assert running.gateway.serial_lidar is not None
    for _ in range(3):
        line = os.open(running.gateway.serial_lidar.path, os.O_RDWR | os.O_NOCTTY)
        os.write(line, os.urandom(200))
        os.close(line)
    running.still_serves()
    deadline = time.monotonic() + DEADLINE_S
    while running.gateway.lidar.client is not None and time.monotonic() < deadline:
        time.sleep(0.02)
    with socket.create_connection(("127.0.0.1", running.gateway.lidar.port), timeout=DEADLINE_S) as next_one:
        next_one.sendall(b"VV\n")
        assert next_one.recv(64).startswith(b"VV\n00")
