"""Byte transports under the LiDAR decoders. Every call has a deadline; a closed peer is an error, not an empty read."""

from __future__ import annotations

import socket
from typing import Protocol

READ_BYTES = 65_536


class TransportError(OSError):
    """The link failed: refused, closed or broken. The message says which end to look at."""


class Transport(Protocol):
    """What a driver needs of a link: TCP now, serial by the same three methods."""

    def read(self, timeout_s: float) -> bytes:
        """Whatever has arrived, at most `READ_BYTES`; empty when nothing came within `timeout_s`."""
        ...

    def write(self, data: bytes, timeout_s: float) -> None:
        """All of `data`, or `TransportError` within `timeout_s`."""
        ...

    def close(self) -> None:
        """Idempotent; ends a read in another thread."""
        ...


class TcpTransport:
    """A TCP client link. Raises `TransportError` if the peer does not answer within `connect_timeout_s`."""

    def __init__(self, host: str, port: int, connect_timeout_s: float) -> None:
        self._name = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=connect_timeout_s)
        except OSError as error:
            raise TransportError(f"no LiDAR at {self._name}: {error.strerror or error}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        try:
            self._socket.settimeout(max(timeout_s, 1e-3))
            data = self._socket.recv(READ_BYTES)
        except TimeoutError:
            return b""
        except OSError as error:
            raise TransportError(f"the link to {self._name} broke: {error.strerror or error}") from error
        if not data:
            raise TransportError(f"the LiDAR at {self._name} closed the link")
        return data

    def write(self, data: bytes, timeout_s: float) -> None:
        """See `Transport.write`."""
        try:
            self._socket.settimeout(timeout_s)
            self._socket.sendall(data)
        except OSError as error:
            raise TransportError(f"cannot write to {self._name}: {error.strerror or error}") from error

    def close(self) -> None:
        """See `Transport.close`."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            self._socket.close()  # the peer was gone already
        else:
            self._socket.close()
