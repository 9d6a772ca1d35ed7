"""Slamtec RPLIDAR's scans: the three formats of the A, S and C series, bytes in, points out. No I/O, bounded memory.

Little-endian. Angles grow clockwise; distance 0 is no return.

* 81, standard: 5-byte nodes without a checksum: start bit and its inverse, quality; check bit and angle/64 deg; distance/4 mm.
* 82, express: 84-byte capsules of 16 x 2 points with angle offsets; 85, dense: 84-byte capsules of 40 distances. Both carry an
  exclusive or of their bytes. A capsule holds only its own start angle, so its points come out with the next one.

Protocol facts: Slamtec/rplidar_sdk (the handlers). Where an angle offset is ambiguous it is read unsigned, as the SDK does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flight.lidar.points import NO_STAMP, Points, join_points, no_points
from flight.lidar.rplidar import CAPSULE_BYTES, NODE_BYTES

_MAX_CALL_BYTES = 16 * 1024
_LOCK_NODES = 8  # consecutive good nodes before a byte position is believed: 3 check bits and the order of angles each
_MAX_STEP_DEG = 20.0  # between two samples: lost bytes, or the wrong position, if more
_BACK_STEP_DEG = 3.0  # angle jitter of the correction for triangulation


def _bearing_rad(clockwise_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.remainder(math.pi - np.radians(clockwise_deg), 2.0 * math.pi) - math.pi


def _forward(difference_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle differences folded to (-90, 270] degrees: small steps back stay small."""
    return np.remainder(difference_deg + 90.0, 360.0) - 90.0


