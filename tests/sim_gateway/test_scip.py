"""The SCIP emulator against an independent client (hokuyolx), and by raw sockets: framing, states, errors, abuse."""

import contextlib
import math
import socket
import threading
import time

import hokuyolx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_gateway.scip import ScipServer, ScipServerError
from sim_gateway.scip_device import MAX_LINE, ScipDevice, ScipGeometry, checksum, encode

GEOMETRY = ScipGeometry()
RANGES = np.linspace(0.5, 3.5, GEOMETRY.steps)
DEADLINE_S = 5.0
FULL = b"0180054001"


class Clock:
    def __init__(self, time_s=12.345):
        self.time_s = time_s

    def __call__(self):
        return self.time_s


class Client:
    """A raw socket with deadlines that reads message by message."""

    def __init__(self, port):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S)
        self.buffer = b""

    def send(self, data):
        self.socket.sendall(data)

    def message(self):
        while b"\n\n" not in self.buffer:
            data = self.socket.recv(4096)
            if not data:
                raise ConnectionError("closed by the device")
            self.buffer += data
        message, _, self.buffer = self.buffer.partition(b"\n\n")
        return message.split(b"\n")

    def ask(self, line):
        self.send(line + b"\n")
        return self.message()

    def closed(self):
        try:
            while self.socket.recv(65536):
                pass
        except ConnectionResetError:
            pass
        return True


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def server(clock):
    with ScipServer(clock, port=0) as server:
        yield server


@pytest.fixture
def client(server):
    client = Client(server.port)
    yield client
    client.socket.close()


def until(condition):
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "condition not reached in time"
        time.sleep(0.005)


def number(text):
    value = 0
    for byte in text:
        value = value * 64 + byte - 0x30
    return value


def scan_of(lines, characters=3):
    """(timestamp ms, values) of the checked data lines of a scan message."""
    bodies = []
    for line in lines:
        assert line[-1:] == checksum(line[:-1])
        bodies.append(line[:-1])
    assert all(len(body) == 64 for body in bodies[1:-1])
    stream = b"".join(bodies[1:])
    return number(bodies[0]), [number(stream[i : i + characters]) for i in range(0, len(stream), characters)]


@contextlib.contextmanager
def spinning(server, clock, ranges=RANGES):
    """Publishes at 20 Hz on the wall clock, as a gateway does."""
    stopped = threading.Event()

    def turn():
        started = time.monotonic() - clock.time_s
        while not stopped.wait(0.05):
            clock.time_s = time.monotonic() - started
            server.publish(clock.time_s, ranges)

    thread = threading.Thread(target=turn)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join(DEADLINE_S)


class TestEncoding:
    @pytest.mark.parametrize(("value", "characters", "text"), [(1234, 2, b"CB"), (5432, 3, b"1Dh"), (16_000_000, 4, b"m2@0")])
    def test_published_vectors(self, value, characters, text):
        assert encode(np.array([value]), characters) == text

    @pytest.mark.parametrize(("line", "character"), [(b"00", b"P"), (b"99", b"b"), (b"02", b"R"), (b"0E", b"e")])
    def test_published_checksums(self, line, character):
        assert checksum(line) == character

    @given(st.lists(st.integers(0, 2**18 - 1), min_size=1, max_size=50))
    def test_three_characters_carry_eighteen_bits(self, values):
        text = encode(np.array(values), 3)
        assert [number(text[i : i + 3]) for i in range(0, len(text), 3)] == values


class TestRanges:
    def test_metres_to_millimetres_and_codes(self):
        ranges = np.full(361, 1.2344)
        ranges[:8] = math.inf, 0.0, math.nan, 0.05, 4.0, 4.01, 0.1, -1.0
        codes = GEOMETRY.codes(ranges)
        assert codes[:9].tolist() == [1, 2, 5, 2, 4000, 1, 100, 2, 1234]

    def test_wrong_number_of_steps_is_refused(self):
        with pytest.raises(ValueError, match="361 steps"):
            GEOMETRY.codes(np.zeros(180))

    def test_bearings_run_from_right_to_left(self):
        bearings = GEOMETRY.bearings_rad()
        assert (bearings[0], bearings[180], bearings[360]) == pytest.approx((-math.pi / 2, 0.0, math.pi / 2))


