"""LDROBOT LD06, LD19, STL-27L: a one-way stream of 47-byte frames. Bytes in, points out; no I/O, bounded memory.

Frame, little-endian: 54 2C | u16 speed, deg/s | u16 start angle, 0.01 deg | 12 x (u16 mm, u8 intensity) | u16 end angle |
u16 clock, ms modulo 30000 | CRC-8 (polynomial 4D, not reflected) of the 46 bytes before it. Angles grow clockwise; distance 0
is no return. The vendor's rule against frames glued together (an angle span that the speed cannot explain) is kept.

Protocol facts: ldrobotSensorTeam/ldlidar_stl_ros2 and the LD06 development manual.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flight.lidar.points import Points, no_points

FRAME_BYTES = 47
POINTS = 12
CLOCK_WRAP_MS = 30_000
LD06_POINTS_PER_S = 2300.0  # early LD06, the manual's example among them; later ones and the LD19 give 4500
STL27L_POINTS_PER_S = 21_600.0
_HEADER = b"\x54\x2c"
_FULL_TURN = 36_000  # hundredths of a degree
_MAX_CALL_BYTES = 16 * 1024
_FRAME = np.dtype(
    {
        "names": ["speed", "start", "points", "end", "stamp"],
        "formats": ["<u2", "<u2", (np.dtype([("mm", "<u2"), ("intensity", "u1")]), POINTS), "<u2", "<u2"],
        "offsets": [2, 4, 6, 42, 44],
        "itemsize": FRAME_BYTES,
    }
)


def _crc_table(polynomial: int) -> bytes:
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ (polynomial if value & 0x80 else 0)  # noqa: PLW2901
        table.append(value & 0xFF)
    return bytes(table)


_CRC = _crc_table(0x14D)


def crc8(data: bytes) -> int:
    """CRC-8, polynomial 0x4D, start 0, not reflected, no final exclusive or."""
    crc, table = 0, _CRC
    for byte in data:
        crc = table[crc ^ byte]
    return crc


class Ld06Decoder:
    """See `points.PointDecoder`.

    `points_per_s`: the lowest sample rate of the model, for the rule on spans (`LD06_POINTS_PER_S`, `STL27L_POINTS_PER_S`).
    `min_intensity`: weaker returns are no return.
    """

    def __init__(self, points_per_s: float, min_intensity: int = 0) -> None:
        self.bad_checksums = 0
        self.bad_frames = 0
        self._points_per_s = points_per_s
        self._min_intensity = min_intensity
        self._buffer = bytearray()

    @property
    def buffered_bytes(self) -> int:
        """At most one unfinished frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Points:
        """See `PointDecoder.feed`."""
        if len(data) > _MAX_CALL_BYTES:  # only the newest matter, and memory stays bounded
            self.bad_frames += 1
            self._buffer.clear()
            data = data[-_MAX_CALL_BYTES:]
        self._buffer += data
        frames, behind = self._cut()
        if not frames:
            return no_points()
        table = np.frombuffer(b"".join(frames), dtype=_FRAME)
        good = self._plausible(table)
        self.bad_frames += int(good.size - np.count_nonzero(good))
        return self._points(table[good], np.array(behind, dtype=np.int64)[good])

    def _cut(self) -> tuple[list[bytes], list[int]]:
        """Whole frames with a right checksum, and for each the bytes that follow it. Keeps what may be the next frame's start."""
        buffer = bytes(self._buffer)
        frames, ends, place = [], [], 0
        while (place := buffer.find(_HEADER, place)) >= 0 and place + FRAME_BYTES <= len(buffer):
            frame = buffer[place : place + FRAME_BYTES]
            if crc8(frame[:-1]) == frame[-1]:
                frames.append(frame)
                place += FRAME_BYTES
                ends.append(place)
            else:
                self.bad_checksums += 1
                place += 1
        if place < 0:  # no header any more; a last 54 may be half of one
            place = len(buffer) - (1 if buffer.endswith(_HEADER[:1]) else 0)
            place = max(place, ends[-1] if ends else 0)  # a checksum that happens to be 54 is spent
        del self._buffer[:place]
        return frames, [len(buffer) - end for end in ends]

    def _plausible(self, table: NDArray[np.void]) -> NDArray[np.bool_]:
        """Angles within a turn, a turning head, and a span of at most 1.5 times what the speed explains."""
        start, end, speed = (table[name].astype(np.int64) for name in ("start", "end", "speed"))
        span_deg = 0.01 * ((end - start) % _FULL_TURN)
        most_deg = 1.5 * speed * POINTS / self._points_per_s
        good: NDArray[np.bool_] = (start < _FULL_TURN) & (end < _FULL_TURN) & (speed > 0) & (span_deg <= most_deg)
        return good

    def _points(self, table: NDArray[np.void], behind: NDArray[np.int64]) -> Points:
        start = table["start"].astype(np.float64)
        step = ((table["end"].astype(np.float64) - start) % _FULL_TURN) / (POINTS - 1)
        index = np.arange(POINTS)
        clockwise_rad = np.radians(0.01 * (start[:, None] + step[:, None] * index))
        millimetres = table["points"]["mm"].ravel()
        intensity = table["points"]["intensity"].ravel()
        ranges = millimetres.astype(np.float32) * np.float32(1e-3)
        ranges[(millimetres == 0) | (intensity < self._min_intensity)] = np.nan
        return Points(
            bearing_rad=np.remainder(math.pi - clockwise_rad, 2.0 * math.pi).ravel() - math.pi,
            range_m=ranges,
            intensity=intensity.copy(),
            before_end_s=((step / table["speed"])[:, None] * (POINTS - 1 - index) * 0.01).ravel(),
            stamp_ms=np.repeat(table["stamp"].astype(np.int64), POINTS),
            bytes_behind=np.repeat(behind, POINTS),
        )
