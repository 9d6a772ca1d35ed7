"""The RPLIDAR emulator against an independent client (rplidar-roboticia over a pseudo-terminal), and by its bytes."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
import pytest
import rplidar as roboticia
from spinning_rig import RealTime

from sim_gateway.rplidar import A1, MODES, RplidarDevice
from sim_gateway.serial_lidar import SerialLidar
from sim_gateway.spinning import Shots

ROOM = {0: 6.0, 90: 3.0, 180: 4.0, 270: 2.0}


class Client(roboticia.RPLidar):
    """The published client, but for its motor line: a pseudo-terminal has no DTR."""

    def start_motor(self) -> None:
        self.motor_running = True

    def stop_motor(self) -> None:
        self.motor_running = False


@pytest.fixture
def client() -> Iterator[Client]:
    with RealTime(SerialLidar("rplidar")) as rig:
        one = Client(rig.lidar.path, timeout=3)
        yield one
        one.stop()
        one.disconnect()


def test_the_published_client_reads_info_and_health(client: Client) -> None:
    info = client.get_info()
    assert (info["model"], tuple(info["firmware"]), info["hardware"]) == (0x18, (1, 29), 7)
    assert info["serialnumber"] == bytes(range(16)).hex().upper()
    assert client.get_health() == ("Good", 0)


def test_the_published_client_sees_the_room_in_standard_scans(client: Client) -> None:
    scans = client.iter_scans(min_len=100)
    for _ in range(3):
        scan = next(scans)
    assert len(scan) == pytest.approx(800, abs=20)
    angles, ranges = np.array([m[1] for m in scan]), np.array([m[2] for m in scan]) / 1000.0
    for clockwise, distance in ROOM.items():
        away = np.abs(np.remainder(angles - clockwise + 180.0, 360.0) - 180.0)
        assert ranges[np.argmin(away)] == pytest.approx(distance, abs=0.15), "clockwise: right is 90"


def test_the_published_client_sees_the_room_in_express_scans() -> None:
    lidar = SerialLidar("rplidar")
    lidar.device = RplidarDevice(A1, firmware=(1, 20))
    with RealTime(lidar) as rig:
        one = Client(rig.lidar.path, timeout=3)
        seen: dict[int, float] = {}
        for count, (_, _, angle, distance) in enumerate(one.iter_measures(scan_type="express")):
            if round(angle) % 360 in ROOM and distance > 0:
                seen[round(angle) % 360] = distance / 1000.0
            if count > 2400:
                break
        one.stop()
        one.disconnect()
    assert seen == pytest.approx(ROOM, abs=0.15)


# -- by its bytes ---------------------------------------------------------------------------------------------------


def asked(device: RplidarDevice, *pieces: str) -> str:
    return b"".join(device.handle(bytes.fromhex(piece)) for piece in pieces).hex().upper()


def conf(key: int, mode: int | None = None) -> bytes:
    body = struct.pack("<I", key) + (struct.pack("<H", mode) if mode is not None else b"")
    raw = bytes([0xA5, 0x84, len(body)]) + body
    check = 0
    for byte in raw:
        check ^= byte
    return raw + bytes([check])


def shots(count: int, first: int = 0) -> Shots:
    time_s = np.arange(first, first + count) / 8000.0
    return Shots(time_s, (3600.0 * time_s) % 360.0, 1.0 + 0.001 * np.arange(count))


def test_descriptors_are_the_published_ones() -> None:
    assert asked(RplidarDevice(), "A520").startswith("A55A0500004081")
    assert asked(RplidarDevice(), "A552") == "A55A0300000006" + "000000"
    assert asked(RplidarDevice(), "A550").startswith("A55A1400000004")
    assert asked(RplidarDevice(), "A559") == "A55A0400000015" + "7D007D00"
    assert asked(RplidarDevice(), "A5820502000000" + "00" + "20") == "A55A5400004085"


def test_requests_in_pieces_and_among_rubbish() -> None:
    device = RplidarDevice()
    assert asked(device, "00FFA5", "52") == asked(RplidarDevice(), "A552")
    assert asked(device, "A58205020000", "0000", "20") == "A55A5400004085"
    assert asked(RplidarDevice(), "A582050200000000" + "21") == "", "wrong checksum"
    assert asked(RplidarDevice(), "A5" * 5000) == ""


def test_it_tells_its_modes_only_when_the_firmware_can() -> None:
    device = RplidarDevice()
    assert device.handle(conf(0x70))[7:] == struct.pack("<IH", 0x70, len(MODES))
    assert [device.handle(conf(0x75, k))[-1] for k in range(3)] == [0x81, 0x82, 0x85]
    assert device.handle(conf(0x71, 1))[11:] == struct.pack("<I", 125 * 256)
    assert device.handle(conf(0x74, 1))[11:] == struct.pack("<I", 12 * 256)
    assert device.handle(conf(0x7C))[11:] == struct.pack("<H", 2)
    assert device.handle(conf(0x7F, 1))[11:] == b"Express\0"
    assert device.handle(conf(0x75, 9)) == b""
    assert RplidarDevice(firmware=(1, 20)).handle(conf(0x70)) == b""


def test_stop_reset_and_a_broken_device() -> None:
    device = RplidarDevice()
    asked(device, "A520")
    assert device.scanning
    assert len(device.take(shots(10))) == 50
    asked(device, "A525")
    assert device.take(shots(10)) == b""
    asked(device, "A520")
    assert b"RP LIDAR" in device.handle(b"\xa5\x40")
    assert not device.scanning
    sick = RplidarDevice(health=2)
    assert asked(sick, "A520") == ""
    assert asked(sick, "A552").endswith("020180")


def test_capsules_have_their_checksum_and_mark_the_first() -> None:
    for mode, per_capsule in ((1, 32), (2, 40)):
        device = RplidarDevice()
        body = bytes([0xA5, 0x82, 5, mode, 0, 0, 0, 0])
        check = 0
        for byte in body:
            check ^= byte
        device.handle(body + bytes([check]))
        data = device.take(shots(100))
        assert len(data) == 84 * (100 // per_capsule)
        for k in range(0, len(data), 84):
            capsule = data[k : k + 84]
            total = 0
            for byte in capsule[2:]:
                total ^= byte
            assert (capsule[0] & 0xF) | (capsule[1] & 0xF) << 4 == total
            assert (capsule[0] >> 4, capsule[1] >> 4) == (0xA, 0x5)
            assert bool(capsule[3] & 0x80) == (k == 0)
        first = struct.unpack_from("<H", data, 4)[0]
        assert (first >> 2 if mode == 1 else first) == 1000
