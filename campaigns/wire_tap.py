"""Recording relays between `fly` and the vehicle: what reached the autopilot's side of the wire, and when."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from pymavlink.dialects.v20 import development as mav

LOOPBACK = "127.0.0.1"
ONBOARD_PORT_OFFSET = 40
_DATAGRAM = 4096
_WAIT_S = 0.2
_KEPT = 400_000
SETPOINT = mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED
STEERING = (SETPOINT, mav.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT, mav.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET)


@dataclass(frozen=True, slots=True)
class Setpoint:
    """A setpoint as it arrived. `time_s`: monotonic; speed in m/s, yaw rate in rad/s, both absolute."""

    time_s: float
    speed_m_s: float
    yaw_rate_rad_s: float

    @property
    def moving(self) -> bool:
        """Whether it asks for any motion."""
        return self.speed_m_s > 1e-3 or self.yaw_rate_rad_s > 1e-3


@dataclass(frozen=True, slots=True)
class Seen:
    """What came from the vehicle: its clock against ours, its modes, its speed."""

    boot_s: list[tuple[float, float]] = field(default_factory=list)
    modes: list[tuple[float, int]] = field(default_factory=list)
    speeds_m_s: list[tuple[float, float]] = field(default_factory=list)


class _Relay:
    """A relay with a thread of its own."""

    def __init__(self) -> None:
        self.mute = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join(2.0)

    def _serve(self) -> None:
        raise AssertionError("a relay serves something")

    @property
    def thread_id(self) -> int | None:
        """For the scheduler."""
        return self._thread.native_id


class WireTap(_Relay):
    """UDP: gateway <-> tap <-> `fly`. `mute` drops all from the vehicle. Bytes are only stored, and read when asked for."""

    def __init__(self, gateway_port: int, fly_port: int) -> None:
        super().__init__()
        self._vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._vehicle.bind((LOOPBACK, gateway_port))
        self._fly = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._fly.bind((LOOPBACK, 0))
        self._to_vehicle, self._to_fly = (LOOPBACK, gateway_port + ONBOARD_PORT_OFFSET), (LOOPBACK, fly_port)
        self._up: deque[tuple[float, bytes]] = deque(maxlen=_KEPT)
        self._down: deque[tuple[float, bytes]] = deque(maxlen=_KEPT)

    def _serve(self) -> None:
        with self._vehicle, self._fly:
            while not self._stop.is_set():
                for ready in select.select([self._fly, self._vehicle], [], [], _WAIT_S)[0]:
                    with contextlib.suppress(OSError):
                        self._pass(ready)

    def _pass(self, ready: socket.socket) -> None:
        data = ready.recv(_DATAGRAM)
        now_s = time.monotonic()
        if ready is self._fly:
            self._up.append((now_s, data))
            self._vehicle.sendto(data, self._to_vehicle)
            return
        self._down.append((now_s, data))
        if not self.mute:
            self._fly.sendto(data, self._to_fly)

    def setpoints(self) -> list[Setpoint]:
        """Every setpoint that passed so far, oldest first."""
        return [
            Setpoint(
                time_s, math.hypot(m.vx, m.vy, m.vz) if m.get_msgId() == SETPOINT else math.inf, abs(getattr(m, "yaw_rate", 0.0))
            )
            for time_s, m in _messages(tuple(self._up))
            if m.get_msgId() in STEERING
        ]

    def seen(self) -> Seen:
        """What the vehicle said so far."""
        seen = Seen()
        for time_s, m in _messages(tuple(self._down)):
            if m.get_type() == "LOCAL_POSITION_NED":
                seen.boot_s.append((time_s, 1e-3 * m.time_boot_ms))
                seen.speeds_m_s.append((time_s, math.hypot(m.vx, m.vy, m.vz)))
            elif m.get_type() in ("HEARTBEAT", "CURRENT_MODE"):
                seen.modes.append((time_s, m.custom_mode >> 16))
        return seen

    def flying_speed_m_s(self) -> float:
        """The vehicle's estimated horizontal speed by its newest message, 0 unless a moving setpoint came lately."""
        setpoints = [m for _, m in _messages(tuple(self._up)[-20:]) if m.get_msgId() == SETPOINT]
        positions = [m for _, m in _messages(tuple(self._down)[-40:]) if m.get_type() == "LOCAL_POSITION_NED"]
        if not positions or not any(math.hypot(m.vx, m.vy) > 0.0 for m in setpoints):
            return 0.0
        return math.hypot(positions[-1].vx, positions[-1].vy)


def _messages(datagrams: tuple[tuple[float, bytes], ...]) -> list[tuple[float, Any]]:
    found = []
    for time_s, data in datagrams:
        parser = mav.MAVLink(None)
        parser.robust_parsing = True
        found += [(time_s, m) for m in parser.parse_buffer(data) or [] if m.get_type() != "BAD_DATA"]
    return found


class ByteTap(_Relay):
    """TCP: one client at a time is joined to `target_port`. `mute` drops what comes from there: a LiDAR gone silent."""

    def __init__(self, target_port: int) -> None:
        super().__init__()
        self._server = socket.create_server((LOOPBACK, 0))
        self._server.settimeout(_WAIT_S)
        self._target_port = target_port

    @property
    def port(self) -> int:
        """Where clients connect."""
        return int(self._server.getsockname()[1])

    def _serve(self) -> None:
        with self._server:
            while not self._stop.is_set():
                with contextlib.suppress(OSError):
                    client, _ = self._server.accept()
                    with client, socket.create_connection((LOOPBACK, self._target_port), 2.0) as device:
                        self._join(client, device)

    def _join(self, client: socket.socket, device: socket.socket) -> None:
        while not self._stop.is_set():
            for ready in select.select([client, device], [], [], _WAIT_S)[0]:
                data = ready.recv(65536)
                if not data:
                    return
                if ready is client:
                    device.sendall(data)
                elif not self.mute:
                    client.sendall(data)