def reply(device, line):
    message = device.handle(line)
    assert message.endswith(b"\n\n")
    assert message.startswith(line[:MAX_LINE] + b"\n")
    status = message.split(b"\n")[1]
    assert status[2:] == checksum(status[:2])
    return status[:2]


class TestStates:
    @pytest.fixture
    def device(self):
        device = ScipDevice(Clock())
        device.new_scan(1.0, GEOMETRY.codes(RANGES))
        return device

    def test_laser_on_twice_then_quit(self, device):
        assert [reply(device, line) for line in (b"BM", b"BM", b"QT", b"QT", b"BM")] == [b"00", b"02", b"00", b"00", b"00"]
        assert device.state == "single"

    def test_single_scan_needs_the_laser(self, device):
        assert reply(device, b"GD" + FULL) == b"10"
        reply(device, b"BM")
        assert reply(device, b"GD" + FULL) == b"00"

    def test_single_scan_before_the_first_turn_is_unstable(self):
        device = ScipDevice(Clock())
        reply(device, b"BM")
        assert reply(device, b"GS" + FULL) == b"0M"

    def test_time_adjustment(self, device):
        statuses = [
            reply(device, line) for line in (b"TM1", b"TM2", b"TM0", b"TM0", b"TM1", b"PP", b"BM", b"MD018005400000", b"TM7")
        ]
        assert statuses == [b"04", b"03", b"00", b"02", b"00", b"10", b"10", b"0H", b"01"]
        assert reply(device, b"MD" + FULL + b"000") == b"10"
        assert [reply(device, b"TM2"), reply(device, b"PP")] == [b"00", b"00"]
        reply(device, b"BM")
        assert reply(device, b"TM0") == b"10"

    def test_counted_stream_counts_down_and_returns(self, device):
        assert reply(device, b"MD" + FULL + b"002") == b"00"
        assert device.state == "multi"
        codes = GEOMETRY.codes(RANGES)
        assert device.new_scan(2.0, codes).startswith(b"MD" + FULL + b"001\n99b\n")
        assert device.new_scan(2.1, codes).startswith(b"MD" + FULL + b"000\n99b\n")
        assert device.new_scan(2.2, codes) == b""
        assert device.state == "standby"

    def test_skip_and_replacement_and_user_string(self, device):
        codes = GEOMETRY.codes(RANGES)
        reply(device, b"MD" + FULL + b"100")
        assert [bool(device.new_scan(t, codes)) for t in (1.0, 2.0, 3.0, 4.0)] == [False, True, False, True]
        assert reply(device, b"MS0300031001000;hello") == b"00"
        assert device.new_scan(5.0, codes).startswith(b"MS0300031001000;hello\n99b\n")

    def test_reset_stops_and_zeroes_the_timer(self):
        clock = Clock(50.0)
        device = ScipDevice(clock)
        reply(device, b"MD" + FULL + b"000")
        assert reply(device, b"RS") == b"00"
        assert device.state == "standby"
        reply(device, b"TM0")
        clock.time_s = 51.5
        assert number(device.handle(b"TM1").split(b"\n")[2][:4]) == 1500

    def test_timer_wraps_at_24_bits(self):
        clock = Clock(2**24 / 1000.0 + 0.007)
        device = ScipDevice(clock)
        reply(device, b"TM0")
        assert number(device.handle(b"TM1").split(b"\n")[2][:4]) == 7

    @pytest.mark.parametrize(
        ("line", "status"),
        [
            (b"XX", b"0E"), (b"\x00\xff", b"0E"), (b"B", b"0E"), (b"%SX", b"0E"), (b"bm", b"0E"), (b"SS019200", b"0F"),
            (b"BM1", b"0D"), (b"GD01800540", b"0H"), (b"GD018005400100", b"0D"), (b"BM;" + b"a" * 17, b"0G"),
            (b"BM;" + b"a" * 16, b"00"),
            (b"MDx180054001000", b"01"), (b"MD0180x54001000", b"02"), (b"MD01800540x1000", b"03"), (b"MD0179054001000", b"04"),
            (b"MD0180054101000", b"04"), (b"MD0300020001000", b"05"), (b"MD0180054001x00", b"06"), (b"MD01800540010x0", b"07"),
            (b"MD-180054001000", b"01"),
        ],
    )  # fmt: skip
    def test_refusals(self, device, line, status):
        assert reply(device, line) == status

    def test_overlong_request_is_cut(self, device):
        message = device.handle(b"VV" * 1000)
        assert message.split(b"\n")[:2] == [(b"VV" * 1000)[:MAX_LINE], b"0D" + checksum(b"0D")]

    @given(st.binary(min_size=1, max_size=80).filter(lambda line: b"\n" not in line))
    def test_any_line_gets_one_bounded_reply(self, line):
        device = ScipDevice(Clock())
        device.new_scan(0.0, GEOMETRY.codes(RANGES))
        message = device.handle(line)
        assert message.endswith(b"\n\n")
        assert message[:-1].count(b"\n\n") == 0
        assert len(message) < 2000

    @given(st.integers(180, 540), st.integers(180, 540), st.integers(0, 99))
    def test_groups_report_the_nearest_echo(self, a, b, group):
        start, end = min(a, b), max(a, b)
        device = ScipDevice(Clock())
        ranges = RANGES.copy()
        ranges[::3] = math.inf
        ranges[5:90] = 0.0
        codes = GEOMETRY.codes(ranges)
        device.new_scan(0.0, codes)
        reply(device, b"BM")
        lines = device.handle(b"GD%04d%04d%02d" % (start, end, group)).split(b"\n")
        _, values = scan_of(lines[2:-2])
        part, size = codes[start - 180 : end - 180 + 1], max(1, group)
        assert len(values) == math.ceil(len(part) / size)
        for i, value in enumerate(values):
            piece = part[i * size : (i + 1) * size]
            echoes = piece[piece >= 100]
            assert value == (echoes.min() if len(echoes) else piece.min())


