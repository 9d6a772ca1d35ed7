"""MAVLink links of every kind: what they carry, how fast, how badly, and to whom."""

from __future__ import annotations

import os
import pty
import socket
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mav

from sim_gateway.frame_reader import FrameReader, decode
from sim_gateway.gateway import GatewayConfig
from sim_gateway.link_conditions import LinkConditions
from sim_gateway.link_spec import LinkQuality, LinkSpec, LinkSpecError
from sim_gateway.mavlink_links import MavlinkLink, PortInUseError, UdpLink
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.open_links import link_plan, nth_links, open_links, ready_links
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.serial_port import PacedReader, PacedWriter, SerialPortError
from sim_gateway.simulation import Simulation
from sim_gateway.stream_links import SerialLink
from sim_gateway.telemetry import Telemetry
from tests.sim_gateway.mavlink_bench import EMPTY, free_port

pytestmark = pytest.mark.timeout(60)


class Rig:
    """A vehicle in lockstep with links of these descriptions. `run` steps it; `each_step` is called in between."""

    def __init__(self, *texts: str, seed: int = 0) -> None:
        self.vehicle = PilotedVehicle(Simulation(EMPTY, estimate="none"), ready_after_s=0.0)
        pilot = self.vehicle.autopilot
        telemetry = Telemetry(pilot, self.vehicle.frame, self.vehicle.snapshot, lambda: self.vehicle.time_s)
        plan = [LinkSpec.parse(text) for text in texts]
        self.links: list[MavlinkLink] = open_links(plan, telemetry.now_s, GatewayConfig(seed=seed))
        self.server = MavlinkServer(pilot, self.vehicle.frame, telemetry, links=self.links)

    def run(self, seconds: float, each_step: Callable[[], object] = lambda: None) -> None:
        for _ in range(round(seconds / 0.004)):
            self.vehicle.advance(1)
            self.server.poll()
            each_step()


@contextmanager
def _rig(*texts: str, seed: int = 0) -> Iterator[Rig]:
    rig = Rig(*texts, seed=seed)
    try:
        yield rig
    finally:
        rig.server.close()


