"""Device scan to vehicle scan to policy beams: nothing near is lost, nothing unknown becomes far, left stays left."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.lidar import BeamReducer, LidarSource, fill_unknown
from flight.lidar.reduce import Mounting
from safety.messages import LidarScan

NATIVE = 361
STEP_RAD = math.pi / 360


def scan_of(ranges: list[float] | np.ndarray, angle_min_rad: float = -math.pi / 2, step_rad: float = STEP_RAD) -> LidarScan:
    return LidarScan(0.0, np.asarray(ranges, dtype=np.float32), angle_min_rad, step_rad, 0.1, 4.0)


def policy_beams() -> BeamReducer:
    return BeamReducer(180, math.pi, 4.0)


values = st.one_of(st.floats(0.0, 4.0, width=32), st.sampled_from([math.inf, math.nan, 0.0]))


@given(st.lists(values, min_size=NATIVE, max_size=NATIVE))
@settings(max_examples=60, deadline=None)
def test_each_beam_is_the_nearest_valid_return_of_its_sector(ranges: list[float]) -> None:
    reduced = policy_beams().reduce(scan_of(ranges))
    for beam in range(180):
        sector = np.array(ranges[2 * beam : 2 * beam + 3], dtype=np.float32)  # half degrees: right edge, centre, left edge
        known = sector[np.isfinite(sector)]
        if known.size:
            assert reduced[beam] == known.min()
        elif np.isnan(sector).any():
            assert np.isnan(reduced[beam])
        else:
            assert reduced[beam] == np.inf


@given(st.integers(0, NATIVE - 1), st.floats(0.125, 4.0, width=32))
@settings(max_examples=60, deadline=None)
def test_a_thin_pole_is_never_lost(beam: int, range_m: float) -> None:
    ranges = np.full(NATIVE, np.inf)
    ranges[beam] = range_m
    reduced = policy_beams().reduce(scan_of(ranges))
    assert reduced.min() == np.float32(range_m)
    bearings = -math.pi / 2 + (np.arange(180) + 0.5) * math.pi / 180
    nearest = bearings[np.argmin(reduced)]
    assert abs(nearest - (-math.pi / 2 + beam * STEP_RAD)) <= math.radians(0.5) + 1e-9


def test_the_simulators_own_beams_pass_unchanged() -> None:
    ranges = np.linspace(0.2, 3.9, 180).astype(np.float32)
    step = math.pi / 180
    for error in (0.0, 1e-9, -1e-8):
        reduced = policy_beams().reduce(scan_of(ranges, -math.pi / 2 + step / 2, step + error))
        np.testing.assert_array_equal(reduced, ranges)


def test_a_coarser_device_leaves_no_hole() -> None:
    step = math.radians(1.7)
    beams = int(math.pi / step) + 1
    reduced = policy_beams().reduce(scan_of(np.full(beams, 2.0), -0.5 * (beams - 1) * step, step))
    assert (reduced == 2.0).all()


def test_what_no_beam_sees_is_unknown_and_beyond_range_is_nothing() -> None:
    reduced = policy_beams().reduce(scan_of(np.full(181, 9.0), -math.pi / 4))
    assert np.isnan(reduced[:44]).all()
    assert np.isnan(reduced[136:]).all()
    assert np.isinf(reduced[46:134]).all()


def test_a_full_turn_wraps_round() -> None:
    ranges = np.full(720, np.inf)
    ranges[540] = 1.5  # 540 * 0.5 deg = 270 deg = 90 deg to the right
    reduced = policy_beams().reduce(scan_of(ranges, 0.0, STEP_RAD))
    assert reduced[0] == np.float32(1.5)
    assert np.isinf(reduced[1:]).all()


def test_a_changed_geometry_is_noticed() -> None:
    reducer = policy_beams()
    ranges = np.full(NATIVE, np.inf)
    ranges[180] = 1.0
    assert np.isfinite(reducer.reduce(scan_of(ranges))).sum() == 2  # straight ahead lies between two beams
    assert np.isfinite(reducer.reduce(scan_of(ranges, -math.pi / 2 + math.radians(10.5)))).argmax() == 100


def test_the_policy_is_shown_nothing_for_unknown_but_too_near_stays() -> None:
    shown = fill_unknown(np.array([np.nan, np.inf, 0.0, 1.5], dtype=np.float32), 4.0)
    assert shown.tolist() == [4.0, 4.0, 0.0, 1.5]
    assert shown.dtype == np.float32


def mounted(ranges: np.ndarray, **config: object) -> tuple[np.ndarray, np.ndarray]:
    """(bearings, ranges) after mounting a 180 degree device of 361 beams."""
    mounting = Mounting(LidarSource.model_validate(config), -math.pi / 2, STEP_RAD, NATIVE)
    out = mounting.apply(ranges.astype(np.float32))
    return mounting.angle_min_rad + mounting.angle_increment_rad * np.arange(NATIVE), out


def wall_ranges(bearings: np.ndarray, *, left_m: float, origin: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Range to the wall y = left_m seen from `origin` along vehicle bearings."""
    with np.errstate(divide="ignore"):
        ranges = (left_m - origin[1]) / np.sin(bearings)
    return np.where((ranges > 0) & (ranges < 4.0), ranges, np.inf)


