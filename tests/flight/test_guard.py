"""The guard as a process and its relay: whole frames both ways, nobody else steers, and what is left after each kind of death.

A socket plays the autopilot, another one MAVSDK; clocks are real where a process is real.
"""

from __future__ import annotations

import math
import os
import pty
import random
import select
import signal
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import development as mav

from flight.errors import RefusedError
from flight.guard.channel import Engage as EngageRequest
from flight.guard.channel import pack_command, pack_disengage, pack_engage, read_answer, read_request
from flight.guard.client import ROOT, GuardLostError, SetpointGuard
from flight.guard.core import STILL, Command, State
from flight.guard.ports import MAX_WAITING_FRAMES, Port, PortError, StreamPort, UdpPort, open_port
from flight.guard.process import GuardProcess
from flight.guard.wire import MAX_FRAME_BYTES, pack_setpoint

AHEAD = (1.0, 0.0, 0.0, 0.1)
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24
LOOPBACK = ("127.0.0.1", 0)


def heartbeat(custom_mode: int = OFFBOARD) -> bytes:
    return bytes(mav.MAVLink_heartbeat_message(2, 12, 0x81, custom_mode, 4, 3).pack(mav.MAVLink(None, 1, 1)))


def setpoints(datagrams: list[bytes]) -> list[tuple[float, float]]:
    """(north, yaw rate) of every setpoint, decoded by pymavlink."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    found = [message for data in datagrams for message in parser.parse_buffer(data) or []]
    return [(m.vx, round(m.yaw_rate, 6)) for m in found if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


def bound() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(LOOPBACK)
    sock.setblocking(False)
    return sock


def drained(sock: socket.socket, for_s: float = 0.0) -> list[bytes]:
    """What has arrived, or arrives within `for_s`."""
    deadline, found = time.monotonic() + for_s, []
    while select.select([sock], [], [], max(0.0, deadline - time.monotonic()))[0]:
        found.append(sock.recv(4096))
    return found


# -- the relay, turn by turn, with a clock of its own -------------------------------------------------------------------


@dataclass
class Bench:
    """A guard without a process: its far ends, and its clock."""

    guard: GuardProcess
    loop: socket.socket
    vehicle: socket.socket
    mavsdk: socket.socket
    relay: socket.socket
    port: Port
    loop_end: int
    now_s: float = 100.0

    def turn(self, pause_s: float = 0.0) -> None:
        self.now_s += pause_s
        ends = [self.loop_end, self.port.fileno(), self.relay.fileno()]
        self.guard.turn(set(select.select(ends, [], [], 0.05)[0]))

    def command(self, sequence: int, stamp_s: float) -> None:
        self.loop.send(pack_command(Command(1, sequence, stamp_s, AHEAD)))

    def engage(self) -> None:
        self.loop.send(pack_engage(EngageRequest(1, (1, 1))))
        self.turn()
        self.vehicle.sendto(heartbeat(), self.port_address)
        self.turn()
        assert self.guard.core.state is State.FOLLOW

    @property
    def port_address(self) -> tuple[str, int]:
        return self.port._socket.getsockname()  # type: ignore[attr-defined]


@pytest.fixture
def bench() -> Iterator[Bench]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    relay, vehicle, mavsdk = bound(), bound(), bound()
    port = UdpPort("127.0.0.1", 0, listen=True)
    with near, far, relay, vehicle, mavsdk:
        guard = GuardProcess(far, port, relay, lambda: bench.now_s)
        bench = Bench(guard, near, vehicle, mavsdk, relay, port, far.fileno())
        near.setblocking(False)
        mavsdk.connect(relay.getsockname())
        mavsdk.send(heartbeat())  # MAVSDK speaks first, the vehicle answers: both ends know each other
        bench.turn()
        vehicle.sendto(heartbeat(HOLD), bench.port_address)
        bench.turn()
        drained(mavsdk)
        yield bench
        port.close()


def test_bytes_pass_unchanged_both_ways(bench: Bench) -> None:
    noise = b"\x01\x02" + heartbeat() + b"tail"
    bench.vehicle.sendto(noise, bench.port_address)
    bench.turn()
    assert drained(bench.mavsdk) == [noise]
    bench.mavsdk.send(heartbeat() + heartbeat(HOLD))
    bench.turn()
    assert drained(bench.vehicle) == [heartbeat() + heartbeat(HOLD)]


def test_nobody_but_the_loop_steers(bench: Bench) -> None:
    packer = mav.MAVLink(None, 245, 191)
    steering = [
        mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x5C7, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0),
        mav.MAVLink_set_attitude_target_message(0, 1, 1, 0, [1, 0, 0, 0], 0, 0, 0, 0.5),
        mav.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0),
    ]
    for message in steering:
        bench.mavsdk.send(heartbeat() + message.pack(packer) + heartbeat(HOLD))
        bench.turn()
    assert drained(bench.vehicle) == [heartbeat() + heartbeat(HOLD)] * len(steering)
    assert bench.guard.dropped == len(steering)


def test_a_stranger_is_neither_heard_nor_answered(bench: Bench) -> None:
    with bound() as stranger:
        stranger.sendto(heartbeat(HOLD), bench.port_address)
        stranger.sendto(heartbeat(), bench.relay.getsockname())
        bench.turn()
        assert drained(bench.mavsdk) == []
        assert drained(bench.vehicle) == []
        bench.engage()
        bench.command(1, bench.now_s)
        bench.turn()
        assert drained(stranger) == []
        assert setpoints(drained(bench.vehicle)) == [(1.0, 0.1)]


def test_of_a_backlog_only_the_newest_counts_and_an_old_one_not_at_all(bench: Bench) -> None:
    bench.engage()
    for k in range(1, 11):
        bench.command(k, bench.now_s - 0.3 + 0.03 * k)
    bench.turn()
    assert setpoints(drained(bench.vehicle)) == [(1.0, 0.1)]
    for k in range(11, 31):
        bench.command(k, bench.now_s + 0.001 * k)
    bench.turn(pause_s=0.5)
    assert setpoints(drained(bench.vehicle)) == [(0.0, 0.0)]
    bench.turn(pause_s=5.0)
    assert drained(bench.vehicle) == []
    assert bench.guard.core.state is State.SILENT


def test_a_mode_of_the_vehicle_silences_it_within_the_same_turn(bench: Bench) -> None:
    bench.engage()
    bench.command(1, bench.now_s)
    bench.turn()
    drained(bench.vehicle)
    bench.vehicle.sendto(heartbeat(HOLD), bench.port_address)
    bench.turn()
    for k in range(2, 30):
        bench.command(k, bench.now_s)
        bench.turn(pause_s=0.05)
    assert drained(bench.vehicle) == []


def test_every_command_is_answered(bench: Bench) -> None:
    bench.engage()
    drained(bench.loop)
    bench.command(1, bench.now_s)
    bench.turn()
    bench.command(2, bench.now_s - 1.0)
    bench.turn()
    answers = [read_answer(message) for message in drained(bench.loop)]
    assert [(answer.sequence, math.isnan(answer.sent_s)) for answer in answers if answer is not None] == [(1, False), (2, True)]


def test_random_bytes_from_all_sides_change_nothing(bench: Bench) -> None:
    dice = random.Random(1)
    bench.engage()
    arrived = []
    for k in range(300):
        noise = dice.randbytes(dice.randrange(1, 300))
        kinds = (b"\xfd", b"\xfe", b"", pack_setpoint(0, 0, (1, 1), (1, 1), (9.0, 0.0, 0.0), 0.0)[: dice.randrange(1, 50)])
        bench.vehicle.sendto(dice.choice(kinds) + noise, bench.port_address)
        bench.mavsdk.send(dice.choice(kinds) + noise)
        bench.command(k + 1, bench.now_s)
        bench.turn(pause_s=0.02)
        arrived += drained(bench.vehicle)
    assert bench.guard.core.state is State.FOLLOW
    sent = setpoints([data for data in arrived if data[5:7] == bytes((245, 192))])
    assert len(sent) > 250
    assert set(sent) == {(1.0, 0.1)}


def test_a_message_that_cannot_be_read_means_silence(bench: Bench) -> None:
    for message in (b"", b"\x01", b"\x02\x00", b"\xff" * 40, pack_disengage()):
        assert read_request(message) is None
    bench.engage()
    bench.loop.send(b"\x01nonsense")
    bench.turn()
    assert bench.guard.core.state is State.SILENT


# -- the wire -----------------------------------------------------------------------------------------------------------


def test_serial_line_cuts_frames_and_never_delivers_a_setpoint_late() -> None:
    master, slave = pty.openpty()
    port = open_port(f"serial://{os.ttyname(slave)}:57600", 1.0)
    try:
        assert termios.tcgetattr(slave)[3] & (termios.ECHO | termios.ICANON) == 0
        os.write(master, heartbeat()[:9])
        assert wait_for(port.receive) == []
        os.write(master, heartbeat()[9:] + heartbeat(HOLD))
        assert wait_for(port.receive) == [heartbeat() + heartbeat(HOLD)]
        assert port.send(heartbeat(), urgent=True)
        assert os.read(master, 100) == heartbeat()
        while port.send(b"x" * 200, urgent=True):
            pass  # nobody reads: the line fills up
        assert not port.send(heartbeat(), urgent=True)
        for _ in range(3 * MAX_WAITING_FRAMES):
            port.send(heartbeat())
        assert isinstance(port, StreamPort)
        assert len(port._waiting) <= MAX_WAITING_FRAMES
    finally:
        port.close()
        os.close(slave)
        os.close(master)


def wait_for(receive: Callable[[], list[bytes]]) -> list[bytes]:
    deadline = time.monotonic() + 0.2
    while time.monotonic() < deadline:
        if found := receive():
            return found
        time.sleep(0.005)
    return []


def test_tcp_both_ways_and_its_end_is_told() -> None:
    with socket.create_server(LOOPBACK) as server:
        port = open_port(f"tcpout://127.0.0.1:{server.getsockname()[1]}", 1.0)
        vehicle, _ = server.accept()
        with vehicle:
            vehicle.sendall(heartbeat())
            assert wait_for(port.receive) == [heartbeat()]
            assert port.send(heartbeat(HOLD), urgent=True)
            assert vehicle.recv(MAX_FRAME_BYTES) == heartbeat(HOLD)
        with pytest.raises(PortError, match="ended"):
            wait_for(port.receive)
        port.close()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("serial:///dev/no-such-device:57600", "No such file"),
        ("serial:///dev/null:57600", "Inappropriate"),
        ("serial:///dev/null:12345", "12345 baud"),
        ("tcpout://127.0.0.1:1", "refused"),
        ("carrier-pigeon://x:1", "carrier-pigeon"),
    ],
)
def test_a_wire_that_cannot_be_opened_is_refused_with_the_reason(url: str, words: str) -> None:
    with SetpointGuard(url) as guard, pytest.raises(RefusedError, match=words):
        guard.start(10.0)


# -- the process --------------------------------------------------------------------------------------------------------


def test_it_needs_the_standard_library_only() -> None:
    code = "import sys, flight.guard.process; print(*{name.split('.')[0] for name in sys.modules})"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-S", "-P", "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) - {"flight", "__main__"} <= set(sys.stdlib_module_names)


@dataclass
class Flown:
    """A real guard in OFFBOARD, and the vehicle's end of its wire."""

    guard: SetpointGuard
    vehicle: socket.socket
    url: tuple[str, int]

    def fly(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.guard.command(AHEAD, time.monotonic())
            time.sleep(0.04)

    @property
    def process(self) -> int:
        assert self.guard.pid is not None
        return self.guard.pid


@pytest.fixture
def flown() -> Iterator[Flown]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(LOOPBACK)
        address = probe.getsockname()
    with bound() as vehicle, SetpointGuard(f"udpin://127.0.0.1:{address[1]}") as guard:
        guard.start(10.0)
        vehicle.sendto(heartbeat(HOLD), address)
        guard.engage((1, 1))
        flown = Flown(guard, vehicle, address)
        vehicle.sendto(heartbeat(), address)
        flown.fly(0.3)
        assert setpoints(drained(vehicle))[-1] == (1.0, 0.1)
        yield flown


@pytest.mark.realtime
def test_it_is_small(flown: Flown) -> None:
    with open(f"/proc/{flown.process}/status") as file:
        peak_kb = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
    assert peak_kb < 20_000


@pytest.mark.realtime
def test_a_loop_that_stops_speaking_is_braked_then_left_to_px4(flown: Flown) -> None:
    found = setpoints(drained(flown.vehicle, for_s=1.2))
    assert 5 <= len(found) <= 12
    assert set(found) == {(0.0, 0.0)}
    assert flown.guard.state is State.SILENT
    assert flown.guard.command(AHEAD, time.monotonic()) is None
    assert drained(flown.vehicle, for_s=0.3) == []


@pytest.mark.realtime
def test_a_loop_that_dies_is_braked_and_the_guard_ends(flown: Flown) -> None:
    control, flown.guard._control = flown.guard._control, None
    assert control is not None
    control.close()
    child = flown.guard._child
    assert child is not None
    assert child.wait(3.0) == 0
    found = setpoints(drained(flown.vehicle))
    assert len(found) >= 5
    assert set(found) == {(0.0, 0.0)}


@pytest.mark.realtime
def test_disengaged_means_not_one_more_message(flown: Flown) -> None:
    flown.guard.disengage()
    assert drained(flown.vehicle, for_s=1.0) == []


@pytest.mark.realtime
@pytest.mark.parametrize("pause_s", [0.02, 0.3, 1.5])
def test_a_guard_that_was_stopped_catches_nothing_up(flown: Flown, pause_s: float) -> None:
    os.kill(flown.process, signal.SIGSTOP)
    stopped_s = time.monotonic()
    for _ in range(3):
        flown.guard._send(pack_command(Command(1, 10_000 + _, time.monotonic(), AHEAD)))
    time.sleep(pause_s)
    drained(flown.vehicle)
    os.kill(flown.process, signal.SIGCONT)
    late = setpoints(drained(flown.vehicle, for_s=0.08))
    moving = [setpoint for setpoint in late if setpoint != (0.0, 0.0)]
    assert len(moving) <= (time.monotonic() - stopped_s < 0.2)  # one at the most, and only while it is young


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_guard_that_dies_or_hangs_is_noticed_at_once_and_never_comes_back(flown: Flown, number: signal.Signals) -> None:
    os.kill(flown.process, number)
    struck_s = time.monotonic()
    with pytest.raises(GuardLostError, match="guard process"):
        flown.fly(2.0)
    assert time.monotonic() - struck_s < 0.4
    drained(flown.vehicle)
    assert drained(flown.vehicle, for_s=0.5) == []


@pytest.mark.realtime
def test_told_to_end_it_brakes_and_keeps_the_way_to_the_ground_open(flown: Flown) -> None:
    os.kill(flown.process, signal.SIGTERM)
    time.sleep(0.05)
    drained(flown.vehicle)
    assert flown.guard.command(AHEAD, time.monotonic()) is None
    assert flown.guard.command(STILL, time.monotonic()) is not None
    assert set(setpoints(drained(flown.vehicle, for_s=0.2))) == {(0.0, 0.0)}
    assert flown.guard.lost is None
