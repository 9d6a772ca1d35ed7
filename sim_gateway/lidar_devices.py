"""The emulated LiDARs of one vehicle, driven by its simulation: SCIP on a TCP port, and a spinning one on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_gateway.readings import Scan
from sim_gateway.scip import ScipServer
from sim_gateway.serial_lidar import SerialLidar
from sim_gateway.simulation import Simulation, step_at

_SCAN_PERIOD_S = 0.05

Alter = Callable[[NDArray[np.float32]], NDArray[np.float32] | None]


class LidarDevices:
    """Both devices, started. Call `step` after every physics step.

    `clock`: what the devices' own clocks show, s; it may run ahead of the simulation's. `tcp_port` 0 takes a free one.
    Raises `ScipServerError` and what a pseudo-terminal raises.
    """

    def __init__(
        self,
        simulation: Simulation,
        clock: Callable[[], float],
        tcp_port: int,
        serial_kind: str | None = None,
        serial_link: Path | None = None,
        seed: int = 0,
    ) -> None:
        self._simulation, self._clock, self._scans = simulation, clock, 0
        self.scip = ScipServer(clock, tcp_port)
        self.serial: SerialLidar | None = None
        try:
            self.scip.start()
            if serial_kind is not None:
                self.serial = SerialLidar(serial_kind, serial_link, seed)
        except Exception:
            self.scip.stop()
            raise

    def ready_message(self) -> dict[str, Any]:
        """Where they are."""
        return {"lidar_port": self.scip.port, "serial_lidar": self.serial.path if self.serial is not None else None}

    def step(self, alter: Alter | None = None, *, seeing: bool = True) -> list[Scan]:
        """Send what is due now, if anything is seen; the SCIP scans that were sent.

        `alter` changes their ranges before, or swallows them (None).
        """
        simulation = self._simulation
        ahead_s = self._clock() - simulation.time_s
        if self.serial is not None:
            self.serial.advance(simulation, ahead_s, seeing=seeing)
        if simulation.steps < step_at(self._scans * _SCAN_PERIOD_S):
            return []
        self._scans += 1
        scans = simulation.device_scans() if seeing else []
        return [sent for scan in scans if (sent := self._publish(scan, ahead_s, alter)) is not None]

    def _publish(self, scan: Scan, ahead_s: float, alter: Alter | None) -> Scan | None:
        ranges = alter(scan.ranges_m) if alter is not None else scan.ranges_m
        if ranges is None:
            return None
        self.scip.publish(scan.time_s + ahead_s, ranges)
        return replace(scan, ranges_m=ranges)

    def close(self) -> None:
        """Free port and line."""
        self.scip.stop()
        if self.serial is not None:
            self.serial.close()
