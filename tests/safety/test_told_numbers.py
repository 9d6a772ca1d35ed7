"""What a rule tells: the number that was measured and the limit that it broke, as whoever reads the log needs them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from safety_plant import command, config, scan, state

from safety.braking import CommandHistory
from safety.estimate_monitor import EstimateMonitor
from safety.frames import CorridorVector
from safety.limits import AT_REST, LastSent, limit_command
from safety.loop_monitor import LoopMonitor
from safety.messages import Health, Intervention
from safety.policy_monitor import PolicyMonitor
from safety.scan_monitor import ScanMonitor

CONFIG = config()
C = CONFIG.monitors
TICK_S = 0.0625  # exact in binary


def told(found):
    return [(item.rule, item.value, item.limit) for item in found]


def of_policy(commands):
    """What the last of some commands makes the monitor tell."""
    monitor, found = PolicyMonitor(CONFIG), list[Intervention]()
    for k, one in enumerate(commands):
        found.clear()
        monitor.judge(one, 8.0 + k * TICK_S, found)
    return told(found)


def test_policy_rules_tell_how_long_and_how_often():
    assert of_policy([command(1.2)] * 35) == [("policy_saturated", 34 * TICK_S, C.saturated_s)]
    assert of_policy([command(0.5 * (-1) ** k) for k in range(14)]) == [("policy_oscillating", 12.0, 10.0)]


def test_memory_and_bad_commands_tell_their_size():
    monitor, found = PolicyMonitor(CONFIG), list[Intervention]()
    monitor.judge_memory(Health(hidden_norm=9.5, inference_s=0.06), found)
    assert told(found) == [("hidden_exploded", 9.5, 9.0), ("inference_hung", 0.06, 0.05)]
    found.clear()
    for time_s in (8.0, 8.25, 8.5):
        monitor.judge_bad(time_s, found)
    assert told(found) == [("command_bad_again", 3.0, 3.0)]


def of_estimate(states, health=None, commanded_m_s=0.0):
    """What the last of some samples makes the monitor tell."""
    monitor, found = EstimateMonitor(C), list[Intervention]()
    for sample in states:
        found.clear()
        monitor.judge(sample, health or Health(), commanded_m_s, sample.time_s, found)
    return told(found)


def test_tilt_is_told_as_an_angle():
    assert of_estimate([state(roll=1.0)]) == [("tilt", pytest.approx(1.0), C.tilt_rad)]
    assert of_estimate([state(roll=3.0)]) == [("tumbling", pytest.approx(3.0), C.tumbling_rad)]
    assert of_estimate([state(roll=0.3, pitch=-1.5)]) == [
        ("tumbling", pytest.approx(math.acos(math.cos(0.3) * math.cos(1.5))), C.tumbling_rad)
    ]


def test_steps_of_the_estimate_are_told_in_metres_with_what_the_time_between_allows():
    before = state(5.0, 1.0, 2.0, v=(0.4, -0.2, 0.1), time_s=8.0)
    allowed_m = 0.25 + 1.6 * TICK_S
    moved = (0.4 * TICK_S, -0.2 * TICK_S, 0.1 * TICK_S)
    across = state(5.0 + moved[0] + 0.6, 1.0 + moved[1] - 0.8, 2.0 + moved[2], v=(0.4, -0.2, 0.1), time_s=8.0 + TICK_S)
    assert of_estimate([before, across]) == [("estimate_jump", pytest.approx(1.0), pytest.approx(allowed_m))]
    up = state(5.0 + moved[0], 1.0 + moved[1], 2.0 + moved[2] - 0.5, v=(0.4, -0.2, 0.1), time_s=8.0 + TICK_S)
    assert of_estimate([before, up]) == [("altitude_jump", pytest.approx(0.5), pytest.approx(allowed_m))]


def test_the_autopilots_own_doubts_are_told_as_it_reports_them():
    for before, now in ((3, 7), (255, 0), (0, 2)):
        resets = [dataclasses.replace(state(time_s=8.0 + k * TICK_S), reset_counter=n) for k, n in enumerate((before, now))]
        assert of_estimate(resets) == [("estimate_reset", float(now), float(before))]
    assert of_estimate([state(time_s=8.0)], Health(estimate_valid=False)) == [("estimate_invalid", 0.0, 1.0)]
    poor = [state(time_s=8.0 + k * TICK_S) for k in range(18)]
    assert of_estimate(poor, Health(accuracy_m=2.5)) == [("estimate_inaccurate", 2.5, C.accuracy_m)]


def test_a_still_estimate_is_told_with_its_time():
    still = [state(v=(0.2, 0.0, 0.0), time_s=8.0 + k * TICK_S) for k in range(6)]
    assert of_estimate(still, commanded_m_s=0.5) == [("estimate_frozen", 5 * TICK_S, C.frozen_state_s)]


def of_loop(healths, history=None, step_s=TICK_S):
    """What the last of some ticks makes the monitor tell."""
    monitor, found = LoopMonitor(C), list[Intervention]()
    for k, health in enumerate(healths):
        found.clear()
        monitor.judge(health, history or CommandHistory(), 8.0 + k * step_s, found)
    return told(found)


def test_the_loop_tells_times_counts_and_charges():
    assert of_loop([Health(in_control=False, landed=True)]) == [("control_lost", 0.0, 1.0), ("landed", 1.0, 0.0)]
    assert of_loop([Health(boots=2), Health(boots=5)]) == [("autopilot_rebooted", 5.0, 2.0)]
    assert of_loop([Health()] * 2, step_s=0.75) == [("tick_gap", 0.75, C.gap_s)]
    assert of_loop([Health(lateness_s=0.07)] * 3) == [("loop_late", 0.07, C.late_s)]
    assert of_loop([Health(link_delay_s=0.9)] * 8) == [("link_slow", 0.9, C.link_delay_s)]
    assert of_loop([Health(battery_fraction=0.1)]) == [("battery_low", 0.1, C.battery_low)]
    assert of_loop([Health(battery_fraction=0.01)]) == [("battery_critical", 0.01, C.battery_critical)]


def test_a_foreign_setpoint_is_told_by_its_distance_from_the_nearest_of_ours():
    history, ours = CommandHistory(), CorridorVector(0.8, 0.0, 0.0)
    for k in range(20):
        history.add(8.0 + k * TICK_S, ours)
    foreign = [Health(echo=CorridorVector(0.8, 0.3, -0.4), echo_time_s=8.0 + k * TICK_S) for k in range(20)]
    assert of_loop(foreign, history) == [("foreign_setpoint", pytest.approx(0.5), C.echo_error_m_s)]


def of_limits(wanted, last=AT_REST, **changes):
    return told(limit_command(wanted, last, 0.05, 4.0, config(**changes))[1])


def test_limits_tell_what_was_wanted_and_what_is_allowed():
    free = {"max_acceleration_m_s2": 900.0, "max_jerk_m_s3": 1000.0}
    allowed_m_s = pytest.approx(limit_command(command(1.2), AT_REST, 0.05, 4.0, config(**free))[0].velocity.x)
    assert of_limits(command(3.0, -4.0), **free)[:1] == [("speed_limit", 5.0, allowed_m_s)]
    assert of_limits(command(0.0, 0.0, -0.75, -1.5), **free) == [
        ("vertical_speed_limit", 0.75, 0.5),
        ("yaw_rate_limit", 1.5, 1.0),
    ]
    grown = of_limits(
        command(0.6, 0.8), LastSent(CorridorVector(0.3, 0.4, 0.0), CorridorVector(0.0, 0.0, 0.0)), max_acceleration_m_s2=4.0
    )
    assert grown == [("acceleration_limit", pytest.approx(0.5), pytest.approx(0.2))]
    assert of_limits(command(0.48, 0.0), max_jerk_m_s3=80.0) == [("jerk_limit", pytest.approx(0.48), pytest.approx(0.2))]


def test_scans_tell_numbers_votes_and_masked_beams():
    monitor, found = ScanMonitor(CONFIG), list[Intervention]()
    for k, number in enumerate((900, 7)):
        monitor.judge(scan(time_s=k * TICK_S, sequence=number), state(time_s=k * TICK_S), found)
    assert told(found) == [("scan_source", 7.0, 900.0)]
    leg = scan(np.where(np.arange(180) < 3, 0.2, 3.0))
    for k in range(2, 20):
        now_s = k * TICK_S
        monitor.judge(dataclasses.replace(leg, time_s=now_s, sequence=k + 8), state(v=(0.5, 0, 0), time_s=now_s), found)
    notices = list[Intervention]()
    monitor.masked(leg, notices)
    assert told(notices) == [("scan_sector_masked", 3.0, 0.0)]
