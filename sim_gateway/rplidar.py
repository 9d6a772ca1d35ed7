"""A Slamtec RPLIDAR: requests in, answers and scan data out. Bytes only; `serial_lidar` gives it a line.

Answers info, health, sample rate, questions about its scan modes, and scans in formats 81 (standard), 82 (express), 85 (dense).
Where the protocol leaves a choice open: a request while it scans is answered in the stream, as the device does; a request with a
wrong checksum is ignored; angle offsets of the express format are 0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim_gateway.spinning import Shots, SpinConfig, millimetres

A1 = SpinConfig(turns_per_s=10.0, points_per_s=8000.0, range_min_m=0.15, range_max_m=12.0)
_SYNC, _HEAD = 0xA5, b"\xa5\x5a"
_STANDARD, _EXPRESS, _DENSE = 0x81, 0x82, 0x85
_STREAM_BYTES = {_STANDARD: 5, _EXPRESS: 84, _DENSE: 84}
_PER_CAPSULE = {_EXPRESS: 32, _DENSE: 40}
_BANNER = b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n"
_MAX_PENDING = 512
_QUALITY = 47


@dataclass(frozen=True, slots=True)
class Mode:
    """A scan mode as `GET_LIDAR_CONF` tells of it."""

    name: str
    kind: int


MODES = (Mode("Standard", _STANDARD), Mode("Express", _EXPRESS), Mode("DenseBoost", _DENSE))


def _descriptor(kind: int, size: int, *, repeating: bool = False) -> bytes:
    return _HEAD + struct.pack("<IB", size | (0x40000000 if repeating else 0), kind)


def _exclusive_or(data: bytes) -> int:
    check = 0
    for byte in data:
        check ^= byte
    return check


class RplidarDevice:
    """The instrument. `firmware`: (major, minor); before 1.24 it knows no scan modes. `health`: 0 good, 1 warning, 2 error."""

    def __init__(self, config: SpinConfig = A1, firmware: tuple[int, int] = (1, 29), health: int = 0, typical: int = 2) -> None:
        self._config = config
        self._firmware = firmware
        self.health = health
        self._typical = typical
        self._kind: int | None = None
        self._pending = bytearray()
        self._fresh = True
        self._turn_deg = 360.0
        self._left = Shots(np.empty(0), np.empty(0), np.empty(0))
        self._simple: dict[int, Callable[[], bytes]] = {
            0x25: self._stop,
            0x40: self._reset,
            0x20: lambda: self._start(_STANDARD),
            0x21: lambda: self._start(_STANDARD),
            0x50: self._info,
            0x52: lambda: _descriptor(0x06, 3) + struct.pack("<BH", self.health, 0x8001 if self.health else 0),
            0x59: lambda: _descriptor(0x15, 4) + struct.pack("<HH", *[self._sample_us] * 2),
        }

    @property
    def scanning(self) -> bool:
        """Whether a scan is running."""
        return self._kind is not None

    @property
    def _sample_us(self) -> int:
        return round(1e6 / self._config.points_per_s)

    def handle(self, data: bytes) -> bytes:
        """The answers to what a client sent, whatever the pieces."""
        self._pending += data[:_MAX_PENDING]
        answers = bytearray()
        while (request := self._next_request()) is not None:
            answers += self._answer(*request)
        return bytes(answers)

    def _next_request(self) -> tuple[int, bytes] | None:
        pending = self._pending
        while pending:
            start = pending.find(_SYNC)
            del pending[: start if start >= 0 else len(pending)]
            if len(pending) < 2:
                return None
            command = pending[1]
            if not command & 0x80:
                del pending[:2]
                return command, b""
            if len(pending) < 3 or len(pending) < 4 + pending[2]:
                return None
            whole = bytes(pending[: 4 + pending[2]])
            if _exclusive_or(whole) == 0:
                del pending[: len(whole)]
                return command, whole[3:-1]
            del pending[:1]
        return None

    def _answer(self, command: int, payload: bytes) -> bytes:
        if command in self._simple:
            return self._simple[command]()
        if command == 0x82 and len(payload) == 5:
            return self._express(payload[0])
        if command == 0x84 and len(payload) >= 4 and self._firmware >= (1, 24):
            return self._configuration(payload)
        return b""  # motor commands, and what it does not know

    def _stop(self) -> bytes:
        self._kind = None
        return b""

    def _reset(self) -> bytes:
        self._kind = None
        return _BANNER

    def _info(self) -> bytes:
        body = struct.pack("<BBBB", 0x18, self._firmware[1], self._firmware[0], 7) + bytes(range(16))
        return _descriptor(0x04, 20) + body

    def _express(self, mode: int) -> bytes:
        if self._firmware < (1, 24):
            return self._start(_EXPRESS)
        return self._start(MODES[mode].kind) if mode < len(MODES) else b""

    def _start(self, kind: int) -> bytes:
        if self.health >= 2:
            return b""
        self._kind, self._fresh = kind, True
        self._left = Shots(np.empty(0), np.empty(0), np.empty(0))
        return _descriptor(kind, _STREAM_BYTES[kind], repeating=True)

    def _configuration(self, payload: bytes) -> bytes:
        (key,) = struct.unpack_from("<I", payload)
        mode = struct.unpack_from("<H", payload, 4)[0] if len(payload) >= 6 else 0
        values: dict[int, Callable[[], bytes]] = {
            0x70: lambda: struct.pack("<H", len(MODES)),
            0x71: lambda: struct.pack("<I", round(256e6 / self._config.points_per_s)),
            0x74: lambda: struct.pack("<I", round(256.0 * self._config.range_max_m)),
            0x75: lambda: struct.pack("<B", MODES[mode].kind),
            0x7C: lambda: struct.pack("<H", self._typical),
            0x7F: lambda: MODES[mode].name.encode("ascii") + b"\0",
        }
        if key not in values or mode >= len(MODES):
            return b""
        value = values[key]()
        return _descriptor(0x20, 4 + len(value)) + struct.pack("<I", key) + value

    # ---- scan data

    def take(self, shots: Shots) -> bytes:
        """The scan data that these shots complete; nothing while it does not scan."""
        if self._kind is None:
            return b""
        if self._kind == _STANDARD:
            return self._nodes(shots)
        return self._capsules(shots, self._kind)

    def _nodes(self, shots: Shots) -> bytes:
        quarters = np.minimum(4 * millimetres(shots.range_m), 0xFFFF)
        angles = np.rint(64.0 * shots.clockwise_deg).astype(np.int64) % 23_040
        sent = bytearray()
        for angle_deg, angle, quarter in zip(shots.clockwise_deg, angles, quarters, strict=True):
            first = 1 if angle_deg < self._turn_deg else 0
            self._turn_deg = float(angle_deg)
            quality = _QUALITY if quarter else 0
            sent += struct.pack("<BHH", quality << 2 | (1 - first) << 1 | first, int(angle) << 1 | 1, int(quarter))
        return bytes(sent)

    def _capsules(self, shots: Shots, kind: int) -> bytes:
        left, size = self._left, _PER_CAPSULE[kind]
        times, angles = np.concatenate([left.time_s, shots.time_s]), np.concatenate([left.clockwise_deg, shots.clockwise_deg])
        ranges = np.concatenate([left.range_m, shots.range_m])
        whole = len(times) // size * size
        sent = b"".join(self._capsule(kind, angles[i], ranges[i : i + size]) for i in range(0, whole, size))
        self._left = Shots(times[whole:], angles[whole:], ranges[whole:])
        return sent

    def _capsule(self, kind: int, start_deg: float, range_m: np.ndarray) -> bytes:
        values = np.minimum(millimetres(range_m), 0xFFFF if kind == _DENSE else 0x3FFF)
        if kind == _DENSE:
            body = struct.pack("<40H", *values.tolist())
        else:
            pairs = values.reshape(16, 2).tolist()
            body = b"".join(struct.pack("<HHB", near << 2, far << 2, 0) for near, far in pairs)
        start = round(64.0 * start_deg) % 23_040 | (0x8000 if self._fresh else 0)
        self._fresh = False
        checked = struct.pack("<H", start) + body
        check = _exclusive_or(checked)
        return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + checked
