"""Every input fault has its own rule, brakes at once and says so; the catalogue's names are in the ids."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from safety_plant import command, config, scan, state

from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import SafeCommand, VelocityCommand

NAN3 = CorridorVector(math.nan, 0.0, 0.0)
WALL = np.full(180, 2.0) + 0.001 * np.arange(180)
STOPPED = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)


def flying(ticks=6, **changes):
    """A filter that has flown forward in the open for a while, and its next tick's time."""
    safety = SafetyFilter(config(**changes))
    for k in range(ticks):
        time_s = 0.05 * k
        sent, verdict = safety.apply(command(0.5), state(5.0 + 0.01 * k, time_s=time_s), scan(time_s=time_s), time_s)
        assert verdict.fault is None
        assert sent.velocity.x == 0.5
    return safety, 0.05 * ticks


def nxt(time_s, **parts):
    """The next tick's arguments, all healthy but for `parts`."""
    healthy = {"command": command(0.5), "state": state(5.2, time_s=time_s), "scan": scan(time_s=time_s), "now_s": time_s}
    return healthy | parts


@pytest.mark.parametrize(
    ("rule", "parts"),
    [
        pytest.param("command_missing", lambda t: {"command": None}, id="P1-none"),
        pytest.param("command_not_finite", lambda t: {"command": command(math.nan)}, id="P1-nan"),
        pytest.param("command_not_finite", lambda t: {"command": command(0, math.inf)}, id="P1-inf"),
        pytest.param("command_not_finite", lambda t: {"command": command(0, 0, -math.inf)}, id="P1-minus-inf"),
        pytest.param("command_not_finite", lambda t: {"command": command(0, 0, 0, math.nan)}, id="P1-yaw-rate"),
        pytest.param("state_missing", lambda t: {"state": None}, id="edge20-no-state"),
        pytest.param("state_stale", lambda t: {"state": state(time_s=t - 0.21)}, id="E3"),
        pytest.param("state_future", lambda t: {"state": state(time_s=t + 0.03)}, id="state-ahead"),
        pytest.param("state_stale", lambda t: {"state": state(time_s=math.nan)}, id="E4-stamp"),
        pytest.param(
            "state_not_finite", lambda t: {"state": dataclasses.replace(state(time_s=t), position=NAN3)}, id="E4-position"
        ),
        pytest.param(
            "state_not_finite", lambda t: {"state": dataclasses.replace(state(time_s=t), velocity=NAN3)}, id="E4-velocity"
        ),
        pytest.param(
            "state_not_finite", lambda t: {"state": dataclasses.replace(state(time_s=t), acceleration=NAN3)}, id="E4-acceleration"
        ),
        pytest.param("state_not_finite", lambda t: {"state": state(time_s=t, yaw=math.inf)}, id="E4-yaw"),
        pytest.param("state_not_finite", lambda t: {"state": state(time_s=t, roll=math.nan)}, id="E4-roll"),
        pytest.param("state_backwards", lambda t: {"state": state(time_s=t - 0.11)}, id="K5"),
        pytest.param("scan_missing", lambda t: {"scan": None}, id="L1-none"),
        pytest.param("scan_stale", lambda t: {"scan": scan(time_s=t - 0.26)}, id="L1-old"),
        pytest.param("scan_future", lambda t: {"scan": scan(time_s=t + 0.03)}, id="L10"),
        pytest.param("scan_not_finite", lambda t: {"scan": scan(time_s=math.nan)}, id="scan-stamp"),
        pytest.param("scan_backwards", lambda t: {"scan": scan(time_s=t - 0.11)}, id="scan-reordered"),
        pytest.param(
            "scan_shape", lambda t: {"scan": dataclasses.replace(scan(time_s=t), ranges_m=np.ones((2, 2)))}, id="L8-shape"
        ),
        pytest.param(
            "scan_geometry", lambda t: {"scan": dataclasses.replace(scan(time_s=t), angle_increment_rad=-0.1)}, id="L8-angle"
        ),
        pytest.param("scan_unknown", lambda t: {"scan": scan(np.full(180, np.nan), t)}, id="L6-all-nan"),
        pytest.param(
            "scan_unknown", lambda t: {"scan": scan(np.where(np.arange(180) < 91, np.nan, np.inf), t)}, id="L6-half-nan"
        ),
        pytest.param("scan_touching", lambda t: {"scan": scan(np.zeros(180), t)}, id="L5-zeros"),
        pytest.param("scan_touching", lambda t: {"scan": scan(np.full(180, -np.inf), t)}, id="L5-minus-inf"),
        pytest.param("clock_backwards", lambda t: {"now_s": t - 0.06}, id="edge29"),
        pytest.param("clock_backwards", lambda t: {"now_s": math.nan}, id="clock-nan"),
        pytest.param("clock_not_finite", lambda t: {"now_s": math.inf}, id="clock-inf"),
        pytest.param("internal_error", lambda t: {"command": "forward"}, id="edge19-command-type"),
        pytest.param("internal_error", lambda t: {"state": object()}, id="edge19-state-type"),
    ],
)
def test_fault_brakes_and_is_named(rule, parts):
    safety, time_s = flying()
    sent, verdict = safety.apply(**nxt(time_s, **parts(time_s)))
    assert sent == STOPPED
    assert verdict.braking
    assert verdict.fault == rule
    assert verdict.interventions[0].rule == rule


def test_fault_is_over_with_the_next_good_input():
    safety, time_s = flying()
    assert safety.apply(**nxt(time_s, scan=None))[1].fault == "scan_missing"
    sent, verdict = safety.apply(**nxt(time_s + 0.05))
    assert verdict.fault is None
    assert sent.velocity.x == pytest.approx(0.375)  # as far as the jerk limit goes in one tick


