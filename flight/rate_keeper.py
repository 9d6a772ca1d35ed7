"""Absolute-time rate keeper: no drift, no catch-up burst, and lateness as data.

Ticks belong to a fixed grid `start + k / rate`. A tick that overran is followed at once by the newest grid point
already passed (an overdue safety check must not wait), the older ones are skipped and counted. Two ticks are never
closer than half a period, so the recurrent policy is not stepped twice in a hurry.

`time.sleep` sleeps to an absolute time of the monotonic clock on Linux (Python 3.11 and later).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike

LATENESS_SAMPLES = 72_000
"""Latenesses kept for the percentiles: the last hour at 20 Hz. The maximum covers the whole run."""


@dataclass(frozen=True, slots=True)
class LatenessStatistics:
    """Distribution of a duration, ms; NaN without samples."""

    p50: float
    p99: float
    max: float


@dataclass(frozen=True, slots=True)
class RateStatistics:
    """A run of the loop. `rate_hz` is the mean over all ticks, NaN before the second one."""

    rate_hz: float
    ticks: int
    deadline_misses: int
    lateness_ms: LatenessStatistics

    def as_dict(self) -> dict[str, object]:
        """Plain nested dictionary."""
        return asdict(self)


class RateKeeper:
    """Wakes its caller on a fixed grid.

    `rate_hz`: ticks a second. `miss_after_s`: a tick that starts later than this after its grid time counts as a
    deadline miss (default a tenth of the period), as does every grid point skipped.
    `clock` and `sleep` take and give seconds of one monotonic clock.
    """

    def __init__(
        self,
        rate_hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        *,
        miss_after_s: float | None = None,
    ) -> None:
        if not (math.isfinite(rate_hz) and rate_hz > 0.0):
            raise ValueError(f"rate_hz must be positive and finite, not {rate_hz}")
        self.period_s = 1.0 / rate_hz
        self._clock = clock
        self._sleep = sleep
        self._miss_after_s = 0.1 * self.period_s if miss_after_s is None else miss_after_s
        self._lateness_s = np.zeros(LATENESS_SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Forget grid and counts; the next tick is due at once and starts a new grid."""
        self.ticks = 0
        self.deadline_misses = 0
        self.lateness_s = 0.0
        self._max_lateness_s = 0.0
        self._index = -1
        self._origin_s = 0.0
        self._first_s = self._started_s = -math.inf

    def wait(self) -> float:
        """Sleep to the next grid point; gives the time of waking. `lateness_s` then holds how late that was."""
        deadline_s = self._plan()
        while (remaining_s := deadline_s - self._clock()) > 0.0:
            self._sleep(remaining_s)
        return self._start_tick(deadline_s)

    @property
    def lagging(self) -> bool:
        """Whether the last tick started late enough to count as a miss."""
        return self.lateness_s > self._miss_after_s

    def statistics(self) -> RateStatistics:
        """Mean rate, counts and lateness percentiles so far."""
        span_s = self._started_s - self._first_s
        rate_hz = (self.ticks - 1) / span_s if self.ticks > 1 and span_s > 0.0 else math.nan
        kept = self._lateness_s[: min(self.ticks, LATENESS_SAMPLES)]
        lateness = percentiles_ms(kept)
        if self.ticks:
            lateness = LatenessStatistics(lateness.p50, lateness.p99, 1e3 * self._max_lateness_s)
        return RateStatistics(rate_hz, self.ticks, self.deadline_misses, lateness)

    def _plan(self) -> float:
        """Choose the next grid point; gives its time."""
        now_s = self._clock()
        if self._index < 0:
            self._origin_s, self._index = now_s, 0
            return now_s
        planned = self._index + 1
        index = max(planned, math.floor((now_s - self._origin_s) / self.period_s))
        if max(now_s, self._grid_s(index)) - self._started_s < 0.5 * self.period_s:
            index += 1
        self.deadline_misses += index - planned
        self._index = index
        return self._grid_s(index)

    def _grid_s(self, index: int) -> float:
        return self._origin_s + index * self.period_s

    def _start_tick(self, deadline_s: float) -> float:
        now_s = self._clock()
        self.lateness_s = max(0.0, now_s - deadline_s)
        self._lateness_s[self.ticks % LATENESS_SAMPLES] = self.lateness_s
        self._max_lateness_s = max(self._max_lateness_s, self.lateness_s)
        self.deadline_misses += self.lagging
        self.ticks += 1
        if self.ticks == 1:
            self._first_s = now_s
        self._started_s = now_s
        return now_s


def percentiles_ms(durations_s: ArrayLike) -> LatenessStatistics:
    """p50, p99 and maximum in ms of durations in s; NaN entries are left out."""
    values = np.asarray(durations_s, dtype=np.float64)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return LatenessStatistics(math.nan, math.nan, math.nan)
    p50, p99 = np.percentile(values, (50.0, 99.0))
    return LatenessStatistics(1e3 * float(p50), 1e3 * float(p99), 1e3 * float(values.max()))
