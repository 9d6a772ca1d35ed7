"""The times of the escalation met exactly, and clocks that must not be mistaken for each other."""

from __future__ import annotations

import dataclasses

import pytest

from safety.escalation import EscalationConfig, EscalationState, Level, escalate, re_engage
from safety.messages import Verdict

CONFIG = EscalationConfig(hold_after_s=2.0, land_after_s=10.0, healthy_s=1.0, blocked_hold_s=15.0)
GOOD, BLOCKED, SCAN = Verdict(braking=False), Verdict(braking=True), Verdict(braking=True, fault="scan_stale")


def level_after(*ticks: tuple[float, Verdict], state: EscalationState | None = None) -> Level:
    """The level after verdicts at times."""
    now = state or EscalationState()
    for time_s, verdict in ticks:
        now = escalate(now, verdict, time_s, CONFIG)
    return now.level


@pytest.mark.parametrize(("time_s", "level"), [(0.9375, Level.BRAKE), (1.0, Level.FLY), (1.0625, Level.FLY)])
def test_a_pause_ends_with_the_healthy_second_itself(time_s, level):
    assert level_after((0.0, SCAN), (time_s, GOOD)) == level


@pytest.mark.parametrize(("time_s", "level"), [(0.9375, Level.HOLD), (1.0, Level.FLY)])
def test_an_operator_may_engage_with_the_healthy_second_itself(time_s, level):
    held = EscalationState(Level.HOLD, 0.0, fault_last_s=0.0, cause="scan_stale")
    assert re_engage(held, time_s, CONFIG).level == level


@pytest.mark.parametrize(("time_s", "level"), [(1.9375, Level.BRAKE), (2.0, Level.HOLD)])
def test_a_fault_holds_with_its_second_second(time_s, level):
    assert level_after((0.0, SCAN), (time_s, SCAN)) == level


@pytest.mark.parametrize("begin_s", [0.0, 1.0, -1.0, 64.0])
@pytest.mark.parametrize(("lasted_s", "level"), [(9.0, Level.HOLD), (9.9375, Level.HOLD), (10.0, Level.LAND), (12.0, Level.LAND)])
def test_hold_lands_with_its_tenth_second_whenever_it_began(begin_s, lasted_s, level):
    held = EscalationState(Level.HOLD, begin_s, fault_since_s=begin_s - 2.0, fault_last_s=begin_s, cause="scan_stale")
    assert level_after((begin_s + lasted_s, SCAN), state=held) == level


@pytest.mark.parametrize(("time_s", "level"), [(14.9375, Level.FLY), (15.0, Level.HOLD), (15.5, Level.HOLD)])
def test_a_blocked_way_holds_with_its_fifteenth_second(time_s, level):
    assert level_after((0.0, BLOCKED), (time_s, BLOCKED)) == level


def test_a_pause_that_flickers_on_for_long_is_no_hold_that_lasts():
    """A fault every half second: never one of two seconds, for twenty."""
    flicker = [(0.25 * k, SCAN if k % 2 == 0 else GOOD) for k in range(81)]
    assert level_after(*flicker) == Level.BRAKE


def test_the_first_fault_long_after_an_operator_engaged_only_brakes():
    engaged = re_engage(EscalationState(Level.HOLD, 3.0), 4.0, CONFIG)
    assert engaged == EscalationState(Level.FLY, 4.0)
    assert level_after((64.0, SCAN), state=engaged) == Level.BRAKE


def test_landing_and_yielding_keep_level_time_and_cause_under_more_faults():
    for level in (Level.LAND, Level.YIELD):
        state = EscalationState(level, 0.0, cause="tilt")
        for time_s in (1.0, 12.0):
            state = escalate(state, SCAN, time_s, CONFIG)
            assert dataclasses.replace(state, fault_since_s=None, fault_last_s=None) == EscalationState(level, 0.0, cause="tilt")
