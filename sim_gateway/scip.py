"""The emulated SCIP laser scanner on a loopback TCP port, in a thread of its own, fed by the simulator.

One client: the first keeps the device, a further connection is closed at once. A closed connection stops everything.
A client that does not read is dropped when its output buffer is full. Empty request lines are ignored.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import threading
from collections.abc import Callable
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from sim_gateway.scip_device import MAX_LINE, ScipDevice, ScipGeometry

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 10940
_OUTPUT_LIMIT = 32 * 1024
_START_STOP_DEADLINE_S = 5.0


class ScipServerError(RuntimeError):
    """The emulated scanner could not be put on its port."""


class _Connection(asyncio.Protocol):
    """One TCP connection. Splits requests at line feeds whatever the packets are; memory bounded both ways."""

    def __init__(self, server: ScipServer) -> None:
        self._server = server
        self._line = bytearray()
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if self._server.client is not None:
            transport.abort()
            return
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _OUTPUT_LIMIT)
        self.transport = transport
        self._server.client = self
        self._server.show_newest()

    def data_received(self, data: bytes) -> None:
        if self.transport is None:
            return
        *lines, rest = data.split(b"\n")
        for piece in lines:
            self._keep(piece)
            line = bytes(self._line).removesuffix(b"\r")
            self._line.clear()
            if line:
                self.send(self._server.device.handle(line))
        self._keep(rest)

    def _keep(self, piece: bytes) -> None:
        self._line += piece[: MAX_LINE + 1 - len(self._line)]

    def send(self, message: bytes) -> None:
        if self.transport is None or self.transport.is_closing() or not message:
            return
        if self.transport.get_write_buffer_size() + len(message) > _OUTPUT_LIMIT:
            self.transport.abort()
            return
        self.transport.write(message)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._server.client is self:
            self._server.client = None
            self._server.device.disconnect()


class ScipServer:
    """The device on 127.0.0.1. `publish` may be called from any thread; use as a context manager or call `stop`."""

    def __init__(self, clock: Callable[[], float], port: int = DEFAULT_PORT, geometry: ScipGeometry | None = None) -> None:
        """`clock`: simulator time in s, read from the server's thread. `port` 0 takes a free one (see `port`)."""
        self.device = ScipDevice(clock, geometry)
        self.client: _Connection | None = None
        self._newest: tuple[float, NDArray[np.floating]] | None = None
        self._wanted_port = port
        self._port: int | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopping: asyncio.Event | None = None
        self._ready = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The TCP port in use; only after `start`."""
        if self._port is None:
            raise ScipServerError("the LiDAR emulator has no port yet: call start() first")
        return self._port

    def start(self) -> None:
        """Bind and serve. Raises `ScipServerError` when the port is taken or may not be used."""
        if self._thread is not None:
            raise ScipServerError("the LiDAR emulator was started before: make a new one")
        listener = _listen(self._wanted_port)
        self._port = int(listener.getsockname()[1])
        self._thread = threading.Thread(target=self._run, args=(listener,), name="scip-server", daemon=True)
        self._thread.start()
        if not self._ready.wait(_START_STOP_DEADLINE_S):
            raise ScipServerError(f"the LiDAR emulator did not start within {_START_STOP_DEADLINE_S} s")

    def stop(self) -> None:
        """Close the port and the connection; safe to call twice."""
        if self._loop is not None and self._stopping is not None and self._thread is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopping.set)
            self._thread.join(_START_STOP_DEADLINE_S)

    def publish(self, scan_time_s: float, ranges_m: NDArray[np.floating]) -> None:
        """Hand over a full scan: `ranges_m` [steps] in m, first step (rightmost) first; see `ScipGeometry.sent_codes`."""
        self._newest = (scan_time_s, ranges_m)
        if self.client is not None and self._loop is not None:  # nobody there: not worth waking the thread
            with contextlib.suppress(RuntimeError):  # the server was stopped: nobody listens any more
                self._loop.call_soon_threadsafe(self._deliver, scan_time_s, ranges_m)

    def show_newest(self) -> None:
        """Let the device know the newest scan, which it was not told of while there was no client."""
        if self._newest is not None:
            self._deliver(*self._newest)

    def _deliver(self, scan_time_s: float, ranges_m: NDArray[np.floating]) -> None:
        message = self.device.new_scan(scan_time_s, self.device.geometry.sent_codes(ranges_m))
        if self.client is not None:
            self.client.send(message)

    def _run(self, listener: socket.socket) -> None:
        asyncio.run(self._serve(listener))

    async def _serve(self, listener: socket.socket) -> None:
        self._loop, self._stopping = asyncio.get_running_loop(), asyncio.Event()
        server = await self._loop.create_server(lambda: _Connection(self), sock=listener)
        self._ready.set()
        await self._stopping.wait()
        server.close()
        if self.client is not None and self.client.transport is not None:
            self.client.transport.abort()
        await asyncio.sleep(0)  # lets the aborted connection report its end

    def __enter__(self) -> ScipServer:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()


def _listen(port: int) -> socket.socket:
    if not 0 <= port <= 65_535:
        raise ScipServerError(f"LiDAR port {port} is impossible: choose 0 (any free one) to 65535")
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
        listener.listen(4)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise ScipServerError(
                f"LiDAR port {port} on {LOOPBACK} is in use: stop the program there or choose another"
            ) from error
        raise ScipServerError(f"cannot listen on LiDAR port {port} on {LOOPBACK}: {error.strerror}") from error
    listener.setblocking(False)
    return listener
