"""The brake tube: stop points, commands in flight, and the induction that makes "brake" always available."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import config, state

from safety.braking import HISTORY, CommandHistory, predict_start, stop_gain_s, tubes
from safety.frames import CorridorVector

component = st.floats(-0.6, 0.6)
vector = st.tuples(component, component, component)


def history_of(*sent) -> CommandHistory:
    history = CommandHistory()
    for time_s, velocity in sent:
        history.add(time_s, CorridorVector(*velocity))
    return history


def stop(start, u=(0.0, 0.0, 0.0), c=None) -> np.ndarray:
    return tubes(start, np.array([u]), c or config()).stop_m[:, 0]


def test_phases_cover_the_interval_with_what_was_sent():
    history = history_of((0.0, (1, 0, 0)), (0.05, (2, 0, 0)), (0.10, (3, 0, 0)))
    found = history.phases(0.02, 0.12, CorridorVector(9, 9, 9))
    assert [(round(d, 9), v.x) for d, v in found] == [(0.03, 1), (0.05, 2), (0.02, 3)]


def test_phases_before_the_first_command_keep_the_velocity():
    found = history_of((0.0, (1, 0, 0))).phases(-0.2, 0.05, CorridorVector(0.5, 0, 0))
    assert [(round(d, 9), v.x) for d, v in found] == [(0.2, 0.5), (0.05, 1)]
    assert [(round(d, 9), v.x) for d, v in CommandHistory().phases(0.0, 0.2, CorridorVector(0.5, 0, 0))] == [(0.2, 0.5)]


def test_history_takes_fixed_space_and_forgets():
    history = CommandHistory()
    for k in range(10 * HISTORY):
        history.add(k * 0.05, CorridorVector(k, 0, 0))
    assert len(history.phases(-1e9, 1e9, CorridorVector(0, 0, 0))) == HISTORY + 1
    history.clear()
    assert len(history.phases(0.0, 1.0, CorridorVector(0, 0, 0))) == 1


def test_stop_point_from_rest_and_from_speed():
    c = config(dead_time_s=0.2, tick_s=0.05, lag_s=0.6, braking_m_s2=2.0)
    rest = predict_start(state(), history_of(), 0.0, c)
    assert stop(rest, c=c) == pytest.approx(np.tile((5.0, 0.0, 2.0), (2, 1)))
    moving = predict_start(state(v=(1.0, 0, 0)), history_of((-0.3, (1.0, 0, 0))), 0.0, c)
    # 0.2 s of the command still in flight, then v tau: the tick at zero is part of the braking
    assert stop(moving, c=c)[0, 0] - 5.0 == pytest.approx(0.2 + 0.6)


def test_command_still_in_flight_counts():
    """Edge 17: at rest, but 1 m/s was sent for the last 0.2 s: the vehicle will fly although it stands."""
    c = config()
    start = predict_start(state(), history_of((-0.2, (1.0, 0, 0))), 0.0, c)
    assert stop(start, c=c)[0, 0] - 5.0 == pytest.approx(0.2)
    assert stop(start, c=c)[1, 0] - 5.0 >= 0.2  # the fast model has gathered more speed in the same time


def test_measured_velocity_counts_not_the_commanded():
    """Edge 18: wind carries the vehicle at 0.5 m/s under a zero command."""
    start = predict_start(state(v=(0.5, 0, 0)), history_of((-1.0, (0, 0, 0))), 0.0, config())
    assert stop(start)[0, 0] - 5.0 == pytest.approx(0.5 * 0.6)


def test_old_state_is_brought_to_now():
    c = config()
    fresh = predict_start(state(v=(1, 0, 0)), history_of((-1.0, (1, 0, 0))), 0.0, c)
    old = predict_start(state(v=(1, 0, 0), time_s=-0.1), history_of((-1.0, (1, 0, 0))), 0.0, c)
    assert stop(old, c=c)[0, 0] - stop(fresh, c=c)[0, 0] == pytest.approx(0.1)


@given(vector, vector, vector, vector)
def test_braking_does_not_move_the_stop_point(v, acting, u1, u2):
    """The induction step: after one tick of zero on the slow model, the stop point is where it was (no saturation)."""
    c = config(braking_m_s2=100.0)
    sent = ((-1.0, acting), (-0.1, u1), (-0.05, u2))
    before = stop(predict_start(state(v=v), history_of(*sent), 0.0, c), c=c)[0]
    u, velocity, left = np.array(acting), np.array(v), np.exp(-c.tick_s / c.lag_s)
    moved = np.array((5.0, 0.0, 2.0)) + u * c.tick_s + (velocity - u) * c.lag_s * (1 - left)
    later = state(*moved, v=tuple(u + (velocity - u) * left), time_s=c.tick_s)
    after = stop(predict_start(later, history_of(*sent, (0.0, (0, 0, 0))), c.tick_s, c), c=c)[0]
    assert after == pytest.approx(before, abs=1e-9)


@given(vector, vector)
def test_stop_point_moves_by_the_command_times_its_gain(v, u):
    c = config(braking_m_s2=100.0)
    start = predict_start(state(v=v), history_of(), 0.0, c)
    shift = stop(start, u, c) - stop(start, c=c)
    assert shift[0] == pytest.approx(np.array(u) * c.tick_s, abs=1e-9)
    assert (np.abs(shift) <= np.abs(u) * stop_gain_s(c) + 1e-9).all()


@given(vector, st.floats(0.2, 1.5))
@settings(max_examples=50)
def test_weaker_braking_stops_later(v, weaker):
    start = predict_start(state(v=v), history_of(), 0.0, config())
    strong, weak = stop(start, c=config(braking_m_s2=2.0)), stop(start, c=config(braking_m_s2=weaker))
    origin = start.position_m
    assert (np.linalg.norm(weak - origin, axis=1) >= np.linalg.norm(strong - origin, axis=1) - 1e-9).all()


def test_saturated_braking_takes_the_parabola():
    c = config(braking_m_s2=1.0, lag_s=0.6, tick_s=1e-6, dead_time_s=0.0)
    start = predict_start(state(v=(1.0, 0, 0)), history_of((-1.0, (1.0, 0, 0))), 0.0, c)
    assert stop(start, (1.0, 0, 0), c)[0, 0] - 5.0 == pytest.approx((1.0 - 0.36) / 2.0 + 0.36, abs=1e-5)
