"""Points of a spinning LiDAR to scans: mounting, blind sectors, gaps, smear and its removal. All in made-up time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.lidar import BeamReducer, LidarSource
from flight.lidar.clock import MAX_JUMP_S, ONE_WAY_DRIFT, DeviceClockError, OneWayClock
from flight.lidar.motion import BodyMotion, body_motion, seen_later
from flight.lidar.points import NO_STAMP, Points
from flight.lidar.reduce import levelled
from flight.lidar.turn import BearingGrid, TurnAssembler
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState

RATE_HZ, POINTS_PER_S = 10.0, 4500.0


def source(**changes: object) -> LidarSource:
    return LidarSource.model_validate({"driver": "ld06", "device": "/dev/null", **changes})


def shots(first: int, last: int, range_m: Callable[[float, float], float]) -> tuple[Points, np.ndarray]:
    """Shots first..last of a head turning clockwise; `range_m` of device bearing (rad, positive left) and time."""
    times = np.arange(first, last) / POINTS_PER_S
    bearings = np.remainder(math.pi - 2.0 * math.pi * RATE_HZ * times, 2.0 * math.pi) - math.pi
    ranges = np.array([range_m(b, t) for b, t in zip(bearings, times, strict=True)], dtype=np.float32)
    count = times.size
    whole = np.zeros(count, dtype=np.int64)
    points = Points(bearings, ranges, np.full(count, 99, np.uint8), np.zeros(count), whole + NO_STAMP, whole)
    return points, times


def scans_of(
    assembler: TurnAssembler, seconds: float, range_m: Callable[[float, float], float], motion: BodyMotion | None = None
) -> list[LidarScan]:
    found = []
    for first in range(0, int(seconds * POINTS_PER_S), 24):
        scan = assembler.add(*shots(first, first + 24, range_m), motion)
        if scan is not None:
            found.append(scan)
    return found


def bearings_deg(scan: LidarScan) -> np.ndarray:
    return np.degrees(scan.angle_min_rad + scan.angle_increment_rad * np.arange(scan.ranges_m.size))


def at(scan: LidarScan, bearing_deg: float) -> float:
    return float(scan.ranges_m[np.argmin(np.abs(bearings_deg(scan) - bearing_deg))])


def left_wall(bearing_rad: float, time_s: float) -> float:
    """A wall 2 m to the left of the device, open elsewhere (10 m)."""
    return 2.0 / math.sin(bearing_rad) if bearing_rad > 0.3 and bearing_rad < math.pi - 0.3 else 10.0


def test_a_turn_is_a_scan_twice_a_turn_dated_by_its_oldest_beam() -> None:
    found = scans_of(TurnAssembler(source(), 0.02, 12.0), 1.0, left_wall)
    assert 17 <= len(found) <= 19, "20 a second from the first full turn on"
    np.testing.assert_allclose(np.diff([scan.time_s for scan in found]), 0.05, atol=0.006)
    for k, scan in enumerate(found):
        newest_s = 0.1 + 0.05 * k
        assert newest_s - 0.006 <= scan.time_s + 0.1 <= newest_s + 0.012
        assert scan.ranges_m.size == 720
        assert not np.isnan(scan.ranges_m).any(), "the device's beams are wider than the grid's"
    assert at(found[-1], 90.0) == pytest.approx(2.0, abs=0.01)
    assert at(found[-1], -90.0) == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("changes", "wall_deg"),
    [({}, 90.0), ({"mount_yaw_deg": 90.0}, 180.0), ({"mirror": True}, -90.0), ({"mirror": True, "mount_yaw_deg": 30.0}, -60.0)],
)
def test_mounting_turns_and_mirrors(changes: dict[str, object], wall_deg: float) -> None:
    scan = scans_of(TurnAssembler(source(**changes), 0.02, 12.0), 0.3, left_wall)[-1]
    away = np.remainder(bearings_deg(scan) - wall_deg + 180.0, 360.0) - 180.0
    assert scan.ranges_m[np.abs(away) < 20.0].max() < 2.2
    assert scan.ranges_m[np.abs(away) > 80.0].min() > 5.0


def test_a_device_off_the_centre_sees_from_the_centre() -> None:
    scan = scans_of(TurnAssembler(source(mount_y_m=0.5, mount_x_m=0.2), 0.02, 12.0), 0.3, left_wall)[-1]
    assert at(scan, 90.0) == pytest.approx(2.5, abs=0.02)


def test_blind_sectors_are_unknown_and_a_hidden_rear_is_left_out() -> None:
    sectors = [[100.0, -100.0], [40.0, 50.0]]
    scan = scans_of(TurnAssembler(source(blind_sectors_deg=sectors), 0.02, 12.0), 0.3, lambda b, t: 3.0)[-1]
    assert -100.0 <= bearings_deg(scan)[0] < -99.0
    assert 99.0 < bearings_deg(scan)[-1] <= 100.0
    known = ~np.isnan(scan.ranges_m)
    inside = (bearings_deg(scan) > 41.0) & (bearings_deg(scan) < 49.0)
    assert not known[inside].any()
    assert known[(bearings_deg(scan) < 39.5) | (bearings_deg(scan) > 50.5)].all()
    assert np.isnan(BeamReducer(180, math.pi, 4.0).reduce(scan)).sum() >= 8


@pytest.mark.parametrize(("no_return", "expected"), [("unknown", math.nan), ("nothing", math.inf)])
def test_missing_is_far_only_if_the_user_says_so(no_return: str, expected: float) -> None:
    def gone(bearing_rad: float, time_s: float) -> float:
        return math.nan if abs(bearing_rad) < 0.5 else 3.0

    scan = scans_of(TurnAssembler(source(no_return=no_return), 0.02, 12.0), 0.3, gone)[-1]
    np.testing.assert_equal(at(scan, 0.0), expected)
    assert at(scan, 60.0) == pytest.approx(3.0)
    reduced = BeamReducer(180, math.pi, 4.0).reduce(scan)
    np.testing.assert_equal(float(reduced[90]), expected)


def test_too_near_is_zero_and_past_the_trusted_range_is_nothing() -> None:
    scan = scans_of(TurnAssembler(source(range_max_m=4.0), 0.1, 12.0), 0.3, lambda b, t: 0.05 if b > 0 else 5.0)[-1]
    assert at(scan, 45.0) == 0.0
    assert at(scan, -45.0) == math.inf
    assert scan.range_max_m == 4.0


@given(st.floats(-math.pi, math.pi), st.floats(0.3, 3.9))
@settings(max_examples=60, deadline=None)
def test_one_return_is_never_lost(bearing_rad: float, range_m: float) -> None:
    step = 2.0 * math.pi * RATE_HZ / POINTS_PER_S

    def pole(bearing: float, time_s: float) -> float:
        return range_m if abs(math.remainder(bearing - bearing_rad, 2.0 * math.pi)) <= 0.5 * step else 8.0

    scan = scans_of(TurnAssembler(source(), 0.02, 12.0), 0.25, pole)[-1]
    nearest = float(scan.ranges_m.min())
    assert nearest == pytest.approx(range_m, abs=1e-5)
    away = math.remainder(math.radians(bearings_deg(scan)[int(np.argmin(scan.ranges_m))]) - bearing_rad, 2.0 * math.pi)
    assert abs(away) < 1.5 * step
    reduced = BeamReducer(180, math.pi, 4.0).reduce(scan)
    if abs(bearing_rad) < math.radians(88.0):
        assert float(np.nanmin(reduced)) == pytest.approx(range_m, abs=1e-5)


def test_lost_frames_leave_a_gap_that_is_unknown_not_far() -> None:
    assembler = TurnAssembler(source(), 0.02, 12.0)
    found = []
    for first in range(0, 4500, 12):
        if 2000 <= first < 2060:  # 48 degrees
            continue
        scan = assembler.add(*shots(first, first + 12, lambda b, t: 3.0))
        if scan is not None:
            found.append(int(np.isnan(scan.ranges_m).sum()))
    assert found[0] == found[-1] == 0
    assert 90 <= max(found) <= 100


def test_a_long_silence_starts_a_new_turn() -> None:
    assembler = TurnAssembler(source(), 0.02, 12.0)
    assert scans_of(assembler, 0.3, lambda b, t: 3.0)
    for first in range(4500, 4500 + 432, 24):
        assert assembler.add(*shots(first, first + 24, lambda b, t: 1.0)) is None
    assert assembler.points_held <= 432
    last = [assembler.add(*shots(4932 + k, 4932 + k + 24, lambda b, t: 1.0)) for k in range(0, 240, 24)]
    scan = next(scan for scan in last if scan is not None)
    assert scan.ranges_m.max() == 1.0, "nothing of what came before the silence"


def test_a_head_that_stands_still_gives_no_scan_and_no_growth() -> None:
    assembler = TurnAssembler(source(), 0.02, 12.0)
    points, times = shots(0, 400, lambda b, t: 3.0)
    still = Points(np.zeros(400), points.range_m, points.intensity, points.before_end_s, points.stamp_ms, points.bytes_behind)
    for k in range(300):
        assert assembler.add(still, times + 0.1 * k) is None
        assert assembler.points_held <= 20_400


# -- motion ---------------------------------------------------------------------------------------------------------

POLE = np.array([3.0, 1.5])
YAW_RATE, SPEED = 1.5, 1.0


def pole_from_a_moving_vehicle(bearing_rad: float, time_s: float) -> float:
    """A pole of 5 cm, as seen from a vehicle flying ahead at 1 m/s while it yaws at 1.5 rad/s."""
    yaw = YAW_RATE * time_s
    place = np.array([math.sin(yaw), 1.0 - math.cos(yaw)]) * SPEED / YAW_RATE
    to = POLE - place
    seen = math.atan2(to[1], to[0]) - yaw
    return float(np.hypot(*to)) if abs(math.remainder(seen - bearing_rad, 2.0 * math.pi)) < 0.03 else 9.0


def errors_of_the_pole(motion: BodyMotion | None) -> list[float]:
    """Distance between the pole as the scan places it and where it was at the scan's own time."""
    errors = []
    for scan in scans_of(TurnAssembler(source(motion_compensation=True), 0.02, 12.0), 0.8, pole_from_a_moving_vehicle, motion):
        near = scan.ranges_m < 8.0
        bearing, reach = np.radians(bearings_deg(scan)[near]).mean(), float(scan.ranges_m[near].mean())
        yaw = YAW_RATE * scan.time_s
        place = np.array([math.sin(yaw), 1.0 - math.cos(yaw)]) * SPEED / YAW_RATE
        to = POLE - place
        there = np.array([math.cos(yaw) * to[0] + math.sin(yaw) * to[1], math.cos(yaw) * to[1] - math.sin(yaw) * to[0]])
        errors.append(float(np.hypot(*(there - reach * np.array([math.cos(bearing), math.sin(bearing)])))))
    return errors


