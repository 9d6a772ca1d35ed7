"""Device clock to monotonic clock: unwrap, offset by the minimum of (receive - device), bounded drift.

A scan can never have been measured after it arrived, and congestion only ever adds delay; so the smallest
difference seen is the best bound on the offset. `TM1` round trips give the offset itself (device time lies between
sending and receiving); the scans' own minimum, compared with its first value, then follows the drift of the crystal.
Following later (a larger offset, younger scans) is limited to what a crystal can do: a link that becomes slow must
show up as age, not be taken for drift. Following earlier is not limited: it makes scans older, which is safe.
"""

from __future__ import annotations

import math
from collections import deque

WRAP_MS = 2**24
MAX_DRIFT = 2e-4
"""Largest believed rate error of device against monotonic clock: twice the worst of a common crystal (100 ppm)."""

MAX_STEP_BACK_MS = 1000
"""A scan under way began before the clock was last read; more than this is a restart."""

MAX_UNEXPLAINED_S = 0.02
"""Scans later than drift explains, all of them through the whole window, by more than this: measure the offset again."""

_BUCKET_S = 0.2
_BUCKETS = 10


class DeviceClockError(ValueError):
    """The device's clock ran backwards or stood still for a while: its offset must be measured again."""


class DeviceClock:
    """Maps the device's 24-bit milliseconds to seconds of the monotonic clock."""

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._unwrapped_ms = 0
        self._offset_s = math.inf
        self._round_trip_s = math.inf
        self._synchronised_s = math.nan
        self._baseline_s: float | None = None
        self._minima: deque[tuple[int, float]] = deque(maxlen=_BUCKETS)

    @property
    def uncertainty_s(self) -> float:
        """Half the best round trip of the time requests, plus the clock's resolution; infinite before the first."""
        return 0.5 * self._round_trip_s + 1e-3

    @property
    def drift_s(self) -> float:
        """How far the device clock is believed to have moved since the first scans."""
        if self._baseline_s is None:
            return 0.0
        return self._smallest() - self._baseline_s

    def synchronise(self, device_ms: int, sent_s: float, received_s: float) -> None:
        """One `TM1` round trip. The one with the smallest round trip counts."""
        device_s = self._unwrap(device_ms)
        if received_s - sent_s < self._round_trip_s:
            self._round_trip_s = received_s - sent_s
            self._offset_s = 0.5 * (sent_s + received_s) - device_s
            self._synchronised_s = received_s

    def measured_at(self, device_ms: int, received_s: float) -> float:
        """Monotonic time, s, of a device time that arrived at `received_s`; never later than `received_s`.

        Raises `DeviceClockError` when the device's clock ran backwards, or fell behind more than a crystal can.
        """
        device_s = self._unwrap(device_ms)
        self._note(received_s - device_s, received_s)
        return min(device_s + self._offset(received_s), received_s)

    def _unwrap(self, device_ms: int) -> float:
        if self._last_ms is not None:
            step = (device_ms - self._last_ms + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2
            if step < -MAX_STEP_BACK_MS:
                raise DeviceClockError(f"device clock ran back from {self._last_ms} to {device_ms} ms")
            self._unwrapped_ms += step
        else:
            self._unwrapped_ms = device_ms
        self._last_ms = device_ms
        return 1e-3 * self._unwrapped_ms

    def _note(self, difference_s: float, now_s: float) -> None:
        bucket = math.floor(now_s / _BUCKET_S)
        if self._minima and self._minima[-1][0] == bucket:
            difference_s = min(difference_s, self._minima.pop()[1])
        elif len(self._minima) == _BUCKETS and self._baseline_s is None:
            self._baseline_s = self._smallest()
        self._minima.append((bucket, difference_s))

    def _smallest(self) -> float:
        return min(difference for _, difference in self._minima)

    def _offset(self, now_s: float) -> float:
        smallest = self._smallest()
        if self._baseline_s is None or not math.isfinite(self._offset_s):
            return min(self._offset_s, smallest)
        allowed = MAX_DRIFT * max(0.0, now_s - self._synchronised_s)
        unexplained_s = smallest - self._baseline_s - allowed
        if unexplained_s > MAX_UNEXPLAINED_S:
            raise DeviceClockError(f"scans come {1e3 * unexplained_s:.0f} ms later than the device's clock explains")
        return min(self._offset_s + min(smallest - self._baseline_s, allowed), smallest)
