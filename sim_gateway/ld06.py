"""An LDROBOT LD06, LD19 or STL-27L: 47-byte frames, one way, from power on. Bytes only; `serial_lidar` gives it a line.

Frame: 54 2C | speed, deg/s | start angle, 0.01 deg | 12 x (mm, intensity) | end angle | clock, ms modulo 30000 | CRC-8 (4D).
"""

from __future__ import annotations

import struct

import numpy as np

from sim_gateway.spinning import Shots, SpinConfig, millimetres

POINTS = 12
LD06 = SpinConfig()
STL27L = SpinConfig(points_per_s=21_600.0, range_min_m=0.03, range_max_m=25.0)
_CLOCK_MS = 30_000
_INTENSITY = 200
_POLYNOMIAL = 0x4D


def crc8(data: bytes) -> int:
    """Bit by bit: polynomial 0x4D, start 0, most significant bit first."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
    return crc


class Ld06Device:
    """Packs shots into frames. `clock_offset_s`: what its clock shows when the vehicle's time is 0."""

    def __init__(self, config: SpinConfig = LD06, clock_offset_s: float = 0.0) -> None:
        self._speed = round(360.0 * config.turns_per_s)
        self._clock_offset_s = clock_offset_s
        self._time_s = np.empty(0)
        self._angle_deg = np.empty(0)
        self._range_m = np.empty(0)

    def handle(self, _: bytes) -> bytes:
        """It has no ears: nothing comes back."""
        return b""

    def take(self, shots: Shots) -> bytes:
        """The frames that these shots complete."""
        self._time_s = np.concatenate([self._time_s, shots.time_s])
        self._angle_deg = np.concatenate([self._angle_deg, shots.clockwise_deg])
        self._range_m = np.concatenate([self._range_m, shots.range_m])
        whole = len(self._time_s) // POINTS * POINTS
        sent = b"".join(self._frame(slice(first, first + POINTS)) for first in range(0, whole, POINTS))
        self._time_s, self._angle_deg, self._range_m = self._time_s[whole:], self._angle_deg[whole:], self._range_m[whole:]
        return sent

    def _frame(self, part: slice) -> bytes:
        angles = np.rint(100.0 * self._angle_deg[part]).astype(np.int64) % 36_000
        values = np.minimum(millimetres(self._range_m[part]), 0xFFFF)
        stamp_ms = int(1000.0 * (self._time_s[part][-1] + self._clock_offset_s) + 1e-6) % _CLOCK_MS
        points = b"".join(struct.pack("<HB", int(value), _INTENSITY if value else 0) for value in values)
        frame = (
            b"\x54\x2c" + struct.pack("<HH", self._speed, int(angles[0])) + points + struct.pack("<HH", int(angles[-1]), stamp_ms)
        )
        return frame + bytes((crc8(frame),))
