"""The spinning LiDARs' drivers on a serial line: a peer that behaves, one that does not, and the gateway's emulators."""

from __future__ import annotations

import builtins
import math
import os
import random
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from lidar_waits import next_scan, until
from spinning_heads import Ld06Head, RplidarHead
from spinning_peers import SerialPeer

from flight.lidar import BodyMotion, LidarDriver, LidarSource, open_lidar
from flight.lidar.serial_port import SerialTransport
from flight.lidar.transport import TransportError
from safety.messages import LidarScan

QUICK = {"reply_timeout_s": 0.4, "stall_timeout_s": 0.4, "reconnect_min_s": 0.02, "reconnect_max_s": 0.1}


def source(driver: str, peer: SerialPeer, **changes: object) -> LidarSource:
    return LidarSource.model_validate({"driver": driver, "device": peer.path, **QUICK, **changes})


@pytest.fixture
def peer() -> Iterator[SerialPeer]:
    with SerialPeer() as running:
        yield running


def at(scan: LidarScan, bearing_deg: float) -> float:
    bearings = scan.angle_min_rad + scan.angle_increment_rad * np.arange(scan.ranges_m.size)
    return float(scan.ranges_m[np.argmin(np.abs(bearings - math.radians(bearing_deg)))])


def test_ld06_scans_arrive_with_left_and_right_in_place(peer: SerialPeer) -> None:
    peer.stream(Ld06Head(), 0.01)
    with open_lidar(source("ld06", peer)) as driver:
        for _ in range(10):
            scan = next_scan(driver)
        health = driver.health()
    assert at(scan, -90.0) == pytest.approx(1.0)
    assert at(scan, 90.0) == pytest.approx(3.0)
    assert (health.model, health.reconnects) == ("LD06", 0)
    assert health.bad_checksums <= 1, "the line may be opened within a frame"
    assert health.rate_hz == pytest.approx(20.0, rel=0.2)
    assert 0.0 < health.age_s < 0.25


def test_ld06_age_is_the_device_clocks_not_the_arrivals(peer: SerialPeer) -> None:
    """A line that becomes 60 ms slower: the device's clock tells, for seconds, that the scans are older than their arrival."""
    head = Ld06Head()
    held: list[tuple[float, bytes]] = []
    delay_s = [0.0]

    def late(data: bytes) -> bytes:
        held.append((time.monotonic(), data))
        sent = b""
        while held and held[0][0] <= time.monotonic() - delay_s[0]:
            sent += held.pop(0)[1]
        return sent

    head.garble = late
    peer.stream(head, 0.01)

    def ages(driver: LidarDriver) -> list[float]:
        return [-next_scan(driver).time_s + time.monotonic() for _ in range(12)]

    with open_lidar(source("ld06", peer)) as driver:
        before = ages(driver)
        delay_s[0] = 0.06
        ages(driver)
        after = ages(driver)
    assert 0.045 < np.median(after) - np.median(before) < 0.075


def test_ld06_damage_is_counted_and_never_shown(peer: SerialPeer) -> None:
    rng = random.Random(4)

    def damage(data: bytes) -> bytes:
        broken = bytearray(data)
        if broken:
            broken[rng.randrange(len(broken))] ^= 0x08
        return bytes(broken)

    head = Ld06Head(lambda angle: 2000)
    head.garble = damage
    peer.stream(head, 0.01)
    with open_lidar(source("ld06", peer)) as driver:
        for _ in range(12):
            scan = next_scan(driver)
            measured = scan.ranges_m[~np.isnan(scan.ranges_m)]
            assert (measured == np.float32(2.0)).all()
        health = driver.health()
    assert health.bad_checksums >= 10
    assert health.reconnects == 0


def test_a_stall_is_named_and_ends_in_a_new_connection(peer: SerialPeer) -> None:
    head = Ld06Head()
    peer.stream(head, 0.01)
    with open_lidar(source("ld06", peer)) as driver:
        before = next_scan(driver)
        head.silent = True
        assert until(lambda: not driver.health().connected)
        assert "no full turn" in driver.health().last_error
        head.silent = False
        after = next_scan(driver)
        assert driver.health().reconnects >= 1
    assert after.time_s > before.time_s + 0.3


def test_the_wrong_baud_rate_is_suggested(peer: SerialPeer) -> None:
    rng = random.Random(8)
    peer.stream(lambda: rng.randbytes(200), 0.01)
    with open_lidar(source("ld06", peer)) as driver:
        assert until(lambda: "unreadable" in driver.health().last_error)
        assert driver.latest() is None


