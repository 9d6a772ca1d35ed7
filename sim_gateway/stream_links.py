"""MAVLink links that carry a stream of bytes: TCP with several clients; serial lines and pseudo-terminals with their bit rate."""

from __future__ import annotations

import errno
import logging
import socket
import struct
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Protocol

from sim_gateway.frame_reader import FrameReader, decode
from sim_gateway.link_faults import RawBytes
from sim_gateway.mavlink_frame import FramePacker
from sim_gateway.mavlink_links import MavlinkLink, PortInUseError
from sim_gateway.serial_port import LineGoneError, PacedReader, PacedWriter
from sim_gateway.telemetry import COMPONENT_ID, SYSTEM_ID, Message

_CLIENTS = 8
_READ_BYTES = 8192
_UNREAD_BYTES = 64 * 1024  # a client that leaves more than this is shut out
_ROOM_S = 0.05
_UNPACED_BAUD = 1_000_000_000

_log = logging.getLogger("sim_gateway.mavlink")


class _StreamLink(MavlinkLink):
    """What they have in common: whole frames out, messages in."""

    def __init__(self, name: str, column: int, now_s: Callable[[], float], system_id: int) -> None:
        super().__init__(name, column, now_s)
        self._packer = FramePacker(system_id, COMPONENT_ID)

    def _transmit(self, message: Message | RawBytes) -> None:
        try:
            data = message.data if isinstance(message, RawBytes) else self._packer.pack(message)
        except (struct.error, OverflowError, ValueError) as error:
            _log.error("message %s has a value outside its field: %s", type(message).__name__, error)
            return
        self._put(data)

    @abstractmethod
    def _put(self, data: bytes) -> None:
        """One message to everybody."""

    @staticmethod
    def _messages(reader: FrameReader, data: bytes) -> list[Message]:
        decoded = (decode(frame) for frame in reader.feed(data)) if data else ()
        return [message for message in decoded if message is not None]


class _Client:
    """One TCP connection: what it has not read yet, and what of a frame has come from it."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNREAD_BYTES)
        self.socket, self.reader, self.unsent = sock, FrameReader(), bytearray()

    def send(self, data: bytes) -> bool:
        """Send what it takes; whether it is still there and reads."""
        self.unsent += data
        if not self.unsent:
            return True
        try:
            del self.unsent[: self.socket.send(self.unsent)]
        except BlockingIOError:
            pass
        except OSError:
            return False
        return len(self.unsent) <= _UNREAD_BYTES

    def receive(self) -> bytes | None:
        """What has come; None when it has gone."""
        try:
            return self.socket.recv(_READ_BYTES) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None


class TcpLink(_StreamLink):
    """Clients connect to our port: up to eight, all told the same. One that never reads is shut out, unnoticed by the others."""

    def __init__(
        self, name: str, address: tuple[str, int], column: int, now_s: Callable[[], float], system_id: int = SYSTEM_ID
    ) -> None:
        super().__init__(name, column, now_s, system_id)
        self._listener = _listen(address, name)
        self.port = int(self._listener.getsockname()[1])
        self._clients: list[_Client] = []

    def watched(self) -> list[socket.socket]:
        """See `MavlinkLink.watched`."""
        return [self._listener, *(client.socket for client in self._clients)]

    def close(self) -> None:
        """Free the port."""
        for client in self._clients:
            client.socket.close()
        self._clients.clear()
        self._listener.close()

    def flush(self) -> None:
        """Also what clients had no room for."""
        super().flush()
        self._put(b"")

    def _put(self, data: bytes) -> None:
        for client in [client for client in self._clients if not client.send(data)]:
            self._drop(client)

    def _fetch(self) -> list[Message]:
        self._accept()
        messages: list[Message] = []
        for client in list(self._clients):
            data = client.receive()
            if data is None:
                self._drop(client)
            else:
                messages += self._messages(client.reader, data)
        return messages

    def _accept(self) -> None:
        try:
            sock, peer = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        if len(self._clients) >= _CLIENTS:
            _log.warning("the %s link has %d clients already: %s is turned away", self.name, _CLIENTS, peer)
            sock.close()
            return
        self._clients.append(_Client(sock))

    def _drop(self, client: _Client) -> None:
        client.socket.close()
        self._clients.remove(client)


class BytePort(Protocol):
    """A serial device or a pseudo-terminal (`serial_port.SerialPort`, `pty_port.PtyPort`)."""

    path: str

    def read(self, most: int = ...) -> bytes:
        """What has arrived."""

    def write(self, data: bytes) -> int:
        """How many bytes it took."""

    def close(self) -> None:
        """Let go of it."""


class SerialLink(_StreamLink):
    """One serial line, at its bit rate by vehicle time. Streams thin out to what it carries; what still does not fit is lost.

    `baud` 0: as fast as it goes. `early`: a real device, which takes its time by itself.
    """

    def __init__(
        self,
        name: str,
        port: BytePort,
        baud: int,
        column: int,
        now_s: Callable[[], float],
        system_id: int = SYSTEM_ID,
        *,
        early: bool = False,
    ) -> None:
        super().__init__(name, column, now_s, system_id)
        self.port = port
        self._frames = FrameReader()
        self._writer = PacedWriter(port.write, baud or _UNPACED_BAUD, early=early)
        self._reader = PacedReader(port.read, _UNPACED_BAUD if early or not baud else baud)
        self._gone = self._parameters_turn = False

    @property
    def lost_messages(self) -> int:
        """How many did not fit."""
        return self._writer.lost

    @property
    def has_room(self) -> bool:
        """See `MavlinkLink.has_room`."""
        return self._writer.backlog_s(self._now_s()) < _ROOM_S

    @property
    def limited(self) -> bool:
        """See `MavlinkLink.limited`."""
        return True

    def due(self, available: Callable[[str], bool]) -> Iterator[str]:
        """See `MavlinkLink.due`. While parameters wait, streams have every other turn."""
        self._parameters_turn = bool(self.parameter_queue) and not self._parameters_turn
        return iter(()) if self._parameters_turn else super().due(available)

    def close(self) -> None:
        """Let go of the line."""
        self.port.close()

    def flush(self) -> None:
        """Also what the line has carried by now."""
        super().flush()
        if not self._gone:
            self._unless_gone(lambda: self._writer.flush(self._now_s()))

    def _put(self, data: bytes) -> None:
        if not self._gone:
            self._unless_gone(lambda: self._writer.send(data, self._now_s()))

    def _fetch(self) -> list[Message]:
        heard: list[bytes] = []
        if not self._gone:
            self._unless_gone(lambda: heard.append(self._reader.read(self._now_s())))
        return self._messages(self._frames, b"".join(heard))

    def _unless_gone(self, use: Callable[[], None]) -> None:
        try:
            use()
        except LineGoneError as error:
            _log.error("%s; the vehicle flies on without it", error)
            self._gone = True


def _listen(address: tuple[str, int], name: str) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setblocking(False)
    try:
        listener.bind(address)
        listener.listen(_CLIENTS)
    except OSError as error:
        listener.close()
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        raise PortInUseError(f"TCP port {address[1]} on {address[0]} ({name} link) {reason}") from error
    return listener
