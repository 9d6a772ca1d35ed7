"""The rate keeper on a scripted clock: grid, misses, no burst, statistics; and once in real time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.rate_keeper import LATENESS_SAMPLES, RateKeeper, percentiles_ms

PERIOD = 0.05


class Clock:
    """Time that only passes by sleeping (a little late) and working."""

    def __init__(self, oversleep_s: float = 0.0) -> None:
        self.now_s = 1000.0
        self.oversleep_s = oversleep_s
        self.slept: list[float] = []

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_s += seconds + self.oversleep_s


def keeper(clock: Clock) -> RateKeeper:
    return RateKeeper(20.0, clock, clock.sleep)


def run(clock: Clock, work_s: list[float]) -> tuple[RateKeeper, list[float]]:
    """Starts of the ticks, in periods after the first."""
    loop, starts = keeper(clock), []
    for work in work_s:
        starts.append(loop.wait())
        clock.now_s += work
    return loop, [(start - starts[0]) / PERIOD for start in starts]


def test_ticks_lie_on_the_grid_whatever_the_work() -> None:
    loop, starts = run(Clock(), [0.0, 0.01, 0.049, 0.001, 0.02])
    assert starts == pytest.approx([0, 1, 2, 3, 4])
    assert loop.deadline_misses == 0
    assert loop.statistics().rate_hz == pytest.approx(20.0)


def test_lateness_does_not_add_up() -> None:
    clock = Clock(oversleep_s=0.002)
    loop, starts = run(clock, [0.01] * 200)
    assert starts[-1] == pytest.approx(199, abs=0.05)
    statistics = loop.statistics()
    assert statistics.lateness_ms.p50 == pytest.approx(2.0)
    assert statistics.lateness_ms.max == pytest.approx(2.0)
    assert (statistics.ticks, statistics.deadline_misses) == (200, 0)


def test_an_overrun_runs_at_once_and_counts_once() -> None:
    loop, starts = run(Clock(), [0.06, 0.0, 0.0])
    assert starts == pytest.approx([0, 1.2, 2])
    assert loop.deadline_misses == 1


def test_missed_ticks_are_skipped_not_made_up_for() -> None:
    loop, starts = run(Clock(), [0.0, 0.26, 0.0, 0.0])
    assert starts == pytest.approx([0, 1, 6.2, 7])
    assert loop.deadline_misses == 4 + 1  # grid points 2..5 never ran, number 6 ran late
    assert loop.statistics().lateness_ms.max == pytest.approx(10.0)


def test_a_tick_is_never_repeated_within_half_a_period() -> None:
    _, starts = run(Clock(), [0.045 + PERIOD, 0.001, 0.0])
    assert starts == pytest.approx([0, 1.9, 3])


@given(st.lists(st.floats(0.0, 0.4), min_size=2, max_size=60), st.floats(0.0, 0.03))
@settings(max_examples=100, deadline=None)
def test_spacing_and_count_hold_for_any_work(work_s: list[float], oversleep_s: float) -> None:
    loop, starts = run(Clock(oversleep_s), work_s)
    assert min(np.diff(starts)) >= 0.5 - 1e-6
    grid = math.floor(starts[-1] + 1e-6)
    assert loop.ticks == len(work_s)
    assert grid - (loop.ticks - 1) <= loop.deadline_misses <= grid + 1


def test_lagging_is_the_last_ticks_lateness() -> None:
    clock = Clock()
    loop = keeper(clock)
    loop.wait()
    clock.now_s += 0.07
    loop.wait()
    assert loop.lagging
    assert loop.lateness_s == pytest.approx(0.02)
    loop.wait()
    assert not loop.lagging


def test_reset_starts_a_new_grid() -> None:
    clock = Clock()
    loop = keeper(clock)
    loop.wait()
    clock.now_s += 12.34
    loop.reset()
    assert loop.wait() == clock.now_s
    assert (loop.ticks, loop.deadline_misses) == (1, 0)


def test_statistics_without_ticks_and_with_more_than_are_kept() -> None:
    loop = keeper(Clock())
    assert math.isnan(loop.statistics().rate_hz)
    assert math.isnan(loop.statistics().lateness_ms.p50)
    clock = Clock(oversleep_s=0.02)
    loop = keeper(clock)
    for tick in range(LATENESS_SAMPLES + 10):
        clock.oversleep_s = 0.02 if tick < 5 else 0.001
        loop.wait()
    assert loop.statistics().lateness_ms.p99 == pytest.approx(1.0)
    assert loop.statistics().lateness_ms.max == pytest.approx(20.0), "the maximum is of the whole run"


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        RateKeeper(rate_hz)


def test_percentiles_leave_out_what_was_not_measured() -> None:
    statistics = percentiles_ms([math.nan, 0.001, 0.003, 0.002])
    assert (statistics.p50, statistics.max) == pytest.approx((2.0, 3.0))
    assert math.isnan(percentiles_ms([math.nan]).max)


def test_real_time_mean_rate() -> None:
    loop = RateKeeper(100.0)
    for _ in range(101):
        loop.wait()
    statistics = loop.statistics()
    assert statistics.ticks == 101
    assert statistics.rate_hz <= 101.0
    assert statistics.rate_hz >= 100.0 * 101 / (101 + statistics.deadline_misses) * 0.98
