"""Scans that come without a link of their own (MAVLink, recordings), the `lidar` section's rules, and `lidar-view`."""

from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError
from scip_peer import Device

from flight.lidar import LidarDriver, LidarSource, open_lidar
from flight.lidar.from_link import feed_from_link
from flight.lidar.inbox import OWNER_TIMEOUT_S, Inbox
from flight.lidar.obstacle_distance import BODY_FRD, ObstacleDistanceError, decode_obstacle_distance
from flight.lidar.polar import polar_plot
from flight.lidar.recording import NpzScans, ScanFileError, open_recording, write_npz
from safety.messages import LidarScan

QUICK = {"reply_timeout_s": 0.3, "stall_timeout_s": 0.3, "reconnect_min_s": 0.02, "reconnect_max_s": 0.1}
ROOT = Path(__file__).resolve().parents[2]


def until(condition: Callable[[], bool], timeout_s: float = 5.0) -> bool:
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if condition():
            return True
        time.sleep(0.005)
    return condition()


# -- OBSTACLE_DISTANCE ----------------------------------------------------------------------------------------------


def message(distances: list[int] | None = None, **changes: object) -> str:
    fields: dict[str, object] = {
        "time_usec": 1_000_000,
        "sensor_type": 0,
        "distances": distances if distances is not None else [100 + k for k in range(72)],
        "increment": 5,
        "min_distance": 20,
        "max_distance": 400,
        "increment_f": 0.0,
        "angle_offset": 0.0,
        "frame": BODY_FRD,
    }
    return json.dumps(fields | changes)


def at(scan: object, bearing_deg: float) -> float:
    ranges = scan.ranges_m  # type: ignore[attr-defined]
    bearings = scan.angle_min_rad + scan.angle_increment_rad * np.arange(ranges.size)  # type: ignore[attr-defined]
    away = np.abs(np.remainder(np.degrees(bearings) - bearing_deg + 180.0, 360.0) - 180.0)
    assert away.min() < 1e-6
    return float(ranges[np.argmin(away)])


def test_bins_run_clockwise_from_the_nose() -> None:
    scan = decode_obstacle_distance(message())
    assert scan.ranges_m.shape == (72,)
    assert scan.angle_increment_rad == pytest.approx(math.radians(5.0))
    for k in (0, 1, 18, 36, 71):
        assert at(scan, -5.0 * k) == pytest.approx(1.0 + 0.01 * k)


def test_offset_fine_and_negative_increments() -> None:
    turned = decode_obstacle_distance(message(angle_offset=-90.0, increment_f=2.5))
    assert at(turned, 90.0) == pytest.approx(1.0)
    assert at(turned, 90.0 - 2.5 * 71) == pytest.approx(1.71)
    back = decode_obstacle_distance(message(increment_f=-5.0, angle_offset=10.0))
    assert at(back, -10.0) == pytest.approx(1.0)
    assert at(back, -10.0 + 5.0) == pytest.approx(1.01)
    coarse = decode_obstacle_distance(message(increment=10))
    assert coarse.ranges_m.shape == (36,), "the second half would lie on top of the first"


def test_codes_keep_their_meaning() -> None:
    scan = decode_obstacle_distance(message([0, 10, 20, 400, 401, 65535] + [200] * 66))
    values = [at(scan, -5.0 * k) for k in range(6)]
    np.testing.assert_allclose(values[:5], [0.0, 0.0, 0.2, 4.0, math.inf], rtol=1e-6)
    assert math.isnan(values[5])


@pytest.mark.parametrize(
    ("text", "why"),
    [(message([1, 2]), "72"), (message(frame=0), "frame 0"), (message(increment=0), "increment"), ("{", "field"), ("[]", "field"),
     (message(max_distance=10), "limits"), (message(angle_offset=1e9), "offset"), (message(distances=[0.5] * 72), "whole"),
     (message([-1] + [5] * 71), "distances"), (message(increment_f="x"), "number"), (message(distances=None)[:-1], "field"),
     ("{" * 5000, "field"), (message(time_usec=None), "whole")],
)  # fmt: skip
def test_what_cannot_be_used_is_refused(text: str, why: str) -> None:
    with pytest.raises(ObstacleDistanceError, match=why):
        decode_obstacle_distance(text)