class TestSocket:
    def test_information_and_checksums(self, client):
        for command, count in ((b"VV", 5), (b"PP", 8), (b"II", 7)):
            lines = client.ask(command)
            assert lines[:2] == [command, b"00P"]
            assert len(lines) == 2 + count
            assert all(line[-2:] == b";" + checksum(line[:-2]) for line in lines[2:])
        values = dict(line[:-2].decode().split(":") for line in client.ask(b"PP")[2:])
        assert {
            "DMIN": "100",
            "DMAX": "4000",
            "ARES": "720",
            "AMIN": "180",
            "AMAX": "540",
            "AFRT": "360",
            "SCAN": "1200",
        }.items() <= values.items()

    @pytest.mark.parametrize(("command", "characters"), [(b"MD", 3), (b"MS", 2)])
    def test_stream_carries_the_scan(self, server, client, command, characters):
        assert client.ask(command + FULL + b"000") == [command + FULL + b"000", b"00P"]
        for i in range(3):
            server.publish(20.0 + 0.05 * i, RANGES)
            lines = client.message()
            assert lines[:2] == [command + FULL + b"000", b"99b"]
            stamp, values = scan_of(lines[2:], characters)
            assert stamp == 20_000 + 50 * i
            assert values == GEOMETRY.codes(RANGES).tolist()

    def test_quit_ends_the_stream(self, server, client):
        client.ask(b"MD" + FULL + b"000")
        server.publish(1.0, RANGES)
        client.message()
        assert client.ask(b"QT") == [b"QT", b"00P"]
        server.publish(1.1, RANGES)
        assert client.ask(b"%ST") == [b"%ST", b"00P", b"000" + checksum(b"000")]

    def test_bytes_split_anywhere(self, client):
        for i in range(4):
            client.send(b"VV\n"[i : i + 1] if i < 3 else b"")
            time.sleep(0.02)
        assert client.message()[0] == b"VV"

    def test_two_commands_in_one_packet_and_crlf(self, client):
        client.send(b"BM\nQT\r\n\n\r\n%ST\n")
        assert [client.message()[0] for _ in range(3)] == [b"BM", b"QT", b"%ST"]

    def test_garbage_then_sense(self, client):
        client.send(bytes(range(11, 256)) + b"\n")
        assert client.message()[-1][:2] == b"0D"
        client.send(b"\xff\x00\n")
        assert client.message()[-1] == b"0Ee"
        assert client.ask(b"BM")[1] == b"00P"

    def test_endless_line_is_bounded(self, server, client):
        for _ in range(50):
            client.send(b"A" * 10_000)
        until(lambda: server.client is not None and len(server.client._line) == MAX_LINE + 1)
        client.send(b"\n")
        assert client.message() == [b"A" * MAX_LINE, b"0Dd"]

    def test_second_client_is_turned_away_and_the_first_goes_on(self, server, client):
        assert client.ask(b"BM")[1] == b"00P"
        second = Client(server.port)
        assert second.closed()
        second.socket.close()
        assert client.ask(b"%ST")[2][:3] == b"003"

    def test_abrupt_close_frees_the_device(self, server, client):
        client.ask(b"MD" + FULL + b"000")
        client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")  # close with RST
        client.socket.close()
        server.publish(1.0, RANGES)
        until(lambda: server.client is None)
        again = Client(server.port)
        assert again.ask(b"%ST")[2][:3] == b"000"
        again.socket.close()

    def test_reconnects_at_once_after_closing(self, server):
        for _ in range(20):
            one = Client(server.port)
            assert one.ask(b"BM")[1] == b"00P"
            one.socket.close()

    @pytest.mark.parametrize("reads", [True, False])
    def test_only_a_client_that_never_reads_is_dropped(self, server, reads):
        client = Client(server.port)
        client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.ask(b"MD" + FULL + b"000")
        for i in range(600):
            server.publish(0.05 * i, RANGES)
            if reads:
                client.message()
            elif server.client is None:
                break
            time.sleep(0.001)
        if reads:
            assert client.ask(b"VV")[1] == b"00P"
        else:
            until(lambda: server.client is None)
        client.socket.close()

    def test_port_in_use_is_said(self, server, clock):
        with pytest.raises(ScipServerError, match=f"{server.port} on 127.0.0.1 is in use"):
            ScipServer(clock, port=server.port).start()

    def test_impossible_port_is_said(self, clock):
        with pytest.raises(ScipServerError, match="99999"):
            ScipServer(clock, port=99_999).start()

    def test_stop_twice_publish_after_and_port_free_again(self, clock):
        server = ScipServer(clock, port=0)
        with pytest.raises(ScipServerError, match="call start"):
            _ = server.port
        server.publish(0.0, RANGES)
        server.start()
        held = Client(server.port)
        assert held.ask(b"VV")[1] == b"00P"
        server.stop()
        server.stop()
        server.publish(1.0, RANGES)
        assert held.closed()
        held.socket.close()
        with ScipServer(clock, port=server.port) as successor:
            assert successor.port == server.port


