"""One connection to a SCIP 2.x device (Hokuyo) over TCP or a serial line: handshake, clock, stream.

A scan's time is when the device measured it (step 0), mapped to the monotonic clock, not when it arrived.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

from flight.lidar import scip
from flight.lidar.clock import DeviceClock
from flight.lidar.reduce import Mounting
from flight.lidar.session import POLL_S, Host
from flight.lidar.transport import Transport, TransportError
from safety.messages import LidarScan

CLOCK_READINGS = 8
_DRAINED_REPLIES = 64
_QUIT_TIMEOUT_S = 0.2


class ScipSession:
    """See `session.Session`."""

    def __init__(self, transport: Transport, host: Host) -> None:
        self.clock = DeviceClock()
        self._transport = transport
        self._config = host.config
        self._now = host.now
        self._stop = host.stop
        self._count_bad = host.count_bad
        self._reader = scip.ReplyReader()
        self._reported = (0, 0)
        self._pending: deque[scip.Reply] = deque(maxlen=_DRAINED_REPLIES)
        self._parameters: scip.ScipParameters | None = None
        self._mounting: Mounting | None = None
        self._sent = b""
        self._newest_s = self._deadline_s = -math.inf

    @property
    def clock_uncertainty_s(self) -> float:
        """Half the best round trip of the time requests."""
        return self.clock.uncertainty_s

    @property
    def clock_drift_s(self) -> float:
        """Of the device's clock against ours."""
        return self.clock.drift_s

    def open(self) -> str:
        """Silence the device, read its geometry, fit its clock; its model. The stream is not started yet."""
        self._ask("QT")
        self._parameters = scip.decode_parameters(self._ask("PP"))
        self._fit_clock()
        return self._parameters.model

    def quit(self) -> None:
        """Stop stream and laser. Waits a moment for the answer: closing on unread data could overtake the request."""
        self._transport.write(scip.request("QT"), _QUIT_TIMEOUT_S)
        deadline_s = self._now() + _QUIT_TIMEOUT_S
        while self._now() < deadline_s and not any(reply.echo == "QT" for reply in self._pending):
            self._receive(_QUIT_TIMEOUT_S / 4.0)

    def close(self) -> None:
        """Close the link."""
        self._transport.close()

    def scans(self) -> Iterator[LidarScan]:
        """Start the stream and give its scans until the driver stops. Raises when the device stalls or the link breaks."""
        self.begin()
        while not self._stop.is_set():
            scan = self.poll()
            if scan is not None:
                yield scan

    def begin(self) -> None:
        """Ask for the stream."""
        parameters = self._parameters
        if parameters is None:
            raise scip.ScipError("the session is not open")
        self._mounting = Mounting(self._config, parameters.angle_min_rad, parameters.angle_increment_rad, parameters.beams)
        self._sent = scip.stream_request(parameters.first_step, parameters.last_step)
        self._transport.write(self._sent, self._config.reply_timeout_s)
        self._newest_s = -math.inf
        self._deadline_s = self._now() + self._config.stall_timeout_s

    def poll(self) -> LidarScan | None:
        """The next scan, None when none came within a moment. Raises when the device stalls or the link breaks."""
        if self._parameters is None or self._mounting is None:
            raise scip.ScipError("the stream was not asked for")
        scan = self._read_scan(self._sent, self._parameters, self._mounting)
        if scan is not None and scan.time_s > self._newest_s:
            self._newest_s = scan.time_s
            self._deadline_s = self._now() + self._config.stall_timeout_s
            return scan
        if scan is not None:
            self._count_bad(0, 1)  # not newer than the last: its clock or its data stands still
        if self._now() > self._deadline_s:
            raise TransportError(f"the LiDAR sent no good scan for {self._config.stall_timeout_s:g} s")
        return None

    def _read_scan(self, sent: bytes, parameters: scip.ScipParameters, mounting: Mounting) -> LidarScan | None:
        """The newest good scan of what has arrived; None when there is none yet."""
        if not self._pending:
            self._receive(min(POLL_S, self._config.stall_timeout_s))
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
            self._receive(min(remaining_s, POLL_S))
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
