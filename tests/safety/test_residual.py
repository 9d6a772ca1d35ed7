"""Assumptions monitored while flying: a vehicle inside them is never accused, one outside loses speed, then lands."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import Plant, command, config, state

from safety.braking import CommandHistory
from safety.caps import cap_factor, cap_speed, extra_delay_s
from safety.frames import CorridorVector
from safety.messages import Health, SafeCommand
from safety.residual import MotionMonitor

CONFIG = config()
C = CONFIG.monitors


def fly(wanted, plant=None, ticks=200, turn_rad=0.0, noise=0.0, seed=0):
    """Shares, caps and rules of each tick; `wanted(k)` is sent. The plant really does it turned by `turn_rad` (E7)."""
    plant, history, monitor = plant or Plant(), CommandHistory(), MotionMonitor(CONFIG)
    random, cos, sin = np.random.default_rng(seed), math.cos(turn_rad), math.sin(turn_rad)
    shares, caps, rules = [], [], []
    for k in range(ticks):
        found, now = [], plant.time_s
        vx, vy = plant.v[0] + noise * random.standard_normal(), plant.v[1] + noise * random.standard_normal()
        monitor.judge(state(plant.x, plant.y, v=(vx, vy, 0.0), time_s=now), history, found)
        shares.append(monitor.braking_share)
        caps.append(monitor.cap)
        rules.append([item.rule for item in found])
        v = wanted(k)
        history.add(now, CorridorVector(*v, 0.0))
        plant.fly(SafeCommand(CorridorVector(cos * v[0] - sin * v[1], sin * v[0] + cos * v[1], 0.0), 0.0))
    return shares, caps, rules


def stop_and_go(k):
    """One metre per second for two seconds, two seconds of zero."""
    return (1.0, 0.0) if k % 80 < 40 else (0.0, 0.0)


def test_vehicle_at_the_bound_of_the_assumptions_has_a_share_of_one():
    shares, caps, rules = fly(stop_and_go, Plant(lag_s=CONFIG.lag_s, dead_s=CONFIG.dead_time_s))
    known = [share for share in shares if not math.isnan(share)]
    assert len(known) > 60
    assert min(known) == pytest.approx(1.0, abs=0.03)
    assert max(known) == pytest.approx(1.0, abs=0.03)
    assert set(caps) == {1.0}
    assert not any(rules)


def test_without_braking_there_is_no_evidence():
    shares, caps, rules = fly(lambda _: (1.0, 0.0))
    assert all(map(math.isnan, shares))
    assert set(caps) == {1.0}
    assert not any(rules)


def test_vehicle_that_never_reaches_its_speed_is_not_accused():
    """V10: too heavy to speed up; what it does not reach it need not brake."""
    _, caps, rules = fly(stop_and_go, Plant(lag_s=0.5, acceleration_m_s2=0.5), ticks=38)
    assert set(caps) == {1.0}
    assert not any(rules)


def test_weaker_braking_lowers_the_cap_then_lands():
    """V7: 1.0 s of lag instead of 0.6."""
    shares, caps, rules = fly(stop_and_go, Plant(lag_s=1.3))
    first_cap, first_fault = next(k for k, cap in enumerate(caps) if cap < 1.0), next(k for k, r in enumerate(rules) if r)
    assert rules[first_fault] == ["braking_weak"]
    assert 40 < first_cap < 70, "within 1.5 s of the zero command"
    assert first_cap < first_fault <= first_cap + 60, "3 s"
    assert caps[first_cap] == pytest.approx(shares[first_cap])
    assert min(caps) < C.braking_failed


def test_a_little_weaker_lowers_the_cap_only():
    _, caps, rules = fly(stop_and_go, Plant(lag_s=0.78), ticks=400)
    assert 0.7 < min(caps) < C.braking_weak
    assert not any(rules)


def test_cap_rises_only_above_the_healthy_share():
    """Hysteresis: a share between the two limits keeps what was decided before."""
    monitor = MotionMonitor(CONFIG)
    caps = []
    for k, share in enumerate((0.95, 0.899, 0.95, 0.999, 1.0, 0.95)):
        monitor.judge(state(time_s=0.05 * k), CommandHistory(), [])
        monitor._seen, monitor._expected = share, 1.0
        monitor._judge_braking(state(time_s=0.05 * k), CommandHistory(), 0.0, [])
        caps.append(monitor.cap)
    assert caps == [1.0, 0.899, 0.95, 0.999, 1.0, 1.0]


def test_better_braking_than_assumed_is_bounded():
    monitor = MotionMonitor(CONFIG)
    monitor._seen, monitor._expected = 9.0, 1.0
    assert (monitor.braking_share, monitor.cap) == (2.0, 1.0)


def test_the_same_sample_twice_counts_once():
    monitor, found = MotionMonitor(CONFIG), []
    for _ in range(100):
        monitor.judge(state(v=(1, 0, 0), time_s=1.0), CommandHistory(), found)
    assert not found
    assert math.isnan(monitor.braking_share)


@pytest.mark.parametrize("degrees", [90, -90, 180, 135])
def test_motion_against_the_commands(degrees):
    """E7: the vehicle flies where its wrong yaw sends it."""
    _, _, rules = fly(lambda _: (0.8, 0.0), turn_rad=math.radians(degrees), ticks=60)
    first = next(k for k, names in enumerate(rules) if "motion_direction" in names)
    assert 0.05 * first <= 2.2, "0.4 m/s take 0.7 s to reach, then 0.7 s"


@pytest.mark.parametrize("degrees", [0, 20, -25])
def test_small_errors_of_the_yaw_are_not_accused(degrees):
    assert not any(fly(lambda _: (0.8, 0.0), turn_rad=math.radians(degrees))[2])


def astray(flown):
    return any("motion_direction" in names for names in flown[2])


def test_direction_says_nothing_when_slow_or_held():
    assert not astray(fly(lambda _: (0.35, 0.0), turn_rad=math.pi))
    assert not astray(fly(lambda _: (0.8, 0.0), Plant(acceleration_m_s2=1e-6)))


def test_direction_is_forgiven_when_the_command_ends():
    assert not astray(fly(lambda k: (0.8, 0.0) if k % 40 < 18 else (0.0, 0.0), turn_rad=math.pi / 2))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.35, 0.58), st.floats(0.1, 0.2), st.floats(0.0, 0.02), st.integers(1, 40))
def test_vehicles_inside_the_assumptions_are_never_accused(seed, lag, dead, noise, hold):
    """Any commands inside the limits, any vehicle inside A1 to A4."""
    random = np.random.default_rng(seed)
    commands = [tuple(random.uniform(-0.8, 0.8, 2)) for _ in range(200)]
    _, caps, rules = fly(lambda k: commands[k // hold], Plant(lag_s=lag, dead_s=dead), noise=noise, seed=seed)
    assert not any(rules)
    assert min(caps) > 0.8


# the factor and what it does


def test_nominal_delays_cost_nothing():
    c = C
    health = Health(lateness_s=c.nominal_late_s, link_delay_s=c.nominal_link_delay_s, inference_s=c.inference_late_s)
    assert extra_delay_s(c.nominal_state_age_s, c.nominal_scan_age_s, health, CONFIG) == 0.0
    assert extra_delay_s(math.nan, math.nan, Health(), CONFIG) == 0.0
    assert cap_factor(0.0, 1.0, CONFIG) == 1.0


@pytest.mark.parametrize(
    ("ages", "health", "extra"),
    [
        ((0.18, 0.0), Health(), 0.1), ((0.0, 0.22), Health(), 0.1), ((0.18, 0.22), Health(), 0.1),
        ((0.0, 0.0), Health(lateness_s=0.07), 0.05), ((0.0, 0.0), Health(link_delay_s=0.3), 0.2),
        ((0.0, 0.0), Health(inference_s=0.045), 0.015), ((0.18, 0.0), Health(lateness_s=0.07, link_delay_s=0.3), 0.35),
    ],
)  # fmt: skip
def test_each_delay_beyond_nominal_adds_up(ages, health, extra):
    """K4, P6, C8, L16: ages by the worse one (both are measured at the same tick), all else in sum."""
    assert extra_delay_s(*ages, health, CONFIG) == pytest.approx(extra)
    assert cap_factor(extra, 1.0, CONFIG) == pytest.approx(CONFIG.delay_s / (CONFIG.delay_s + extra))


def test_the_way_out_stays_open():
    assert cap_factor(1e6, 1.0, CONFIG) == cap_factor(0.0, 0.0, CONFIG) == C.cap_least


def test_speed_cap_keeps_the_direction():
    capped, told = cap_speed(command(0.9, 1.2, 0.1, 0.7), 0.5, CONFIG)
    assert (capped.velocity.x, capped.velocity.y, capped.velocity.z) == pytest.approx((0.36, 0.48, 0.04))
    assert capped.yaw_rate_rad_s == 0.7
    assert told[0].rule == "speed_cap"
    assert told[0].limit == pytest.approx(math.dist((0, 0, 0), (0.36, 0.48, 0.04)))
    upward, _ = cap_speed(command(0.3, 0, 0.5), 0.5, CONFIG)
    assert (upward.velocity.x, upward.velocity.z) == pytest.approx((0.15, 0.25))


def test_speed_cap_tells_how_fast_the_command_was():
    _, told = cap_speed(command(0.9, -1.2, 0.8), 0.5, CONFIG)
    assert (told[0].value, told[0].limit) == pytest.approx((1.7, 0.3125 * 1.7))  # 0.25 of 0.8 m/s upwards is the worst share


@pytest.mark.parametrize("changes", [{}, {"max_horizontal_speed_m_s": 2.0, "max_vertical_speed_m_s": 1.5}])
@pytest.mark.parametrize("wanted", [(3.0, -4.0, 0.0), (-0.1, 0.0, -2.0), (0.9, 1.2, 1.4), (2.0, 0.1, -0.2)])
def test_speed_cap_is_the_largest_share_that_obeys_both_limits(wanted, changes):
    chosen = config(**changes)
    for factor in (0.25, 0.5, 0.9):
        across = factor * chosen.max_horizontal_speed_m_s / math.hypot(*wanted[:2])
        up = factor * chosen.max_vertical_speed_m_s / max(abs(wanted[2]), 1e-9)
        v = cap_speed(command(*wanted), factor, chosen)[0].velocity
        assert (v.x, v.y, v.z) == pytest.approx([min(across, up, 1.0) * part for part in wanted])


def test_the_cap_is_what_braking_and_delay_leave_together():
    t_s = CONFIG.dead_time_s + CONFIG.tick_s + CONFIG.lag_s
    assert cap_factor(0.0, 0.8, CONFIG) == pytest.approx(0.8)
    assert cap_factor(1.0, 1.0, CONFIG) == pytest.approx(t_s / (t_s + 1.0))
    assert cap_factor(0.15, 0.8, CONFIG) == pytest.approx(0.8 * t_s / (t_s + 0.15))
    assert cap_factor(0.15, 0.8, config(lag_s=1.0)) == pytest.approx(0.8 * 1.25 / 1.4)


def test_speed_cap_leaves_slow_commands_alone():
    slow = command(0.6, 0, 0.25)
    assert cap_speed(slow, 0.5, CONFIG) == (slow, ())
    assert cap_speed(slow, 0.5, CONFIG)[0] is slow
    fast = command(50.0)
    assert cap_speed(fast, 1.0, CONFIG)[0] is fast


@settings(deadline=None)
@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_more_delay_or_weaker_braking_never_allows_more(extra, more, braking, weaker):
    assert cap_factor(extra + more, braking * weaker, CONFIG) <= cap_factor(extra, braking, CONFIG)


@settings(deadline=None)
@given(*[st.floats(-1e6, 1e6)] * 3, st.floats(0.25, 1.0))
def test_capped_command_obeys_the_share_of_both_limits_and_never_grows(x, y, z, factor):
    capped, _ = cap_speed(command(x, y, z), factor, CONFIG)
    v, slack = capped.velocity, 1 + 1e-12
    if factor < 1.0:
        assert math.hypot(v.x, v.y) <= factor * CONFIG.max_horizontal_speed_m_s * slack
        assert abs(v.z) <= factor * CONFIG.max_vertical_speed_m_s * slack
    assert abs(v.x) <= abs(x)
    assert abs(v.y) <= abs(y)
    assert abs(v.z) <= abs(z)