class OneMessageAtATime(hokuyolx.HokuyoLX):
    """Works round its reader: it splits on whatever one `recv` returned, and loops for ever when the peer closes."""

    def _recv(self, header=None):
        deadline = time.monotonic() + DEADLINE_S
        pending = getattr(self, "_pending", b"")
        while True:
            assert time.monotonic() < deadline
            while b"\n\n" not in pending:
                data = self._sock.recv(self.buf)
                assert data, "device closed the connection"
                pending += data
            message, _, pending = pending.partition(b"\n\n")
            self._pending = pending
            lines = message.decode("ascii").split("\n")
            if header is None or lines[0] == header:
                return lines


class TestIndependentClient:
    def test_reads_information_time_and_scans(self, server, clock):
        server.publish(clock.time_s, RANGES)
        with spinning(server, clock):
            laser = OneMessageAtATime(addr=("127.0.0.1", server.port), tsync=False, convert_time=False)
            try:
                assert (laser.amin, laser.amax, laser.aforw, laser.ares, laser.scan_freq) == (180, 540, 360, 720, 20)
                assert laser.version()["PROT"] == "SCIP 2.2"
                assert laser.laser_state() == (3, "Single scan state")
                stamp, scan = laser.get_dist()
                assert abs(stamp / 1000.0 - clock.time_s) < 0.5
                assert scan.tolist() == GEOMETRY.codes(RANGES).tolist()
                scans = list(laser.iter_dist(scans=5))
                assert [pending for _, _, pending in scans] == [4, 3, 2, 1, 0]
                gaps = np.diff([stamp for _, stamp, _ in scans])
                assert ((gaps >= 45) & (gaps <= 200)).all()
                laser.standby()
                assert laser.tsync_enter()[0] == "00"
                assert abs(laser.tsync_get() / 1000.0 - clock.time_s) < 0.5
                assert laser.tsync_exit()[0] == "00"
                laser.reset()
                assert laser.laser_state()[0] == 0
            finally:
                laser.close()