def test_a_million_mutated_bytes_raise_only_what_is_declared() -> None:
    rng = random.Random(3)
    clean, seen, good = message().encode(), 0, 0
    while seen < 1_000_000:
        data = bytearray(clean)
        for _ in range(rng.randrange(1, 4)):
            place = rng.randrange(len(data))
            data[place : place + rng.randrange(3)] = rng.choice((b"9", b"-", b"e", b"]", b'"', b",", bytes([rng.randrange(256)])))
        seen += len(data)
        try:
            scan = decode_obstacle_distance(data.decode("utf-8", errors="replace"))
        except ObstacleDistanceError:
            continue
        good += 1
        assert not (scan.ranges_m < 0.0).any()
        assert np.isfinite([scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, scan.range_max_m, scan.stamp_s]).all()
    assert good > 50


class Sender:
    """Puts messages into the driver's inbox at 20 Hz, stamped by a clock of its own."""

    def __init__(self, driver: LidarDriver, delay_s: float = 0.0, sender: int = 1) -> None:
        self.silent = False
        self.distances = [100 + k for k in range(72)]
        self._driver, self._delay_s, self._sender = driver, delay_s, sender
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            if not self.silent:
                text = message(self.distances, time_usec=int(1e6 * (time.monotonic() + 77.0)))
                self._driver.inbox.put(text, time.monotonic() + self._delay_s, self._sender)

    def __enter__(self) -> Sender:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)


def test_the_mavlink_driver_is_fed_and_dated_and_mounted() -> None:
    config = LidarSource.model_validate({"driver": "mavlink", "mount_yaw_deg": 90.0, "extra_age_s": 0.03, **QUICK})
    with open_lidar(config) as driver, Sender(driver):
        for _ in range(10):
            scan = driver.wait_for_scan(2.0)
        health = driver.health()
    assert scan is not None
    assert at(scan, 90.0) == pytest.approx(1.0)
    assert health.rate_hz == pytest.approx(20.0, rel=0.2)
    assert 0.03 <= health.age_s < 0.15
    assert health.model == "MAVLink OBSTACLE_DISTANCE"


def test_silence_is_named_and_a_second_sender_is_not_mixed_in() -> None:
    config = LidarSource.model_validate({"driver": "mavlink", **QUICK})
    with open_lidar(config) as driver:
        assert until(lambda: "no OBSTACLE_DISTANCE" in driver.health().last_error)
        with Sender(driver) as first, Sender(driver, sender=99) as second:
            second.distances = [33] * 72
            for _ in range(8):
                scan = driver.wait_for_scan(2.0)
                assert scan is not None
                assert at(scan, -5.0) == pytest.approx(1.01)
            assert until(lambda: driver.health().bad_frames >= 5)
            first.silent = second.silent = True
            assert until(lambda: "second sender" in driver.health().last_error)


def test_an_inbox_keeps_one_message_and_one_sender() -> None:
    box = Inbox()
    assert box.put("a", 1.0, "one")
    assert box.put("b", 1.1, "one")
    assert not box.put("c", 1.2, "two")
    letter = box.take(0.0)
    assert letter is not None
    assert letter.text == "b"
    assert box.take(0.01) is None
    assert box.put("d", 1.2 + OWNER_TIMEOUT_S, "two"), "the first has gone silent"


def test_the_link_feeds_only_a_mavlink_driver() -> None:
    handlers: dict[str, Callable[[str, float, int], None]] = {}
    asked: list[tuple[str, float]] = []
    link = SimpleNamespace(subscribe=handlers.__setitem__, request_message_rate=lambda name, rate: asked.append((name, rate)))
    other = LidarSource()
    feed_from_link(open_lidar(other), other, link)  # type: ignore[arg-type]
    assert (handlers, asked) == ({}, [])
    config = LidarSource(driver="mavlink")
    driver = open_lidar(config)
    feed_from_link(driver, config, link)  # type: ignore[arg-type]
    assert asked == [("OBSTACLE_DISTANCE", 20.0)]
    handlers["OBSTACLE_DISTANCE"](message(), 5.0, 1)
    letter = driver.inbox.take(0.0)
    assert letter is not None
    assert letter.arrived_s == 5.0


