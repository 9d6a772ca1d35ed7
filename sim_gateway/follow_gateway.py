"""A world for a vehicle that is elsewhere: it follows the vehicle's reported pose and serves the LiDAR it would have here.

The vehicle may be simulated by another program, or fly over an empty field: its policy then meets virtual obstacles first.
"""

from __future__ import annotations

import logging
import math
import select
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import development as mav

from sim_gateway.dynamics import Course, Demand, after_step
from sim_gateway.faults import KINDS, SCAN, Fault, only_possible
from sim_gateway.flight_report import FlightRecorder, world_facts, write_report
from sim_gateway.frame_reader import FrameReader, decode
from sim_gateway.lidar import LidarConfig
from sim_gateway.lidar_devices import LidarDevices
from sim_gateway.local_frame import LocalFrame
from sim_gateway.mavlink_frame import FramePacker
from sim_gateway.pace import Pace
from sim_gateway.pose_source import open_source
from sim_gateway.pose_tracker import Pose, PoseTracker
from sim_gateway.scene import Point, World
from sim_gateway.scip import DEFAULT_PORT
from sim_gateway.simulation import Simulation
from sim_gateway.vehicle import LANDED, OMEGA, POS, QUAT, STEP_S, VEL

Array = NDArray[np.float64]

_SYSTEM_ID, _COMPONENT_ID = 245, 196  # an onboard computer's
_TIMESYNC_PERIOD_S = 0.2
_GROUND_M = 0.15  # below this height a vehicle counts as standing
_MAX_STEPS_PER_TURN = 25
_LONGEST_WAIT_S = 0.02
_FAULTS = tuple(name for name, kind in KINDS.items() if kind.group == SCAN)

_log = logging.getLogger("sim_gateway.follow")


@dataclass(frozen=True, slots=True)
class FollowConfig:
    """How to run. `url`: see `pose_source.open_source`. `lidar_port` 0: any free one.

    `origin_m`: where in the corridor the vehicle's local origin lies; None: at the world's start. `heading_rad`: compass heading
    of the corridor's x axis. `timeout_s`, `latency_s`: see `PoseTracker`.
    """

    url: str
    seed: int = 0
    origin_m: Point | None = None
    heading_rad: float = 0.0
    timeout_s: float = 0.3
    latency_s: float = 0.0
    lidar_port: int = DEFAULT_PORT
    max_time_s: float = math.inf
    report: Path | None = None
    serial_lidar: str | None = None
    serial_link: Path | None = None
    faults: tuple[Fault, ...] = ()


class FollowedDynamics:
    """Puts the vehicle where `pose` says it is, in `frame`; without one it stays where it was."""

    name = "followed"

    def __init__(self, frame: LocalFrame) -> None:
        self._frame = frame
        self.pose: Pose | None = None

    def moved(self) -> None:
        """Nothing is kept outside the state row."""

    def advance(self, course: Course, demand: Demand, normals: Array, first_step: int) -> None:
        """See `dynamics.Dynamics.advance`."""
        state = course.state
        x, y, z = state[POS : POS + 3].tolist()
        if self.pose is not None:
            self._put(state, self.pose)
        last = first_step + normals.shape[0] - 1
        after_step(state, x, y, z, last, course.boxes, course.fixed, course.movers, course.contact_radius_m, course.log)

    def _put(self, state: Array, pose: Pose) -> None:
        frame = self._frame
        half = 0.5 * frame.heading_rad
        cos, sin = math.cos(half), math.sin(half)
        w, x, y, z = pose.attitude  # turned back by the heading, then from NED and FRD to up and left
        p, q, r = pose.rates_rad_s
        state[POS : POS + 3] = frame.point_to_world(pose.position_m)
        state[VEL : VEL + 3] = frame.vector_to_world(pose.velocity_m_s)
        state[QUAT : QUAT + 4] = (cos * w + sin * z, cos * x + sin * y, -(cos * y - sin * x), -(cos * z - sin * w))
        state[OMEGA : OMEGA + 3] = (p, -q, -r)
        state[LANDED] = 1.0 if state[POS + 2] < _GROUND_M else 0.0