def test_a_wall_on_the_left_stays_on_the_left_however_the_device_hangs() -> None:
    own = -math.pi / 2 + STEP_RAD * np.arange(NATIVE)
    for yaw_deg, mirror in ((0.0, False), (0.0, True), (20.0, False), (-35.0, True)):
        on_vehicle = math.radians(yaw_deg) + (-own if mirror else own)
        bearings, ranges = mounted(wall_ranges(on_vehicle, left_m=1.0), mount_yaw_deg=yaw_deg, mirror=mirror)
        np.testing.assert_allclose(ranges, wall_ranges(bearings, left_m=1.0), rtol=1e-5)


def test_blind_sectors_are_unknown_also_across_the_back() -> None:
    bearings, ranges = mounted(np.full(NATIVE, 2.0), mount_yaw_deg=180.0, blind_sectors_deg=((170.0, -170.0), (100.0, 110.0)))
    degrees = np.degrees(np.remainder(bearings, 2 * math.pi))
    blind = ((degrees >= 170.0 - 1e-6) & (degrees <= 190.0 + 1e-6)) | ((degrees >= 100.0 - 1e-6) & (degrees <= 110.0 + 1e-6))
    np.testing.assert_array_equal(np.isnan(ranges), blind)


def test_an_offset_device_reports_distances_from_the_vehicles_centre() -> None:
    own = -math.pi / 2 + STEP_RAD * np.arange(NATIVE)
    offset = (0.15, -0.05)
    bearings, ranges = mounted(wall_ranges(own, left_m=1.0, origin=offset), mount_x_m=offset[0], mount_y_m=offset[1])
    expected = wall_ranges(bearings, left_m=1.0)
    seen = np.isfinite(expected) & (expected < 2.0) & (bearings < math.radians(80.0))
    np.testing.assert_allclose(ranges[seen], expected[seen], rtol=0.03)
    assert np.isnan(ranges[-1]), "straight left of the centre lies behind the device: it cannot know"
    assert np.isinf(ranges[:150]).all()


@given(st.integers(0, NATIVE - 1), st.floats(0.3, 4.0), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
@settings(max_examples=80, deadline=None)
def test_an_offset_never_loses_a_pole_inside_the_field_of_view(beam: int, range_m: float, x: float, y: float) -> None:
    ranges = np.full(NATIVE, np.inf)
    ranges[beam] = range_m
    bearing = -math.pi / 2 + beam * STEP_RAD
    point = (x + range_m * math.cos(bearing), y + range_m * math.sin(bearing))
    bearings, moved = mounted(ranges, mount_x_m=x, mount_y_m=y)
    seen = math.atan2(point[1], point[0])
    if abs(seen) < math.pi / 2 - STEP_RAD:
        place = int(np.nanargmin(moved))
        assert moved[place] == pytest.approx(math.hypot(*point), rel=1e-4)
        assert abs(bearings[place] - seen) <= 2.0 * STEP_RAD + 1e-9