def test_a_port_that_vanishes_is_waited_for() -> None:
    gone = SerialPeer()
    gone.stream(Ld06Head(), 0.01)
    link = f"/tmp/lidar-test-{os.getpid()}"
    os.symlink(gone.path, link)
    try:
        config = LidarSource.model_validate({"driver": "ld06", "device": link, **QUICK})
        with open_lidar(config) as driver:
            next_scan(driver)
            gone.close()
            assert until(lambda: not driver.health().connected)
            os.unlink(link)
            assert until(lambda: "no LiDAR at" in driver.health().last_error)
            with SerialPeer() as back:
                back.stream(Ld06Head(), 0.01)
                os.symlink(back.path, link)
                assert until(lambda: driver.health().connected)
                next_scan(driver)
            assert driver.health().reconnects >= 1
    finally:
        if os.path.lexists(link):
            os.unlink(link)


def test_close_is_quick_idempotent_and_final(peer: SerialPeer) -> None:
    driver = open_lidar(source("ld06", peer, stall_timeout_s=5.0))
    driver.start()
    assert until(lambda: driver.health().connected)
    started_s = time.monotonic()
    driver.close()
    driver.close()
    assert time.monotonic() - started_s < 1.0
    assert driver.wait_for_scan(0.01) is None


def test_without_pyserial_the_fix_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name == "serial":
            raise ImportError(name)
        return real(name, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.delitem(sys.modules, "serial", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(TransportError, match="pip install pyserial"):
        SerialTransport("/dev/null", 115200)


def test_a_pseudo_terminal_has_no_dtr_and_that_is_no_error(peer: SerialPeer) -> None:
    transport = SerialTransport(peer.path, 1_000_000)
    assert transport.set_dtr(False) is False
    peer.send(b"abc")
    assert transport.read(1.0) == b"abc"
    assert transport.read(0.01) == b""
    transport.write(b"xyz", 0.5)
    assert os.read(peer.master, 10) == b"xyz"
    transport.close()
    transport.close()
    with pytest.raises(TransportError):
        transport.read(0.1)


# -- RPLIDAR --------------------------------------------------------------------------------------------------------


def stream(peer: SerialPeer, head: RplidarHead) -> None:
    peer.answer = head.answer
    peer.stream(head, 0.01)


@pytest.mark.parametrize(
    ("mode", "firmware", "kind"),
    [("standard", (1, 29), "81"), ("express", (1, 29), "82"), ("dense", (1, 29), "85"), ("auto", (1, 29), "85"),
     ("auto", (1, 20), "82"), ("standard", (1, 20), "81")],
)  # fmt: skip
def test_rplidar_in_every_mode(peer: SerialPeer, mode: str, firmware: tuple[int, int], kind: str) -> None:
    head = RplidarHead(firmware)
    stream(peer, head)
    with open_lidar(source("rplidar", peer, rplidar_mode=mode, motor_pwm=660)) as driver:
        for _ in range(8):
            scan = next_scan(driver)
        health = driver.health()
    assert health.model.endswith(f"format {kind}")
    assert at(scan, -90.0) == pytest.approx(1.0)
    assert at(scan, 90.0) == pytest.approx(3.0)
    assert health.rate_hz == pytest.approx(20.0, rel=0.25)
    assert 0.0 < health.age_s < 0.3
    assert 0xF0 in head.commands
    assert head.commands[0] == 0x25
    assert until(lambda: head.commands[-1] == 0x25), "stopped at the end"


def test_rplidar_health_error_resets_and_says_so(peer: SerialPeer) -> None:
    head = RplidarHead()
    head.health = 2
    stream(peer, head)
    with open_lidar(source("rplidar", peer)) as driver:
        assert until(lambda: "health 2, code 8001" in driver.health().last_error)
        assert until(lambda: 0x40 in head.commands)
        head.health = 1  # a warning flies
        next_scan(driver)


@pytest.mark.parametrize(
    ("command", "what"), [(0x50, "info"), (0x52, "health"), (0x84, "configuration 70"), (0x82, "scan command")]
)
def test_rplidar_that_does_not_answer_is_named(peer: SerialPeer, command: int, what: str) -> None:
    head = RplidarHead()
    head.silent_to = {command}
    stream(peer, head)
    with open_lidar(source("rplidar", peer)) as driver:
        assert until(lambda: what in driver.health().last_error)
        assert driver.latest() is None
        head.silent_to = set()
        next_scan(driver)


def test_rplidar_mode_it_does_not_have_and_talk_that_does_not_stop(peer: SerialPeer) -> None:
    head = RplidarHead((1, 20))
    stream(peer, head)
    with open_lidar(source("rplidar", peer, rplidar_mode="dense")) as driver:
        assert until(lambda: "no dense mode" in driver.health().last_error)
        head.chatter = True
        assert until(lambda: "does not stop sending" in driver.health().last_error)


@pytest.mark.parametrize(("mode", "sent"), [("express", (0x82, 0x84)), ("dense", (0x85, 0x86)), ("standard", (0x81, 0x83))])
def test_a_format_that_is_not_read_is_named(peer: SerialPeer, mode: str, sent: tuple[int, int]) -> None:
    head = RplidarHead()
    head.sends = dict([sent])
    stream(peer, head)
    names = {0x83: "83 (HQ, not read here)", 0x84: "84 (ultra, not read here)", 0x86: "86 (ultra-dense, not read here)"}
    with open_lidar(source("rplidar", peer, rplidar_mode=mode)) as driver:
        assert until(lambda: f"asked for scan format {sent[0]:02X} ({mode}), the LiDAR sends {names[sent[1]]}" in
                     driver.health().last_error), driver.health()  # fmt: skip
        assert driver.latest() is None


def test_a_device_with_none_of_our_formats_is_refused_by_their_names(peer: SerialPeer) -> None:
    head = RplidarHead()
    head.modes, head.typical = {0: 0x83, 1: 0x84, 2: 0x86}, 1
    stream(peer, head)
    with open_lidar(source("rplidar", peer)) as driver:
        assert until(lambda: "offers the formats 83 (HQ, not read here), 84 (ultra" in driver.health().last_error)
        assert "standard, express or dense is needed" in driver.health().last_error


def test_rplidar_restart_in_flight_is_recovered(peer: SerialPeer) -> None:
    head = RplidarHead()
    stream(peer, head)
    with open_lidar(source("rplidar", peer)) as driver:
        next_scan(driver)
        head.kind = 0
        peer.send(b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n")
        assert until(lambda: driver.health().reconnects >= 1)
        assert until(lambda: driver.health().age_s < 0.3)


# -- Hokuyo over a serial line: the SCIP peer's bytes, carried by a pseudo-terminal ---------------------------------


def test_scip_over_a_serial_line(peer: SerialPeer) -> None:
    from scip_peer import BEAMS, encode, parameter_lines, reply, scan_message, summed

    streaming = threading.Event()

    def answer(heard: bytes) -> bytes:
        out = b""
        for line in heard.decode("ascii").split():
            lines: list[str] = []
            if line == "PP":
                lines = parameter_lines(MODL="URG-04LX(peer)")
            if line == "TM1":
                lines = [summed(encode(int(time.monotonic() * 1000) % 2**24, 4))]
            (streaming.set if line.startswith("MD") else streaming.clear)()
            out += reply(line, "00", lines)
        return out

    peer.answer = answer
    scan_bytes = lambda: scan_message([1500] * BEAMS, int(time.monotonic() * 1000)) if streaming.is_set() else b""  # noqa: E731
    peer.stream(scan_bytes, 0.02)
    with open_lidar(source("scip-serial", peer, reply_timeout_s=1.0)) as driver:
        for _ in range(5):
            scan = next_scan(driver)
        health = driver.health()
    assert health.model == "URG-04LX(peer)"
    np.testing.assert_allclose(scan.ranges_m, 1.5, rtol=1e-6)
    assert health.age_s < 0.1


# -- the gateway's emulators ----------------------------------------------------------------------------------------


class Rig:
    """A simulated vehicle that hovers, and may yaw, with the gateway's emulator on a pseudo-terminal, in real time."""

    def __init__(self, kind: str, yaw_rate_rad_s: float = 0.0) -> None:
        from sim_gateway.scene import World
        from sim_gateway.serial_lidar import SerialLidar
        from sim_gateway.simulation import Simulation

        boxes = np.array([[6.0, -9.0, 0.0, 7.0, 9.0, 6.0], [-9.0, 3.0, 0.0, 9.0, 4.0, 6.0], [-9.0, -3.0, 0.0, 9.0, -2.0, 6.0],
                          [-4.0, -9.0, 0.0, -3.0, 9.0, 6.0]])  # fmt: skip
        world = World(length_m=20.0, width_m=20.0, height_m=6.0, static_boxes=boxes, movers=(), start=(0.0, 0.0, 0.0),
                      start_yaw_rad=0.0, goal=(5.0, 0.0, 2.0), seed=0, name="room")  # fmt: skip
        self.simulation = Simulation(world, hover_height_m=2.0, estimate="none")
        self.lidar = SerialLidar(kind)
        self.yaw_rate_rad_s = yaw_rate_rad_s
        self.yaw_at: dict[int, float] = {}
        self._stop = threading.Event()
        self.origin_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        simulation = self.simulation
        while not self._stop.wait(0.002):
            for _ in range(min(25, int((time.monotonic() - self.origin_s - simulation.time_s) / 0.004))):
                simulation.advance(1, (0.0, 0.0, 0.0), self.yaw_rate_rad_s)
                self.yaw_at[simulation.steps] = simulation.truth.yaw_rad
                self.lidar.advance(simulation)

    def yaw_rad(self, time_s: float) -> float:
        return self.yaw_at[round((time_s - self.origin_s) / 0.004)]

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.lidar.close()


KINDS = [("ld06", "ld06", {}), ("stl27l", "stl27l", {}), ("rplidar", "rplidar", {"rplidar_mode": "standard"}),
         ("rplidar", "rplidar", {"rplidar_mode": "express"}), ("rplidar", "rplidar", {})]  # fmt: skip


@pytest.mark.parametrize(("kind", "driver_name", "changes"), KINDS, ids=["ld06", "stl27l", "standard", "express", "auto"])
def test_each_driver_reads_the_gateways_room(kind: str, driver_name: str, changes: dict[str, object]) -> None:
    pytest.importorskip("sim_gateway.serial_lidar", reason="needs the extra `sim`")
    with Rig(kind) as rig:
        config = LidarSource.model_validate({"driver": driver_name, "device": rig.lidar.path, **QUICK, **changes})
        with open_lidar(config) as driver:
            for _ in range(20):
                scan = next_scan(driver, 10.0)
            health = driver.health()
        x, y, _ = rig.simulation.truth.position_m
    expected = {0.0: 6.0 - x, 90.0: 3.0 - y, -90.0: y + 2.0, 179.9: x + 3.0}
    for bearing, distance in expected.items():
        assert at(scan, bearing) == pytest.approx(distance, abs=0.15), bearing
    assert health.reconnects == 0
    assert health.bad_checksums <= 1
    assert np.isnan(scan.ranges_m).mean() < 0.02
    assert 0.05 < health.age_s < 0.3


def wall_bearing_rad(scan: LidarScan) -> float:
    """Bearing of the nearest wall's foot, from all returns on it (the wall 2 m to the right at y = -2)."""
    bearings = scan.angle_min_rad + scan.angle_increment_rad * np.arange(scan.ranges_m.size)
    x, y = scan.ranges_m * np.cos(bearings), scan.ranges_m * np.sin(bearings)
    near = np.isfinite(scan.ranges_m) & (np.abs(scan.ranges_m) < 2.3)
    slope = np.linalg.lstsq(np.stack([x[near], np.ones(near.sum())], axis=1), y[near], rcond=None)[0][0]
    return float(math.atan(slope))


def test_motion_compensation_undoes_the_emulators_smear() -> None:
    """Yawing at 1 rad/s in front of a wall: without it the scan is bent by up to a turn's yaw, with it the wall is straight."""
    pytest.importorskip("sim_gateway.serial_lidar", reason="needs the extra `sim`")
    errors: dict[bool, list[float]] = {}
    for undo in (False, True):
        with Rig("ld06", yaw_rate_rad_s=0.8) as rig:
            options = {"driver": "ld06", "device": rig.lidar.path, **QUICK, "motion_compensation": undo}
            with open_lidar(LidarSource.model_validate(options)) as driver:
                driver.follow(lambda rig=rig: BodyMotion(0.0, 0.0, rig.yaw_rate_rad_s))
                for _ in range(6):
                    next_scan(driver, 10.0)
                found = []
                for _ in range(14):
                    scan = next_scan(driver)
                    found.append(abs(math.remainder(wall_bearing_rad(scan) + rig.yaw_rad(scan.time_s), math.pi)))
            errors[undo] = found
    assert np.median(errors[False]) > 0.03, errors
    assert np.median(errors[True]) < 0.5 * np.median(errors[False]), errors