def test_exception_text_is_kept_and_reset_forgets_it():
    safety, time_s = flying()
    assert safety.last_error is None
    safety.apply(**nxt(time_s, command="forward"))
    assert "AttributeError" in safety.last_error
    safety.reset()
    assert safety.last_error is None


@pytest.mark.parametrize(("age", "fault"), [(0.25, None), (0.2501, "scan_stale"), (-0.02, None), (-0.0201, "scan_future")])
def test_scan_age_limits_are_exact(age, fault):
    safety = SafetyFilter(config())
    now = 16.0
    _, verdict = safety.apply(command(), state(time_s=now), scan(time_s=now - age), now)
    assert verdict.fault == fault
    assert verdict.scan_age_s == pytest.approx(age)


@pytest.mark.parametrize(("age", "fault"), [(0.2, None), (0.2001, "state_stale"), (-0.02, None), (-0.0201, "state_future")])
def test_state_age_limits_are_exact(age, fault):
    safety = SafetyFilter(config())
    now = 16.0
    _, verdict = safety.apply(command(), state(time_s=now - age), scan(time_s=now), now)
    assert verdict.fault == fault
    assert verdict.state_age_s == pytest.approx(age)


def frozen(ranges, v=(0.5, 0, 0), yaw_rate=0.0, fresh=True):
    """Faults of six ticks that all show the same ranges."""
    safety, faults = SafetyFilter(config()), []
    for k in range(6):
        time_s = 0.05 * k
        stamp = time_s if fresh else 0.0
        _, verdict = safety.apply(command(0.2), state(v=v, yaw_rate=yaw_rate, time_s=time_s), scan(ranges, stamp), time_s)
        faults.append(verdict.fault)
    return faults


def test_frozen_scan_with_fresh_stamps_brakes_on_the_third_repeat():
    """L2, edge 30: re-stamped data. 3 repeats = 150 ms."""
    assert frozen(WALL) == [None, None, None, "scan_frozen", "scan_frozen", "scan_frozen"]
    assert frozen(WALL, v=(0, 0, 0), yaw_rate=-0.5)[3:] == ["scan_frozen"] * 3


def test_a_frozen_scan_stays_one_when_the_vehicle_has_braked():
    """L2: until a scan differs."""
    safety, faults = SafetyFilter(config()), []
    for k in range(12):
        seen, speed = (WALL if k < 9 else WALL - 0.1), (0.5 if k < 5 else 0.0)
        sample = state(x=0.0, v=(speed, 0, 0), time_s=0.05 * k)
        _, verdict = safety.apply(command(0.2), sample, scan(seen, 0.05 * k), 0.05 * k)
        faults.append(verdict.fault)
    assert [fault == "scan_frozen" for fault in faults] == [False] * 3 + [True] * 6 + [False] * 3


def test_equal_scans_are_right_when_nothing_moves_or_nothing_is_there():
    assert frozen(WALL, v=(0.1, 0, 0)) == [None] * 6
    assert frozen(None) == [None] * 6


def test_the_same_scan_seen_twice_is_not_frozen():
    """One scan serves several ticks when the LiDAR is slower than the loop."""
    assert frozen(WALL, fresh=False) == [None] * 6


def test_walls_that_vanish_at_once_are_not_free():
    """L4, edge 24: all beams at the maximum right after a scan full of returns."""
    safety = SafetyFilter(config())
    safety.apply(command(), state(), scan(WALL), 0.0)
    for k, empty in enumerate((None, np.full(180, 4.0)), start=1):
        _, verdict = safety.apply(command(), state(time_s=0.05 * k), scan(empty, 0.05 * k), 0.05 * k)
        assert verdict.fault == "scan_blank"
    _, verdict = safety.apply(command(), state(time_s=0.15), scan(WALL, 0.15), 0.15)
    assert verdict.fault is None


def test_walls_that_recede_are_fine():
    safety = SafetyFilter(config())
    for k, count in enumerate((60, 30, 15, 5, 0)):
        ranges = np.where(np.arange(180) < count, 2.0, np.inf)
        _, verdict = safety.apply(command(), state(time_s=0.05 * k), scan(ranges, 0.05 * k), 0.05 * k)
        assert verdict.fault is None


def test_gate_catches_what_the_stages_let_through():
    """The last gate stands by itself: a later bug in a stage cannot pass a bad number."""
    from safety.filter import gate_problem

    c = config()
    bad = {
        "gate_not_finite": [(math.nan, 0, 0, 0), (0, math.inf, 0, 0), (0, 0, 0, math.nan)],
        "gate_limit": [(1.3, 0, 0, 0), (0.9, 0.9, 0, 0), (0, 0, 0.51, 0), (0, 0, -0.51, 0), (0, 0, 0, 1.01), (0, 0, 0, -1.01)],
    }
    for rule, commands in bad.items():
        for x, y, z, rate in commands:
            assert gate_problem(SafeCommand(CorridorVector(x, y, z), rate), c).rule == rule
    assert gate_problem(SafeCommand(CorridorVector(1.2, 0, 0.5), -1.0), c) is None


def test_gate_is_wired_in(monkeypatch):
    """If the limits stage let something through, the gate still brakes."""
    import safety.filter as module

    monkeypatch.setattr(module, "limit_command", lambda wanted, *_: (VelocityCommand(CorridorVector(5.0, 0, 0), 0.0), ()))
    safety = SafetyFilter(config())
    sent, verdict = safety.apply(command(5.0), state(x=15.0), scan(), 0.0)
    assert sent == STOPPED
    assert verdict.fault == "gate_limit"
