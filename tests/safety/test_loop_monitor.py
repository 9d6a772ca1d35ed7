"""Timing, authority, link and battery: limits met exactly, unknown accuses nobody."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safety.braking import CommandHistory
from safety.frames import CorridorVector
from safety.loop_monitor import LoopMonitor
from safety.messages import Health
from safety.monitor_config import MonitorConfig

C = MonitorConfig()
TICK = 0.0625  # exact in binary


def rules(healths, step_s=TICK, history=None, start_s=8.0):
    """Rules of each tick."""
    monitor, result = LoopMonitor(C), []
    for k, health in enumerate(healths):
        found = []
        monitor.judge(health, history or CommandHistory(), start_s + k * step_s, found)
        result.append([item.rule for item in found])
    return result


def test_nothing_known_accuses_nobody():
    assert not any(rules([Health()] * 50))


@pytest.mark.parametrize(
    ("health", "rule"),
    [
        (Health(in_control=False), "control_lost"), (Health(in_control=True), None), (Health(landed=True), "landed"),
        (Health(landed=False), None), (Health(battery_fraction=0.15), None), (Health(battery_fraction=0.1499), "battery_low"),
        (Health(battery_fraction=0.07), "battery_low"), (Health(battery_fraction=0.0699), "battery_critical"),
        (Health(battery_fraction=0.0), "battery_critical"), (Health(battery_fraction=math.nan), None),
    ],
)  # fmt: skip
def test_one_tick_is_enough(health, rule):
    assert rules([health]) == [[rule] if rule else []]


def test_restart_of_the_autopilot_is_never_forgotten():
    """K10: from the first count on; earlier restarts are history."""
    assert not any(rules([Health(boots=int("1000")), Health(boots=int("1000"))]))  # equal, though not one object
    counts = [None, 2, 2, None, 3, 3, None]
    assert rules([Health(boots=n) for n in counts]) == [[]] * 4 + [["autopilot_rebooted"]] * 2 + [[]]


def test_three_late_ticks_within_a_second():
    """C8: 50 ms is in time; the third miss within exactly one second is HOLD."""
    late, good = Health(lateness_s=C.late_s + 1e-9), Health(lateness_s=C.late_s)
    assert not any(rules([good] * 40))
    assert rules([late] * 4) == [[], [], ["loop_late"], ["loop_late"]]
    spread = [late if k in (0, 8, 16) else good for k in range(17)]  # 16 ticks of 62.5 ms: one second
    assert rules(spread)[-1] == ["loop_late"]
    too_far = [late if k in (0, 8, 17) else good for k in range(18)]
    assert not any(rules(too_far))
    assert not any(rules([late if k in (0, 9, 18) else good for k in range(19)], start_s=0.6))  # 18 ticks, the clock just begun
    assert rules([late if k in (0, 8, 16) else good for k in range(17)], start_s=0.5)[-1] == ["loop_late"]


def test_a_pause_between_two_calls():
    """C4: 0.25 s is accepted."""
    assert not any(rules([Health()] * 3, step_s=C.gap_s))
    for start_s in (0.1, 1.0, 700.0):
        assert rules([Health()] * 2, step_s=0.3, start_s=start_s) == [[], ["tick_gap"]]
        assert not any(rules([Health()] * 9, step_s=0.24, start_s=start_s))
    assert rules([Health()] * 3, step_s=C.gap_s + 1e-4) == [[], ["tick_gap"], ["tick_gap"]]


def test_a_microsecond_of_rounding_is_forgiven_whenever_time_is_measured():
    slow = Health(link_delay_s=1.0)
    assert rules([Health()] * 2, step_s=C.gap_s + 1e-6, start_s=0.0)[-1] == []
    assert rules([Health()] * 2, step_s=C.gap_s + 2e-6, start_s=0.0)[-1] == ["tick_gap"]
    assert "link_slow" in rules([slow] * 2, step_s=C.link_delay_lasts_s - 1e-6, start_s=0.0)[-1]
    assert "link_slow" not in rules([slow] * 2, step_s=C.link_delay_lasts_s - 2e-6, start_s=0.0)[-1]
    assert echoed([0.0, 0.1, 0.2, 0.3, 0.4, C.echo_s - 1e-6])[-1] == ["foreign_setpoint"]
    assert echoed([0.0, 0.1, 0.2, 0.3, 0.4, C.echo_s - 2e-6])[-1] == []


def test_slow_link_must_last():
    """K4: half a second is accepted; more, for 0.4 s, is not; one good answer starts anew."""
    slow = Health(link_delay_s=C.link_delay_s + 1e-9)
    assert not any(rules([Health(link_delay_s=C.link_delay_s)] * 40))
    for start_s in (0.1, 8.0):
        assert rules([slow] * 10, step_s=0.05, start_s=start_s) == [[]] * 8 + [["link_slow"]] * 2
    assert not any(rules([slow] * 8 + [Health(link_delay_s=0.1)] + [slow] * 8, step_s=0.05))


FLOWN = CorridorVector(0.8, 0.0, 0.0)
FOREIGN = CorridorVector(0.0, -1.0, 0.0)


def sent(velocity=FLOWN, ticks=40):
    history = CommandHistory()
    for k in range(ticks):
        history.add(8.0 + k * TICK, velocity)
    return history


def echoes(velocity, ticks=40):
    return [Health(echo=velocity, echo_time_s=8.0 + k * TICK) for k in range(ticks)]


def test_foreign_setpoint():
    """K6: what was sent, and zero, are ours; what differs by more than the tolerance for 0.6 s is not."""
    history = sent()
    assert not any(rules(echoes(FLOWN), history=history))
    assert not any(rules(echoes(CorridorVector(0, 0, 0)), history=history))
    assert not any(rules(echoes(CorridorVector(0.8, C.echo_error_m_s, 0)), history=history))
    found = rules(echoes(CorridorVector(0.8, C.echo_error_m_s + 1e-6, 0)), history=history)
    assert found == [[]] * 10 + [["foreign_setpoint"]] * 30


def test_old_echo_is_judged_by_what_was_sent_then():
    """The autopilot repeats our command of a moment ago: ours. One of two seconds ago: not."""
    history = CommandHistory()
    for k in range(60):
        history.add(8.0 + k * TICK, FLOWN if k < 20 else CorridorVector(0, 0.5, 0))
    found = rules([Health(echo=FLOWN, echo_time_s=8.0 + k * TICK) for k in range(60)], history=history)
    since = next(k for k, names in enumerate(found) if names)
    assert since * TICK == pytest.approx(20 * TICK + 2 * C.echo_s, abs=2 * TICK)


def test_the_same_echo_again_is_not_judged_again():
    stale = [Health(echo=CorridorVector(0, -1, 0), echo_time_s=8.0)] * 40
    assert not any(rules(stale, history=sent()))
    assert not any(rules([Health(echo=CorridorVector(0, -1, 0))] * 40, history=sent()))


def test_foreign_setpoints_between_ours_are_seen_and_a_few_accuse_nobody():
    """K6: a second sender at the same rate is echoed in turn with us; six foreign echoes within 1 s, over 0.6 s, are enough."""

    def mixed(every: int) -> list[list[str]]:
        foreign = CorridorVector(0, -1, 0)
        told = [Health(echo=foreign if k % every == 0 else FLOWN, echo_time_s=8.0 + k * TICK) for k in range(40)]
        return rules(told, history=sent())

    first = next(k for k, names in enumerate(mixed(2)) if names)
    assert first * TICK == pytest.approx(C.echo_s, abs=TICK)
    assert any(mixed(3))
    assert not any(mixed(5))


def echoed(times_s, echo=FOREIGN, ours=FLOWN):
    """Rules of echoes at given times, among commands of ours once a tick all the while."""
    history, monitor, result = CommandHistory(), LoopMonitor(C), []
    begin_s = min(times_s) - 1.0
    for k in range(60):
        history.add(begin_s + k * TICK, ours)
    for time_s in times_s:
        found = []
        monitor.judge(Health(echo=echo, echo_time_s=time_s), history, time_s, found)
        result.append([item.rule for item in found if item.rule == "foreign_setpoint"])
    return result


@pytest.mark.parametrize("start_s", [0.2, 8.0])
def test_six_foreign_echoes_over_at_least_six_tenths_of_a_second_and_within_one(start_s):
    def at(*after_s):
        return [start_s + part for part in after_s]

    told = ["foreign_setpoint"]
    assert echoed(at(0.0, 0.125, 0.25, 0.375, 0.5, 0.6))[-1] == told
    assert echoed(at(0.0, 0.125, 0.25, 0.375, 0.5, 0.59))[-1] == []
    assert echoed(at(0.0, 0.25, 0.5, 0.75, 0.875, 1.0))[-1] == told
    assert echoed(at(0.0, 0.25, 0.5, 0.75, 0.875, 1.001))[-1] == []
    assert echoed(at(0.0, 0.25, 0.5, 0.75, 0.875, 1.001, 1.1))[-1] == told  # six of the last second
    assert not any(echoed(at(0.0, 0.2, 0.4, 0.6, 0.8)))


def test_an_echo_told_again_counts_once_and_an_older_one_not_at_all():
    assert not any(echoed([8.0] + [8.6] * 9))
    assert not any(echoed([8.0, 8.7, 8.1, 8.2, 8.3, 8.4, 8.75]))
    assert not any(rules([Health(echo_time_s=9.0)] * 9))  # a time without an echo


def test_an_echo_is_foreign_by_its_distance_in_all_three_directions():
    times_s = [8.0 + k * TICK for k in range(20)]
    ours = CorridorVector(0.5, -0.4, 0.3)
    for off, foreign in ((0.14, False), (0.15, True)):  # 0.14 * sqrt(3) is 0.242, 0.15 * sqrt(3) is 0.26
        for sign in (1, -1):
            echo = CorridorVector(0.5 + sign * off, -0.4 - sign * off, 0.3 + sign * off)
            assert any(echoed(times_s, echo, ours)) == foreign


def test_a_monitor_that_was_reset_judges_like_a_new_one():
    history = sent()

    def run(monitor):
        result = []
        for k in range(12):
            found = []
            health = Health(0.06, 0.7, 0.5, boots=3 + k // 9, echo=FOREIGN, echo_time_s=8.0 + k * TICK)
            monitor.judge(health, history, 8.0 + k * TICK, found)
            result.append([(item.rule, item.value) for item in found])
        return result

    used = LoopMonitor(C)
    first = run(used)
    monitored = {rule for found in first for rule, _ in found}
    assert monitored == {"loop_late", "link_slow", "foreign_setpoint", "autopilot_rebooted"}
    used.reset()
    assert run(used) == first == run(LoopMonitor(C))


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 0.2), max_size=60))
def test_late_is_raised_exactly_when_three_misses_lie_within_a_second(latenesses):
    found = rules([Health(lateness_s=late) for late in latenesses])
    misses = [k for k, late in enumerate(latenesses) if late > C.late_s]
    for k in range(len(latenesses)):
        before = [m for m in misses if m <= k]
        expected = k in misses and len(before) >= 3 and (k - before[-3]) * TICK <= 1.0
        assert (found[k] == ["loop_late"]) == expected


@settings(deadline=None)
@given(st.lists(st.one_of(st.none(), st.integers(0, 3)), max_size=30))
def test_a_restart_is_told_whenever_the_count_is_not_the_first_one(counts):
    known = [n for n in counts if n is not None]
    for n, names in zip(counts, rules([Health(boots=n) for n in counts]), strict=True):
        assert (names == ["autopilot_rebooted"]) == (n is not None and n != known[0])
