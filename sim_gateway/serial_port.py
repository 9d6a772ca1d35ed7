"""A serial device that never makes anybody wait, and the time that bytes take on a line of some bit rate."""

from __future__ import annotations

import os
import select
from collections import deque
from collections.abc import Callable

import serial

_READ_BYTES = 4096
_BITS_PER_BYTE = 10  # with start and stop bit
_MOST_WAITING = 500  # messages


class SerialPortError(OSError):
    """The device cannot be opened; the message names it."""


class LineGoneError(OSError):
    """The device is no longer there."""


class SerialPort:
    """A serial device, 8N1. Raises `SerialPortError`; later, `LineGoneError`."""

    def __init__(self, device: str, baud: int) -> None:
        try:
            self._serial = serial.Serial(device, baud, timeout=0, exclusive=True)
        except (serial.SerialException, ValueError, OSError) as error:
            raise SerialPortError(f"the serial line {device} cannot be opened at {baud} baud: {error}") from error
        self.path = device

    def fileno(self) -> int:
        """For `select`."""
        return int(self._serial.fileno())

    def read(self, most: int = _READ_BYTES) -> bytes:
        """What has arrived, up to `most` bytes."""
        if most <= 0 or not select.select([self], [], [], 0.0)[0]:
            return b""
        try:
            data = os.read(self.fileno(), most)
        except OSError as error:
            raise LineGoneError(f"the serial line {self.path} has gone ({error.strerror})") from None
        if not data:
            raise LineGoneError(f"the serial line {self.path} has gone")
        return data

    def write(self, data: bytes) -> int:
        """How many bytes the device took."""
        try:  # not pyserial's: it tries for ever while the device takes nothing
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LineGoneError(f"the serial line {self.path} has gone ({error.strerror})") from None

    def close(self) -> None:
        """Let go of it; safe to call twice."""
        self._serial.close()


class PacedWriter:
    """Messages one after the other over a line of `baud` bits per second; times are the caller's.

    `write` takes bytes and says how many it took. A message is handed over when its last byte would be through, or, `early`,
    when the line is free for its first: for real lines, which take the time themselves. One that would have to wait for more
    than `longest_s` is lost, and so are all while the other end takes nothing.
    """

    def __init__(self, write: Callable[[bytes], int], baud: int, *, early: bool = False, longest_s: float = 0.5) -> None:
        self._write, self._early, self._longest_s = write, early, longest_s
        self._byte_s = _BITS_PER_BYTE / baud
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._rest = b""
        self._free_s = 0.0
        self.lost = 0

    def backlog_s(self, now_s: float) -> float:
        """How long a message sent now would wait."""
        return max(0.0, self._free_s - now_s)

    def send(self, data: bytes, now_s: float) -> None:
        """Send one message, or lose it."""
        if self.backlog_s(now_s) > self._longest_s or len(self._waiting) >= _MOST_WAITING:
            self.lost += 1
            return
        begins_s = max(now_s, self._free_s)
        self._free_s = begins_s + len(data) * self._byte_s
        self._waiting.append((begins_s if self._early else self._free_s, data))
        self.flush(now_s)

    def flush(self, now_s: float) -> None:
        """Hand over what is through by now."""
        while self._rest or (self._waiting and self._waiting[0][0] <= now_s + 1e-9):
            data = self._rest or self._waiting.popleft()[1]
            self._rest = data[self._write(data) :]
            if self._rest:
                return


class PacedReader:
    """No more bytes than a line of `baud` bits per second brings; times are the caller's. `read`: at most so many bytes."""

    def __init__(self, read: Callable[[int], bytes], baud: int) -> None:
        self._read, self._bytes_s = read, baud / _BITS_PER_BYTE
        self._last_s: float | None = None
        self._due = 0.0

    def read(self, now_s: float) -> bytes:
        """What is through by now. A line that was not read for long brings at most a buffer full at once."""
        elapsed_s = 0.0 if self._last_s is None else now_s - self._last_s
        self._last_s = now_s
        self._due = min(self._due + elapsed_s * self._bytes_s, float(_READ_BYTES))
        data = self._read(int(self._due))
        self._due -= len(data)
        return data
