"""Configuration refuses what contradicts itself (G1, G2, G6); the formulas are what their sources say."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from safety_plant import FENCE, config

from safety.config import Fence, SafetyConfig, braking_distance_m, speed_cap_m_s

speeds = st.floats(0.0, 5.0)
lags = st.floats(0.05, 2.0)
brakings = st.floats(0.5, 6.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lag_min_s": 0.9}, "lag_min_s"),
        ({"return_speed_m_s": 2.0}, "return_speed_m_s"),
        ({"memory_hold_s": 30.0}, "memory_hold_s"),
        ({"hold_off_speed_m_s": 0.4}, "hold_off_speed_m_s"),
        ({"max_horizontal_speed_m_s": math.nan}, "finite"),
        ({"max_horizontal_speed_m_s": math.inf}, "finite"),
        ({"max_horizontal_speed_m_s": 0.0}, "greater than 0"),
        ({"margin_m": -0.01}, "greater than or equal to 0"),
        ({"monitors": {"velocity_window_s": 1e-6}}, "greater than or equal to 0.1"),
        ({"monitors": {"velocity_window_s": 3.2}}, "less than or equal to 3"),
        ({"monitors": {"braking_horizon_s": 3.2}}, "less than or equal to 3"),
        ({"monitors": {"echo_s": 1.1}}, "less than or equal to 1"),
        ({"max_speed": 1.0}, "Extra inputs"),
        ({"vehicle_radius_m": 6.0}, "fence: no place is left"),
        ({"vehicle_half_height_m": 2.0}, "fence z"),
        ({"fence": {"min_m": (0, 0, 0), "max_m": (10, 0, 3)}}, "fence y"),
        ({"fence": {"min_m": (0, 0, 0), "max_m": (10, math.nan, 3)}}, "finite"),
        ({"fence": {"min_m": (0, 0), "max_m": (10, 10)}}, "min_m"),
        ({"fence": None}, "fence"),
    ],
)
def test_contradictions_are_refused_and_named(changes, words):
    with pytest.raises(ValidationError, match=words):
        SafetyConfig(**({"fence": FENCE} | changes))


def test_defaults_are_the_reviewed_numbers():
    """A changed limit must be changed here too, knowingly."""
    values = config().model_dump(exclude={"fence", "monitors"})
    assert values == {
        "max_horizontal_speed_m_s": 1.2,
        "max_vertical_speed_m_s": 0.5,
        "max_acceleration_m_s2": 10.0,
        "max_jerk_m_s3": 150.0,
        "max_yaw_rate_rad_s": 1.0,
        "vehicle_radius_m": 0.35,
        "vehicle_half_height_m": 0.1,
        "margin_m": 0.05,
        "tick_s": 0.05,
        "dead_time_s": 0.2,
        "lag_s": 0.6,
        "lag_min_s": 0.35,
        "braking_m_s2": 2.0,
        "position_error_m": 0.05,
        "velocity_error_m_s": 0.05,
        "obstacle_speed_m_s": 0.0,
        "scan_stale_s": 0.25,
        "state_stale_s": 0.2,
        "future_tolerance_s": 0.02,
        "return_speed_m_s": 0.3,
        "hold_off_speed_m_s": 0.25,
        "fov_margin_rad": 0.1,
        "memory_s": 20.0,
        "memory_hold_s": 0.12,
        "fault_hold_s": 2.0,
        "ground_z_m": 0.0,
        "ground_band_m": 0.2,
    }


def test_config_is_frozen():
    with pytest.raises(ValidationError):
        config().margin_m = 0.0


def test_delay_and_distances_add_up():
    c = config(tick_s=0.05, dead_time_s=0.2, lag_s=0.6, vehicle_radius_m=0.35, margin_m=0.04)
    assert c.delay_s == pytest.approx(0.85)
    assert c.keep_out_m == pytest.approx(0.39)
    assert c.stop_distance_m(1.0) == pytest.approx(0.85)


def test_keep_in_takes_radius_margin_and_error_off():
    c = config(fence=Fence(min_m=(0, -4, 0), max_m=(10, 4, 3)), vehicle_radius_m=0.3, margin_m=0.1, position_error_m=0.05)
    assert c.drift_m == pytest.approx(0.05 * 0.85)
    assert c.braked_drift_m == pytest.approx(0.05 * 2.0)
    assert c.fault_room_m == pytest.approx(0.05 * 1.15)
    assert config(fault_hold_s=0.5).braked_drift_m == c.drift_m
    assert c.keep_in_z() == pytest.approx((0.35, 2.65))
    assert c.eroded_fence().room_m([(0.55, 0.0), (9.45, 3.45), (5.0, 0.0)]) == pytest.approx([0.0, 0.0, 3.45])


@given(speeds, lags, brakings)
def test_braking_distance_equals_the_simulated_one(speed, lag, braking):
    """Independent check: integrate the saturated first-order loop."""
    v, distance, h = speed, 0.0, 0.002
    for _ in range(int((speed / braking + 12 * lag) / h)):
        a = -min(v / lag, braking)
        distance += v * h + 0.5 * a * h * h
        v += a * h
    assert braking_distance_m(speed, lag, braking) == pytest.approx(distance, abs=0.01 + 0.01 * distance)


@given(speeds, speeds, lags, brakings)
def test_stop_distance_grows_with_speed(a, b, lag, braking):
    low, high = sorted((a, b))
    assert braking_distance_m(low, lag, braking) <= braking_distance_m(high, lag, braking)


@given(st.floats(0.0, 20.0), st.floats(0.05, 2.0), brakings)
def test_capped_speed_stops_within_the_distance(distance, delay, braking):
    v = speed_cap_m_s(distance, delay, braking)
    assert v * delay + v * v / (2 * braking) <= distance + 1e-9
    assert v <= distance / (math.e * delay) + 1e-12


@given(st.floats(0.0, 20.0), st.floats(0.0, 1.0), st.floats(0.05, 2.0), st.floats(0.0, 0.5), brakings)
def test_cap_falls_with_less_distance_and_more_delay(distance, less, delay, more, braking):
    v = speed_cap_m_s(distance, delay, braking)
    assert speed_cap_m_s(distance - less, delay, braking) <= v
    assert speed_cap_m_s(distance, delay + more, braking) <= v + 1e-12


def test_cap_matches_the_worked_examples():
    """b = 2 m/s^2, T = 0.4 s: the parabola alone gives 3.74 m/s at 5 m and 6.17 m/s at 12 m; near the wall D / (e T) is lower."""
    assert speed_cap_m_s(5.0, 0.4, 2.0) == pytest.approx(3.74, abs=0.01)
    assert speed_cap_m_s(12.0, 0.4, 2.0) == pytest.approx(6.17, abs=0.01)
    assert speed_cap_m_s(0.5, 0.4, 2.0) == pytest.approx(0.5 / (math.e * 0.4))
    assert speed_cap_m_s(0.0, 0.4, 2.0) == 0.0
    assert speed_cap_m_s(-1.0, 0.4, 2.0) == 0.0