class Stream:
    """A client of a stream link: over a socket or a file descriptor."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self.descriptor, self.reader, self.bytes = descriptor, FrameReader(), 0
        self.seen: list[Any] = []
        self._packer = mav.MAVLink(None, srcSystem=245, srcComponent=190)

    def drain(self) -> None:
        try:
            data = os.read(self.descriptor, 65536)
        except BlockingIOError:
            return
        self.bytes += len(data)
        self.seen += [decode(frame) for frame in self.reader.feed(data)]

    def send(self, *messages: Any) -> None:
        os.write(self.descriptor, b"".join(message.pack(self._packer) for message in messages))

    def named(self, name: str) -> list[Any]:
        return [message for message in self.seen if message.get_type() == name]

    def pings(self) -> list[int]:
        """Numbers of our own pings that came back (the vehicle sends some of its own)."""
        return [message.seq for message in self.named("PING") if message.target_system == 245]


def _tcp(port: int) -> tuple[socket.socket, Stream]:
    sock = socket.create_connection(("127.0.0.1", port), timeout=5.0)
    return sock, Stream(sock.fileno())


def _ping(number: int) -> mav.MAVLink_message:
    return mav.MAVLink_ping_message(0, number, 0, 0)


# ---- descriptions


def test_descriptions() -> None:
    assert LinkSpec.parse("udp:14540") == LinkSpec("udp", "127.0.0.1", 14540)
    assert LinkSpec.parse("tcp:5760").host == "127.0.0.1"
    assert LinkSpec.parse("udp:192.168.1.5:14550,streams=ground") == LinkSpec("udp", "192.168.1.5", 14550, streams="ground")
    assert LinkSpec.parse("serial:/dev/ttyUSB0,baud=57600") == LinkSpec("serial", path="/dev/ttyUSB0", baud=57600)
    poor = LinkSpec.parse("udp:14540,delay_ms=50,jitter_ms=10,loss=0.02,dup=0.01")
    assert poor.quality == LinkQuality(0.05, 0.01, 0.02, 0.01)


_REFUSED = (
    *("", "udp", "udp:", "udp:x", "udp:0", "udp:70000", "ipx:1", "serial:", "serial:/dev/ttyUSB0", "tcp:5760,baud=9600"),
    *("udp:14540,loss=2", "udp:14540,delay_ms=nan", "udp:14540,delay_ms=-1", "udp:14540,loss", "udp:14540,colour=red"),
    *("pty:,baud=12", "pty:,streams=all"),
)


@pytest.mark.parametrize("text", _REFUSED)
def test_descriptions_that_are_refused_say_what_to_write(text: str) -> None:
    with pytest.raises(LinkSpecError, match=r"--link '"):
        LinkSpec.parse(text)


def test_a_link_on_a_usual_port_takes_its_place_and_its_streams() -> None:
    poor, radio = LinkSpec.parse("udp:14550,loss=0.5"), LinkSpec.parse("pty:/tmp/radio,baud=57600")
    plan = link_plan(14540, 14550, [radio, poor])
    assert [(link.kind, link.port, link.streams, link.quality.loss) for link in plan] == [
        ("udp", 14540, "onboard", 0.0),
        ("udp", 14550, "ground", 0.5),
        ("pty", 0, "onboard", 0.0),
    ]
    elsewhere = LinkSpec.parse("udp:10.0.0.2:14540")
    assert link_plan(14540, 0, [elsewhere]) == [LinkSpec("udp", port=14540), elsewhere]


def test_links_of_further_vehicles_move_along() -> None:
    links = [LinkSpec.parse(text) for text in ("udp:14540,loss=0.1", "udp:14550,loss=0.2", "tcp:5760", "pty:/tmp/a.tty")]
    third = nth_links(links, 2, 14550)
    assert [link.port or link.path for link in third] == [14542, 14550, 5762, "/tmp/a-3.tty"]
    with pytest.raises(LinkSpecError, match="one vehicle only"):
        nth_links([LinkSpec.parse("serial:/dev/ttyUSB0,baud=9600")], 1, 0)


# ---- quality


def _through(quality: LinkQuality, seed: int, *, in_order: bool = False) -> list[tuple[int, float]]:
    """(message, when it leaves) of one message every 4 ms for 20 s."""
    conditions, left = LinkConditions(quality, seed, in_order=in_order), []
    for step in range(5000):
        left += [(message, 0.004 * step) for message in conditions.out(step, 0.004 * step)]
    return left + [(message, 21.0) for message in conditions.due_out(21.0)]


def test_loss_and_duplicates_in_their_share_and_the_same_for_a_seed() -> None:
    left = _through(LinkQuality(loss=0.1, duplicate=0.05), 1)
    assert len({message for message, _ in left}) == pytest.approx(4500, rel=0.03)
    assert len(left) == pytest.approx(4500 * 1.05, rel=0.03)
    assert left == _through(LinkQuality(loss=0.1, duplicate=0.05), 1)
    assert left != _through(LinkQuality(loss=0.1, duplicate=0.05), 2)


@settings(deadline=None)
@given(st.floats(0.0, 0.2), st.floats(0.0, 0.1), st.booleans())
def test_delay_and_jitter_stay_within_their_bounds(delay_s: float, jitter_s: float, in_order: bool) -> None:
    left = _through(LinkQuality(delay_s, jitter_s), 3, in_order=in_order)
    assert len(left) == 5000
    late = [when - 0.004 * message for message, when in left if when < 20.0]
    assert max(0.0, delay_s - jitter_s) - 1e-6 <= min(late)
    assert max(late) <= delay_s + jitter_s + 0.0041
    assert in_order <= (left == sorted(left))


def test_a_poor_udp_link_delays_both_ways_and_leaves_the_other_alone() -> None:
    ports = (free_port(), free_port())
    with _rig(f"udp:{ports[0]},delay_ms=100", f"udp:{ports[1]}") as rig:
        clients = []
        for port in ports:
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.bind(("127.0.0.1", port))
            sock.sendto(_ping(7).pack(mav.MAVLink(None, srcSystem=245, srcComponent=190)), ("127.0.0.1", port + 40))
            clients.append(Stream(sock.detach()))
        answered: dict[int, float] = {}

        def look() -> None:
            for index, client in enumerate(clients):
                client.drain()
                if client.pings():
                    answered.setdefault(index, rig.vehicle.time_s)

        rig.run(0.5, look)
    assert answered[1] < 0.02
    assert answered[0] == pytest.approx(0.2, abs=0.02)


# ---- TCP


def test_tcp_serves_several_clients_and_drops_only_the_one_that_never_reads() -> None:
    port = free_port()
    with _rig(f"tcp:{port}") as rig:
        deaf = socket.socket()
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(("127.0.0.1", port))
        (one, first), (two, second) = _tcp(port), _tcp(port)
        rig.run(0.1)
        first.send(mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 105, 1000, 0, 0, 0, 0, 0))
        for _ in range(200):
            rig.run(0.1, lambda: (first.drain(), second.drain()))
            if len(rig.links[0].watched()) == 3:
                break
        else:
            pytest.fail("the client that never reads is still there")
        one.close()
        rig.run(0.2, second.drain)
        assert len(rig.links[0].watched()) == 2
        assert len(second.named("HEARTBEAT")) >= 2
        assert second.named("COMMAND_ACK"), "all clients of a link are told the same"
        deaf.close()
        two.close()


def test_tcp_takes_frames_in_pieces_and_shrugs_off_garbage() -> None:
    port = free_port()
    with _rig(f"tcp:{port}") as rig:
        (good, client), (bad, _) = _tcp(port), _tcp(port)
        frame = _ping(42).pack(mav.MAVLink(None, srcSystem=245, srcComponent=190))
        broken = bytearray(frame)
        broken[-1] ^= 1
        rig.run(0.1)
        bad.sendall(os.urandom(5000) + bytes(broken) + frame[:9])
        bad.close()
        for byte in frame:
            good.sendall(bytes([byte]))
            rig.run(0.004, client.drain)
        rig.run(0.1, client.drain)
        assert client.pings() == [42]
        good.close()


def test_tcp_turns_away_a_ninth_client_and_listens_on_loopback_only() -> None:
    port = free_port()
    with _rig(f"tcp:{port}") as rig:
        assert rig.links[0].watched()[0].getsockname()[0] == "127.0.0.1"
        clients = [socket.create_connection(("127.0.0.1", port), timeout=5.0) for _ in range(9)]
        rig.run(0.1)
        assert len(rig.links[0].watched()) == 9
        with pytest.raises(PortInUseError, match="in use"):
            open_links([LinkSpec.parse(f"tcp:{port}")], lambda: 0.0, GatewayConfig())
        for client in clients:
            client.close()
    with _rig(f"tcp:0.0.0.0:{port}") as rig:
        assert rig.links[0].watched()[0].getsockname()[0] == "0.0.0.0"


def test_udp_stays_on_loopback_unless_another_host_is_named() -> None:
    near = UdpLink("near", free_port(), 14540, 0, lambda: 0.0)
    far = UdpLink("far", free_port(), 14540, 0, lambda: 0.0, host="10.1.2.3")
    assert near.socket.getsockname()[0] == "127.0.0.1"
    assert far.socket.getsockname()[0] == "0.0.0.0"
    heard = [far._is_heard(address) for address in ("10.1.2.3", "127.0.0.1", "10.1.2.4")]
    assert heard == [True, True, False]
    near.close()
    far.close()


# ---- serial lines


def test_a_slow_pseudo_terminal_carries_what_its_bit_rate_allows(tmp_path: Path) -> None:
    name = tmp_path / "radio"
    with _rig(f"pty:{name},baud=57600") as rig:
        assert ready_links(rig.links) == [f"serial:{os.path.realpath(name)}"]
        client = Stream(os.open(name, os.O_RDWR | os.O_NOCTTY))
        rig.run(5.0, client.drain)
        assert 0.8 * 5 * 5760 < client.bytes <= 5 * 5760 + 300
        assert len(client.named("HEARTBEAT")) in (4, 5, 6), "slow streams keep their rate, fast ones thin out"
        assert 5 < len(client.named("ATTITUDE")) < 100
        client.send(mav.MAVLink_param_request_read_message(1, 1, b"COM_OF_LOSS_T", -1))
        rig.run(0.5, client.drain)
        assert [message.param_id for message in client.named("PARAM_VALUE")] == ["COM_OF_LOSS_T"]
    assert not name.exists()


def test_all_parameters_come_over_a_slow_line_none_lost() -> None:
    with _rig("pty:,baud=115200") as rig:
        client = Stream(os.open(ready_links(rig.links)[0].removeprefix("serial:"), os.O_RDWR | os.O_NOCTTY))
        client.send(mav.MAVLink_param_request_list_message(1, 1))
        rig.run(30.0, client.drain)
        assert len({message.param_index for message in client.named("PARAM_VALUE")}) == 876


def test_what_a_client_writes_at_once_takes_its_time_too() -> None:
    with _rig("pty:,baud=9600") as rig:
        client = Stream(os.open(ready_links(rig.links)[0].removeprefix("serial:"), os.O_RDWR | os.O_NOCTTY))
        client.send(*[_ping(number) for number in range(50)])  # 19 bytes each without trailing zeros, or a little more
        rig.run(0.2, client.drain)
        early = max(client.pings())
        assert early < 15
        rig.run(3.0, client.drain)
        assert max(client.pings()) == 49


def test_a_serial_device_and_one_that_is_unplugged() -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    device = os.ttyname(theirs)
    port = free_port()
    with _rig(f"serial:{device},baud=921600", f"tcp:{port}") as rig:
        client = Stream(ours)
        client.send(_ping(3))
        rig.run(2.0, client.drain)
        assert client.pings() == [3]
        assert len(client.named("HEARTBEAT")) >= 1
        os.close(theirs)
        os.close(ours)
        sock, other = _tcp(port)
        rig.run(1.5, other.drain)
        assert other.named("HEARTBEAT"), "the others go on"
        sock.close()


def test_a_serial_device_that_is_not_there_opens_nothing() -> None:
    port = free_port()
    with pytest.raises(SerialPortError, match="cannot be opened"):
        open_links(
            [LinkSpec.parse(f"tcp:{port}"), LinkSpec.parse("serial:/dev/nothing_here,baud=9600")], lambda: 0.0, GatewayConfig()
        )
    open_links([LinkSpec.parse(f"tcp:{port}")], lambda: 0.0, GatewayConfig())[0].close()


@settings(deadline=None)
@given(st.lists(st.integers(1, 280), min_size=1, max_size=60), st.sampled_from([9600, 57600, 921600]))
def test_paced_messages_are_whole_in_order_and_never_early(sizes: list[int], baud: int) -> None:
    taken: list[bytes] = []
    writer = PacedWriter(lambda data: taken.append(data) or len(data), baud, longest_s=1e9)
    for index, size in enumerate(sizes):
        writer.send(bytes([index]) * size, 0.0)
    total = 0
    for step in range(0, 4000, 7):
        writer.flush(1e-3 * step)
        total = sum(map(len, taken))
        assert total <= 1e-3 * step * baud / 10 + 1e-6
    writer.flush(1e9)
    assert b"".join(taken) == b"".join(bytes([index]) * size for index, size in enumerate(sizes))


def test_a_writer_nobody_listens_to_stays_bounded() -> None:
    writer = PacedWriter(lambda _: 0, 921600)
    for step in range(20_000):
        writer.send(bytes(100), 0.004 * step)
    assert len(writer._waiting) <= 500
    assert writer.lost > 19_000


def test_a_reader_that_was_not_asked_for_long_brings_one_buffer_at_most() -> None:
    reader = PacedReader(bytes, 9600)
    assert reader.read(0.0) == b""
    assert len(reader.read(0.1)) == 96
    assert len(reader.read(1000.0)) == 4096


def test_the_vehicle_is_flown_over_a_slow_line_beside_a_perfect_one() -> None:
    """Arming over a 57,600 baud line with delay, while the other link hears its acknowledgement's effect."""
    port = free_port()
    with _rig("pty:,baud=57600,delay_ms=50", f"tcp:{port}") as rig:
        assert isinstance(rig.links[0], SerialLink)
        radio = Stream(os.open(ready_links(rig.links)[1].removeprefix("serial:"), os.O_RDWR | os.O_NOCTTY))
        sock, wire = _tcp(port)
        rig.run(1.0, lambda: (radio.drain(), wire.drain()))
        radio.send(mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0))
        rig.run(2.0, lambda: (radio.drain(), wire.drain()))
        assert [ack.result for ack in radio.named("COMMAND_ACK")] == [mav.MAV_RESULT_ACCEPTED]
        assert wire.named("HEARTBEAT")[-1].base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED
        sock.close()
