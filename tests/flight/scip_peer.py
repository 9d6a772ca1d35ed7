"""A SCIP device for tests, written from the protocol alone: an independent encoder and a TCP server that can misbehave.

It shares no line with `flight.lidar.scip`, so that a mistake there cannot cancel itself out here.
"""

from __future__ import annotations

import math
import random
import socket
import threading
import time
from collections.abc import Callable, Sequence

FIRST, LAST, FRONT, TURN = 180, 540, 360, 720
BEAMS = LAST - FIRST + 1
STREAM_ECHO = f"MD{FIRST:04d}{LAST:04d}010"


def character_sum(text: str) -> str:
    total = 0
    for letter in text:
        total += ord(letter)
    return chr(total % 64 + 48)


def encode(value: int, width: int) -> str:
    digits = []
    for _ in range(width):
        value, low = divmod(value, 64)
        digits.append(chr(low + 48))
    return "".join(reversed(digits))


def summed(text: str) -> str:
    return text + character_sum(text)


def reply(echo: str, status: str, lines: Sequence[str] = ()) -> bytes:
    return ("\n".join([echo, summed(status), *lines]) + "\n\n").encode("latin-1")


def scan_message(values: Sequence[int], timestamp_ms: int, echo: str = STREAM_ECHO + "00", status: str = "99") -> bytes:
    stream = "".join(encode(value, 3) for value in values)
    lines = [summed(encode(timestamp_ms % 2**24, 4))]
    while stream:
        lines.append(summed(stream[:64]))
        stream = stream[64:]
    return reply(echo, status, lines)


def parameter_lines(**changes: object) -> list[str]:
    fields = {
        "MODL": "TEST-30(peer)",
        "DMIN": 100,
        "DMAX": 4000,
        "ARES": TURN,
        "AMIN": FIRST,
        "AMAX": LAST,
        "AFRT": FRONT,
        "SCAN": 1200,
    }
    fields.update(changes)
    return [f"{key}:{value};{character_sum(f'{key}:{value}')}" for key, value in fields.items()]


class Device:
    """Serves one client at a time on 127.0.0.1. Faults are attributes, read at every message.

    `values`: what a scan holds, given its number. `garble`: what becomes of a scan's bytes. `silent_to`: requests not
    answered. `stalled`: stream nothing. `clock_offset_s`: device clock minus monotonic clock.
    """

    def __init__(self, rate_hz: float = 50.0, port: int = 0) -> None:
        self.rate_hz = rate_hz
        self.values: Callable[[int], list[int]] = lambda number: [1000 + i for i in range(BEAMS)]
        self.garble: Callable[[bytes], bytes] = lambda message: message
        self.silent_to: set[str] = set()
        self.refuse: dict[str, str] = {}
        self.stalled = False
        self.frozen_clock = False
        self._stamp_ms = 0
        self.chunks = False
        self.close_after: int | None = None
        self.clock_offset_s = 12345.678
        self.greeting = b""
        self.parameters: dict[str, object] = {}
        self.requests: list[str] = []
        self.connections = 0
        self.scans_sent = 0
        self.measured: dict[int, float] = {}
        self._streaming = False
        self._random = random.Random(7)
        self._stop = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.settimeout(0.05)
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __enter__(self) -> Device:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self._listener.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            self.connections += 1
            with client:
                try:
                    self._talk(client)
                except OSError:
                    continue

    def _talk(self, client: socket.socket) -> None:
        client.settimeout(0.002)
        client.sendall(self.greeting)
        self._streaming = False
        sent_here = 0
        pending = b""
        next_s = time.monotonic()
        while not self._stop.is_set():
            try:
                data = client.recv(4096)
                if not data:
                    return
                pending += data
            except TimeoutError:
                pass
            while b"\n" in pending:
                line, pending = pending.split(b"\n", 1)
                self._answer(client, line.decode("latin-1"))
            if self._streaming and not self.stalled and time.monotonic() >= next_s:
                next_s = max(next_s + 1.0 / self.rate_hz, time.monotonic() - 1.0 / self.rate_hz)
                self._send_scan(client)
                sent_here += 1
                if self.close_after is not None and sent_here >= self.close_after:
                    return

    def clock_ms(self) -> int:
        return math.floor(1000.0 * (time.monotonic() + self.clock_offset_s)) % 2**24

    def _send_scan(self, client: socket.socket) -> None:
        if not self.frozen_clock:
            self._stamp_ms = self.clock_ms()
        stamp = self._stamp_ms
        self.measured[self.scans_sent] = time.monotonic()
        message = self.garble(scan_message(self.values(self.scans_sent), stamp))
        self.scans_sent += 1
        while self.chunks and len(message) > 1:
            cut = self._random.randrange(1, min(len(message), 300))
            client.sendall(message[:cut])
            message = message[cut:]
        client.sendall(message)

    def _answer(self, client: socket.socket, line: str) -> None:
        self.requests.append(line)
        if line in self.silent_to:
            return
        status, lines = self.refuse.get(line, "00"), []
        if line == "PP":
            lines = parameter_lines(**self.parameters)
        elif line == "TM1":
            lines = [summed(encode(self.clock_ms(), 4))]
        client.sendall(reply(line, status, lines))
        if line.startswith("MD"):
            self._streaming = True
        elif line == "QT":
            self._streaming = False
