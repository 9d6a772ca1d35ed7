"""Flight log, CSV and picture."""

from __future__ import annotations

import csv
import logging
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from flight_records import GOAL, flown, limited, record

from flight.trajectory import CSV_COLUMNS, MAX_HIT_CELLS, FlightLog, draw_trajectory_png, write_trajectory_csv
from safety.config import Fence
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState

FENCE = Fence(min_m=(0.0, -4.0, 0.3), max_m=(20.0, 4.0, 6.0))
BOXES = np.array([[0, 4, 0, 20, 4.2, 10], [0, -4.2, 0, 20, -4, 10], [8, -1.5, 0, 8.6, -0.9, 10], [11, 1.2, 0, 12, 2.0, 10.0]])


def scan_and_state(time_s: float, x: float = 5.0, yaw: float = 0.0) -> tuple[LidarScan, VehicleState]:
    ranges = np.full(181, np.inf, dtype=np.float32)
    ranges[0], ranges[90], ranges[180], ranges[45] = 1.0, 2.0, 3.0, 0.0
    zero = CorridorVector(0.0, 0.0, 0.0)
    state = VehicleState(time_s, CorridorVector(x, 0.0, 2.0), zero, zero, 0.0, 0.0, yaw, 0.0)
    return LidarScan(time_s, ranges, -math.pi / 2, math.pi / 180, 0.1, 4.0), state


def test_the_log_is_bounded_and_counts_what_it_drops() -> None:
    log = FlightLog(max_ticks=5)
    for k in range(8):
        log.append(record(k), 0.0)
    assert (len(log), log.dropped, len(list(log))) == (5, 3, 5)
    with pytest.raises(ValueError, match="max_ticks"):
        FlightLog(0)


def test_positions_leave_out_ticks_without_a_state() -> None:
    log = flown()
    assert log.positions_m.shape == (399, 3)
    assert FlightLog().positions_m.shape == (0, 3)


def test_lidar_hits_are_placed_in_the_corridor() -> None:
    log = FlightLog()
    log.see(*scan_and_state(1.0))
    expected = {(5.0, -1.0), (7.0, 0.0), (5.0, 3.0)}
    assert len(log.hit_points_m) == 3
    for x, y in expected:
        assert np.hypot(*(log.hit_points_m - (x, y)).T).min() <= 0.05
    turned = FlightLog()
    turned.see(*scan_and_state(1.0, yaw=math.pi / 2))
    assert np.hypot(*(turned.hit_points_m - (5.0, 2.0)).T).min() <= 0.05, "ahead is now along y"


def test_lidar_hits_are_thinned_in_time_and_bounded() -> None:
    log = FlightLog()
    log.see(None, None)
    for k in range(100):
        log.see(*scan_and_state(1.0 + 0.05 * k, x=5.0 + k))
    assert len(log.hit_points_m) <= 3 * 26
    rng = np.random.default_rng(1)
    for k in range(900):
        scan, state = scan_and_state(100.0 + k, x=float(3 * k))
        ranges = rng.uniform(0.2, 4.0, 181).astype(np.float32)
        log.see(LidarScan(scan.time_s, ranges, scan.angle_min_rad, scan.angle_increment_rad, 0.1, 4.0), state)
    assert len(log.hit_points_m) <= MAX_HIT_CELLS + 181


def test_csv_rows_say_what_happened(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.csv"
    write_trajectory_csv(path, flown())
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == CSV_COLUMNS
    assert len(rows) == 400
    assert (rows[1]["time_s"], rows[1]["x_m"], rows[1]["sent_vx_m_s"]) == ("0.050000", "4.025000", "0.500000")
    assert (rows[120]["rules"], rows[120]["braking"]) == ("obstacle", "0")
    assert (rows[252]["wanted_vx_m_s"], rows[252]["braking"]) == ("", "1")
    assert rows[300]["x_m"] == ""
    assert (rows[0]["hidden_reset"], rows[1]["hidden_reset"]) == ("1", "0")


def test_the_same_flight_gives_the_same_bytes_whenever_it_is_flown(tmp_path: Path) -> None:
    later = FlightLog()
    for one, _ in flown():
        shifted = {name: getattr(one, name) for name in one.__slots__}
        shifted.update(inference_s=7.0)
        later.append(type(one)(**shifted), 1e6)
    write_trajectory_csv(tmp_path / "a.csv", flown())
    write_trajectory_csv(tmp_path / "b.csv", later)
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert b"-0.000000" not in (tmp_path / "a.csv").read_bytes()


def test_an_empty_flight_has_a_header_only(tmp_path: Path) -> None:
    write_trajectory_csv(tmp_path / "a.csv", FlightLog())
    assert (tmp_path / "a.csv").read_text() == ",".join(CSV_COLUMNS) + "\n"


def pixels(path: Path) -> np.ndarray:
    from matplotlib.image import imread

    return imread(path)[:, :, :3]


def has_colour(image: np.ndarray, colour: str) -> bool:
    from matplotlib.colors import to_rgb

    return bool((np.abs(image - np.array(to_rgb(colour))).max(axis=2) < 0.02).any())


@pytest.mark.parametrize("known", [True, False], ids=["obstacles known", "as seen by LiDAR"])
def test_the_picture_shows_path_obstacles_fence_and_marks(tmp_path: Path, known: bool) -> None:
    log = flown()
    log.see(*scan_and_state(1.0))
    path = tmp_path / "trajectory.png"
    truth = log.positions_m + 0.02
    boxes = BOXES if known else None
    assert draw_trajectory_png(path, log, boxes=boxes, goal=GOAL, goal_radius_m=0.3, fence=FENCE, truth=truth, title="flight")
    image = pixels(path)
    assert image.shape[1] > image.shape[0] > 300
    assert has_colour(image, "#8d96a3") is known
    assert has_colour(image, "#e74c3c")  # braking
    assert has_colour(image, "#f8c471")  # limited
    assert has_colour(image, "#c0392b")  # fence


@pytest.mark.parametrize("ticks", [0, 1, 2])
def test_a_flight_that_hardly_began_is_drawn_too(tmp_path: Path, ticks: int) -> None:
    log = FlightLog()
    for k in range(ticks):
        log.append(record(k, verdict=limited("obstacle")), 0.0)
    path = tmp_path / "trajectory.png"
    assert draw_trajectory_png(path, log, boxes=np.zeros((0, 6)), goal=GOAL, goal_radius_m=0.3, fence=None)
    assert pixels(path).size > 0


def test_without_matplotlib_the_flight_still_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    path = tmp_path / "trajectory.png"
    with caplog.at_level(logging.WARNING):
        assert not draw_trajectory_png(path, flown(), boxes=BOXES, goal=GOAL, goal_radius_m=0.3, fence=FENCE)
    assert not path.exists()
    assert "lstm-pilot[report]" in caplog.text
