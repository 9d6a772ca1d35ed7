"""The escalation: small enough to be walked through completely."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safety.escalation import ESTIMATE_FAULTS, EscalationConfig, EscalationState, Level, escalate, re_engage
from safety.messages import Verdict
from safety.reactions import REACTIONS

CONFIG = EscalationConfig()
GOOD = Verdict(braking=False)
BLOCKED = Verdict(braking=True)
SCAN = Verdict(braking=True, fault="scan_stale")
STATE = Verdict(braking=True, fault="state_stale")
TICK = 0.05


def run(verdict, duration_s, state=None, begin_s=0.0):
    state, ticks = state or EscalationState(), round(duration_s / TICK)
    for k in range(ticks):
        state = escalate(state, verdict, begin_s + k * TICK, CONFIG)
    return state, begin_s + ticks * TICK


def test_healthy_flight_stays_at_fly():
    assert run(GOOD, 30.0)[0] == EscalationState()


def test_fault_brakes_in_the_same_tick():
    state = escalate(EscalationState(), SCAN, 5.0, CONFIG)
    assert (state.level, state.level_since_s, state.cause) == (Level.BRAKE, 5.0, "scan_stale")


def test_short_fault_ends_after_a_healthy_second():
    state, now = run(SCAN, 0.5)
    state, now = run(GOOD, 0.9, state, now)
    assert state.level == Level.BRAKE
    state, _ = run(GOOD, 0.2, state, now)
    assert state.level == Level.FLY
    assert state.cause is None


def test_flickering_fault_does_not_end_the_pause():
    state, now = run(SCAN, 0.2)
    for _ in range(10):
        state, now = run(GOOD, 0.5, state, now)
        state, now = run(SCAN, 0.05, state, now)
    assert state.level == Level.BRAKE


@pytest.mark.parametrize(("verdict", "level"), [(SCAN, Level.HOLD), (STATE, Level.LAND)])
def test_lasting_fault_goes_up_after_two_seconds(verdict, level):
    state, now = run(verdict, 2.0)
    assert state.level == Level.BRAKE
    assert run(verdict, 0.1, state, now)[0].level == level


def test_fault_that_outlasts_hold_lands():
    state, now = run(SCAN, 2.05)
    assert state.level == Level.HOLD
    state, now = run(SCAN, 9.9, state, now)
    assert state.level == Level.HOLD
    assert run(SCAN, 0.2, state, now)[0].level == Level.LAND


def test_hold_without_fault_stays_hold():
    state, now = run(SCAN, 2.1)
    assert run(GOOD, 60.0, state, now)[0].level == Level.HOLD


def test_estimate_lost_while_holding_lands():
    state, now = run(SCAN, 2.1)
    assert run(STATE, 0.05, state, now)[0].level == Level.LAND


def test_obstacle_braking_waits_fifteen_seconds():
    state, now = run(BLOCKED, 14.9)
    assert state.level == Level.FLY
    state, _ = run(BLOCKED, 0.2, state, now)
    assert (state.level, state.cause) == (Level.HOLD, "blocked")


def test_obstacle_braking_with_a_break_starts_anew():
    state, now = run(BLOCKED, 14.0)
    state, now = run(GOOD, 0.05, state, now)
    assert run(BLOCKED, 14.0, state, now)[0].level == Level.FLY


def test_only_an_operator_leaves_hold_and_only_when_healthy():
    state, now = run(SCAN, 2.1)
    assert re_engage(state, now, CONFIG) == state
    state, now = run(GOOD, 1.1, state, now)
    assert re_engage(state, now, CONFIG) == EscalationState(Level.FLY, now)
    assert re_engage(EscalationState(), 1.0, CONFIG).level == Level.FLY


@given(st.lists(st.tuples(st.sampled_from([GOOD, BLOCKED, SCAN, STATE]), st.floats(0.01, 20.0)), max_size=40))
def test_severity_never_drops_by_itself(steps):
    """Any sequence: only BRAKE may fall, only to FLY, only after a healthy second."""
    state, now, last_fault = EscalationState(), 0.0, None
    for verdict, duration in steps:
        now += duration
        last_fault = now if verdict.fault else last_fault
        after = escalate(state, verdict, now, CONFIG)
        if after.level < state.level:
            assert (state.level, after.level) == (Level.BRAKE, Level.FLY)
            assert now - last_fault >= CONFIG.healthy_s
        assert after.level >= Level.BRAKE or verdict.fault is None
        state = after


def test_every_reachable_state_has_a_way_up_and_land_is_final():
    """All sequences of four 6 s phases: LAND is never left, and a lasting estimate fault always ends in LAND."""
    for phases in itertools.product([GOOD, BLOCKED, SCAN, STATE], repeat=4):
        state, now = EscalationState(), 0.0
        for verdict in phases:
            landed = state.level == Level.LAND
            state, now = run(verdict, 6.0, state, now)
            assert not landed or state.level == Level.LAND
        assert run(STATE, 2.1, state, now)[0].level == Level.LAND


def test_estimate_faults_are_rules_of_the_monitor():
    """HOLD needs an estimate: what says that there is none, or that it is wrong, ends in LAND."""
    assert REACTIONS.keys() >= ESTIMATE_FAULTS
    assert {rule for rule in REACTIONS if rule.startswith("state_")} <= ESTIMATE_FAULTS