class StandardDecoder:
    """Type 81. Nodes carry no checksum, so a byte position is believed only while check bits and the order of angles hold.

    Eight nodes in a row must be good before the first is given; with the first bad one, the position is sought again.
    """

    def __init__(self, sample_s: float) -> None:
        self.bad_checksums = 0
        self.bad_frames = 0
        self._sample_s = sample_s
        self._buffer = b""
        self._locked = False
        self._last_deg = math.nan

    @property
    def buffered_bytes(self) -> int:
        """At most the nodes needed to believe a position."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Points:
        """See `PointDecoder.feed`."""
        if len(data) > _MAX_CALL_BYTES:
            self._lose()
            self._buffer, data = b"", data[-_MAX_CALL_BYTES:]
        self._buffer += data
        parts = list(self._runs())
        return join_points(parts)

    def _runs(self) -> Iterator[Points]:
        """Runs of good nodes. Each turn consumes bytes or ends."""
        while True:
            if not self._locked and not self._lock():
                return
            table = self._table(self._buffer)
            good = self._good(table, self._last_deg)
            count = good.size if good.all() else int(np.argmin(good))
            rest = len(self._buffer) - count * NODE_BYTES
            if count:
                yield self._points(table[:count], rest)
                self._last_deg = float(_angles_deg(table[count - 1 : count])[0])
            self._buffer = self._buffer[count * NODE_BYTES :]
            if count == good.size:
                return
            self._lose()
            self._buffer = self._buffer[1:]

    def _lock(self) -> bool:
        """Move to the first position with enough good nodes in a row; keep the tail that might become one."""
        need = _LOCK_NODES * NODE_BYTES
        raw = np.frombuffer(self._buffer, dtype=np.uint8)
        plausible = (((raw[:-1] ^ (raw[:-1] >> 1)) & raw[1:]) & 1).astype(bool) if raw.size > 1 else np.zeros(0, dtype=bool)
        starts = len(self._buffer) - need + 1
        if starts > 0:
            candidates = np.logical_and.reduce([plausible[k : k + starts] for k in range(0, need, NODE_BYTES)])
            for place in np.flatnonzero(candidates):
                if self._good(self._table(self._buffer[place : place + need]), math.nan).all():
                    self._buffer = self._buffer[place:]
                    self._locked, self._last_deg = True, math.nan
                    return True
            self._buffer = self._buffer[starts:]
        return False

    def _lose(self) -> None:
        self.bad_frames += 1
        self._locked = False

    @staticmethod
    def _table(data: bytes) -> NDArray[np.int64]:
        whole = len(data) // NODE_BYTES * NODE_BYTES
        return np.frombuffer(data[:whole], dtype=np.uint8).reshape(-1, NODE_BYTES).astype(np.int64)

    @staticmethod
    def _good(table: NDArray[np.int64], last_deg: float) -> NDArray[np.bool_]:
        angles = _angles_deg(table)
        before = np.concatenate(([last_deg if math.isfinite(last_deg) else angles[0]], angles[:-1])) if angles.size else angles
        step = _forward(angles - before)
        checks = ((table[:, 0] ^ (table[:, 0] >> 1)) & table[:, 1] & 1).astype(bool)
        good: NDArray[np.bool_] = checks & (angles < 360.0) & (step > -_BACK_STEP_DEG) & (step < _MAX_STEP_DEG)
        return good

    def _points(self, table: NDArray[np.int64], rest: int) -> Points:
        count = len(table)
        quarter_mm = table[:, 3] | (table[:, 4] << 8)
        ranges = quarter_mm.astype(np.float32) * np.float32(0.25e-3)
        ranges[quarter_mm == 0] = np.nan
        return Points(
            bearing_rad=_bearing_rad(_angles_deg(table)),
            range_m=ranges,
            intensity=(table[:, 0] & 0xFC).astype(np.uint8),
            before_end_s=self._sample_s * np.arange(count - 1, -1, -1, dtype=np.float64),
            stamp_ms=np.full(count, NO_STAMP, dtype=np.int64),
            bytes_behind=np.full(count, rest, dtype=np.int64),
        )


def _angles_deg(table: NDArray[np.int64]) -> NDArray[np.float64]:
    return ((table[:, 1] >> 1) | (table[:, 2] << 7)) / 64.0


@dataclass(frozen=True, slots=True)
class _Capsule:
    start_deg: float
    body: bytes
    behind: int


class CapsuleDecoder:
    """Types 82 and 85. Points of a capsule come out with the next one, which must follow it without a gap.

    A capsule lost in between would stretch the points over two: so a span that departs by half from the one before is dropped.
    """

    def __init__(self, sample_s: float, *, dense: bool) -> None:
        self.bad_checksums = 0
        self.bad_frames = 0
        self._sample_s = sample_s
        self._dense = dense
        self._buffer = bytearray()
        self._last: _Capsule | None = None
        self._span_deg = math.nan

    @property
    def buffered_bytes(self) -> int:
        """At most one unfinished capsule and the one that waits for its successor."""
        return len(self._buffer) + (CAPSULE_BYTES if self._last is not None else 0)

    def feed(self, data: bytes) -> Points:
        """See `PointDecoder.feed`."""
        if len(data) > _MAX_CALL_BYTES:
            self.bad_frames += 1
            self._buffer.clear()
            self._last = None
            data = data[-_MAX_CALL_BYTES:]
        self._buffer += data
        parts = [points for capsule in self._cut() if (points := self._take(capsule)) is not None]
        return join_points(parts) if parts else no_points()

    def _cut(self) -> Iterator[_Capsule]:
        """Capsules with a right checksum. Any other byte in between forgets the capsule that waits."""
        place = 0
        while len(self._buffer) - place >= CAPSULE_BYTES:
            raw = self._buffer[place : place + CAPSULE_BYTES]
            if raw[0] >> 4 != 0xA or raw[1] >> 4 != 0x5:
                if self._last is not None:
                    self._forget()
                place += 1
            elif _xor(raw[2:]) != (raw[0] & 0xF) | (raw[1] & 0xF) << 4:
                self.bad_checksums += 1
                self._last = None
                place += 1
            else:
                place += CAPSULE_BYTES
                start = raw[2] | raw[3] << 8
                if start & 0x8000:  # the first after a start: nothing before it belongs to it
                    self._last = None
                yield _Capsule((start & 0x7FFF) / 64.0, bytes(raw[4:]), len(self._buffer) - place)
        del self._buffer[:place]

    def _forget(self) -> None:
        self.bad_frames += 1
        self._last = None

    def _take(self, capsule: _Capsule) -> Points | None:
        if capsule.start_deg >= 360.0:
            self._forget()
            return None
        before, self._last = self._last, capsule
        if before is None:
            return None
        span_deg = (capsule.start_deg - before.start_deg) % 360.0
        usual_deg, self._span_deg = self._span_deg, span_deg
        if not math.isnan(usual_deg) and not 0.5 * usual_deg < span_deg < 1.5 * usual_deg:
            self.bad_frames += 1
            return None
        return self._points(before, span_deg, capsule.behind)

    def _points(self, capsule: _Capsule, span_deg: float, behind: int) -> Points:
        millimetres, offset_deg = _dense_values(capsule.body) if self._dense else _express_values(capsule.body)
        count = millimetres.size
        clockwise_deg = capsule.start_deg + span_deg / count * np.arange(count) - offset_deg
        ranges = millimetres.astype(np.float32) * np.float32(1e-3)
        ranges[millimetres == 0] = np.nan
        return Points(
            bearing_rad=_bearing_rad(clockwise_deg),
            range_m=ranges,
            intensity=np.where(millimetres > 0, 255, 0).astype(np.uint8),
            # the capsule that completes these points holds as many newer ones
            before_end_s=self._sample_s * (2 * count - 1 - np.arange(count, dtype=np.float64)),
            stamp_ms=np.full(count, NO_STAMP, dtype=np.int64),
            bytes_behind=np.full(count, behind, dtype=np.int64),
        )


def _xor(data: bytes | bytearray) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(data, dtype=np.uint8)))


def _dense_values(body: bytes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(mm [40], offsets, none) of a dense capsule."""
    millimetres = np.frombuffer(body, dtype="<u2").astype(np.int64)
    return millimetres, np.zeros(millimetres.size)


def _express_values(body: bytes) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(mm [32], angle offsets in degrees [32], to be subtracted) of an express capsule."""
    cabins = np.frombuffer(body, dtype=np.uint8).reshape(16, 5).astype(np.int64)
    words = np.stack([cabins[:, 0] | cabins[:, 1] << 8, cabins[:, 2] | cabins[:, 3] << 8], axis=1)
    nibbles = np.stack([cabins[:, 4] & 0xF, cabins[:, 4] >> 4], axis=1)
    offsets = (nibbles | (words & 3) << 4) / 8.0
    return (words >> 2).ravel(), offsets.ravel()