def test_motion_compensation_takes_the_smear_out() -> None:
    smeared = errors_of_the_pole(None)
    undone = errors_of_the_pole(BodyMotion(SPEED, 0.0, YAW_RATE))
    assert max(smeared) > 0.3, "up to a turn's age at 1.5 rad/s and 3 m"
    assert max(undone) < 0.05


def test_points_seen_later_from_a_vehicle_that_flew_on() -> None:
    x, y = seen_later(np.array([3.0]), np.array([1.0]), np.array([0.5]), BodyMotion(2.0, 0.0, 0.0))
    assert (x[0], y[0]) == pytest.approx((2.0, 1.0))
    x, y = seen_later(np.array([1.0]), np.array([0.0]), np.array([0.5]), BodyMotion(0.0, 0.0, math.pi))
    assert (x[0], y[0]) == pytest.approx((0.0, -1.0)), "turned left: what was ahead is right"


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-1.5, 1.5), st.floats(-0.15, 0.15))
@settings(max_examples=60, deadline=None)
def test_points_seen_later_agree_with_the_path_integrated(ahead: float, left: float, yaw_rate: float, later_s: float) -> None:
    steps, place, yaw = 200, np.zeros(2), 0.0
    for _ in range(steps):
        yaw += 0.5 * yaw_rate * later_s / steps
        velocity = np.array([ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)])
        place = place + velocity * later_s / steps
        yaw += 0.5 * yaw_rate * later_s / steps
    to = np.array([2.0, -1.0]) - place
    expected = (math.cos(yaw) * to[0] + math.sin(yaw) * to[1], math.cos(yaw) * to[1] - math.sin(yaw) * to[0])
    x, y = seen_later(np.array([2.0]), np.array([-1.0]), np.array([later_s]), BodyMotion(ahead, left, yaw_rate))
    assert (x[0], y[0]) == pytest.approx(expected, abs=2e-3)


