"""Several vehicles in one world and one process, numbered and addressed as PX4 numbers its simulated instances."""

from __future__ import annotations

import contextlib
import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sim_gateway.collision import clearance_m
from sim_gateway.gateway import Gateway, GatewayConfig, run_together
from sim_gateway.open_links import nth_links
from sim_gateway.scene import Point, World

SPACING_M = 1.2
"""Between the starts of neighbours: more than two vehicles' width of 0.7 m."""
_ROOM_M = 0.5  # from a start to the nearest box
_RINGS = 20


class NoRoomError(ValueError):
    """There are not enough free places near the start."""


class Fleet:
    """`count` vehicles with system ids 1..count. Vehicle i listens on the i-th next onboard, ground station and LiDAR port.

    The ground station's own port is the same for all, as with PX4. The vehicles do not see or touch each other: each has the
    world to itself, at the same time. Each has its own seed (the first the configured one), every fault happens to all, and
    reports of further vehicles carry their number (`truth-2.json`). Use as a context manager.

    Raises `NoRoomError`, and what `Gateway` raises.
    """

    def __init__(self, world: World, config: GatewayConfig, count: int = 1) -> None:
        self._cleanup = contextlib.ExitStack()
        self.gateways: list[Gateway] = []
        with contextlib.ExitStack() as opened:
            for index, start in enumerate(start_places(world, count)):
                gateway = Gateway(replace(world, start=start), nth_config(config, index))
                self.gateways.append(opened.enter_context(gateway))
            self._cleanup = opened.pop_all()

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def ready_message(self) -> dict[str, Any]:
        """The first vehicle's message; with several, `vehicles` has id, ports and start of each."""
        messages = [gateway.ready_message() for gateway in self.gateways]
        names = ("system_id", "onboard_port", "gcs_port", "lidar_port", "serial_lidar", "start")
        several = {"vehicles": [{name: message[name] for name in names} for message in messages]} if messages[1:] else {}
        return messages[0] | several

    def run(self, stop: threading.Event) -> None:
        """See `Gateway.run`."""
        run_together(self.gateways, stop)


def nth_config(config: GatewayConfig, index: int) -> GatewayConfig:
    """The configuration of the vehicle with that index, from 0."""
    if index == 0:
        return config
    return replace(
        config,
        seed=config.seed + index,
        system_id=config.system_id + index,
        onboard_port=config.onboard_port + index,
        lidar_port=config.lidar_port + index if config.lidar_port else 0,
        report=_numbered(config.report, index),
        serial_link=_numbered(config.serial_link, index),
        links=nth_links(config.links, index, config.gcs_port),
    )


def _numbered(path: Path | None, index: int) -> Path | None:
    return None if path is None else path.with_name(f"{path.stem}-{index + 1}{path.suffix}")


def start_places(world: World, count: int) -> list[Point]:
    """Free places on a grid round the world's start, the start itself first, then the nearest.

    Raises `NoRoomError` if there are fewer than `count`.
    """
    x0, y0, z0 = world.start
    rings = range(-_RINGS, _RINGS + 1)
    grid = sorted(((i, j) for i in rings for j in rings), key=lambda place: (math.hypot(*place), place))
    boxes = world.boxes_at(0.0)
    places: list[Point] = []
    for i, j in grid:
        place = (x0 + SPACING_M * i, y0 + SPACING_M * j, z0)
        inside = 0.0 < place[0] < world.length_m and abs(place[1]) < 0.5 * world.width_m
        if (i, j) == (0, 0) or (inside and clearance_m(boxes, np.array(place), _ROOM_M) > 0.0):
            places.append(place)
        if len(places) == count:
            return places
    raise NoRoomError(f"only {len(places)} of {count} vehicles find a free place {SPACING_M} m from the next round the start")
