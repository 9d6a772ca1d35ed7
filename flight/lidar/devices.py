"""Which session and which link each `driver` of the mission's `lidar` section stands for."""

from __future__ import annotations

import time
from collections.abc import Callable

from flight.lidar.config import SERIAL, LidarSource
from flight.lidar.driver import LidarDriver
from flight.lidar.mavlink_session import MavlinkSession
from flight.lidar.recording import ScanSource, recording_session
from flight.lidar.rplidar_session import RplidarStarter
from flight.lidar.scip_session import ScipSession
from flight.lidar.serial_port import SerialTransport
from flight.lidar.session import Host, Session
from flight.lidar.spinning_session import LdrobotStarter, SpinningSession
from flight.lidar.transport import TcpTransport, Transport

GATHER_S = 0.004
"""A spinning device sends a frame every few ms: taking several at once saves most of the wake-ups."""


def open_lidar(
    config: LidarSource, *, recording: ScanSource | None = None, clock: Callable[[], float] = time.monotonic
) -> LidarDriver:
    """The driver that `config` names, not yet started: use it as a context manager or call `start` and `close`.

    `recording`: scans for `driver: recording` in place of the file at `path`.
    """

    def open_session(host: Host) -> Session:
        if config.driver == "mavlink":
            return MavlinkSession(host)
        if config.driver == "recording":
            return recording_session(config, host, recording)
        return _over_link(_connect(config), host)

    return LidarDriver(config, open_session, clock)


def _connect(config: LidarSource) -> Transport:
    if config.driver in SERIAL:
        gather_s = 0.0 if config.driver == "scip-serial" else GATHER_S
        return SerialTransport(config.device or "", config.bit_rate, gather_s)
    return TcpTransport(config.host, config.port, config.connect_timeout_s)


def _over_link(transport: Transport, host: Host) -> Session:
    driver = host.config.driver
    if driver == "rplidar":
        return SpinningSession(transport, RplidarStarter(transport, host), host)
    if driver in ("ld06", "ld19", "stl27l"):
        return SpinningSession(transport, LdrobotStarter(host.config), host)
    return ScipSession(transport, host)
