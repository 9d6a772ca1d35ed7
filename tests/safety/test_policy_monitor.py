"""The policy's output as a sign of its health."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import command, config

from safety.messages import Health
from safety.policy_monitor import PolicyMonitor

CONFIG = config()
C = CONFIG.monitors
TICK = 0.0625


def notices(commands, step_s=TICK):
    monitor, result = PolicyMonitor(CONFIG), []
    for k, one in enumerate(commands):
        told = []
        monitor.judge(one, 8.0 + k * step_s, told)
        result.append([item.rule for item in told])
    return result


@pytest.mark.parametrize(
    ("health", "rule"),
    [
        (Health(hidden_norm=C.hidden_norm_max), None), (Health(hidden_norm=C.hidden_norm_max + 1e-6), "hidden_exploded"),
        (Health(hidden_norm=math.inf), "hidden_exploded"), (Health(inference_s=C.inference_hung_s), None),
        (Health(inference_s=C.inference_hung_s + 1e-9), "inference_hung"), (Health(), None),
    ],
)  # fmt: skip
def test_memory_and_inference_limits_are_exact(health, rule):
    """P5, P7."""
    found = []
    PolicyMonitor(CONFIG).judge_memory(health, found)
    assert [item.rule for item in found] == ([rule] if rule else [])


def bad(times):
    monitor, result = PolicyMonitor(CONFIG), []
    for time_s in times:
        found = []
        monitor.judge_bad(time_s, found)
        result.append(bool(found))
    return result


def test_third_bad_command_within_a_second():
    """P1: three in exactly one second are too many; slower ones are not."""
    assert bad([8.0, 8.5, 9.0, 9.5]) == [False, False, True, True]
    assert bad([8.0, 8.5, 9.0001, 9.51]) == [False, False, False, False]
    assert bad([0.6, 1.2, 1.7, 1.9]) == [False, False, False, True]  # soon after the clock began, too


@pytest.mark.parametrize(
    "full",
    [
        command(1.2),
        command(0, -1.19),
        command(0, 0, 0.5),
        command(0, 0, -0.495),
        command(0, 0, 0, -1.0),
        command(0.2, 0, 0, 0.99),
    ],
)
def test_saturation_is_told_after_two_seconds(full):
    """P2: 32 ticks of 62.5 ms."""
    assert notices([full] * 34) == [[]] * 32 + [["policy_saturated"]] * 2
    assert not any(notices([full] * 31 + [command(0.5)] + [full] * 31))


@pytest.mark.parametrize(("short_s", "is_told"), [(1e-6, True), (2e-6, False)])
def test_saturation_forgives_a_microsecond_of_rounding(short_s, is_told):
    monitor, told = PolicyMonitor(CONFIG), []
    for now_s in (0.0, C.saturated_s - short_s):
        monitor.judge(command(1.2), now_s, told)
    assert bool(told) == is_told


def test_cruising_is_not_saturation():
    assert not any(notices([command(1.1, 0.3, 0.4, 0.9)] * 100))


@pytest.mark.parametrize("limit", [0.5, 2.0])
@pytest.mark.parametrize("channel", range(4))
def test_each_channel_is_full_from_99_percent_of_its_own_limit_on(channel, limit):
    chosen = config(max_horizontal_speed_m_s=limit, max_vertical_speed_m_s=limit, max_yaw_rate_rad_s=limit)
    for share, full in ((0.99, True), (-0.99, True), (0.989, False), (-0.989, False)):
        monitor, told = PolicyMonitor(chosen), []
        for k in range(40):
            monitor.judge(command(*(share * limit * (i == channel) for i in range(4))), 0.6 + k * TICK, told)
        assert bool(told) == full


def test_a_bad_command_ends_saturation_and_oscillation():
    monitor, told = PolicyMonitor(CONFIG), []
    for k in range(60):
        if k % 9 == 8:
            monitor.judge_bad(8.0 + k * TICK, [])
        else:
            monitor.judge(command(1.2 if k % 2 else -1.2), 8.0 + k * TICK, told)
    assert not told


def test_oscillation_at_half_the_rate_is_told():
    """P10: the step turns back at every tick; the second command makes the first step, the tenth turn is told."""
    swing = [command(0.5 * (-1) ** k) for k in range(14)]
    assert notices(swing) == [[]] * 11 + [["policy_oscillating"]] * 3
    assert not any(notices([command(0.0, 0.15 * (-1) ** k) for k in range(40)]))  # steps of exactly 0.3 m/s


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_oscillation_is_told_at_the_same_tick_along_every_axis_either_way(axis, sign):
    swing = [command(*(0.4 * sign * (-1) ** k * (i == axis) for i in range(3))) for k in range(14)]
    assert notices(swing) == [[]] * 11 + [["policy_oscillating"]] * 3


def swinging(chance):
    """Velocities whose steps mostly turn back, not along one line, and are sometimes short or go on."""
    v, step, result = [0.0] * 3, [chance.uniform(-0.5, 0.5) for _ in range(3)], []
    for _ in range(60):
        result.append(tuple(v))
        back = -1.0 if chance.random() < 0.97 else 1.0
        size = 0.2 if chance.random() < 0.02 else chance.uniform(0.35, 0.6)
        step = [back * part + chance.uniform(-0.2, 0.2) for part in step]
        step = [size * part / math.hypot(*step) for part in step]
        v = [a + b for a, b in zip(v, step, strict=True)]
    return result


def turns_in_a_row(velocities):
    """Of each velocity: how many steps up to it turned back without a break, each longer than the limit."""
    steps = [[b - a for a, b in zip(p, q, strict=True)] for p, q in itertools.pairwise(velocities)]
    turns = [0, 0]
    for before, step in itertools.pairwise(steps):
        back = sum(a * b for a, b in zip(before, step, strict=True)) < 0.0
        turns.append(turns[-1] + 1 if back and math.hypot(*step) > C.oscillation_m_s else 0)
    return turns


@pytest.mark.parametrize("seed", range(30))
def test_turns_in_any_direction_are_counted_by_the_whole_vector(seed):
    velocities = swinging(random.Random(seed))
    monitor, found = PolicyMonitor(CONFIG), []
    for k, v in enumerate(velocities):
        told = []
        monitor.judge(command(*v), 8.0 + k * TICK, told)
        found.append([item.value for item in told if item.rule == "policy_oscillating"])
    assert found == [[float(n)] if n >= C.oscillation_ticks else [] for n in turns_in_a_row(velocities)]


def test_a_monitor_that_was_reset_judges_like_a_new_one():
    def run(monitor):
        found = []
        for k in range(50):
            told = []
            if k % 17 == 16:
                monitor.judge_bad(8.0 + k * TICK, told)
            else:
                monitor.judge(command(1.2 * (-1) ** k), 8.0 + k * TICK, told)
            found.append([(item.rule, item.value) for item in told])
        return found

    used = PolicyMonitor(CONFIG)
    first = run(used)
    used.reset()
    assert run(used) == first == run(PolicyMonitor(CONFIG))


def test_slower_swings_are_manoeuvres():
    """Two ticks there, two ticks back is a quarter of the rate: nothing turns back at each tick."""
    assert not any(notices([command(0.5 if k // 2 % 2 else -0.5) for k in range(80)]))


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-1.1, 1.1), st.floats(-1.1, 1.1), st.floats(-0.49, 0.49)), max_size=60))
def test_oscillation_needs_ten_turns_in_a_row(velocities):
    turns = 0
    told = notices([command(*v) for v in velocities])
    for k in range(len(velocities)):
        if k >= 2:
            before = [b - a for a, b in zip(velocities[k - 2], velocities[k - 1], strict=True)]
            step = [b - a for a, b in zip(velocities[k - 1], velocities[k], strict=True)]
            back = sum(a * b for a, b in zip(before, step, strict=True)) < 0.0
            turns = turns + 1 if back and math.hypot(*step) > C.oscillation_m_s else 0
        assert (told[k] == ["policy_oscillating"]) == (turns >= C.oscillation_ticks)
