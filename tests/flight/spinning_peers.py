"""LD06 and RPLIDAR encoders for tests, written from the protocol alone, and a serial line to send their bytes through.

They share no line with `flight.lidar` nor with `sim_gateway`, so that a mistake there cannot cancel itself out here.
"""

from __future__ import annotations

import os
import pty
import threading
import time
import tty
from collections.abc import Callable, Sequence

LD06_EXAMPLE = bytes.fromhex("542C6808AB7EE000E4DC00E2D900E5D500E3D300E4D000E9CD00E4CA00E2C700E9C500E5C200E5C000E5BE823A1A50")


def bitwise_crc(data: bytes) -> int:
    """CRC-8, polynomial x^8 + x^6 + x^3 + x^2 + 1, as a division of polynomials."""
    remainder = 0
    for byte in data + b"\0":
        for bit in range(7, -1, -1):
            carry = remainder >> 7
            remainder = ((remainder << 1) & 0xFF) | ((byte >> bit) & 1)
            if carry:
                remainder ^= 0x4D
    return remainder


def ld06_frame(
    start_deg: float, end_deg: float, points: Sequence[tuple[int, int]], stamp_ms: int = 0, speed_deg_s: int = 3600
) -> bytes:
    """One frame of twelve (mm, intensity)."""
    assert len(points) == 12
    head = [0x54, 0x2C, *_little(speed_deg_s), *_little(round(start_deg * 100) % 36000)]
    body = [byte for distance, intensity in points for byte in (*_little(distance), intensity)]
    raw = bytes(head + body + [*_little(round(end_deg * 100) % 36000), *_little(stamp_ms % 30000)])
    return raw + bytes([bitwise_crc(raw)])


def ld06_turn(
    ranges_mm: Callable[[float], int], first_s: float = 0.0, rate_hz: float = 10.0, seconds: float = 0.1
) -> list[bytes]:
    """Frames of a head that turns clockwise, 4500 points a second: `ranges_mm` of the clockwise angle in degrees."""
    frames = []
    for number in range(round(seconds * 4500 / 12)):
        times = [first_s + (12 * number + k) / 4500 for k in range(12)]
        angles = [(360.0 * rate_hz * t) % 360.0 for t in times]
        points = [(ranges_mm(angle), 200) for angle in angles]
        frames.append(ld06_frame(angles[0], angles[-1], points, int(times[-1] * 1000), round(360 * rate_hz)))
    return frames


def _little(value: int) -> tuple[int, int]:
    return value % 256, value // 256


def node(angle_deg: float, distance_mm: float, quality: int = 15, start: bool = False) -> bytes:
    """A standard node."""
    angle = int(angle_deg * 64 + 0.5) * 2 + 1
    distance = int(distance_mm * 4 + 0.5)
    flags = 1 if start else 2
    return bytes([quality * 4 + flags, angle % 256, angle // 256, distance % 256, distance // 256])


def express_capsule(start_deg: float, points: Sequence[tuple[int, int]], first: bool = False) -> bytes:
    """An express capsule of 32 (mm, angle offset in eighths of a degree, 0..63)."""
    assert len(points) == 32
    body = bytearray()
    for k in range(0, 32, 2):
        (one, turn_one), (two, turn_two) = points[k], points[k + 1]
        body += bytes(_little(one * 4 + turn_one // 16)) + bytes(_little(two * 4 + turn_two // 16))
        body.append(turn_one % 16 + 16 * (turn_two % 16))
    return _capsule(start_deg, bytes(body), first)


def dense_capsule(start_deg: float, distances_mm: Sequence[int], first: bool = False) -> bytes:
    """A dense capsule of 40 mm."""
    assert len(distances_mm) == 40
    return _capsule(start_deg, b"".join(bytes(_little(value)) for value in distances_mm), first)


def _capsule(start_deg: float, body: bytes, first: bool) -> bytes:
    angle = int(start_deg * 64 + 0.5) % (360 * 64) + (32768 if first else 0)
    checked = bytes(_little(angle)) + body
    total = 0
    for byte in checked:
        total ^= byte
    return bytes([0xA0 + total % 16, 0x50 + total // 16]) + checked


class SerialPeer:
    """The far end of a serial line: sends what it is given, at its own pace, and keeps what it is sent."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self._slave)
        self.heard = bytearray()
        self.answer: Callable[[bytes], bytes] = lambda heard: b""
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def send(self, data: bytes) -> None:
        try:
            os.write(self.master, data)
        except BlockingIOError:
            return

    def stream(self, next_bytes: Callable[[], bytes], every_s: float) -> None:
        """Answer requests, and send `next_bytes()` every so often, in a thread."""

        def run() -> None:
            due_s = time.monotonic()
            while not self._stop.wait(max(0.0, due_s - time.monotonic())):
                due_s += every_s
                try:
                    heard = os.read(self.master, 4096)
                except BlockingIOError:
                    heard = b""
                self.heard += heard
                self.send(self.answer(heard) + next_bytes())

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None
        for descriptor in (self.master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self.master = self._slave = -1

    def __enter__(self) -> SerialPeer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
