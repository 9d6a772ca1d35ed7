"""One connection to a spinning LiDAR on a serial line: LDROBOT (only listens) or RPLIDAR (asks, then listens).

A beam's time is the device's own stamp where its frames carry one, else arrival minus what transmission takes; the bytes that
had arrived behind a frame tell how long ago it came.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flight.lidar.clock import OneWayClock
from flight.lidar.config import LidarSource
from flight.lidar.ld06 import CLOCK_WRAP_MS, FRAME_BYTES, LD06_POINTS_PER_S, STL27L_POINTS_PER_S, Ld06Decoder
from flight.lidar.points import PointDecoder, Points
from flight.lidar.session import POLL_S, Host
from flight.lidar.transport import Transport, TransportError
from flight.lidar.turn import TurnAssembler
from safety.messages import LidarScan


@dataclass(frozen=True, slots=True)
class StreamKind:
    """What a stream is once it runs.

    `frame_bytes`: sent after the newest beam of a frame has fired. `wrap_s`: of the device's stamps; None if it sends none.
    `first_bytes`: of the stream, that came with the handshake.
    """

    model: str
    decoder: PointDecoder
    range_min_m: float
    range_max_m: float
    frame_bytes: int
    wrap_s: float | None = None
    first_bytes: bytes = b""


class Starter(Protocol):
    """The part of a protocol that comes before and after the stream."""

    def start(self) -> StreamKind:
        """Make the device stream."""
        ...

    def stop(self) -> None:
        """Make it stop."""
        ...


class LdrobotStarter:
    """LD06, LD19 and STL-27L stream by themselves from power on."""

    def __init__(self, config: LidarSource) -> None:
        self._config = config

    def start(self) -> StreamKind:
        """See `Starter`."""
        fast = self._config.driver == "stl27l"
        decoder = Ld06Decoder(STL27L_POINTS_PER_S if fast else LD06_POINTS_PER_S, self._config.min_intensity)
        near_m, far_m = (0.03, 25.0) if fast else (0.02, 12.0)
        name = {"ld06": "LD06", "ld19": "LD19", "stl27l": "STL-27L"}[self._config.driver]
        return StreamKind(name, decoder, near_m, far_m, FRAME_BYTES, wrap_s=1e-3 * CLOCK_WRAP_MS)

    def stop(self) -> None:
        """Nothing can be sent to them."""


class SpinningSession:
    """See `session.Session`."""

    def __init__(self, transport: Transport, starter: Starter, host: Host) -> None:
        self._transport = transport
        self._starter = starter
        self._host = host
        self._kind: StreamKind | None = None
        self._clock: OneWayClock | None = None
        self._reported = (0, 0)

    @property
    def clock_uncertainty_s(self) -> float:
        """Infinite: a device that cannot be asked for its clock may always be late by a constant."""
        return math.inf

    @property
    def clock_drift_s(self) -> float:
        """Of the device's clock, if it has one."""
        return self._clock.drift_s if self._clock is not None else 0.0

    def open(self) -> str:
        """Start the stream."""
        self._kind = self._starter.start()
        self._clock = OneWayClock(self._kind.wrap_s) if self._kind.wrap_s is not None else None
        return self._kind.model

    def quit(self) -> None:
        """Stop the stream."""
        self._starter.stop()

    def close(self) -> None:
        """Close the link."""
        self._transport.close()

    def scans(self) -> Iterator[LidarScan]:
        """Scans of the last full turn. Raises when the device stalls or the link breaks."""
        kind, host = self._kind, self._host
        if kind is None:
            raise TransportError("the session is not open")
        assembler = TurnAssembler(host.config, kind.range_min_m, kind.range_max_m)
        newest_s, data = -math.inf, kind.first_bytes
        deadline_s = host.now() + host.config.stall_timeout_s
        while not host.stop.is_set():
            points = kind.decoder.feed(data)
            self._report(kind.decoder)
            motion = host.motion() if host.config.motion_compensation else None
            scan = assembler.add(points, self._times(points, kind, host.now()), motion)
            if scan is not None and scan.time_s > newest_s:
                newest_s = scan.time_s
                deadline_s = host.now() + host.config.stall_timeout_s
                yield scan
            if host.now() > deadline_s:
                raise TransportError(
                    f"the LiDAR sent no full turn for {host.config.stall_timeout_s:g} s{self._hint(kind.decoder)}"
                )
            data = self._transport.read(min(POLL_S, host.config.stall_timeout_s))

    @staticmethod
    def _hint(decoder: PointDecoder) -> str:
        """What a user can do about it."""
        if decoder.bad_checksums + decoder.bad_frames > 0:
            return " but unreadable data: check `lidar.driver` and `lidar.baud`"
        return ": check power, wiring and that its motor turns"

    def _report(self, decoder: PointDecoder) -> None:
        counted = (decoder.bad_checksums, decoder.bad_frames)
        if counted != self._reported:
            self._host.count_bad(counted[0] - self._reported[0], counted[1] - self._reported[1])
            self._reported = counted

    def _times(self, points: Points, kind: StreamKind, received_s: float) -> NDArray[np.float64]:
        """Monotonic firing time of each point [n], s."""
        config = self._host.config
        sent_s: NDArray[np.float64] = received_s - config.byte_s * (points.bytes_behind.astype(np.float64) + kind.frame_bytes)
        if self._clock is not None and len(points):
            sent_s = self._by_stamp(self._clock, points, sent_s)
        times: NDArray[np.float64] = sent_s - points.before_end_s - config.extra_age_s
        return times

    @staticmethod
    def _by_stamp(clock: OneWayClock, points: Points, sent_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Each frame's stamp on our clock, for each of its points."""
        first = np.flatnonzero(np.diff(points.bytes_behind, prepend=-1))
        ends = [clock.measured_at(1e-3 * int(points.stamp_ms[place]), float(sent_s[place])) for place in first]
        return np.repeat(ends, np.diff(np.append(first, len(points))))
