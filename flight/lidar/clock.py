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


ONE_WAY_DRIFT = 0.005
"""Largest believed rate error where the device cannot be asked for its clock: some run on an RC oscillator."""

MAX_JUMP_S = 1.0
"""A device's clock that steps this far from ours between two frames was set anew."""


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


class OneWayClock:
    """The clock of a device that only sends: seconds of ours for its stamps, by the smallest (arrival - stamp) seen.

    A smaller difference counts at once: it makes scans older, which is safe. A larger one is followed at `ONE_WAY_DRIFT`
    only: enough for any oscillator, while a link that turns slow shows up as age for long enough to end the flight.
    What remains is the least delay ever seen, which no listener can know.
    """

    def __init__(self, wrap_s: float = math.inf) -> None:
        """`wrap_s`: the stamps start again from 0 here."""
        self._wrap_s = wrap_s
        self._stamp_s = math.nan
        self._device_s = 0.0
        self._arrived_s = math.nan
        self._offset_s = math.inf
        self._first_offset_s = math.nan

    @property
    def drift_s(self) -> float:
        """How far the device's clock is believed to have moved since the first frame."""
        return 0.0 if math.isnan(self._first_offset_s) else self._offset_s - self._first_offset_s

    def measured_at(self, stamp_s: float, arrived_s: float) -> float:
        """Monotonic time, s, of a stamp whose frame began to arrive at `arrived_s`; never later than that.

        Raises `DeviceClockError` when the device's clock was set anew.
        """
        if math.isnan(self._stamp_s):
            self._device_s, self._first_offset_s = stamp_s, arrived_s - stamp_s
            passed_s = 0.0
        else:
            passed_s = max(0.0, arrived_s - self._arrived_s)
            step_s = stamp_s - self._stamp_s
            if math.isfinite(self._wrap_s):
                step_s = (step_s + MAX_JUMP_S) % self._wrap_s - MAX_JUMP_S
            if not abs(step_s - passed_s) <= MAX_JUMP_S:
                raise DeviceClockError(f"the device's clock moved {step_s:.2f} s while {passed_s:.2f} s passed")
            self._device_s += step_s
        self._stamp_s = stamp_s
        self._arrived_s = arrived_s if math.isnan(self._arrived_s) else self._arrived_s + passed_s
        self._offset_s = min(arrived_s - self._device_s, self._offset_s + ONE_WAY_DRIFT * passed_s)
        return min(self._device_s + self._offset_s, arrived_s)