def test_body_motion_of_a_state() -> None:
    state = VehicleState(
        0.0, CorridorVector(0, 0, 0), CorridorVector(0.0, 2.0, 0.0), CorridorVector(0, 0, 0), 0.0, 0.0, math.pi / 2, 0.3
    )
    motion = body_motion(state)
    assert motion is not None
    assert (motion.ahead_m_s, motion.left_m_s, motion.yaw_rate_rad_s) == pytest.approx((2.0, 0.0, 0.3))
    assert body_motion(None) is None


def test_levelled_distances_are_horizontal() -> None:
    scan = LidarScan(0.0, np.array([np.inf, 2.0, np.nan], dtype=np.float32), -math.pi / 2, math.pi / 2, 0.1, 4.0)
    level = levelled(scan, 0.0, math.radians(20.0))
    assert level.ranges_m[1] == pytest.approx(2.0 * math.cos(math.radians(20.0)), rel=1e-6)
    assert np.isinf(level.ranges_m[0])
    assert np.isnan(level.ranges_m[2])
    side = LidarScan(0.0, np.array([2.0, 2.0, 2.0], dtype=np.float32), -math.pi / 2, math.pi / 2, 0.1, 4.0)
    rolled = levelled(side, math.radians(10.0), 0.0).ranges_m
    np.testing.assert_allclose(rolled, [2.0 * math.cos(math.radians(10.0)), 2.0, 2.0 * math.cos(math.radians(10.0))], rtol=1e-6)


