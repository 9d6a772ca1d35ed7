"""The wire to the autopilot: UDP, TCP or a serial line, from MAVSDK's URLs. Nothing here blocks once it is open.

A port hands over whole frames and takes whole frames. A setpoint (`urgent`) never waits anywhere: where the wire is still busy
with what went before, it is dropped rather than delivered late.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import termios
from collections import deque
from typing import Any, Protocol
from urllib.parse import urlsplit

from flight.guard.wire import FrameStream, read_frames, read_mode

Address = tuple[Any, ...]
CHUNK_BYTES = 4096
MAX_WAITING_FRAMES = 64
MAX_UNSENT_BYTES = 512
"""A setpoint goes out only when fewer bytes than this wait in the kernel: 6 ms at 921600 baud."""


class PortError(Exception):
    """The wire cannot be opened, or has ended. The message is for the user."""


class Port(Protocol):
    """One wire to one autopilot."""

    def fileno(self) -> int:
        """For `select`."""
        ...

    def receive(self) -> list[bytes]:
        """Datagrams for MAVSDK, each of whole frames; empty when nothing waits. Raises `PortError` when the wire has ended."""
        ...

    def send(self, frames: bytes, urgent: bool = False) -> bool:
        """Whether the bytes went out (or, unless `urgent`, will go out)."""
        ...

    def close(self) -> None:
        """Free it."""
        ...


class UdpPort:
    """UDP. A listening port takes the address of the first autopilot's heartbeat as its peer, and hears only that one then."""

    def __init__(self, host: str, port: int, *, listen: bool) -> None:
        family, _, _, _, address = _resolve(host, port, socket.SOCK_DGRAM)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self.peer: Address | None = None if listen else address
        try:
            if listen:
                self._socket.bind(address)
        except OSError as error:
            raise PortError(f"{error.strerror}; stop the program that uses UDP port {port} or change the connection") from None
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """For `select`."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """One datagram, unless it comes from a stranger."""
        try:
            data, sender = self._socket.recvfrom(CHUNK_BYTES)
        except (BlockingIOError, ConnectionError):
            return []
        if sender != self.peer and not self._adopt(data, sender):
            return []
        return [data]

    def _adopt(self, data: bytes, sender: Address) -> bool:
        """Take `sender` as the autopilot if it shows one's heartbeat and none is known; with none known, anybody is heard."""
        if self.peer is not None:
            return False
        if any(read_mode(frame) is not None for frame in read_frames(data)[0]):
            self.peer = sender
        return True

    def send(self, frames: bytes, urgent: bool = False) -> bool:
        """Whether it went out."""
        if self.peer is None:
            return False
        try:
            self._socket.sendto(frames, self.peer)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Free the port."""
        self._socket.close()


class StreamPort:
    """A serial line or a TCP connection."""

    def __init__(self, descriptor: int, owner: socket.socket | None = None) -> None:
        self._descriptor, self._owner = descriptor, owner
        self._stream = FrameStream()
        self._waiting: deque[bytes] = deque()
        os.set_blocking(descriptor, False)

    def fileno(self) -> int:
        """For `select`."""
        return self._descriptor

    def receive(self) -> list[bytes]:
        """The frames that have come in as one datagram."""
        try:
            data = os.read(self._descriptor, CHUNK_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            raise PortError(f"the wire to the autopilot has ended: {error.strerror}") from None
        if not data:
            raise PortError("the wire to the autopilot has ended")
        frames = self._stream.feed(data)
        self._write_waiting()
        return [b"".join(frame.raw for frame in frames)] if frames else []

    def send(self, frames: bytes, urgent: bool = False) -> bool:
        """Whether it went out whole; frames that are not urgent may wait for the wire, the oldest are lost when too many do."""
        self._write_waiting()
        if urgent:
            return not self._waiting and self._unsent_bytes() < MAX_UNSENT_BYTES and self._write(frames) == len(frames)
        if len(self._waiting) >= MAX_WAITING_FRAMES:
            self._waiting.popleft()
        self._waiting.append(frames)
        self._write_waiting()
        return True

    def _write_waiting(self) -> None:
        while self._waiting and self._unsent_bytes() < MAX_UNSENT_BYTES:
            written = self._write(self._waiting[0])
            if written < len(self._waiting[0]):
                self._waiting[0] = self._waiting[0][written:]
                return
            self._waiting.popleft()

    def _write(self, data: bytes) -> int:
        """How many bytes the kernel took. A setpoint's rest is dropped: half a frame fails its checksum, a late one would not."""
        try:
            return os.write(self._descriptor, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise PortError(f"the wire to the autopilot has ended: {error.strerror}") from None

    def _unsent_bytes(self) -> int:
        answer = fcntl.ioctl(self._descriptor, termios.TIOCOUTQ, struct.pack("i", 0))
        return int(struct.unpack("i", answer)[0])

    def close(self) -> None:
        """Free it."""
        if self._owner is not None:
            self._owner.close()
        else:
            os.close(self._descriptor)


def open_port(url: str, timeout_s: float) -> Port:
    """Open `udpin://`, `udpout://`, `tcpin://`, `tcpout://HOST:PORT` or `serial://DEVICE:BAUD`. Raises `PortError`."""
    parts = urlsplit(url)
    try:
        if parts.scheme.startswith("serial"):
            device, _, baud = parts.path.rpartition(":")
            return StreamPort(_open_serial(device, int(baud), flow_control=parts.scheme.endswith("flowcontrol")))
        host, port = parts.hostname or "", parts.port or 0
        if parts.scheme in ("udpin", "udpout"):
            return UdpPort(host, port, listen=parts.scheme == "udpin")
        if parts.scheme in ("tcpin", "tcpout"):
            connection = _tcp(host, port, timeout_s, listen=parts.scheme == "tcpin")
            return StreamPort(connection.fileno(), connection)
    except OSError as error:
        raise PortError(f"{error.strerror or error}; check address, cable, device name and permissions") from None
    except (ValueError, termios.error) as error:
        raise PortError(f"{error}; give for example udpin://127.0.0.1:14540") from None
    raise PortError(f"unknown kind of connection {parts.scheme}; give for example udpin://127.0.0.1:14540")


def _resolve(host: str, port: int, kind: socket.SocketKind) -> tuple[int, int, int, str, Address]:
    return socket.getaddrinfo(host, port, 0, kind)[0]


def _tcp(host: str, port: int, timeout_s: float, *, listen: bool) -> socket.socket:
    if not listen:
        connection = socket.create_connection((host, port), timeout_s)
    else:
        with socket.create_server((host, port)) as server:
            server.settimeout(timeout_s)
            connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _open_serial(device: str, baud: int, *, flow_control: bool) -> int:
    """Raw 8N1 at `baud`; input waiting from before is thrown away."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise ValueError(f"{baud} baud is not a rate of this system's serial lines")
    descriptor = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        attributes = termios.tcgetattr(descriptor)
        flags = termios.CS8 | termios.CREAD | termios.CLOCAL | (termios.CRTSCTS if flow_control else 0)
        attributes[:6] = [0, 0, flags, 0, speed, speed]
        attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
        termios.tcflush(descriptor, termios.TCIOFLUSH)
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
    except termios.error as error:
        os.close(descriptor)
        raise OSError(error.args[0], error.args[1]) from None
    return descriptor
