"""Whatever is wrong with one input, in any amount: zero is sent and the rule is named. Seen from outside, through the filter."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from safety_plant import command, config, scan, state

from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.lidar import TILT_BAND_M, BeamTable, see

AT_REST = CorridorVector(0.0, 0.0, 0.0)
SIDES = np.full(180, 2.0) + 0.001 * np.arange(180)
quick = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
NOT_FINITE = st.sampled_from((math.nan, math.inf, -math.inf))


def in_flight(ranges=None) -> tuple[SafetyFilter, float]:
    """A filter after half a second of quiet flight, and the time of its next tick."""
    safety = SafetyFilter(config())
    for k in range(10):
        now = 0.05 * k
        _, verdict = safety.apply(command(0.3), state(5.0 + 0.01 * k, time_s=now), scan(ranges, time_s=now), now)
        assert verdict.fault is None
    return safety, 0.5


def brakes(safety: SafetyFilter, rule: str, now_s: float, **parts) -> bool:
    """Whether the next tick, healthy but for `parts`, sends nothing but zero and names the rule."""
    tick = {"command": command(0.3), "state": state(5.1, time_s=now_s), "scan": scan(time_s=now_s)} | parts
    sent, verdict = safety.apply(tick["command"], tick["state"], tick["scan"], now_s)
    return sent.velocity == AT_REST and sent.yaw_rate_rad_s == 0.0 and verdict.braking and verdict.fault == rule


@quick
@given(
    st.sampled_from(("velocity", "acceleration", "position", "roll_rad", "pitch_rad", "yaw_rad", "yaw_rate_rad_s")),
    st.sampled_from("xyz"),
    NOT_FINITE,
)
def test_one_number_of_the_estimate_that_is_none_brakes(part, axis, value):
    safety, now = in_flight()
    good = state(5.1, time_s=now)
    old = getattr(good, part)
    bad = dataclasses.replace(old, **{axis: value}) if isinstance(old, CorridorVector) else value
    assert brakes(safety, "state_not_finite", now, state=dataclasses.replace(good, **{part: bad}))


@quick
@given(st.sampled_from(("state", "scan")))
def test_a_stamp_that_is_no_number_is_not_young(which):
    safety, now = in_flight()
    bad = {"state": state(5.1, time_s=math.nan), "scan": scan(time_s=math.nan)}[which]
    assert brakes(safety, {"state": "state_stale", "scan": "scan_not_finite"}[which], now, **{which: bad})


@quick
@given(st.floats(1e-6, 1e4))
def test_a_clock_that_went_back_by_any_amount_brakes(back_s):
    safety, now = in_flight()
    assert brakes(safety, "clock_backwards", now - 0.05 - back_s)


@quick
@given(st.integers(91, 180), st.sampled_from((0.0, -1.0, -math.inf, 0.05)), st.randoms(use_true_random=False))
def test_a_covered_lens_brakes_however_it_shows(covered, value, chance):
    safety, now = in_flight(SIDES)
    ranges = SIDES.copy()
    ranges[chance.sample(range(180), covered)] = value
    assert brakes(safety, "scan_touching", now, scan=scan(ranges, now))


@quick
@given(st.floats(0.8, 2.9), st.integers(40, 180))
def test_walls_do_not_vanish_between_two_scans(distance, beams):
    walls = np.where(np.arange(180) < beams, distance + 0.001 * np.arange(180), np.inf)
    walls[70:110] = 3.9  # nothing near ahead: the way is free
    safety, now = in_flight(walls)
    assert brakes(safety, "scan_blank", now, scan=scan(np.full(180, np.inf), now))


@quick
@given(
    st.sampled_from(("angle_increment_rad", "range_max_m", "range_min_m")),
    st.sampled_from((0.0, -0.1, -4.0)),
)
def test_a_scan_of_impossible_geometry_brakes(part, value):
    bad = {"angle_increment_rad": value, "range_max_m": value, "range_min_m": 4.0 - value}[part]
    safety, now = in_flight()
    assert brakes(safety, "scan_geometry", now, scan=dataclasses.replace(scan(time_s=now), **{part: bad}))


@quick
@given(st.floats(-math.pi, math.pi), st.floats(155.0, 308.2))
@example(math.pi / 4.0, 308.2)
def test_huge_commands_are_shortened_and_keep_their_direction(bearing, exponent):
    """Their squares overflow, and at last their length: taken for infinite it would turn them into zero or NaN."""
    x, y = math.cos(bearing), math.sin(bearing)
    size, longer = 10.0**exponent, max(abs(x), abs(y))
    wanted = command(size * (x / longer), size * (y / longer))
    sent, verdict = SafetyFilter(config()).apply(wanted, state(yaw=bearing), scan(), 0.0)
    assert verdict.fault is None
    assert 0.0 < math.hypot(sent.velocity.x, sent.velocity.y) <= config().max_horizontal_speed_m_s * (1.0 + 1e-9)
    assert math.remainder(math.atan2(sent.velocity.y, sent.velocity.x) - bearing, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)


@quick
@given(st.floats(-0.4, 0.4), st.floats(1.3, 50.0))
def test_a_command_over_the_limit_keeps_its_direction(bearing, speed):
    safety, limit = SafetyFilter(config()), config().max_horizontal_speed_m_s
    for k in range(8):
        now = 0.05 * k
        wanted = command(speed * math.cos(bearing), speed * math.sin(bearing))
        sent, _ = safety.apply(wanted, state(5.0 + 0.002 * k, time_s=now), scan(time_s=now), now)
        assert math.hypot(sent.velocity.x, sent.velocity.y) <= limit * (1.0 + 1e-9)
        assert math.atan2(sent.velocity.y, sent.velocity.x) == pytest.approx(bearing, abs=1e-9)


@quick
@given(st.floats(0.6, 3.0))
def test_no_faster_than_the_sensor_sees(sight):
    """With so short a view the speed limit is what stops within it, told as such."""
    settings = config(max_horizontal_speed_m_s=3.0)
    safety = SafetyFilter(settings)
    for k in range(10):
        now = 0.05 * k
        wanted, seen = command(3.0), scan(time_s=now, range_max=sight)
        sent, verdict = safety.apply(wanted, state(5.0 + 0.001 * k, time_s=now), seen, now)
        assert settings.stop_distance_m(sent.velocity.x) <= sight
        assert "speed_limit" in {why.rule for why in verdict.interventions}


@quick
@given(st.floats(0.5, 0.9), st.floats(0.25, 0.35), st.floats(-0.1, 0.1))
def test_a_beam_that_meets_the_ground_says_nothing_of_what_is_behind(height, pitch, roll):
    """Nose down, so that the beams ahead end on the ground: no obstacle, and free only as far as at the vehicle's height."""
    bearing = -math.pi / 2 + math.pi / 180 * (np.arange(180) + 0.5)
    down = np.cos(bearing) * math.sin(pitch) - np.sin(bearing) * math.sin(roll) * math.cos(pitch)
    with np.errstate(divide="ignore"):
        ranges = np.where(down > 0.0, height / down, np.inf)
    ground = ranges < 4.0
    ranges[~ground] = np.inf
    seen = see(scan(ranges), state(z=height, pitch=-pitch, roll=roll), BeamTable(), config())
    assert ground.any()
    assert np.isnan(seen.range_m[ground]).all()
    assert (seen.free_m[ground] * down[ground] <= TILT_BAND_M).all()
    assert seen.x_m.shape == (0,)
