"""The judgement of one tick's input, at each number exactly, and what is remembered of the tick before."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from safety_plant import command, config, scan, state

from safety.braking import CommandHistory
from safety.frames import CorridorVector
from safety.messages import Health, Intervention
from safety.monitors import InputMonitor, Judgement, _alike, _length, age_fault, command_fault, state_fault

C = config()
NAN, INF = math.nan, math.inf


def up(value: float) -> float:
    return math.nextafter(value, INF)


def down(value: float) -> float:
    return math.nextafter(value, -INF)


def told(fault: Intervention | None) -> tuple[str, float, float] | None:
    return None if fault is None else (fault.rule, fault.value, fault.limit)


def without_numbers(fault: Intervention | None) -> str | None:
    """The rule of a fault that has no numbers to tell."""
    assert fault is None or (math.isnan(fault.value) and math.isnan(fault.limit))
    return None if fault is None else fault.rule


def test_a_command_is_there_and_finite_in_every_number():
    assert command_fault(command(0.1, -0.2, 0.3, -0.4)) is None
    assert without_numbers(command_fault(None)) == "command_missing"
    for bad in ((NAN, 0.0, 0.0, 0.0), (0.0, INF, 0.0, 0.0), (0.0, 0.0, -INF, 0.0), (0.0, 0.0, 0.0, NAN)):
        assert without_numbers(command_fault(command(*bad))) == "command_not_finite"


def test_ages_are_accepted_up_to_both_limits():
    assert age_fault("scan", 0.25, 0.25, 0.02) is None
    assert told(age_fault("scan", up(0.25), 0.25, 0.02)) == ("scan_stale", up(0.25), 0.25)
    assert age_fault("state", -0.02, 0.25, 0.02) is None
    assert told(age_fault("state", down(-0.02), 0.25, 0.02)) == ("state_future", down(-0.02), -0.02)
    assert told(age_fault("state", -INF, 0.25, 0.02)) == ("state_future", -INF, -0.02)
    unknown = age_fault("state", NAN, 0.25, 0.02)
    assert unknown is not None
    assert (unknown.rule, unknown.limit) == ("state_stale", 0.25)


def test_a_state_is_there_finite_and_of_now():
    good = state(time_s=1.0)
    assert state_fault(good, 1.2, C) is None
    assert told(state_fault(good, 1.25, C)) == ("state_stale", 0.25, 0.2)
    assert told(state_fault(good, 0.75, C)) == ("state_future", -0.25, -0.02)
    assert without_numbers(state_fault(None, 1.0, C)) == "state_missing"
    bad = CorridorVector(0.0, 0.0, INF)
    parts: tuple[dict[str, object], ...] = (
        {"position": bad}, {"velocity": bad}, {"acceleration": bad}, {"roll_rad": NAN}, {"pitch_rad": NAN}, {"yaw_rad": NAN},
        {"yaw_rate_rad_s": INF},
    )  # fmt: skip
    for part in parts:
        assert without_numbers(state_fault(replace(good, **part), 1.0, C)) == "state_not_finite"


class Ticks:
    """A monitor fed tick by tick: healthy input at `time_s` but for what is given."""

    def __init__(self, **changes) -> None:
        self.config = config(**changes)
        self.monitor, self.history = InputMonitor(self.config), CommandHistory()

    def judge(self, time_s: float, **parts) -> Judgement:
        healthy = {"command": command(0.1), "state": state(time_s=time_s), "scan": scan(time_s=time_s), "now_s": time_s}
        return self.monitor.judge(**(healthy | {"history": self.history} | parts))

    def rules(self, time_s: float, **parts) -> list[str]:
        return [fault.rule for fault in self.judge(time_s, **parts).faults]


def test_a_healthy_tick_has_no_fault_and_gives_the_scan_back():
    ticks, seen = Ticks(), scan(time_s=1.0)
    judged = ticks.judge(1.0, scan=seen)
    assert (judged.faults, judged.notices, judged.cap) == ((), (), 1.0)
    assert judged.scan is seen


def test_the_clock_may_stand_but_not_go_back():
    ticks = Ticks()
    assert ticks.rules(1.0) == ticks.rules(1.0) == []
    judged = ticks.judge(down(1.0))
    assert [told(fault) for fault in judged.faults] == [("clock_backwards", down(1.0), 1.0)]
    assert (judged.notices, judged.scan, judged.cap) == ((), None, 1.0)
    assert ticks.rules(NAN) == ["clock_backwards"]
    judged = ticks.judge(INF)
    assert [fault.rule for fault in judged.faults] == ["clock_not_finite"]
    assert (judged.faults[0].value, math.isnan(judged.faults[0].limit)) == (INF, True)
    assert ticks.rules(1.0) == [], "an infinite time is not remembered"


def test_samples_may_repeat_but_not_go_back():
    ticks = Ticks()
    first, seen = state(time_s=1.0), scan(time_s=1.0)
    assert ticks.rules(1.0, state=first, scan=seen) == ticks.rules(1.05, state=first, scan=seen) == []
    older = ticks.judge(1.1, state=state(time_s=down(1.0)), scan=scan(time_s=down(1.0)))
    assert [told(fault) for fault in older.faults] == [
        ("state_backwards", down(1.0), 1.0),
        ("scan_backwards", down(1.0), 1.0),
    ]


def test_faults_are_told_most_severe_first_and_else_in_order():
    """Tumbling yields, a critical battery lands, the rest only brakes: in the order in which it was judged."""
    ticks = Ticks()
    found = ticks.rules(1.0, state=state(time_s=1.0, roll=1.5), scan=None, command=None, health=Health(battery_fraction=0.01))
    assert found == ["tumbling", "battery_critical", "scan_missing", "command_missing"]
    assert Ticks().rules(1.0, state=None, scan=None, command=None) == ["state_missing", "scan_missing", "command_missing"]
    two = Ticks().rules(1.0, state=state(time_s=1.0, roll=1.5), health=Health(inference_s=1.0))
    assert two == ["tumbling", "inference_hung"]


def test_bad_commands_count_only_where_the_samples_were_good():
    ticks = Ticks()
    assert [ticks.rules(1.0 + 0.05 * k, command=None)[0] for k in range(3)] == ["command_missing"] * 2 + ["command_bad_again"]
    ticks = Ticks()
    for k in range(4):
        assert ticks.rules(1.0 + 0.05 * k, command=None, scan=None) == ["scan_missing", "command_missing"]
    assert ticks.rules(1.2, command=command(NAN)) == ["command_not_finite"]


def shares(count: int, value: float, other: float = INF, beams: int = 20) -> np.ndarray:
    """So many beams with a value, the others with another."""
    return np.where(np.arange(beams) < count, value, other)


def test_more_than_half_of_the_beams_unknown_or_touching_is_no_scan():
    for value, rule in ((NAN, "scan_unknown"), (0.0, "scan_touching"), (-INF, "scan_touching")):
        assert Ticks().rules(1.0, scan=scan(shares(10, value), 1.0)) == []
        judged = Ticks().judge(1.0, scan=scan(shares(11, value), 1.0))
        assert [told(fault) for fault in judged.faults] == [(rule, 11 / 20, 0.5)]
    least = replace(scan(time_s=1.0), ranges_m=np.full(20, 0.1), range_min_m=0.1)
    assert Ticks().rules(1.0, scan=least) == []
    assert Ticks().rules(1.0, scan=replace(least, range_min_m=up(0.1))) == ["scan_touching"]


@pytest.mark.parametrize(
    ("before", "after", "blank"),
    [
        (shares(2, 2.9), shares(0, 0.0), True),  # a tenth of the beams was near
        (shares(1, 2.9), shares(0, 0.0), False),
        (shares(20, 3.0), shares(0, 0.0), False),  # three quarters of the range are not near
        (shares(20, 2.9), shares(20, 4.0), True),
        (shares(20, 2.9), shares(1, 3.9), False),
        (shares(20, 2.9), shares(1, 1.0), False),
        (shares(20, 2.9), shares(1, NAN), False),
    ],
)
def test_a_scan_full_of_returns_is_not_followed_by_an_empty_one(before, after, blank):
    ticks = Ticks()
    assert ticks.rules(1.0, scan=scan(before, 1.0)) == []
    for time_s in (1.05, 1.1):
        judged = ticks.judge(time_s, scan=scan(after, time_s))
        assert [told(fault) for fault in judged.faults] == ([("scan_blank", 0.0, 0.1)] if blank else [])


def test_walls_are_those_of_the_scan_before():
    """Near, then only at a distance, then nothing: nothing wrong with that."""
    ticks = Ticks()
    for k, ranges in enumerate((shares(20, 1.0), shares(1, 1.0), shares(0, 1.0))):
        assert ticks.rules(1.0 + 0.05 * k, scan=scan(ranges, 1.0 + 0.05 * k)) == []


def frozen(
    repeats: int, speed: float = 0.0, yaw_rate: float = 0.0, ranges=None, fresh: bool = True
) -> list[tuple[str, float, float]]:
    """What is told of a tick in which so many repeats of a scan have been seen."""
    ticks, ranges = Ticks(), shares(20, 2.0) if ranges is None else ranges
    found: list[tuple[str, float, float]] = []
    for k in range(repeats + 1):
        time_s = 1.0 + 0.0625 * k
        sample = state(x=5.0 + speed * time_s, v=(speed, 0.0, 0.0), yaw_rate=yaw_rate, time_s=time_s)
        judged = ticks.judge(time_s, state=sample, scan=scan(ranges, time_s if fresh else 1.0 + 0.0 * k))
        found = [(fault.rule, fault.value, fault.limit) for fault in judged.faults]
    return found


def test_a_frozen_scan_is_told_from_the_third_repeat_on_in_motion():
    assert frozen(2, 0.5) == []
    assert frozen(3, 0.5) == [("scan_frozen", 3.0, 3.0)]
    assert frozen(4, 0.5) == [("scan_frozen", 4.0, 3.0)]
    assert frozen(3, 0.3) == frozen(3, 0.0, 0.2) == frozen(3, 0.0, -0.2) == frozen(3, 0.5, fresh=False) == []
    assert frozen(3, up(0.3)) == frozen(3, 0.0, up(0.2)) == frozen(3, 0.0, -up(0.2)) == [("scan_frozen", 3.0, 3.0)]


def test_a_scan_that_shows_only_the_vehicle_itself_is_not_frozen():
    """A return on the hull, 0.35 m away, may be a part of the vehicle; one beyond it is not."""
    hull = np.full(20, INF)
    for range_m, expected in (
        (0.2, []),
        (0.35, []),
        (np.nextafter(np.float32(0.35), np.float32(1.0)), [("scan_frozen", 3.0, 3.0)]),
    ):
        hull[3] = range_m
        ticks = Ticks(vehicle_radius_m=float(np.float32(0.35)))
        found: list[tuple[str, float, float]] = []
        for k in range(4):
            time_s = 1.0 + 0.0625 * k
            sample = state(x=5.0 + 0.5 * time_s, v=(0.5, 0.0, 0.0), time_s=time_s)
            judged = ticks.judge(time_s, state=sample, scan=scan(hull, time_s))
            found = [(fault.rule, fault.value, fault.limit) for fault in judged.faults]
        assert found == expected
    assert frozen(3, 0.5, ranges=np.full(20, INF)) == []
    assert frozen(3, 0.5, ranges=shares(5, NAN, 2.0)) == []


def test_once_frozen_in_motion_it_lasts_until_a_scan_differs():
    ticks, wall = Ticks(), shares(20, 2.0)
    speeds = (0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0)
    found = []
    for k, speed in enumerate(speeds):
        time_s = 1.0 + 0.0625 * k
        found.append(ticks.rules(time_s, state=state(v=(speed, 0.0, 0.0), time_s=time_s), scan=scan(wall, time_s)))
    assert found == [[], [], [], [], ["scan_frozen"], ["scan_frozen"], ["scan_frozen"]]
    assert ticks.rules(1.5, scan=scan(shares(20, 2.1), 1.5)) == []
    assert ticks.rules(1.5625, scan=scan(shares(20, 2.1), 1.5625)) == []


def test_without_a_state_a_frozen_scan_is_counted_but_not_told():
    ticks, wall = Ticks(), shares(20, 2.0)
    for k in range(5):
        time_s = 1.0 + 0.0625 * k
        assert ticks.rules(time_s, state=None, scan=scan(wall, time_s)) == ["state_missing"]
    moving = state(v=(0.5, 0.0, 0.0), time_s=1.3125)
    assert ticks.rules(1.3125, state=moving, scan=scan(wall, 1.3125)) == ["scan_frozen"]


def test_scans_are_alike_when_every_range_is():
    a = np.array([1.0, 2.0, INF])
    assert _alike(a, a.copy())
    assert not _alike(a, np.array([1.0, 2.0, 3.0]))
    assert not _alike(a, a[:2])
    assert not _alike(a[:2], a)
    assert not _alike(np.array([NAN]), np.array([NAN]))


def test_lengths_have_three_parts():
    assert _length(CorridorVector(2.0, -3.0, 6.0)) == 7.0


@pytest.mark.parametrize(
    ("state_age_s", "scan_age_s", "cap"),
    [(0.0, 0.0, 1.0), (0.13, 0.0, 0.85 / 0.9), (0.0, 0.22, 0.85 / 0.95), (0.18, 0.13, 0.85 / 0.95)],
)
def test_the_cap_is_that_of_the_ages_beyond_the_nominal_ones(state_age_s, scan_age_s, cap):
    """A blind time of 0.85 s; 0.08 s and 0.12 s of age are within it."""
    ticks = Ticks()
    judged = ticks.judge(1.0, state=state(time_s=1.0 - state_age_s), scan=scan(time_s=1.0 - scan_age_s))
    assert judged.cap == pytest.approx(cap)
    late = ticks.judge(1.01, state=None, health=Health(lateness_s=0.04))
    assert (late.cap, late.faults[0].rule) == (1.0, "state_missing")
    assert ticks.judge(1.02, scan=None, health=Health(lateness_s=0.04)).cap == 1.0
    assert ticks.judge(1.03, health=Health(lateness_s=0.04)).cap == pytest.approx(0.85 / 0.87)


def test_ages_are_counted_from_a_clock_that_has_just_begun():
    ticks = Ticks()
    assert ticks.judge(0.13, state=state(), scan=scan()).cap == pytest.approx(0.85 / 0.9)
    ticks = Ticks()
    assert ticks.judge(0.22, state=state(time_s=0.22), scan=scan()).cap == pytest.approx(0.85 / 0.95)
    assert ticks.rules(0.26, state=state(time_s=0.26), scan=scan()) == ["scan_stale"]


def test_a_good_scan_is_compared_with_the_one_before_where_the_state_is_fit():
    ticks = Ticks()
    ticks.judge(1.0, scan=scan(time_s=1.0, sequence=7))
    assert ticks.rules(1.05, state=None, scan=scan(time_s=1.05, sequence=3)) == ["state_missing"]
    judged = ticks.judge(1.1, scan=scan(time_s=1.1, sequence=7))
    assert [told(fault) for fault in judged.faults] == [("scan_source", 7.0, 7.0)]
    assert judged.scan is not None


def test_a_part_of_the_vehicle_is_taken_out_of_the_scan_and_told():
    """L15: 0.2 m away for more than half a second of flight: unknown in the scan that is given back, with or without a state."""
    ticks, ranges = Ticks(), np.full(180, INF)
    ranges[90] = 0.2
    for k in range(14):
        time_s = 1.0 + 0.0625 * k
        sample = state(x=5.0 + 0.4 * time_s, v=(0.4, 0.0, 0.0), time_s=time_s)
        judged = ticks.judge(time_s, state=sample if k < 13 else None, scan=scan(ranges, time_s))
    assert [notice.rule for notice in judged.notices] == ["scan_sector_masked"]
    assert judged.scan is not None
    assert np.flatnonzero(np.isnan(judged.scan.ranges_m)).tolist() == [90]


def test_a_scan_that_is_no_scan_is_named_before_anything_is_asked_of_it():
    for bad, rule in (
        (replace(scan(time_s=1.0), ranges_m=np.ones((2, 2))), "scan_shape"),
        (replace(scan(time_s=1.0), angle_increment_rad=-0.1), "scan_geometry"),
        (replace(scan(time_s=1.0), range_max_m=NAN), "scan_not_finite"),
    ):
        ticks = Ticks()
        fault = ticks.judge(1.0, scan=bad).faults[0]
        assert without_numbers(fault) == rule
        assert ticks.rules(1.0, scan=scan(time_s=0.9)) == []


def test_reset_forgets_times_and_scans():
    ticks, wall = Ticks(), shares(20, 2.0)
    for k in range(5):
        time_s = 9.0 + 0.0625 * k
        ticks.judge(
            time_s, state=state(v=(0.5, 0.0, 0.0), x=5.0 + 0.5 * time_s, time_s=time_s), scan=scan(wall, time_s, sequence=5 + k)
        )
    ticks.monitor.reset()
    names = ("_now_s", "_state_time_s", "_scan_time_s", "_ranges", "_frozen", "_stuck", "_walled")
    assert [getattr(ticks.monitor, name) for name in names] == [-INF, -INF, -INF, None, 0, False, False]
    assert ticks.rules(1.0, state=state(x=9.0, time_s=1.0), scan=scan(None, 1.0, beams=30, sequence=1)) == []


@pytest.mark.parametrize("reset", [False, True])
def test_reset_forgets_what_the_other_monitors_remember(reset):
    """Another place, another geometry, after a pause: three faults in the same flight, none in a new one."""
    ticks = Ticks()
    ticks.judge(1.0)
    if reset:
        ticks.monitor.reset()
    found = ticks.rules(1.5, state=state(x=9.0, time_s=1.5), scan=scan(None, 1.5, beams=30))
    assert found == ([] if reset else ["tick_gap", "estimate_jump", "scan_source"])


def test_the_commands_sent_decide_whether_an_estimate_may_stand_still():
    """E2: nothing changes in any bit while 0.3 m/s are commanded, counted in all three directions."""
    for sent, rules in ((CorridorVector(0.2, 0.2, 0.1), ["estimate_frozen"]), (CorridorVector(0.2, 0.2, 0.05), [])):
        ticks = Ticks()
        ticks.history.add(0.0, CorridorVector(9.0, 0.0, 0.0))
        ticks.history.add(0.5, sent)
        for k in range(6):
            found = ticks.rules(1.0 + 0.0625 * k, state=state(time_s=1.0 + 0.0625 * k))
        assert found == rules
