"""The LD06 emulator read by a decoder written here; beams cast when they fire; the line and the gateway around it."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav
from spinning_rig import hovering, room

from sim_gateway.gateway import Gateway, GatewayConfig
from sim_gateway.ld06 import LD06, STL27L, Ld06Device, crc8
from sim_gateway.obstacle_distance import UNKNOWN, obstacle_distance, sector_distances_cm
from sim_gateway.pty_port import PtyPort
from sim_gateway.readings import Scan
from sim_gateway.serial_lidar import SerialLidar
from sim_gateway.spinning import Shots, SpinConfig, SpinningScanner, millimetres

EXAMPLE = bytes.fromhex("542C6808AB7EE000E4DC00E2D900E5D500E3D300E4D000E9CD00E4CA00E2C700E9C500E5C200E5C000E5BE823A1A50")


def read_frames(data: bytes) -> list[dict[str, object]]:
    """The plain reading of the manual: no resynchronisation, every frame must be perfect."""
    assert len(data) % 47 == 0
    frames = []
    for k in range(0, len(data), 47):
        raw = data[k : k + 47]
        assert raw[:2] == b"\x54\x2c"
        speed, start = struct.unpack_from("<HH", raw, 2)
        end, stamp = struct.unpack_from("<HH", raw, 42)
        points = [struct.unpack_from("<HB", raw, 6 + 3 * i) for i in range(12)]
        frames.append({"speed": speed, "start": start / 100, "end": end / 100, "stamp": stamp, "points": points, "crc": raw[46]})
        assert crc8(raw[:46]) == raw[46]
    return frames


def shots(count: int, first: int = 0) -> Shots:
    index = np.arange(first, first + count)
    time_s = index / 4500.0
    return Shots(time_s, (3600.0 * time_s) % 360.0, 1.0 + 0.001 * (index % 1000))


def test_the_checksum_is_the_manuals() -> None:
    assert crc8(b"123456789") == 0xC3
    assert crc8(EXAMPLE[:46]) == EXAMPLE[46]


def test_frames_hold_twelve_shots_and_what_is_left_waits() -> None:
    device = Ld06Device()
    data = device.take(shots(30)) + device.take(shots(18, 30))
    frames = read_frames(data)
    assert len(frames) == 4
    assert frames[0]["speed"] == 3600
    assert frames[0]["start"] == 0.0
    assert frames[0]["end"] == pytest.approx(8.8)
    assert [mm for mm, _ in frames[3]["points"]] == list(range(1036, 1048))  # type: ignore[attr-defined]
    assert device.handle(b"anything") == b""


def test_the_clock_wraps_at_thirty_seconds() -> None:
    device = Ld06Device(clock_offset_s=29.999)
    stamps = [frame["stamp"] for frame in read_frames(device.take(shots(24)))]
    assert stamps == [int(29_999 + 1000 * 11 / 4500) % 30_000, int(29_999 + 1000 * 23 / 4500) % 30_000]


def test_no_return_is_zero_with_no_intensity() -> None:
    ranges = np.array([np.inf, 0.0, 1.2344, 99.0] + [1.0] * 8)
    frame = read_frames(Ld06Device().take(Shots(np.arange(12) / 4500.0, np.arange(12) * 0.8, ranges)))[0]
    assert frame["points"][:4] == [(0, 0), (0, 0), (1234, 200), (65_535, 200)]  # type: ignore[index]
    assert millimetres(np.array([np.nan, -1.0])).tolist() == [0, 0]


@pytest.mark.parametrize("config", [LD06, STL27L])
def test_the_room_is_where_it_is(config: SpinConfig) -> None:
    simulation, scanner = hovering(), SpinningScanner(config)
    seen: list[tuple[float, float]] = []
    for _ in range(25):
        simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
        fired = scanner.fire(simulation)
        seen += list(zip(fired.clockwise_deg, fired.range_m, strict=True))
    assert len(seen) == pytest.approx(config.points_per_s * 0.1, abs=1)
    angles, ranges = (np.array(column) for column in zip(*seen, strict=True))
    for clockwise, distance in {0.2: 6.0, 90.0: 3.0, 180.0: 4.0, 270.0: 2.0}.items():
        assert ranges[np.argmin(np.abs(angles - clockwise))] == pytest.approx(distance, abs=0.08), "clockwise: right is 90"


def test_each_beam_is_cast_when_it_fires() -> None:
    """Yawing, the far wall moves through the scan while it is taken: a snapshot would not show it."""
    simulation, scanner = hovering(), SpinningScanner(SpinConfig(noise_sigma_m=0.0))
    for _ in range(250):
        simulation.advance(1, (0.0, 0.0, 0.0), 1.0)
    scanner.fire(simulation)
    yaw_then, errors, snapshot_errors = [], [], []
    for _ in range(25):
        simulation.advance(1, (0.0, 0.0, 0.0), 1.0)
        fired, yaw = scanner.fire(simulation), simulation.truth.yaw_rad
        yaw_then.append(yaw)
        x, y, _ = simulation.truth.position_m
        for angle, reach in zip(np.radians(fired.clockwise_deg), fired.range_m, strict=True):
            for guess, found in ((yaw, errors), (yaw_then[0], snapshot_errors)):
                bearing = guess - angle
                place = np.array([x + reach * np.cos(bearing), y + reach * np.sin(bearing)])
                found.append(min(abs(place[0] - 6.0), abs(place[0] + 4.0), abs(place[1] - 2.0), abs(place[1] + 3.0)))
    assert max(errors) < 0.06, "tilt while it turns"
    assert max(snapshot_errors) > 0.2


def test_a_pause_loses_beams_instead_of_piling_them_up() -> None:
    simulation, scanner = hovering(), SpinningScanner(LD06)
    for _ in range(500):
        simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
    assert len(scanner.fire(simulation).time_s) == 450
    with pytest.raises(ValueError, match="cannot be simulated"):
        SpinConfig(turns_per_s=0.0)


def test_a_line_nobody_reads_loses_bytes_and_does_not_block(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    with PtyPort(link) as port:
        started_s = time.monotonic()
        for _ in range(100):
            port.write(bytes(1000))
        assert time.monotonic() - started_s < 1.0
        assert port.lost_bytes > 50_000  # the rest lies in the kernel, whose buffer differs between machines
        assert os.readlink(link) == port.path
        assert port.read() == b""
    assert not link.is_symlink()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(FileExistsError):
        PtyPort(tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_bytes_of_a_second_on_the_line_are_whole_frames() -> None:
    simulation, lidar = hovering(), SerialLidar("ld06")
    client = os.open(lidar.path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
    data = bytearray()
    try:
        for _ in range(250):
            simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
            lidar.advance(simulation)
            try:
                data += os.read(client, 4096)
            except BlockingIOError:
                continue
    finally:
        os.close(client)
        lidar.close()
    frames = read_frames(bytes(data))
    assert len(frames) == 375
    assert lidar.port.lost_bytes == 0


def test_sectors_of_obstacle_distance() -> None:
    ranges = np.full(361, np.inf, dtype=np.float32)
    ranges[180], ranges[0], ranges[360], ranges[190] = 1.5, 0.0, 3.999, 2.0  # ahead, right, left, 5 degrees left
    scan = Scan(7.5, ranges, -np.pi / 2, np.pi / 360, 0.1, 4.0)
    cm = sector_distances_cm(scan)
    assert (cm[0], cm[18], cm[54], cm[71], cm[1]) == (150, 0, 400, 200, 401)
    assert (cm[19:54] == UNKNOWN).all(), "it does not look behind"
    message = obstacle_distance(scan)
    packed = message.pack(mav.MAVLink(None))
    (back,) = mav.MAVLink(None).parse_buffer(packed)
    assert (back.frame, back.increment, back.increment_f, back.time_usec, back.max_distance) == (12, 5, 5.0, 7_500_000, 400)
    assert list(back.distances) == cm.tolist()


def test_the_gateway_offers_a_serial_lidar_beside_the_others(tmp_path: Path) -> None:
    link = tmp_path / "lidar"
    config = GatewayConfig(onboard_port=26_540, gcs_port=0, lidar_port=0, serial_lidar="ld06", serial_link=link)
    with Gateway(room(), config) as gateway:
        assert gateway.ready_message()["serial_lidar"] == os.readlink(link)
        client = os.open(link, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
        for _ in range(210):
            gateway.step()
        data = os.read(client, 4096)
        os.close(client)
        assert data[:2] == b"\x54\x2c"
        assert not gateway.telemetry.available("HEARTBEAT")
        assert gateway.telemetry.available("OBSTACLE_DISTANCE")
        assert gateway.telemetry.build("OBSTACLE_DISTANCE").distances[0] == 401
    assert not link.exists()


def test_the_command_line_knows_it(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("x")
    command = [sys.executable, "-m", "sim_gateway", "--world", "configs/worlds/corridor.yaml", "--serial-lidar", "ld06",
               "--onboard-port", "26560", "--gcs-port", "0", "--lidar-port", "0"]  # fmt: skip
    refused = subprocess.run([*command, "--serial-link", str(tmp_path / "mine")], capture_output=True, text=True, timeout=120,
                             check=False)  # fmt: skip
    assert refused.returncode == 2
    assert "--serial-link" in refused.stderr.splitlines()[-1]
    running = subprocess.run([*command, "--max-time", "0.1"], capture_output=True, text=True, timeout=120, check=False)
    assert running.returncode == 0
    assert json.loads(running.stdout.splitlines()[0])["serial_lidar"].startswith("/dev/")
