"""What the filter takes in and keeps, once and in order: scans, commands sent, and what is missing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import command, config, scan, state

from safety.filter import SafetyFilter, _verdict
from safety.frames import CorridorVector
from safety.lidar import see
from safety.messages import SafeCommand
from safety.monitors import Judgement
from safety.shield import Decision

REST, AHEAD = CorridorVector(0.0, 0.0, 0.0), CorridorVector(0.25, 0.0, 0.0)
ALL = {"command": command(0.25), "state": state(), "scan": scan()}


@pytest.mark.parametrize("missing", [("command",), ("state",), ("scan",), ("command", "state"), ("state", "scan"), tuple(ALL)])
def test_what_is_missing_brakes_although_nobody_noticed(monkeypatch, missing):
    """With monitors that find no fault in anything."""
    given = {name: None if name in missing else value for name, value in ALL.items()}
    monkeypatch.setattr("safety.monitors.InputMonitor.judge", lambda *_: Judgement((), (), given["scan"]))
    sent, verdict = SafetyFilter(config()).apply(given["command"], given["state"], given["scan"], 0.0)
    assert (sent.velocity, verdict.fault, verdict.braking) == (REST, "input_missing", True)


def taken_in(monkeypatch, *times_s: float) -> list[float]:
    """Stamps of the scans that were taken in, of those that came at ticks of 0.05 s."""
    taken: list[float] = []

    def noted(new, *rest):
        taken.append(new.time_s)
        return see(new, *rest)

    monkeypatch.setattr("safety.filter.see", noted)
    safety = SafetyFilter(config())
    for k, time_s in enumerate(times_s):
        now_s = 1.0 + 0.05 * k
        safety.apply(command(), state(time_s=now_s), scan(np.full(180, 2.0 + 0.1 * k), time_s), now_s)
    return taken


def test_a_scan_is_taken_in_once_and_newer_ones_again(monkeypatch):
    """Equal stamps may be two objects."""
    assert taken_in(monkeypatch, 1.0, float("1.0"), 1.05, 1.05, 1.15) == [1.0, 1.05, 1.15]


def test_a_scan_from_before_is_not_taken_in_whatever_the_monitors_say(monkeypatch):
    older = scan(time_s=0.9)
    monkeypatch.setattr("safety.monitors.InputMonitor.judge", lambda _self, _command, _state, given, *_: Judgement((), (), given))
    assert taken_in(monkeypatch, 1.0, older.time_s, 1.1) == [1.0, 1.1]


def applied(*ticks: tuple[float, float]) -> SafetyFilter:
    """A filter that was asked for speeds at times, (s, m/s)."""
    safety = SafetyFilter(config(max_acceleration_m_s2=900.0, max_jerk_m_s3=1000.0))
    for now_s, speed in ticks:
        safety.apply(command(speed), state(time_s=now_s), scan(time_s=now_s), now_s)
    return safety


def test_asked_twice_at_the_same_time_the_last_command_counts():
    """Slowing down is free, so that the second one may be sent as it is."""
    now_s = 1.0
    for again_s in (now_s, float("1.0")):
        safety = applied((now_s, 0.25), (again_s, 0.125))
        assert safety._history.phases(1.0, 2.0, REST) == [(1.0, CorridorVector(0.125, 0.0, 0.0))]


@pytest.mark.parametrize("wrong_s", [math.nan, math.inf, -math.inf, 0.5])
def test_what_is_sent_at_an_impossible_time_is_not_among_the_commands_in_flight(wrong_s):
    safety = applied((1.0, 0.1), (wrong_s, 0.2))
    assert safety._last_time_s == 1.0
    assert [v.x for v in safety._history.sent(0.0, 9.0)] == [0.1]


@pytest.mark.parametrize("wrong_s", [math.nan, math.inf, -math.inf])
def test_no_flight_begins_at_an_impossible_time(wrong_s):
    safety = applied((wrong_s, 0.1))
    assert safety._last_time_s is None
    assert safety._history.sent(-9.0, 9.0) == []


@pytest.mark.parametrize(
    ("wanted", "sent", "braking"),
    [
        (AHEAD, REST, True),
        (AHEAD, AHEAD, False),
        (REST, REST, False),  # who wants to stand is not braked
        (REST, AHEAD, False),
        (CorridorVector(0.0, 0.0, -1e-9), REST, True),
        (AHEAD, CorridorVector(1.0, 0.0, 0.0), False),
        (AHEAD, CorridorVector(0.0, 1e-9, 0.0), False),
    ],
)
def test_it_brakes_where_motion_is_wanted_and_none_is_sent(wanted, sent, braking):
    decision = Decision(sent, (), 1.5, 2.5)
    found = _verdict(command(wanted.x, wanted.y, wanted.z), SafeCommand(sent, 0.0), (), decision)
    assert (found.braking, found.clearance_m, found.fence_margin_m, found.fault) == (braking, 1.5, 2.5, None)
