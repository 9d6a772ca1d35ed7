"""The line to a real PX4: TCP to one in SITL, which waits for the simulator at every step, or serial to a flight controller."""

from __future__ import annotations

import errno
import logging
import select
import socket
import struct
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from sim_gateway.frame_reader import Frame, FrameReader
from sim_gateway.serial_port import LineGoneError, PacedWriter, SerialPort, SerialPortError

DEFAULT_PORT = 4560
DEFAULT_BAUD = 921_600
_LOOPBACK = "127.0.0.1"
_READ_BYTES = 8192
_SEND_DEADLINE_S = 5.0
_ACCEPT_TURN_S = 0.2
_LONGEST_BACKLOG_S = 0.02  # of a serial line
_CONTROLS = struct.Struct("<QQ16fB")
_CONTROLS_NUMBER = 93
_ARMED = 128

_log = logging.getLogger("sim_gateway.px4")


class Px4LineError(OSError):
    """The line to PX4 cannot be opened; the message says what to change."""


class Px4GoneError(RuntimeError):
    """PX4 has gone from the line."""


@dataclass(frozen=True, slots=True)
class Controls:
    """HIL_ACTUATOR_CONTROLS: the step it answers (PX4's clock, us), motors 1 to 4 (0 to 1), whether armed."""

    time_us: int
    motors: tuple[float, float, float, float]
    armed: bool


class Px4Line(Protocol):
    """What carries frames to and from PX4. `lockstep`: PX4 answers every step, and waits for the next."""

    lockstep: bool

    def connect(self, stop: threading.Event) -> bool:
        """Wait for PX4; False if `stop` came first."""

    def send(self, data: bytes) -> None:
        """Raises `Px4GoneError`."""

    def receive(self, timeout_s: float) -> list[Controls]:
        """What has arrived, or arrives within that time. Raises `Px4GoneError`."""

    def close(self) -> None:
        """Let go of it; safe to call twice."""


class TcpLine:
    """The server on loopback that PX4 in SITL connects to. One PX4: while it is there, nobody else gets in."""

    lockstep = True

    def __init__(self, port: int = DEFAULT_PORT) -> None:
        self._listener = _listen(port)
        self.port = int(self._listener.getsockname()[1])
        self._socket: socket.socket | None = None
        self._poll = select.poll()
        self._reader = FrameReader()

    def connect(self, stop: threading.Event) -> bool:
        """See `Px4Line.connect`."""
        self._listener.settimeout(_ACCEPT_TURN_S)
        while not stop.is_set():
            try:
                sock, _ = self._listener.accept()
            except TimeoutError:
                continue
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.settimeout(_SEND_DEADLINE_S)
            self._listener.close()
            self._socket = sock
            self._poll.register(sock, select.POLLIN)
            return True
        return False

    def send(self, data: bytes) -> None:
        """See `Px4Line.send`."""
        assert self._socket is not None
        try:
            self._socket.sendall(data)
        except TimeoutError:
            raise Px4GoneError(f"PX4 has read nothing for {_SEND_DEADLINE_S:g} s") from None
        except OSError as error:
            raise Px4GoneError(f"PX4 has closed the connection ({error.strerror})") from None

    def receive(self, timeout_s: float) -> list[Controls]:
        """See `Px4Line.receive`."""
        assert self._socket is not None
        if not self._poll.poll(1e3 * timeout_s):
            return []
        try:
            data = self._socket.recv(_READ_BYTES)
        except OSError as error:
            raise Px4GoneError(f"PX4 has closed the connection ({error.strerror})") from None
        if not data:
            raise Px4GoneError("PX4 has closed the connection")
        return controls(self._reader.feed(data))

    def close(self) -> None:
        """See `Px4Line.close`."""
        self._listener.close()
        if self._socket is not None:
            self._socket.close()


class SerialLine:
    """A serial line to a flight controller in HITL. Nothing waits for the line: what it cannot carry in time is lost."""

    lockstep = False

    def __init__(self, device: str, baud: int = DEFAULT_BAUD) -> None:
        try:
            self._port = SerialPort(device, baud)
        except SerialPortError as error:
            raise Px4LineError(str(error)) from error
        self._writer = PacedWriter(self._port.write, baud, early=True, longest_s=_LONGEST_BACKLOG_S)
        self._reader = FrameReader()

    @property
    def lost_messages(self) -> int:
        """How many the line was too slow for."""
        return self._writer.lost

    def connect(self, stop: threading.Event) -> bool:
        """There is nothing to wait for: the controller speaks when it hears a simulator."""
        return not stop.is_set()

    def send(self, data: bytes) -> None:
        """Send, or lose it if too much of what was sent before is still on its way."""
        try:
            self._writer.send(data, time.monotonic())
        except LineGoneError as error:
            raise Px4GoneError(str(error)) from None

    def receive(self, timeout_s: float) -> list[Controls]:
        """See `Px4Line.receive`."""
        try:
            if timeout_s > 0.0:
                select.select([self._port], [], [], timeout_s)
            self._writer.flush(time.monotonic())
            data = self._port.read()
        except LineGoneError as error:
            raise Px4GoneError(str(error)) from None
        return controls(self._reader.feed(data)) if data else []

    def close(self) -> None:
        """See `Px4Line.close`."""
        self._port.close()


def controls(frames: Iterable[Frame]) -> list[Controls]:
    """The motor commands among frames. Values that are no number stop their motor."""
    found = []
    for frame in frames:
        if frame.number != _CONTROLS_NUMBER or len(frame.payload) > _CONTROLS.size:
            continue
        time_us, _, *values, mode = _CONTROLS.unpack(frame.payload.ljust(_CONTROLS.size, b"\0"))
        a, b, c, d = (min(1.0, max(0.0, value)) if value == value else 0.0 for value in values[:4])  # noqa: PLR0124  (NaN)
        found.append(Controls(time_us, (a, b, c, d), bool(mode & _ARMED)))
    return found


def open_line(address: str) -> Px4Line:
    """The line of an address: `tcp:PORT` (on this machine) or `serial:DEVICE[,BAUD]`.

    Raises `Px4LineError`.
    """
    kind, _, rest = address.partition(":")
    if kind == "tcp":
        if not rest.isdigit() or not 0 <= int(rest) <= 65_535:
            raise Px4LineError(f"{address}: give a port, such as tcp:{DEFAULT_PORT}")
        return TcpLine(int(rest))
    if kind == "serial":
        device, _, baud = rest.partition(",")
        if not device or not (baud or "1").isdigit() or int(baud or 1) == 0:
            raise Px4LineError(f"{address}: give a device and its bit rate, such as serial:/dev/ttyACM0,{DEFAULT_BAUD}")
        return SerialLine(device, int(baud or DEFAULT_BAUD))
    raise Px4LineError(f"{address}: give tcp:PORT or serial:DEVICE,BAUD")


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((_LOOPBACK, port))
        listener.listen(1)
    except OSError as error:
        listener.close()
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        raise Px4LineError(f"TCP port {port} for PX4 {reason}: stop the program there, or --px4 tcp:PORT with another") from error
    return listener
