"""PX4's own log over the real MAVSDK: from a small vehicle that speaks the log messages (whole, none, silent, stalled), and
from the gateway after a flight.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from air import open_air
from pymavlink.dialects.v20 import common as mavlink
from pyulog import ULog
from stand import free_port

from flight.link import VehicleLink
from flight.px4_log import FILE_NAME, fetch_px4_log

LOG = bytes((7 * k + k // 251) % 256 for k in range(20_000))
PIECE = 90


@dataclass
class Stop:
    count: int = 0


@dataclass
class LogVehicle:
    """A vehicle with one log of `LOG`. `silent`: answers no request. `empty`: has no log. `stalls`: stops halfway, once."""

    port: int
    silent: bool = False
    empty: bool = False
    stalls: bool = False
    _end: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        self._wire = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._wire.robust_parsing = True
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as self._socket:
            self._socket.settimeout(0.02)
            next_beat = 0.0
            while not self._end.is_set():
                if time.monotonic() >= next_beat:
                    next_beat = time.monotonic() + 0.5
                    self._send(mavlink.MAVLink_heartbeat_message(2, 12, 81, 0x03040000, 3, 3))
                try:
                    data = self._socket.recv(2048)
                except TimeoutError:
                    continue
                for message in self._wire.parse_buffer(data) or ():
                    self._answer(message)

    def _send(self, message: mavlink.MAVLink_message) -> None:
        self._socket.sendto(message.pack(self._wire), ("127.0.0.1", self.port))

    def _answer(self, message: mavlink.MAVLink_message) -> None:
        if self.silent:
            return
        if message.get_type() == "LOG_REQUEST_LIST":
            count = 0 if self.empty else 1
            self._send(mavlink.MAVLink_log_entry_message(0, count, 0, 1_700_000_000, len(LOG) * count))
        elif message.get_type() == "LOG_REQUEST_DATA":
            end = min(message.ofs + message.count, len(LOG))
            for start in range(message.ofs, end, PIECE):
                if self.stalls and start > len(LOG) // 2:
                    return
                data = LOG[start : min(start + PIECE, end)]
                self._send(mavlink.MAVLink_log_data_message(0, start, len(data), list(data.ljust(PIECE, b"\0"))))
                time.sleep(0.0005)


@pytest.fixture
def port() -> int:
    return free_port(socket.SOCK_DGRAM)


@pytest.fixture
def vehicle(port: int, request: pytest.FixtureRequest) -> Iterator[LogVehicle]:
    made = LogVehicle(port, **getattr(request, "param", {}))
    yield made
    made.stop()


def fetch(port: int, folder: Path, stop: Stop, list_deadline_s: float = 10.0) -> str:
    with VehicleLink(f"udpin://127.0.0.1:{port}") as link:
        link.connect(10.0)
        return fetch_px4_log(link.system, folder, stop, list_deadline_s)


def test_the_newest_log_is_fetched_byte_for_byte(vehicle: LogVehicle, port: int, tmp_path: Path) -> None:
    line = fetch(port, tmp_path, Stop())
    assert line == f"PX4 log: {tmp_path / FILE_NAME} ({len(LOG)} bytes)"
    assert (tmp_path / FILE_NAME).read_bytes() == LOG


@pytest.mark.parametrize("vehicle", [{"empty": True}, {"silent": True}], indirect=True)
def test_no_log_is_one_line(vehicle: LogVehicle, port: int, tmp_path: Path) -> None:
    begin = time.monotonic()
    line = fetch(port, tmp_path, Stop(), list_deadline_s=3.0)
    assert line.startswith("no PX4 log: ")
    assert "\n" not in line
    assert time.monotonic() - begin < 20.0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("vehicle", [{"stalls": True}], indirect=True)
def test_a_signal_ends_a_stalled_download(vehicle: LogVehicle, port: int, tmp_path: Path) -> None:
    stop = Stop()
    threading.Timer(4.0, lambda: setattr(stop, "count", 1)).start()
    begin = time.monotonic()
    line = fetch(port, tmp_path, stop)
    assert line.startswith("no PX4 log: download failed (stopped by a signal)"), "MAVSDK's last callback was waited for"
    assert time.monotonic() - begin < 20.0
    assert not (tmp_path / FILE_NAME).exists()


@pytest.mark.realtime
@pytest.mark.timeout(120)
def test_the_gateways_log_of_a_flight_is_fetched_and_opens(tmp_path: Path, seeker_policy: Path) -> None:
    with open_air(tmp_path, seeker_policy) as air:
        air.link.arm()
        air.link.take_off(1.2)
        air.wait(lambda: air.gateway.vehicle.simulation.truth.position_m[2] > 1.0, 20.0)
        air.autopilot.land()
        air.wait(lambda: not air.autopilot.armed, 30.0)
        line = fetch_px4_log(air.link.system, tmp_path, Stop())
    assert line.startswith(f"PX4 log: {tmp_path / FILE_NAME} ("), line
    log = ULog(str(tmp_path / FILE_NAME))
    assert not log.file_corruption
    assert log.get_dataset("vehicle_local_position").data["z"].min() < -1.0
    assert {17, 18} <= set(log.get_dataset("vehicle_status").data["nav_state"])
