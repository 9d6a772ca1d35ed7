"""A hovering vehicle in a room, for the tests of the spinning emulators."""

from __future__ import annotations

import threading
import time

import numpy as np

from sim_gateway.scene import World
from sim_gateway.serial_lidar import SerialLidar
from sim_gateway.simulation import Simulation


def room() -> World:
    """Walls 6 m ahead, 2 m to the left, 4 m behind, 3 m to the right of the start."""
    boxes = np.array(
        [
            [6.0, -9.0, 0.0, 7.0, 9.0, 6.0],
            [-9.0, 2.0, 0.0, 9.0, 3.0, 6.0],
            [-5.0, -9.0, 0.0, -4.0, 9.0, 6.0],
            [-9.0, -4.0, 0.0, 9.0, -3.0, 6.0],
        ]
    )
    return World(
        length_m=20.0,
        width_m=20.0,
        height_m=6.0,
        static_boxes=boxes,
        movers=(),
        start=(0.0, 0.0, 0.0),
        start_yaw_rad=0.0,
        goal=(5.0, 0.0, 2.0),
        seed=0,
        name="room",
    )


def hovering() -> Simulation:
    return Simulation(room(), hover_height_m=2.0, estimate="none")


class RealTime:
    """Physics and emulator in a thread, paced by the clock."""

    def __init__(self, lidar: SerialLidar) -> None:
        self.simulation, self.lidar = hovering(), lidar
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        origin_s = time.monotonic()
        while not self._stop.wait(0.002):
            for _ in range(min(25, int((time.monotonic() - origin_s - self.simulation.time_s) / 0.004))):
                self.simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
                self.lidar.advance(self.simulation)

    def __enter__(self) -> RealTime:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.lidar.close()
