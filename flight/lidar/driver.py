"""The LiDAR driver: a thread that opens a session with the device, takes its scans, and reconnects with back-off.

The newest scan wins: `latest()` never waits and never queues. What differs between devices is in their sessions.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

from flight.lidar.clock import DeviceClockError
from flight.lidar.config import LidarSource
from flight.lidar.inbox import Inbox
from flight.lidar.motion import BodyMotion
from flight.lidar.recording import ScanFileError
from flight.lidar.rplidar import RplidarError
from flight.lidar.scip import ScipError
from flight.lidar.session import Host, NoMoreScansError, Session
from flight.lidar.transport import TransportError
from safety.messages import LidarScan

_log = logging.getLogger(__name__)

BREAKS = (TransportError, ScipError, RplidarError, DeviceClockError, ScanFileError)
"""Errors that end a session but not the driver."""

OpenSession = Callable[[Host], Session]

_RATE_WINDOW = 40
_CLOSE_TIMEOUT_S = 3.0


@dataclass(frozen=True, slots=True)
class LidarHealth:
    """What the driver knows of itself. `rate_hz` and `age_s` are NaN before there are scans.

    `age_s`: now minus the newest scan's own measurement time. `rate_hz`: of this connection's last scans. `reconnects`:
    connections after the first one. `last_error`: why the link is or was down, empty if it never was.
    """

    connected: bool
    rate_hz: float
    age_s: float
    scans: int
    reconnects: int
    bad_checksums: int
    bad_frames: int
    clock_uncertainty_s: float
    clock_drift_s: float
    model: str
    last_error: str


_UNKNOWN = LidarHealth(False, math.nan, math.nan, 0, 0, 0, 0, math.inf, 0.0, "", "")


class LidarDriver:
    """A device as a source of `LidarScan`. Context manager; `start` and `close` are idempotent.

    `open_session` opens the link and gives the session for it; `clock` gives monotonic seconds. `inbox`: where messages for
    a device behind another link (MAVLink) are put.
    """

    def __init__(self, config: LidarSource, open_session: OpenSession, clock: Callable[[], float] = time.monotonic) -> None:
        self.inbox = Inbox()
        self._config = config
        self._open_session = open_session
        self._clock = clock
        self._fresh = threading.Condition()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._motion: Callable[[], BodyMotion | None] = _motion_unknown
        self._scan: LidarScan | None = None
        self._health = _UNKNOWN
        self._connections = 0
        self._measured: deque[float] = deque(maxlen=_RATE_WINDOW)

    def start(self) -> None:
        """Start reading; returns at once. A device that is not there yet is waited for."""
        if self._thread is None and not self._stop.is_set():
            self._thread = threading.Thread(target=self._run, name="lidar", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop the stream and the thread. A closed driver stays closed."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_CLOSE_TIMEOUT_S)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def follow(self, motion: Callable[[], BodyMotion | None]) -> None:
        """Where to ask for the vehicle's motion, for drivers that take it out of their scans; called on the driver's thread."""
        self._motion = motion

    def latest(self) -> LidarScan | None:
        """The newest scan, or None before the first. Its age is the caller's to judge."""
        return self._scan

    def wait_for_scan(self, timeout_s: float) -> LidarScan | None:
        """The next scan to arrive, or None if none does within `timeout_s`."""
        with self._fresh:
            before = self._health.scans
            arrived = self._fresh.wait_for(lambda: self._health.scans != before or self._stop.is_set(), timeout_s)
            return self._scan if arrived and not self._stop.is_set() else None

    def health(self) -> LidarHealth:
        """A snapshot; cheap enough for every tick."""
        with self._fresh:
            health, measured, scan = self._health, tuple(self._measured), self._scan
        span_s = measured[-1] - measured[0] if len(measured) > 1 else 0.0
        rate_hz = (len(measured) - 1) / span_s if span_s > 0.0 else math.nan
        age_s = self._clock() - scan.time_s if scan is not None else math.nan
        return replace(health, rate_hz=rate_hz, age_s=age_s)

    def _run(self) -> None:
        pause_s = self._config.reconnect_min_s
        while not self._stop.is_set():
            scans_before = self._health.scans
            try:
                self._stream_until_broken()
            except BREAKS as error:
                self._note_broken(str(error))
            except NoMoreScansError as end:
                self._note_broken(str(end))
                break
            if self._health.scans > scans_before:
                pause_s = self._config.reconnect_min_s
            self._stop.wait(pause_s)
            pause_s = min(2.0 * pause_s, self._config.reconnect_max_s)
        with self._fresh:
            self._health = replace(self._health, connected=False)
            self._fresh.notify_all()

    def _stream_until_broken(self) -> None:
        host = Host(self._config, self._clock, self._stop, self._count_bad, self.inbox, self._motion_now)
        session = self._open_session(host)
        try:
            self._note_connected(session.open(), session)
            for scan in session.scans():
                self._publish(scan, session)
            session.quit()
        finally:
            session.close()

    def _motion_now(self) -> BodyMotion | None:
        return self._motion()

    def _publish(self, scan: LidarScan, session: Session) -> None:
        with self._fresh:
            self._scan = replace(scan, sequence=self._health.scans)
            self._measured.append(scan.time_s)
            self._health = replace(self._health, scans=self._health.scans + 1, clock_drift_s=session.clock_drift_s)
            self._fresh.notify_all()

    def _note_connected(self, model: str, session: Session) -> None:
        self._connections += 1
        with self._fresh:
            self._measured.clear()
            self._health = replace(
                self._health,
                connected=True,
                reconnects=self._connections - 1,
                model=model,
                clock_uncertainty_s=session.clock_uncertainty_s,
            )
        _log.info("LiDAR on %s: %s", self._config.place, model)

    def _note_broken(self, why: str) -> None:
        if why != self._health.last_error or self._health.connected:
            _log.warning("LiDAR: %s", why)
        with self._fresh:
            self._health = replace(self._health, connected=False, last_error=why)

    def _count_bad(self, checksums: int, frames: int) -> None:
        with self._fresh:
            health = self._health
            self._health = replace(health, bad_checksums=health.bad_checksums + checksums, bad_frames=health.bad_frames + frames)


def _motion_unknown() -> BodyMotion | None:
    return None
