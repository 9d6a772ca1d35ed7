"""The brake tube and the commands in flight, number by number: equal times, all three axes, ticks longer than a lag."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config, state

from safety.braking import CommandHistory, Start, flown_velocity, predict_start, stop_gain_s, stop_time_s, tubes
from safety.frames import CorridorVector

REST = CorridorVector(0.0, 0.0, 0.0)
BEFORE = CorridorVector(9.0, 9.0, 9.0)
FIRST, SECOND, THIRD = (CorridorVector(float(k), 0.5, -0.25) for k in (1, 2, 3))
E = math.exp(-1.0)


def history() -> CommandHistory:
    """Three commands, a quarter of a second apart."""
    sent = CommandHistory()
    for time_s, command in ((1.0, FIRST), (1.25, SECOND), (1.5, THIRD)):
        sent.add(time_s, command)
    return sent


def test_before_the_first_command_the_newest_is_none():
    assert CommandHistory().newest() == REST


def test_an_overruled_command_keeps_its_time():
    sent = history()
    sent.overrule()
    assert sent.newest() == REST
    assert sent.phases(1.0, 1.75, BEFORE) == [(0.25, FIRST), (0.25, SECOND), (0.25, REST)]


def test_overruling_nothing_sends_nothing():
    sent = CommandHistory()
    sent.overrule()
    assert sent.sent(0.0, 9.0) == []


@pytest.mark.parametrize(
    ("begin_s", "end_s", "newest"),
    [
        (1.25, 1.5, [THIRD, SECOND]),  # sent at the very end: the newest one then; the first was replaced at the begin
        (1.3, 1.4, [SECOND]),
        (1.2, 1.25, [SECOND, FIRST]),
        (0.0, 0.9, []),
        (0.0, 1.0, [FIRST]),
        (2.0, 3.0, [THIRD]),
    ],
)
def test_commands_count_from_their_own_time_up_to_the_next(begin_s, end_s, newest):
    assert history().sent(begin_s, end_s) == newest


@pytest.mark.parametrize(
    ("begin_s", "end_s", "phases"),
    [
        (1.0, 1.5, [(0.25, FIRST), (0.25, SECOND)]),  # what is sent at the end has lasted no time, nor has what was before
        (1.25, 1.375, [(0.125, SECOND)]),
        (0.5, 1.125, [(0.5, BEFORE), (0.125, FIRST)]),
        (0.5, 0.75, [(0.25, BEFORE)]),
        (1.5, 1.5, []),
        (1.75, 1.625, []),  # an estimate ahead of the clock: no time to cover
        (1.125, 0.5, []),
    ],
)
def test_phases_last_from_command_to_command(begin_s, end_s, phases):
    assert history().phases(begin_s, end_s, BEFORE) == phases


def test_the_begin_may_be_the_time_of_a_command_to_the_bit():
    """Two equal numbers that are two objects."""
    sent = CommandHistory()
    sent.add(float("1.25"), FIRST)
    assert sent.phases(float("1.25"), 2.0, BEFORE) == [(0.75, FIRST)]


def test_one_lag_takes_all_but_a_third_of_the_way_to_a_command():
    """From v to the command u in a lag of 1 s: u + (v - u) / e after 1 s, having come u + (v - u) (1 - 1 / e)."""
    c = config(lag_s=1.0, lag_min_s=1.0, dead_time_s=1.0)
    v, u = np.array((1.0, -0.5, 0.25)), CorridorVector(0.25, 0.5, -0.5)
    sent = CommandHistory()
    sent.add(3.0, u)
    found = predict_start(state(0.0, 0.0, 0.0, v=tuple(v), time_s=4.0), sent, 4.0, c)
    wanted = np.array((0.25, 0.5, -0.5))
    assert found.velocity_m_s == pytest.approx(np.tile(wanted + (v - wanted) * E, (2, 1)))
    assert found.position_m == pytest.approx(np.tile(wanted + (v - wanted) * (1.0 - E), (2, 1)))


def test_velocity_is_flown_through_all_phases_on_all_axes():
    """A lag of 0.5 s: after half a second 1 / e of the difference is left, after a whole one 1 / e^2."""
    found = flown_velocity(CorridorVector(1.0, 2.0, 3.0), [(0.5, REST), (1.0, CorridorVector(4.0, -5.0, 6.0))], 0.5)
    half = np.array((1.0, 2.0, 3.0)) * E
    wanted = np.array((4.0, -5.0, 6.0))
    assert found == pytest.approx(wanted + (half - wanted) * E * E)


@pytest.mark.parametrize(("lag_s", "lag_min_s"), [(1.0, 0.5), (2.0, 1.0)])
def test_a_tick_of_one_second_turns_the_vehicle_as_its_lags_say(lag_s, lag_min_s):
    """From rest under a command of 1 m/s: 1 - tau (1 - exp(-1 / tau)) m in 1 s, tau after tau."""
    c = config(lag_s=lag_s, lag_min_s=lag_min_s, tick_s=1.0, braking_m_s2=100.0)
    tube = tubes(Start(np.zeros((2, 3)), np.zeros((2, 3))), np.array([[0.0, 1.0, 0.0]]), c)
    assert tube.turn_m[:, 0, 1] == pytest.approx([1.0 - tau * (1.0 - math.exp(-1.0 / tau)) for tau in (lag_s, lag_min_s)])


@pytest.mark.parametrize(
    ("tick_s", "lag_s", "lag_min_s", "gain_s"),
    [
        (0.05, 0.6, 0.35, 0.05 + 0.25 * (1.0 - math.exp(-1.0 / 7.0))),  # at most: the fast loop speeds up, the slow one brakes
        (1.0, 1.0, 0.5, 1.0 + 0.5 * (1.0 - E * E)),
        (0.3, 0.9, 0.9, 0.3),  # one loop: what was sent for a tick
    ],
)
def test_the_stop_point_moves_by_tick_and_difference_of_the_lags(tick_s, lag_s, lag_min_s, gain_s):
    c = config(tick_s=tick_s, lag_s=lag_s, lag_min_s=lag_min_s, braking_m_s2=100.0)
    assert stop_gain_s(c) == pytest.approx(gain_s)
    tube = tubes(Start(np.zeros((2, 3)), np.zeros((2, 3))), np.array([[1.0, 0.0, 0.0]]), c)
    assert tube.stop_m[:, 0, 0].max() == pytest.approx(gain_s)


@pytest.mark.parametrize(("braking_m_s2", "speed_m_s", "time_s"), [(1.0, 0.3, 0.5), (1.0, 1.0, 0.625), (3.0, 2.0, 6.25 / 12.0)])
def test_stopping_takes_the_lag_or_longer_where_deceleration_binds(braking_m_s2, speed_m_s, time_s):
    """Knee b tau = 0.5 and 1.5 m/s: (v^2 + knee^2) / (2 b v) above: 1.25 / 2; (4 + 2.25) / 12."""
    assert stop_time_s(speed_m_s, config(braking_m_s2=braking_m_s2, lag_s=0.5)) == pytest.approx(time_s)
