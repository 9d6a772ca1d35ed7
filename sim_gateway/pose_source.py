"""Where the messages of a vehicle elsewhere come from: a UDP port, a TCP server or a serial line, named by a URL.

Nothing is sent to the vehicle but TIMESYNC: no heartbeat, so that it takes nobody here for its ground station.
"""

from __future__ import annotations

import contextlib
import logging
import socket
from typing import Protocol
from urllib.parse import urlsplit

from sim_gateway.serial_port import LineGoneError, SerialPort

_READ_BYTES = 65536
_DATAGRAMS_PER_POLL = 100
_RETRY_S = 1.0
_CONNECT_S = 0.2
_EXAMPLES = "udpin://127.0.0.1:14551, udpout://127.0.0.1:14580, tcp://127.0.0.1:5760 or serial:///dev/ttyUSB0:57600"

_log = logging.getLogger("sim_gateway.follow")


class FollowUrlError(OSError):
    """A URL that cannot be followed; the message says what to write or what is wrong."""


class PoseSource(Protocol):
    """Bytes from a vehicle, and back."""

    def read(self, now_s: float) -> list[bytes]:
        """What has arrived, in the pieces in which it came."""

    def send(self, data: bytes) -> None:
        """To the vehicle, if it is known where that is; may be lost."""

    def watched(self) -> list[socket.socket | SerialPort]:
        """What becomes readable when something arrives."""

    def close(self) -> None:
        """Let go of it."""


class UdpSource:
    """Listens on a port, or speaks to one (`peer`)."""

    def __init__(self, listen: tuple[str, int] | None, peer: tuple[str, int] | None) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer, self._fixed = peer, peer is not None
        if listen is not None:
            try:
                self._socket.bind(listen)
            except OSError as error:
                self._socket.close()
                raise FollowUrlError(f"UDP port {listen[1]} on {listen[0]} cannot be listened to ({error.strerror})") from error

    def read(self, now_s: float) -> list[bytes]:
        """See `PoseSource.read`."""
        found = []
        for _ in range(_DATAGRAMS_PER_POLL):
            try:
                data, peer = self._socket.recvfrom(_READ_BYTES)
            except BlockingIOError:
                break
            except OSError:  # nobody there (yet)
                continue
            if self._fixed and peer != self._peer:
                continue
            self._peer = peer
            found.append(data)
        return found

    def send(self, data: bytes) -> None:
        """See `PoseSource.send`."""
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)

    def watched(self) -> list[socket.socket | SerialPort]:
        """See `PoseSource.watched`."""
        return [self._socket]

    def close(self) -> None:
        """See `PoseSource.close`."""
        self._socket.close()


class TcpSource:
    """A client of a server; connects again when that has gone."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address, self._retry_s = address, -1e9
        self._socket: socket.socket | None = None

    def read(self, now_s: float) -> list[bytes]:
        """See `PoseSource.read`."""
        if self._socket is None:
            self._connect(now_s)
        if self._socket is None:
            return []
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            _log.warning("the server %s:%d has closed the connection", *self._address)
            self.close()
        return [data] if data else []

    def _connect(self, now_s: float) -> None:
        if now_s - self._retry_s < _RETRY_S:
            return
        self._retry_s = now_s
        with contextlib.suppress(OSError):
            self._socket = socket.create_connection(self._address, timeout=_CONNECT_S)
            self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        """See `PoseSource.send`."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(data)

    def watched(self) -> list[socket.socket | SerialPort]:
        """See `PoseSource.watched`."""
        return [self._socket] if self._socket is not None else []

    def close(self) -> None:
        """See `PoseSource.close`."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class SerialSource:
    """A serial line, such as a telemetry radio's. Raises `SerialPortError`."""

    def __init__(self, device: str, baud: int) -> None:
        self._port: SerialPort | None = SerialPort(device, baud)

    def read(self, now_s: float) -> list[bytes]:
        """See `PoseSource.read`."""
        if self._port is None:
            return []
        try:
            data = self._port.read()
        except LineGoneError as error:
            _log.error("%s", error)
            self.close()
            return []
        return [data] if data else []

    def send(self, data: bytes) -> None:
        """See `PoseSource.send`."""
        if self._port is not None:
            with contextlib.suppress(LineGoneError):
                self._port.write(data)

    def watched(self) -> list[socket.socket | SerialPort]:
        """See `PoseSource.watched`."""
        return [self._port] if self._port is not None else []

    def close(self) -> None:
        """See `PoseSource.close`."""
        if self._port is not None:
            self._port.close()
            self._port = None


def open_source(url: str) -> PoseSource:
    """The source of a URL: ``udpin://``, ``udpout://``, ``tcp://`` (host and port) or ``serial://DEVICE:BAUD``.

    Raises `FollowUrlError`, `SerialPortError`.
    """
    kind, separator, rest = url.partition("://")
    if kind == "serial" and separator:
        device, _, baud = rest.rpartition(":")
        if not device or not baud.isdigit() or int(baud) == 0:
            raise FollowUrlError(f"{url}: give device and bit rate, such as {_EXAMPLES}")
        return SerialSource(device, int(baud))
    try:
        parts = urlsplit(url)
        address = (socket.gethostbyname(parts.hostname or ""), parts.port or 0)
    except (ValueError, OSError) as error:
        raise FollowUrlError(f"{url}: {error}; write it as {_EXAMPLES}") from None
    if kind not in ("udpin", "udpout", "tcp") or not parts.hostname or not address[1]:
        raise FollowUrlError(f"{url}: write it as {_EXAMPLES}")
    if kind == "tcp":
        return TcpSource(address)
    return UdpSource(address, None) if kind == "udpin" else UdpSource(None, address)