# -- recordings -----------------------------------------------------------------------------------------------------


def scan_number(k: int, period_s: float = 0.05) -> LidarScan:
    ranges = np.array([1.0 + k, np.inf, np.nan, 0.0], dtype=np.float32)
    return LidarScan(1000.0 + period_s * k, ranges, -0.3, 0.2, 0.1, 4.0, k)


def test_a_file_of_scans_comes_back_bit_by_bit(tmp_path: Path) -> None:
    path = tmp_path / "scans.npz"
    scans = [scan_number(k) for k in range(5)]
    assert write_npz(path, scans) == 5
    back = list(open_recording(path).scans())
    for one, other in zip(scans, back, strict=True):
        np.testing.assert_array_equal(one.ranges_m, other.ranges_m)
        assert (one.time_s, one.angle_min_rad, one.range_max_m, one.sequence) == (
            other.time_s, other.angle_min_rad, other.range_max_m, other.sequence)  # fmt: skip
    assert len(list(open_recording(path).scans())) == 5, "from the beginning again"


def test_a_recording_is_played_at_its_pace_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "scans.npz"
    write_npz(path, [scan_number(k) for k in range(8)])
    started_s = time.monotonic()
    with open_lidar(LidarSource.model_validate({"driver": "recording", "path": str(path), "speed": 2.0})) as driver:
        assert until(lambda: "over" in driver.health().last_error)
        elapsed_s = time.monotonic() - started_s
        scan = driver.latest()
        assert scan is not None
        assert scan.ranges_m[0] == 8.0
        assert not driver.health().connected
        assert driver.health().scans == 8
    assert 0.15 < elapsed_s < 0.6


def test_a_recording_may_repeat_and_may_be_any_source() -> None:
    class Two:
        def scans(self) -> list[LidarScan]:
            return [scan_number(0), scan_number(1)]

    config = LidarSource.model_validate({"driver": "recording", "path": "anything", "repeat": True})
    with open_lidar(config, recording=Two()) as driver:
        assert until(lambda: driver.health().scans >= 7)
        scan = driver.latest()
        assert scan is not None
        assert 0.0 <= time.monotonic() - scan.time_s < 0.5


@pytest.mark.parametrize("damage", ["cut", "pickle", "missing", "times", "shape", "geometry", "text"])
def test_a_file_that_is_no_recording_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "scans.npz"
    write_npz(path, [scan_number(k) for k in range(4)])
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:200])
    elif damage == "text":
        path.write_text("time_s: 5")
    else:
        arrays |= {
            "pickle": {"time_s": np.array([{}], dtype=object)},
            "missing": {},
            "times": {"time_s": np.array([0.0, 2.0, 1.0, 3.0])},
            "shape": {"ranges_m": np.zeros((3, 4), np.float32)},
            "geometry": {"angle_increment_rad": np.float64(-1.0)},
        }[damage]
        if damage == "missing":
            del arrays["range_max_m"]
        np.savez(path, **arrays)
    with pytest.raises(ScanFileError, match=r"scans\.npz"):
        NpzScans(path)


def test_a_driver_with_a_missing_file_says_so(tmp_path: Path) -> None:
    for name in ("none.npz", "scans.bag"):
        with open_lidar(LidarSource.model_validate({"driver": "recording", "path": str(tmp_path / name)})) as driver:
            assert until(lambda name=name, driver=driver: name in driver.health().last_error)