class FollowGateway:
    """LiDARs for one vehicle elsewhere. Use as a context manager; `run` returns when asked to stop.

    Raises `FollowUrlError`, `SerialPortError`, `ScipServerError`, and `FaultError` for faults that are not the LiDAR's. For tests
    in process: `alter_scan` changes a scan before it is sent, or swallows it (None).
    """

    def __init__(self, world: World, config: FollowConfig) -> None:
        self.world, self.config = world, config
        only_possible(config.faults, _FAULTS, ("start",), "--follow")
        self.frame = LocalFrame(config.origin_m or (*world.start[:2], 0.0), config.heading_rad)
        self.dynamics = FollowedDynamics(self.frame)
        self.simulation = Simulation(world, None, LidarConfig.device(), "none", None, config.seed, dynamics=self.dynamics)
        for fault in config.faults:
            self.simulation.inject(fault)
        self.tracker = PoseTracker(config.timeout_s, config.latency_s)
        self.source = open_source(config.url)
        self.recorder = FlightRecorder(self.simulation, {**world_facts(world), "seed": config.seed, "dynamics": "followed"})
        self.pace = Pace(1.0, time.monotonic())
        self.alter_scan: Callable[[NDArray[np.float32]], NDArray[np.float32] | None] | None = None
        self._reader, self._packer = FrameReader(), FramePacker(_SYSTEM_ID, _COMPONENT_ID)
        self._asked_s = -math.inf
        self._seeing = False
        try:
            kinds = (config.lidar_port, config.serial_lidar, config.serial_link, config.seed)
            self.lidars = LidarDevices(self.simulation, lambda: self.simulation.time_s + self.pace.dropped_s, *kinds)
        except Exception:
            self.source.close()
            raise

    def __enter__(self) -> FollowGateway:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free all ports and lines."""
        self.lidars.close()
        self.source.close()

    def ready_message(self) -> dict[str, Any]:
        """What a program that started the gateway needs to know."""
        world = self.world
        return {
            "ready": True,
            "follow": self.config.url,
            **self.lidars.ready_message(),
            "origin": list(self.frame.origin),
            "start": list(world.start),
            "start_yaw_rad": world.start_yaw_rad,
            "goal": list(world.goal),
            "boxes": world.static_boxes.tolist(),
        }

    def run(self, stop: threading.Event) -> None:
        """Follow in real time until `stop` is set or `max_time_s` is over, then write the report."""
        started_s = time.monotonic()
        self.pace = Pace(1.0, started_s)
        try:
            while not stop.is_set() and self.simulation.time_s < self.config.max_time_s:
                self._listen(time.monotonic())
                behind_s = self.pace.behind_s(time.monotonic(), self.simulation.time_s)
                for _ in range(min(int(behind_s / STEP_S), _MAX_STEPS_PER_TURN)):
                    self._step()
                wait_s = self.pace.due_s(self.simulation.time_s + STEP_S) - time.monotonic()
                if wait_s > 0.0:
                    select.select(self.source.watched(), [], [], min(wait_s, _LONGEST_WAIT_S))
        finally:
            self._write_report(started_s)

    def _listen(self, now_s: float) -> None:
        """Take what has arrived; ask for the vehicle's time now and then."""
        for data in self.source.read(now_s):
            for frame in self._reader.feed(data):
                message = decode(frame)
                if message is not None:
                    self.tracker.take(message, now_s)
        if now_s - self._asked_s >= _TIMESYNC_PERIOD_S:
            self._asked_s = now_s
            self.source.send(self._packer.pack(mav.MAVLink_timesync_message(0, self.tracker.ask(now_s))))

    def _step(self) -> None:
        pose = self.tracker.pose(self.pace.due_s(self.simulation.time_s + STEP_S))
        self.dynamics.pose = pose
        self.simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
        self.recorder.watch()
        self.lidars.step(self.alter_scan, seeing=pose is not None)
        self._note_change(seeing=pose is not None)

    def _note_change(self, *, seeing: bool) -> None:
        if seeing != self._seeing:
            self._seeing = seeing
            self.recorder.note_event(self.simulation.time_s, pose=seeing, system_id=self.tracker.system_id)
            what = f"following vehicle {self.tracker.system_id}" if seeing else "no fresh pose: no scans"
            _log.info("%.2f s: %s", self.simulation.time_s, what)

    def _write_report(self, started_s: float) -> None:
        if self.config.report is not None:
            factor = round(self.simulation.time_s / max(time.monotonic() - started_s, 1e-9), 4)
            content = self.recorder.as_dict(real_time_factor=factor, dropped_s=round(self.pace.dropped_s, 3))
            write_report(self.config.report, content)


def warm_up(world: World) -> None:
    """Compile or load every kernel once."""
    simulation = Simulation(world, None, LidarConfig.device(), "none", None, dynamics=FollowedDynamics(LocalFrame()))
    simulation.advance(1, np.zeros(3), 0.0)
    simulation.scan()