# -- grid and clock -------------------------------------------------------------------------------------------------


def test_the_grids_bins_are_the_policys_sectors_cut_in_two() -> None:
    grid = BearingGrid(0.5)
    ranges = grid.fill(np.radians([0.4, -0.4]), np.array([1.0, 2.0], np.float32), np.zeros(2))
    scan = LidarScan(0.0, ranges, grid.angle_min_rad, grid.angle_increment_rad, 0.1, 4.0)
    reduced = BeamReducer(180, math.pi, 4.0).reduce(scan)
    assert (reduced[90], reduced[89]) == (1.0, 2.0)
    assert np.isnan(reduced).sum() == 178


def test_one_way_clock_takes_the_fastest_frame_for_the_truth() -> None:
    clock = OneWayClock(wrap_s=30.0)
    errors = []
    for k in range(4000):
        now_s = 100.0 + 0.01 * k  # wraps once
        delay_s = 0.002 + 0.01 * (k % 7) / 7
        errors.append(clock.measured_at((now_s + 5.0) % 30.0, now_s + delay_s) - now_s)
    assert max(errors[7:]) < 0.003
    assert min(errors) > -0.001


def test_one_way_clock_follows_an_oscillator_but_shows_a_slow_link() -> None:
    clock = OneWayClock()
    for k in range(2000):
        now_s = 0.01 * k
        error_s = clock.measured_at(now_s * 0.997, now_s + 0.001) - now_s
        assert -0.002 < error_s < 0.003
    slow = [clock.measured_at(0.01 * k * 0.997, 0.01 * k + 0.2) - 0.01 * k for k in range(2000, 2200)]
    assert max(slow) < 0.001 + 2.0 * ONE_WAY_DRIFT + 0.002, "two seconds later the scans still show most of their age"


def test_one_way_clock_refuses_a_clock_set_anew_but_not_a_tiny_step_back() -> None:
    clock = OneWayClock(wrap_s=30.0)
    clock.measured_at(10.0, 1.0)
    clock.measured_at(9.999, 1.01)
    with pytest.raises(DeviceClockError, match="moved"):
        clock.measured_at(9.999 + MAX_JUMP_S + 0.1, 1.02)
