"""The policy's output as a sign of its health."""

from __future__ import annotations

import math

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


def test_cruising_is_not_saturation():
    assert not any(notices([command(1.1, 0.3, 0.4, 0.9)] * 100))


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
