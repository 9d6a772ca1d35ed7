"""What braking shows, number by number: against commands flown through in small steps, and at each threshold exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config, state

from safety.braking import CommandHistory
from safety.frames import CorridorVector
from safety.residual import MotionMonitor

CONFIG = config()
C = CONFIG.monitors
ROUNDING_S = 1e-6
LEAST_SPEED, LEAST_CHANGE = 0.2, 0.1


def sent(*commands: tuple[float, float, float]) -> CommandHistory:
    """Commands (time, x, y)."""
    history = CommandHistory()
    for time_s, x, y in commands:
        history.add(time_s, CorridorVector(x, y, 0.3))
    return history


def slowly_flown(velocity: np.ndarray, begin_s: float, end_s: float, commands: list[tuple[float, float, float]]) -> np.ndarray:
    """A low-pass of the commands in steps of 10 ms, which divide all times here; before the first it was the velocity."""
    v, steps = velocity.copy(), round((end_s - begin_s) / 0.01)
    for k in range(steps):
        now_s = begin_s + (k + 0.5) * 0.01
        newest = [np.array(u) for t, *u in commands if t <= now_s][-1:]
        v += ((newest[0] if newest else velocity) - v) * (1.0 - math.exp(-0.01 / CONFIG.lag_s))
    return v


class Plain:
    """The evidence, from all samples ever taken."""

    def __init__(self) -> None:
        self.samples: list[tuple[float, np.ndarray]] = []
        self.seen = self.expected = 0.0

    def judge(self, time_s: float, v: np.ndarray, commands: list[tuple[float, float, float]]) -> None:
        self.samples.append((time_s, v))
        if len(self.samples) < 2:
            return
        dt = time_s - self.samples[-2][0]
        self.seen, self.expected = (value * math.exp(-dt / 2.0) for value in (self.seen, self.expected))
        old = [sample for sample in self.samples if sample[0] <= time_s - 0.6 + ROUNDING_S]
        if not old:
            return
        begin_s, begin = old[-1]
        speed = float(np.linalg.norm(begin))
        if speed < LEAST_SPEED:
            return
        ahead, dead_s = begin / speed, 0.2
        expected = min(speed - float(slowly_flown(begin, begin_s - dead_s, time_s - dead_s, commands) @ ahead), speed)
        if expected > LEAST_CHANGE:
            self.seen += (speed - float(v @ ahead)) * expected * dt
            self.expected += expected**2 * dt


@pytest.mark.parametrize("seed", range(5))
def test_evidence_is_what_was_expected_and_seen_of_every_sample(seed):
    chance = np.random.default_rng(seed)
    monitor, plain, history = MotionMonitor(CONFIG), Plain(), CommandHistory()
    commands: list[tuple[float, float, float]] = []
    v, time_s, wanted = chance.uniform(-1.0, 1.0, 2), 20.0, np.zeros(2)
    for k in range(34):
        dt = float(chance.choice((0.05, 0.1)))
        time_s += dt
        v = v + (wanted - v) * chance.uniform(0.0, 0.4)
        monitor.judge(state(v=(*v, 0.7), time_s=time_s), history, [])
        plain.judge(time_s, v.copy(), commands)
        assert (monitor._seen, monitor._expected) == pytest.approx((plain.seen, plain.expected), rel=1e-9, abs=1e-12)
        if k % 9 == 0:
            wanted = chance.uniform(-1.2, 1.2, 2) * chance.choice((0.0, 1.0))
        history.add(time_s, CorridorVector(*wanted.tolist(), 0.0))
        commands.append((time_s, *wanted.tolist()))
    assert plain.expected > 0.0


def judged(*samples: tuple[float, float, float], history: CommandHistory | None = None) -> MotionMonitor:
    """A monitor that has seen samples (time, vx, vy)."""
    monitor = MotionMonitor(CONFIG)
    for time_s, x, y in samples:
        monitor.judge(state(v=(x, y, 0.0), time_s=time_s), history or sent((-1.0, 0.0, 0.0)), [])
    return monitor


def test_a_sample_counts_from_the_very_horizon_on():
    """0.6 s and a microsecond of rounding: a sample exactly then is old enough, the next number is not."""
    begin_s = 1.0 - 0.6 + ROUNDING_S
    assert judged((begin_s, 1.0, 0.0), (1.0, 0.5, 0.0))._expected > 0.0
    assert judged((math.nextafter(begin_s, 1.0), 1.0, 0.0), (1.0, 0.5, 0.0))._expected == 0.0


def test_the_newest_sample_that_is_old_enough_is_compared():
    """Of one at exactly the horizon and one a moment younger the first: it flew at 1 m/s, the other at 0.5 m/s."""
    begin_s = 1.0 - 0.6 + ROUNDING_S
    for second_s, speed in ((begin_s, 0.5), (math.nextafter(begin_s, 1.0), 1.0)):
        monitor = judged((0.1, 1.0, 0.0), (second_s, 0.5, 0.0), (1.0, 0.0, 0.0))
        assert monitor._seen / monitor._expected * (1.0 - math.exp(-(1.0 - second_s if speed < 1.0 else 0.9) / 0.6)) == (
            pytest.approx(1.0, abs=1e-5)
        )


@pytest.mark.parametrize(("speed", "counts"), [(0.2, True), (math.nextafter(0.2, 0.0), False)])
def test_a_speed_counts_from_the_least_on(speed, counts):
    """Stopped by a zero command long ago: after 1 s the slowest assumed vehicle has lost 81 % of 0.2 m/s."""
    assert (judged((0.0, 0.0, speed), (1.0, 0.0, 0.0))._expected > 0.0) == counts


def test_a_change_counts_above_the_least():
    """Slowing down from v for 1 s under a zero command: v (1 - exp(-1 / 0.6)) is just over, just not over 0.1 m/s."""
    share = 1.0 - math.exp(-1.0 / 0.6)
    for change, counts in ((0.1001, True), (0.0999, False)):
        history = sent((-1.0, 0.3 - change / share, 0.0))
        assert (judged((0.0, 0.3, 0.0), (1.0, 0.0, 0.0), history=history)._expected > 0.0) == counts


def test_a_change_of_exactly_the_least_does_not_count(monkeypatch):
    """0.6 of 0.7 m/s are left: in floating point that is 0.1 m/s less, to the last bit of the least."""
    for left, counts in ((0.25 - 0.1, False), (math.nextafter(0.25 - 0.1, 0.0), True)):
        monkeypatch.setattr("safety.residual.flown_velocity", lambda *_, left=left: (left, 0.0, 0.0))
        assert 0.25 - 0.15 == 0.1
        assert (judged((0.0, 0.25, 0.0), (1.0, 0.0, 0.0))._expected > 0.0) == counts


def test_more_than_a_stop_is_never_expected():
    """Commanded backwards for long: from 1 m/s a stop is expected, and no more; seen is all that changed."""
    monitor = judged((0.0, 1.0, 0.0), (1.0, -0.5, 0.0), history=sent((-2.0, -1.2, 0.0)))
    assert (monitor._seen, monitor._expected) == pytest.approx((1.5, 1.0))


def test_the_share_is_believed_from_the_evidence_on_and_bounded():
    monitor = MotionMonitor(CONFIG)
    monitor._seen, monitor._expected = 0.04, 0.08
    assert monitor.braking_share == 0.5
    monitor._expected = math.nextafter(0.08, 0.0)
    assert math.isnan(monitor.braking_share)
    monitor._seen, monitor._expected = 0.5, 0.2
    assert monitor.braking_share == 2.0


def shown(share: float, monitor: MotionMonitor | None = None) -> MotionMonitor:
    """A monitor that has judged a share of so much, without braking in this very tick."""
    monitor = monitor or judged((0.0, 0.0, 0.0))
    monitor._seen, monitor._expected = share, 1.0
    monitor._judge_braking(state(time_s=0.0), CommandHistory(), 0.0, [])
    return monitor


def test_the_cap_falls_below_the_weak_share_and_is_never_negative():
    assert shown(0.9).cap == 1.0
    assert shown(math.nextafter(0.9, 0.0)).cap == math.nextafter(0.9, 0.0)
    assert shown(0.95).cap == 1.0
    assert shown(-0.3).cap == 0.0
    assert shown(1.0, shown(0.8)).cap == 1.0
    assert shown(math.nextafter(1.0, 0.0), shown(0.8)).cap == math.nextafter(1.0, 0.0)


def failing(share: float, failed_s: float) -> list[tuple[str, float, float]]:
    """What is told of a share that has failed for so long, in a tick without braking."""
    monitor, found = judged((0.0, 0.0, 0.0)), []
    monitor._seen, monitor._expected, monitor._failed_s = share, 1.0, failed_s
    monitor._judge_braking(state(time_s=0.0), CommandHistory(), 0.05, found)
    kept = math.exp(-0.05 / 2.0)
    assert (monitor._seen, monitor._expected) == pytest.approx((share * kept, kept))
    return [(item.rule, item.value, item.limit) for item in found]


def test_failing_longer_than_half_a_second_is_told():
    just = 0.5 + ROUNDING_S
    assert failing(0.6, just) == failing(0.6, 0.3) == []
    assert failing(0.6, math.nextafter(just, 1.0)) == [("braking_weak", pytest.approx(0.6), 0.7)]
    assert failing(0.71, 9.0) == []


def test_a_share_of_exactly_what_fails_does_not_fail():
    monitor = judged((0.0, 0.0, 0.0))
    for share, failed_s in ((0.7, 0.0), (math.nextafter(0.7, 0.0), 9.0)):
        monitor._failed_s = 9.0
        assert shown(share, monitor)._failed_s == failed_s


def test_only_ticks_of_braking_count_as_failing():
    """Zero sent at 1 m/s: the second tick has no sample that is old enough, the third has; in the next none was expected."""
    monitor = judged((0.0, 1.0, 0.0), (0.4, 1.0, 0.0))
    monitor._seen, monitor._expected = 0.1, 5.0
    monitor.judge(state(v=(1.0, 0.0, 0.0), time_s=0.5), sent((-1.0, 0.0, 0.0)), [])
    assert monitor._failed_s == 0.0
    monitor.judge(state(v=(1.0, 0.0, 0.0), time_s=0.8), sent((-1.0, 0.0, 0.0)), [])
    assert monitor._failed_s == pytest.approx(0.3)
    monitor.judge(state(v=(1.0, 0.0, 0.0), time_s=0.85), sent((-1.0, 1.0, 0.0)), [])
    assert monitor._failed_s == pytest.approx(0.3)
    monitor._seen = 5.0
    monitor.judge(state(v=(1.0, 0.0, 0.0), time_s=0.9), sent((-1.0, 0.0, 0.0)), [])
    assert monitor._failed_s == 0.0


def test_better_braking_than_assumed_allows_no_more_than_the_limit():
    monitor = MotionMonitor(CONFIG)
    monitor._seen, monitor._expected, monitor._weak = 1.5, 1.0, True
    assert monitor.cap == 1.0


def test_the_course_is_a_low_pass_of_what_was_sent():
    monitor = judged((0.0, 0.0, 0.0), (0.6, 0.0, 0.0), history=sent((-1.0, 0.8, -0.4)))
    share = 1.0 - math.exp(-1.0)
    assert monitor._course == pytest.approx((0.8 * share, -0.4 * share))
    monitor.judge(state(time_s=0.8), sent((0.4, -0.2, 0.6)), [])
    rest = math.exp(-0.2 / 0.6)
    assert monitor._course == pytest.approx((-0.2 + (0.8 * share + 0.2) * rest, 0.6 + (-0.4 * share - 0.6) * rest))


def directed(
    course: tuple[float, float], v: tuple[float, float], since_s: float | None = 0.0, now_s: float = 9.0
) -> tuple[float | None, list[tuple[float, float]]]:
    """Since when the vehicle is astray after a judgement, and what is told."""
    monitor, found = MotionMonitor(CONFIG), []
    monitor._course, monitor._astray_s = course, since_s
    monitor._judge_direction(state(v=(*v, 3.0), time_s=now_s), found)
    assert {item.rule for item in found} <= {"motion_direction"}
    return monitor._astray_s, [(item.value, item.limit) for item in found]


@pytest.mark.parametrize(
    ("course", "v", "error"),
    [
        ((0.5, 0.0), (0.2, 0.6), 0.6), ((0.5, 0.0), (0.2, -0.6), 0.6), ((0.5, 0.0), (-0.7, 0.1), 0.7),
        ((0.0, -0.5), (0.9, 0.3), 0.9), ((0.3, 0.4), (-0.6, -0.8), 1.0), ((0.3, 0.4), (0.8, -0.6), 1.0),
        ((0.6, -0.8), (0.8, 0.6), 1.0), ((1.2, 1.6), (-1.0, 0.0), 0.8),
    ],
)  # fmt: skip
def test_motion_across_or_against_the_course_is_its_larger_part(course, v, error):
    since_s, told = directed(course, v)
    assert since_s == 0.0
    assert told == [(pytest.approx(error), 0.4)]


@pytest.mark.parametrize("v", [(2.0, 0.3), (0.1, -0.39), (-0.39, 0.0), (0.0, 0.0)])
def test_motion_along_the_course_or_slowly_beside_it_is_fine(v):
    assert directed((0.5, 0.0), v) == (None, [])


def test_direction_counts_from_the_least_speed_and_above_the_error():
    assert directed((0.4, 0.0), (0.0, 0.5))[0] == 0.0
    assert directed((math.nextafter(0.4, 0.0), 0.0), (0.0, 0.5))[0] is None
    assert directed((1.0, 0.0), (0.0, 0.4))[0] is None
    assert directed((1.0, 0.0), (0.0, math.nextafter(0.4, 1.0)))[0] == 0.0


def test_a_wrong_direction_is_told_after_its_time():
    just = 0.7 + ROUNDING_S
    assert directed((1.0, 0.0), (0.0, 0.9), None, 5.0) == (5.0, [])
    assert directed((1.0, 0.0), (0.0, 0.9), 0.0, just) == (0.0, [])
    assert directed((1.0, 0.0), (0.0, 0.9), 0.0, math.nextafter(just, 1.0)) == (0.0, [(0.9, 0.4)])
    assert directed((1.0, 0.0), (0.0, 0.9), 4.5, 5.0) == (4.5, [])


def test_reset_forgets_all_evidence():
    used = judged((0.0, 1.0, 0.0), (1.0, 0.9, 0.1), (2.0, 0.8, 0.2), history=sent((-1.0, 0.8, 0.0)))
    used._failed_s, used._astray_s, used._weak = 0.3, 1.0, True
    used.reset()
    fresh = MotionMonitor(CONFIG)
    names = ("_seen", "_expected", "_course", "_astray_s", "_failed_s", "_weak", "cap")
    assert [getattr(used, name) for name in names] == [getattr(fresh, name) for name in names]
    assert [getattr(fresh, name) for name in names] == [0.0, 0.0, (0.0, 0.0), None, 0.0, False, 1.0]
    assert not used._samples


def test_a_sample_that_is_not_newer_changes_nothing():
    monitor = judged((0.0, 1.0, 0.0), (1.0, 0.5, 0.0))
    before = (monitor._seen, monitor._expected, monitor._course, len(monitor._samples))
    for time_s in (1.0, 0.5):
        monitor.judge(state(v=(0.1, 0.0, 0.0), time_s=time_s), sent((0.0, 1.0, 0.0)), [])
    assert (monitor._seen, monitor._expected, monitor._course, len(monitor._samples)) == before
