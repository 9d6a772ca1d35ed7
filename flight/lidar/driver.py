"""SCIP 2.x driver: a thread that connects, reads the device's geometry and clock, streams, and reconnects.

The newest scan wins: `latest()` never waits and never queues. A scan's time is when the device measured it (step 0),
mapped to the monotonic clock, not when it arrived.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

from flight.lidar import scip
from flight.lidar.clock import DeviceClock, DeviceClockError
from flight.lidar.config import LidarSource
from flight.lidar.reduce import Mounting
from flight.lidar.transport import TcpTransport, Transport, TransportError
from safety.messages import LidarScan

_log = logging.getLogger(__name__)

CLOCK_READINGS = 8
_RATE_WINDOW = 40
_POLL_S = 0.1
_DRAINED_REPLIES = 64
_QUIT_TIMEOUT_S = 0.2
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


class ScipDriver:
    """A Hokuyo SCIP 2.x device as a source of `LidarScan`. Context manager; `start` and `close` are idempotent.

    `connect` opens the transport (replaceable for other links), `clock` gives monotonic seconds.
    """

    def __init__(
        self,
        config: LidarSource,
        connect: Callable[[LidarSource], Transport] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config = config
        self._connect = connect or _connect_tcp
        self._clock = clock
        self._fresh = threading.Condition()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._transport: Transport | None = None
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
            except (TransportError, scip.ScipError, DeviceClockError) as error:
                self._note_broken(str(error))
            if self._health.scans > scans_before:
                pause_s = self._config.reconnect_min_s
            self._stop.wait(pause_s)
            pause_s = min(2.0 * pause_s, self._config.reconnect_max_s)
        with self._fresh:
            self._health = replace(self._health, connected=False)
            self._fresh.notify_all()

    def _stream_until_broken(self) -> None:
        transport = self._connect(self._config)
        try:
            session = _ScipSession(transport, self._config, self._clock, self._stop, self._count_bad)
            parameters = session.open()
            self._note_connected(parameters, session.clock)
            for scan in session.scans():
                self._publish(scan, session.clock)
            session.quit()
        finally:
            transport.close()

    def _publish(self, scan: LidarScan, clock: DeviceClock) -> None:
        with self._fresh:
            self._scan = replace(scan, sequence=self._health.scans)
            self._measured.append(scan.time_s)
            self._health = replace(self._health, scans=self._health.scans + 1, clock_drift_s=clock.drift_s)
            self._fresh.notify_all()

    def _note_connected(self, parameters: scip.ScipParameters, clock: DeviceClock) -> None:
        self._connections += 1
        reconnects = self._connections - 1
        with self._fresh:
            self._measured.clear()
            self._health = replace(
                self._health,
                connected=True,
                reconnects=reconnects,
                model=parameters.model,
                clock_uncertainty_s=clock.uncertainty_s,
            )
        _log.info("LiDAR %s: %d beams, clock within %.1f ms", parameters.model, parameters.beams, 1e3 * clock.uncertainty_s)

    def _note_broken(self, why: str) -> None:
        if why != self._health.last_error or self._health.connected:
            _log.warning("LiDAR: %s", why)
        with self._fresh:
            self._health = replace(self._health, connected=False, last_error=why)

    def _count_bad(self, checksums: int, frames: int) -> None:
        with self._fresh:
            health = self._health
            self._health = replace(health, bad_checksums=health.bad_checksums + checksums, bad_frames=health.bad_frames + frames)


def _connect_tcp(config: LidarSource) -> Transport:
    return TcpTransport(config.host, config.port, config.connect_timeout_s)


class _ScipSession:
    """One connection: handshake, clock, stream. Ends by an exception (broken) or by the stop event."""

    def __init__(
        self,
        transport: Transport,
        config: LidarSource,
        clock: Callable[[], float],
        stop: threading.Event,
        count_bad: Callable[[int, int], None],
    ) -> None:
        self.clock = DeviceClock()
        self._transport = transport
        self._config = config
        self._now = clock
        self._stop = stop
        self._count_bad = count_bad
        self._reader = scip.ReplyReader()
        self._reported = (0, 0)
        self._pending: deque[scip.Reply] = deque(maxlen=_DRAINED_REPLIES)
        self._parameters: scip.ScipParameters | None = None

    def open(self) -> scip.ScipParameters:
        """Silence the device, read its geometry, fit its clock. The stream is not started yet."""
        self._ask("QT")
        self._parameters = scip.decode_parameters(self._ask("PP"))
        self._fit_clock()
        return self._parameters

    def quit(self) -> None:
        """Stop stream and laser. Waits a moment for the answer: closing on unread data could overtake the request."""
        self._transport.write(scip.request("QT"), _QUIT_TIMEOUT_S)
        deadline_s = self._now() + _QUIT_TIMEOUT_S
        while self._now() < deadline_s and not any(reply.echo == "QT" for reply in self._pending):
            self._receive(_QUIT_TIMEOUT_S / 4.0)

    def scans(self) -> Iterator[LidarScan]:
        """Start the stream and give its scans until the driver stops. Raises when the device stalls or the link breaks."""
        parameters = self._parameters
        if parameters is None:
            raise scip.ScipError("the session is not open")
        mounting = Mounting(self._config, parameters.angle_min_rad, parameters.angle_increment_rad, parameters.beams)
        sent = scip.stream_request(parameters.first_step, parameters.last_step)
        self._transport.write(sent, self._config.reply_timeout_s)
        newest_s = -math.inf
        deadline_s = self._now() + self._config.stall_timeout_s
        while not self._stop.is_set():
            scan = self._read_scan(sent, parameters, mounting)
            if scan is not None and scan.time_s > newest_s:
                newest_s = scan.time_s
                deadline_s = self._now() + self._config.stall_timeout_s
                yield scan
            elif scan is not None:
                self._count_bad(0, 1)  # not newer than the last: its clock or its data stands still
            if self._now() > deadline_s:
                raise TransportError(f"the LiDAR sent no good scan for {self._config.stall_timeout_s:g} s")

    def _read_scan(self, sent: bytes, parameters: scip.ScipParameters, mounting: Mounting) -> LidarScan | None:
        """The newest good scan of what has arrived; None when there is none yet."""
        if not self._pending:
            self._receive(min(_POLL_S, self._config.stall_timeout_s))
        received_s = self._now()
        newest: scip.ScipScan | None = None
        measured_s = math.nan
        while self._pending:
            scan = self._decode(self._pending.popleft(), sent, parameters)
            if scan is not None:
                newest, measured_s = scan, self.clock.measured_at(scan.timestamp_ms, received_s)
        return None if newest is None else self._to_vehicle(newest, measured_s, parameters, mounting)

    def _decode(self, reply: scip.Reply, sent: bytes, parameters: scip.ScipParameters) -> scip.ScipScan | None:
        if reply.status == scip.STATUS_OK and not reply.lines:
            return None  # the stream's acknowledgement
        if reply.status == scip.STATUS_UNSTABLE:
            return None  # the device says: skip this one, go on
        try:
            return scip.decode_scan(reply, sent, parameters.beams)
        except scip.ScipChecksumError:
            self._count_bad(1, 0)
        except scip.ScipError:
            self._count_bad(0, 1)
        return None

    def _to_vehicle(
        self, scan: scip.ScipScan, measured_s: float, parameters: scip.ScipParameters, mounting: Mounting
    ) -> LidarScan:
        range_max_mm = parameters.range_max_mm
        if self._config.range_max_m is not None:
            range_max_mm = min(range_max_mm, round(1e3 * self._config.range_max_m))
        ranges = scip.ranges_from_values(scan.values_mm, parameters.range_min_mm, range_max_mm)
        return LidarScan(
            time_s=measured_s,
            ranges_m=mounting.apply(ranges),
            angle_min_rad=mounting.angle_min_rad,
            angle_increment_rad=mounting.angle_increment_rad,
            range_min_m=1e-3 * parameters.range_min_mm,
            range_max_m=1e-3 * range_max_mm,
        )

    def _fit_clock(self) -> None:
        self._ask("TM", "0")
        for _ in range(CLOCK_READINGS):
            sent_s = self._now()
            reply = self._ask("TM", "1")
            self.clock.synchronise(scip.decode_clock(reply), sent_s, self._now())
        self._ask("TM", "2")

    def _ask(self, code: str, parameters: str = "") -> scip.Reply:
        """Send one request and give its reply; scans still under way are dropped. Raises if it takes too long."""
        wanted = code + parameters
        self._transport.write(scip.request(code, parameters), self._config.reply_timeout_s)
        deadline_s = self._now() + self._config.reply_timeout_s
        while not self._stop.is_set():
            while self._pending:
                reply = self._pending.popleft()
                if reply.echo == wanted:
                    return _accepted(reply)
            remaining_s = deadline_s - self._now()
            if remaining_s <= 0.0:
                raise TransportError(f"the LiDAR did not answer {wanted} within {self._config.reply_timeout_s:g} s")
            self._receive(min(remaining_s, _POLL_S))
        raise TransportError("the driver was closed")

    def _receive(self, timeout_s: float) -> None:
        self._pending.extend(self._reader.feed(self._transport.read(timeout_s)))
        counted = (self._reader.bad_checksums, self._reader.bad_frames)
        if counted != self._reported:
            self._count_bad(counted[0] - self._reported[0], counted[1] - self._reported[1])
            self._reported = counted


def _accepted(reply: scip.Reply) -> scip.Reply:
    """The reply if the device did as asked. TM0 answers 02 and TM2 03 when it was in that state already."""
    already = {"TM0": "02", "TM2": "03"}.get(reply.echo)
    if reply.status in (scip.STATUS_OK, already):
        return reply
    raise scip.ScipError(f"the LiDAR refused {reply.echo} with status {reply.status}")
