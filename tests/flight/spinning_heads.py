"""Heads of spinning LiDARs for tests: they turn in real time and answer; faults are attributes."""

from __future__ import annotations

import time
from collections.abc import Callable

from spinning_peers import dense_capsule, express_capsule, ld06_turn, node

INFO = bytes.fromhex("A55A1400000004")
MODES = {0: 0x81, 1: 0x82, 2: 0x84, 3: 0x85}  # 84 is a format the driver does not read
POINTS = {0x81: 1, 0x82: 32, 0x85: 40}  # of one piece of the stream


def right_is_near(clockwise_deg: float) -> int:
    """1 m on the right half, 3 m on the left."""
    return 1000 if 0.0 < clockwise_deg < 180.0 else 3000


class Ld06Head:
    """Frames of a head in real time; faults are attributes."""

    def __init__(self, ranges_mm: Callable[[float], int] = right_is_near) -> None:
        self.ranges_mm = ranges_mm
        self.silent = False
        self.garble: Callable[[bytes], bytes] = lambda data: data
        self._started_s = time.monotonic()
        self._sent = 0

    def __call__(self) -> bytes:
        due = int((time.monotonic() - self._started_s) * 4500 / 12)
        first, self._sent = self._sent, due
        if self.silent or due <= first:
            return b""
        frames = ld06_turn(self.ranges_mm, first_s=first * 12 / 4500, seconds=(due - first) * 12 / 4500)
        return self.garble(b"".join(frames))


class RplidarHead:
    """An RPLIDAR of 8000 points a second for tests."""

    def __init__(self, firmware: tuple[int, int] = (1, 29)) -> None:
        self.firmware = firmware
        self.health = 0
        self.modes = dict(MODES)
        self.typical = 2
        self.sends: dict[int, int] = {}  # asked for this format, it sends that one
        self.kind = 0
        self.commands: list[int] = []
        self.silent_to: set[int] = set()
        self.chatter = False
        self.garble: Callable[[bytes], bytes] = lambda data: data
        self._sent = 0
        self._started_s = time.monotonic()
        self._first = True

    def answer(self, heard: bytes) -> bytes:
        replies = b""
        while heard:
            command = heard[1]
            size = 3 + heard[2] + 1 if command & 0x80 else 2
            payload, heard = heard[3 : size - 1], heard[size:]
            self.commands.append(command)
            if command not in self.silent_to:
                replies += self._reply(command, payload)
        return replies

    def _reply(self, command: int, payload: bytes) -> bytes:
        if command == 0x25:
            self.kind = 0
        if command == 0x50:
            return INFO + bytes([0x18, self.firmware[1], self.firmware[0], 7]) + bytes(16)
        if command == 0x52:
            return bytes.fromhex("A55A0300000006") + bytes([self.health, 0x01, 0x80])
        if command == 0x59:
            return bytes.fromhex("A55A0400000015") + (125).to_bytes(2, "little") * 2
        if command == 0x84:
            key, mode = payload[0], payload[4]
            value = {
                0x70: len(self.modes).to_bytes(2, "little"),
                0x71: (125 * 256).to_bytes(4, "little"),
                0x74: (16 * 256).to_bytes(4, "little"),
                0x75: bytes([self.modes.get(mode, 0)]),
                0x7C: self.typical.to_bytes(2, "little"),
            }[key]
            return bytes.fromhex("A55A") + (4 + len(value)).to_bytes(4, "little") + b"\x20" + bytes([key, 0, 0, 0]) + value
        if command in (0x20, 0x82):
            self.kind = 0x81 if command == 0x20 else (0x82 if self.firmware < (1, 24) else self.modes[payload[0]])
            self.kind = self.sends.get(self.kind, self.kind)
            self._first = True
            size = {0x81: 5, 0x83: 781, 0x84: 132, 0x86: 170}.get(self.kind, 84)
            return b"\xa5\x5a" + (size | 1 << 30).to_bytes(4, "little") + bytes([self.kind])
        return b""

    def __call__(self) -> bytes:
        due = int((time.monotonic() - self._started_s) * 8000)
        size = POINTS.get(self.kind, 1)
        due -= due % size
        first, self._sent = self._sent, due
        if self.chatter:
            return b"\x55" * 50
        if self.kind not in POINTS:
            return b""
        return self.garble(b"".join(self._piece(first + k, size) for k in range(0, min(due - first, 800), size)))

    def _piece(self, number: int, size: int) -> bytes:
        angles = [((number + k) * 10 * 360.0 / 8000) % 360.0 for k in range(size)]
        ranges = [right_is_near(angle) for angle in angles]
        opening, self._first = self._first, False
        if self.kind == 0x81:
            return node(angles[0], ranges[0], start=angles[0] < 0.5)
        if self.kind == 0x82:
            return express_capsule(angles[0], [(mm, 0) for mm in ranges], first=opening)
        return dense_capsule(angles[0], ranges, first=opening)
