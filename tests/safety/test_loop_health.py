"""What the loop tells reaches the verdict: health, caps, masks, the order of severity, and what follows an overruled command."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import Plant, command, config, scan, state

import safety.monitors as monitors_module
from safety.escalation import EscalationConfig, EscalationState, Level, escalate
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import Health, SafeCommand
from safety.monitor_config import MonitorConfig
from safety.reactions import NOTICES, REACTIONS, level_of

STOPPED = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)


def cruising(healths, speed=1.0, **changes):
    """A flight along x in the open; (sent, verdict) of each tick."""
    safety, plant, result = SafetyFilter(config(**changes)), Plant(), []
    for health in healths:
        sent, verdict = safety.apply(command(speed), plant.estimate(), scan(time_s=plant.time_s), plant.time_s, health)
        result.append((sent, verdict))
        plant.fly(sent)
    return result


@pytest.mark.parametrize(
    ("health", "rule"),
    [
        (Health(in_control=False), "control_lost"), (Health(landed=True), "landed"), (Health(boots=1), "autopilot_rebooted"),
        (Health(estimate_valid=False), "estimate_invalid"), (Health(battery_fraction=0.1), "battery_low"),
        (Health(battery_fraction=0.01), "battery_critical"), (Health(hidden_norm=math.inf), "hidden_exploded"),
        (Health(inference_s=0.06), "inference_hung"),
    ],
)  # fmt: skip
def test_health_brakes_in_the_same_tick(health, rule):
    *good, (sent, verdict) = cruising([Health(boots=0)] * 10 + [health])
    assert all(v.fault is None for _, v in good)
    assert sent == STOPPED
    assert verdict.fault == rule
    assert escalate(EscalationState(), verdict, 0.5, EscalationConfig()).level == level_of(rule)


def test_most_severe_fault_is_the_verdicts_fault_and_all_are_told():
    health = Health(in_control=False, battery_fraction=0.01, hidden_norm=99.0)
    _, verdict = SafetyFilter(config()).apply(None, None, None, 0.0, health)
    rules = [item.rule for item in verdict.interventions]
    assert verdict.fault == "control_lost"
    assert set(rules) == {
        "control_lost",
        "battery_critical",
        "hidden_exploded",
        "state_missing",
        "scan_missing",
        "command_missing",
    }
    assert [level_of(rule) for rule in rules] == sorted(map(level_of, rules), reverse=True)


def test_unknown_health_changes_nothing_bit_for_bit():
    assert cruising([None] * 60) == cruising([Health()] * 60)
    nominal = Health(0.01, 0.05, 0.9, True, False, 0, True, 0.3, inference_s=0.001, hidden_norm=4.0)
    flown = cruising([nominal] * 60)
    assert flown == cruising([None] * 60)
    assert flown[-1][1].interventions == ()


def test_a_late_tick_slows_down_at_once_and_only_then():
    """C8, K4: the cap falls in the same tick, and is gone with its cause."""
    flown = cruising([Health(), Health(), Health(link_delay_s=0.4), Health()])
    speeds = [sent.velocity.x for sent, _ in flown]
    c = config()
    assert speeds[2] == pytest.approx(1.2 * c.delay_s / (c.delay_s + 0.3))
    assert [item.rule for item in flown[2][1].interventions] == ["speed_cap"]
    assert not flown[2][1].braking
    assert speeds[1] == speeds[3] == 1.0


def test_three_late_ticks_hold():
    flown = cruising([Health()] * 5 + [Health(lateness_s=0.06)] * 3, speed=1.2)
    assert [verdict.fault for _, verdict in flown][-3:] == [None, None, "loop_late"]
    assert flown[4][0].velocity.x == 1.2 > flown[6][0].velocity.x
    assert level_of("loop_late") == Level.HOLD


def test_third_bad_command_holds():
    """P1: the samples are good, the policy is not."""
    safety, plant, faults = SafetyFilter(config()), Plant(), []
    for k in range(12):
        wanted = command(math.nan) if k in (2, 5, 9) else command(0.3)
        sent, verdict = safety.apply(wanted, plant.estimate(), scan(time_s=plant.time_s), plant.time_s)
        faults.append(verdict.fault)
        plant.fly(sent)
    assert [faults[k] for k in (2, 5, 9)] == ["command_not_finite", "command_not_finite", "command_bad_again"]
    assert level_of("command_bad_again") == Level.HOLD


def test_a_command_missing_by_right_is_not_the_policys_fault():
    """Without a scan nobody asks the policy."""
    safety, plant = SafetyFilter(config()), Plant()
    for _ in range(6):
        _, verdict = safety.apply(None, plant.estimate(), None, plant.time_s)
        assert verdict.fault == "scan_missing"
        plant.fly(STOPPED)


def test_overruled_command_was_never_flown():
    """The loop sent zero instead: nothing of the command is in flight, and the next one starts from zero."""
    told, untold = (SafetyFilter(config(max_acceleration_m_s2=2.0)) for _ in range(2))
    for k in range(8):
        now = 0.05 * k
        for safety in (told, untold):
            at = state(5.0 + 1e-3 * k, time_s=now)
            sent, _ = safety.apply(command(1.0), at, scan(time_s=now), now, Health(overruled=safety is told))
            if safety is told:
                assert sent.velocity.x == pytest.approx(0.2 if k == 0 else 0.1)
    assert sent.velocity.x > 0.5
    assert told._history.sent(0.0, 0.34) != untold._history.sent(0.0, 0.34)
    assert all(v.x == 0.0 for v in told._history.sent(0.0, 0.31))


def test_overruled_before_the_first_command_is_harmless():
    sent, verdict = SafetyFilter(config()).apply(command(0.5), state(), scan(), 0.0, Health(overruled=True))
    assert verdict.fault is None
    assert sent.velocity.x == 0.5


def test_jump_of_the_estimate_forgets_where_obstacles_were():
    """E1: remembered places mean something else after a jump; the scan of that tick is looked at anew."""
    safety = SafetyFilter(config())
    wall = np.where(np.abs(np.arange(180) - 90) < 20, 1.5, np.inf)
    for k in range(5):
        safety.apply(command(0.1), state(5.0 + 0.001 * k, time_s=0.05 * k), scan(wall, 0.05 * k), 0.05 * k)
    assert safety._memory.points(0.2, safety.config)[0].size
    _, verdict = safety.apply(command(0.1), state(9.0, time_s=0.25), scan(wall, 0.25), 0.25)
    assert verdict.fault == "estimate_jump"
    assert not safety._memory.points(0.25, safety.config)[0].size
    _, verdict = safety.apply(command(0.1), state(9.0, time_s=0.3), scan(wall, 0.25), 0.3)
    assert verdict.fault is None
    assert min(safety._memory.points(0.3, safety.config)[0]) > 9.0


def test_part_of_the_vehicle_no_longer_holds_it_off():
    """L15: a leg seen at 0.2 m is pushed away from at first; once it is known to move along, the vehicle flies on."""
    safety, plant, forward, told = SafetyFilter(config(memory_s=1.0)), Plant(), [], set()
    leg = np.where(np.arange(180) < 4, 0.2, np.inf)
    for _ in range(120):
        sent, verdict = safety.apply(command(0.8), plant.estimate(), scan(leg, plant.time_s), plant.time_s)
        assert verdict.fault is None
        forward.append(sent.velocity.x)
        told |= {item.rule for item in verdict.interventions}
        plant.fly(sent)
    assert "scan_sector_masked" in told
    assert forward[-1] == pytest.approx(0.8)


def test_internal_errors_in_health_brake():
    sent, verdict = SafetyFilter(config()).apply(command(0.5), state(), scan(), 0.0, "healthy")
    assert sent == STOPPED
    assert verdict.fault == "internal_error"


@pytest.mark.parametrize(
    "changes",
    [
        {"tilt_rad": 2.0}, {"inference_late_s": 0.1}, {"battery_critical": 0.5}, {"nominal_late_s": 0.06},
        {"nominal_link_delay_s": 0.6}, {"braking_failed": 0.95}, {"braking_weak": 1.0, "braking_healthy": 0.95},
        {"late_ticks": 0}, {"mirror_votes": 0}, {"hidden_norm_max": math.nan}, {"unheard_of": 1.0},
    ],
)  # fmt: skip
def test_contradictory_thresholds_are_refused_and_named(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        MonitorConfig(**changes)


def test_default_thresholds_are_the_reviewed_numbers():
    """A changed threshold must be changed here too, knowingly."""
    assert MonitorConfig().model_dump() == {
        "position_jump_m": 0.25, "altitude_jump_m": 0.25, "velocity_mismatch_m_s": 1.6, "velocity_window_s": 0.4,
        "jumps_window_s": 5.0, "frozen_state_s": 0.2, "frozen_command_m_s": 0.3, "direction_speed_m_s": 0.4,
        "direction_error_m_s": 0.4, "direction_s": 0.7, "accuracy_m": 1.0, "accuracy_s": 1.0, "tilt_rad": 0.95,
        "tumbling_rad": 1.4, "mask_s": 0.5, "mask_motion_m": 0.2, "mirror_turn_rad": 0.15, "mirror_votes": 4,
        "hidden_norm_max": 9.0, "bad_commands": 3, "inference_late_s": 0.03, "inference_hung_s": 0.05, "saturated_s": 2.0,
        "oscillation_m_s": 0.3, "oscillation_ticks": 10, "late_s": 0.05, "late_ticks": 3, "gap_s": 0.25, "link_delay_s": 0.5,
        "link_delay_lasts_s": 0.4, "echo_error_m_s": 0.25, "echo_s": 0.6, "battery_low": 0.15, "battery_critical": 0.07,
        "nominal_state_age_s": 0.08, "nominal_scan_age_s": 0.12, "nominal_late_s": 0.02, "nominal_link_delay_s": 0.1,
        "braking_horizon_s": 0.6, "braking_memory_s": 2.0, "braking_weak": 0.9, "braking_healthy": 1.0,
        "braking_failed": 0.7, "braking_failed_s": 0.5, "cap_least": 0.25,
    }  # fmt: skip


NUMBERS = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.just(math.nan))
HEALTHS = st.builds(
    Health, NUMBERS, NUMBERS, NUMBERS, st.sampled_from([None, True, False]), st.sampled_from([None, True, False]),
    st.one_of(st.none(), st.integers()), st.sampled_from([None, True, False]), NUMBERS,
    st.one_of(st.none(), st.builds(CorridorVector, NUMBERS, NUMBERS, NUMBERS)), NUMBERS, NUMBERS, NUMBERS, st.booleans(),
)  # fmt: skip


@settings(deadline=None)
@given(st.lists(HEALTHS, min_size=1, max_size=12))
def test_any_health_gives_a_finite_command_and_a_known_rule(healths):
    """And never a faster one than without it."""
    told, untold = SafetyFilter(config()), SafetyFilter(config())
    for k, health in enumerate(healths):
        now = 0.05 * k
        inputs = (command(1.0, 0.2, 0.1, 0.4), state(5.0 + 0.01 * k, v=(0.2, 0, 0), time_s=now), scan(time_s=now), now)
        sent, verdict = told.apply(*inputs, health)
        free, _ = untold.apply(*inputs)
        assert math.isfinite(sent.velocity.x + sent.velocity.y + sent.velocity.z + sent.yaw_rate_rad_s)
        assert verdict.fault is None or verdict.fault in REACTIONS
        assert verdict.fault != "internal_error"
        assert (verdict.fault is None) or sent == STOPPED
        assert math.hypot(sent.velocity.x, sent.velocity.y) <= math.hypot(free.velocity.x, free.velocity.y) + 1e-9


@settings(deadline=None)
@given(st.floats(-1e5, 1e5))
def test_shift_of_the_clock_changes_nothing(shift):
    """Must-have: only differences of times count."""

    def rules(begin):
        safety, result = SafetyFilter(config()), []
        for k in range(12):
            now = begin + 0.0625 * k
            health = Health(lateness_s=0.06 * (k % 3 == 0), link_delay_s=0.7 * (k > 3))
            _, verdict = safety.apply(command(0.6), state(5.0 + 0.01 * k, time_s=now), scan(time_s=now), now, health)
            result.append([item.rule for item in verdict.interventions])
        return result

    assert rules(round(shift)) == rules(0.0)


def test_every_rule_of_the_monitors_is_in_the_table_and_the_other_way_round():
    """No orphan: a rule that a monitor can name has a reaction, and no reaction is for a rule that nobody names."""
    folder = Path(monitors_module.__file__).parent
    monitors = [*folder.glob("*_monitor.py"), *(folder / f"{name}.py" for name in ("monitors", "residual", "caps", "lidar"))]
    text = "\n".join(path.read_text(encoding="utf-8") for path in monitors)
    named = set(re.findall(r'Intervention\(\s*"(\w+)"', text)) | set(re.findall(r'"(scan_\w+|estimate_jump\w*)"', text))
    named |= {f"{kind}_{what}" for kind in ("state", "scan") for what in ("stale", "future")}
    table = REACTIONS.keys() | NOTICES.keys()
    assert named <= table
    of_the_filter = {rule for rule in table - named if f'"{rule}"' in (folder / "filter.py").read_text(encoding="utf-8")}
    assert named | of_the_filter == table


def test_docs_show_the_table_as_it_is():
    """docs/safety.md is written by hand around the table; rule, ids, level and bound must be those of the code."""
    text = (Path(__file__).parents[2] / "docs" / "safety.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    shown = {row[0].strip("| `"): row for row in rows if len(row) == 5 and row[3] in Level.__members__}
    assert shown.keys() == REACTIONS.keys()
    for rule, row in shown.items():
        reaction = REACTIONS[rule]
        assert (row[1], row[3], row[4]) == (", ".join(reaction.faults), reaction.level.name, f"{reaction.bound_s:g} s |")


def test_health_is_small_and_closed():
    assert not hasattr(Health(), "__dict__")
    with pytest.raises(dataclasses.FrozenInstanceError):
        Health().lateness_s = 1.0