# -- the section ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "why"),
    [({"driver": "ld06"}, "needs device"), ({"driver": "recording"}, "needs path"), ({"device": "/dev/ttyUSB0"}, "means nothing"),
     ({"driver": "ld06", "device": "x", "port": 5}, "nothing"), ({"driver": "ld06", "device": "x", "repeat": True}, "nothing"),
     ({"driver": "rplidar", "device": "x", "min_intensity": 5}, "nothing"), ({"motion_compensation": True}, "means nothing"),
     ({"driver": "ld06", "device": "x", "grid_deg": 0.7}, "full turn"), ({"driver": "ld06", "device": "x", "baud": 5}, "1200"),
     ({"driver": "rplidar", "device": "x", "rplidar_mode": "ultra"}, "auto"), ({"driver": "sick"}, "scip-tcp")],
)  # fmt: skip
def test_a_section_that_cannot_mean_anything_is_refused(section: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        LidarSource.model_validate(section)


def test_baud_and_place_and_advice() -> None:
    head = LidarSource(driver="stl27l", device="/dev/ttyS1")
    assert (head.bit_rate, head.place) == (921_600, "/dev/ttyS1 at 921600 baud")
    assert LidarSource(driver="rplidar", device="a", baud=460_800).byte_s == pytest.approx(10 / 460_800)
    assert LidarSource().advice == "`lidar.host` and `lidar.port`"
    assert LidarSource(driver="mavlink").place == "the vehicle's MAVLink"


# -- lidar-view -----------------------------------------------------------------------------------------------------


def view(*arguments: str, timeout_s: float = 30.0) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "100", "LINES": "40"}
    command = [sys.executable, "-m", "flight.lidar.view", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, env=environment, check=False)


def test_view_prints_one_object_and_records(tmp_path: Path) -> None:
    with Device() as device:
        done = view("--driver", "scip-tcp", "--set", f"port={device.port}", "--json", "--seconds", "1.5",
                    "--record", str(tmp_path / "seen.npz"))  # fmt: skip
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["model"] == "TEST-30(peer)"
    assert facts["rate_hz"] > 20.0
    assert facts["coverage"] == 1.0
    assert facts["beams"] == 361
    assert 0.0 <= facts["age_ms"]["p50"] < 100.0
    assert facts["nearest_m"] == pytest.approx(1.0)
    assert len(list(NpzScans(tmp_path / "seen.npz").scans())) > 10


def test_view_without_a_device_says_so_and_usage_is_one_line() -> None:
    done = view("--driver", "scip-tcp", "--set", "port=9", "--json", "--seconds", "0.5")
    assert done.returncode == 1
    assert json.loads(done.stdout)["rate_hz"] is None
    assert "127.0.0.1:9" in done.stderr
    for arguments in (["--driver", "ld06"], [], ["--set", "x"], ["--driver", "mavlink"], ["--driver", "x"]):
        done = view(*arguments)
        assert done.returncode == 2, arguments
        assert done.stderr.count("\n") == 1
        assert done.stderr.startswith("lidar-view: ")
    assert "lidar-view --mission" in view("--help").stdout


def test_the_plot_has_ahead_up_and_left_left_and_shows_what_is_unknown() -> None:
    bearings = np.radians(np.arange(-180.0, 180.0, 0.5))
    ranges = np.full(720, np.inf, dtype=np.float32)
    empty = polar_plot(LidarScan(0.0, ranges, -math.pi, math.radians(0.5), 0.1, 4.0), 60, 30, 4.0)
    assert len(empty) == 30
    assert {len(line) for line in empty} == {60}

    def more(changed: np.ndarray) -> list[tuple[int, int]]:
        drawn = polar_plot(LidarScan(0.0, changed, -math.pi, math.radians(0.5), 0.1, 4.0), 60, 30, 4.0)
        return [(r, c) for r in range(30) for c in range(60) if drawn[r][c] != empty[r][c]]

    ahead, left, unknown = ranges.copy(), ranges.copy(), ranges.copy()
    ahead[np.abs(bearings) < 0.2] = 2.5
    left[np.abs(bearings - math.pi / 2) < 0.2] = 2.5
    unknown[np.abs(bearings + math.pi / 2) < 0.4] = np.nan
    assert max(r for r, _ in more(ahead)) < 12
    assert max(c for _, c in more(left)) < 20
    assert min(c for _, c in more(unknown)) > 40
