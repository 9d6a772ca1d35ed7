"""The simulator of a real PX4: its vehicle, sensors and world; PX4 itself serves MAVLink to everybody else.

In SITL every step is one exchange: sensors out, motor commands back. Vehicle time is PX4's clock and goes as fast as asked, or as
fast as both can. A flight controller in HITL keeps its own time, so the vehicle flies in real time and takes what comes.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim_gateway.errors import DynamicsError
from sim_gateway.faults import KINDS, SCAN, Fault, only_possible
from sim_gateway.flight_report import FlightRecorder, world_facts, write_report
from sim_gateway.hil_sensors import HilSensors
from sim_gateway.lidar import LidarConfig
from sim_gateway.lidar_devices import LidarDevices
from sim_gateway.local_frame import LocalFrame
from sim_gateway.motor_dynamics import NONE_IRIS, MotorDynamics, standing_height_m
from sim_gateway.pace import Pace
from sim_gateway.px4_wire import DEFAULT_PORT, Controls, Px4GoneError, Px4LineError, SerialLine, TcpLine, open_line
from sim_gateway.scene import Point, World
from sim_gateway.scip import DEFAULT_PORT as LIDAR_PORT
from sim_gateway.simulation import Simulation, WindConfig
from sim_gateway.vehicle import STEP_S

_PATIENCE_S = 1.0  # PX4 may think this long about a step before it gets another one
_FREE_WAIT_S = STEP_S  # until its first answer PX4 is still starting: no step waits longer for it
_SILENCE_S = 0.5  # a controller in HITL that says nothing for so long has its motors stopped
_HEARTBEAT_STEPS = 250
_MAX_STEPS_PER_TURN = 25
_FAULTS = (*(name for name, kind in KINDS.items() if kind.group == SCAN), "gps_loss", "wind", "gust", "motor_weak", "heavy")

_log = logging.getLogger("sim_gateway.px4")


@dataclass(frozen=True, slots=True)
class Px4Config:
    """How to run. `address`: see `px4_wire.open_line`. `speed` 0: as fast as PX4 answers. `lidar_port` 0: any free one."""

    address: str = f"tcp:{DEFAULT_PORT}"
    seed: int = 0
    gps: bool = True
    lidar_port: int = LIDAR_PORT
    wind_m_s: Point = (0.0, 0.0, 0.0)
    heading_rad: float = 0.0
    speed: float = 1.0
    max_time_s: float = math.inf
    report: Path | None = None
    serial_lidar: str | None = None
    serial_link: Path | None = None
    faults: tuple[Fault, ...] = ()


class Px4Gateway:
    """Simulator role for one PX4. Use as a context manager; `run` returns when PX4 has gone or when asked to stop.

    Raises `Px4LineError`, `ScipServerError`, and `FaultError` for faults that only our own autopilot can have.
    """

    def __init__(self, world: World, config: Px4Config | None = None) -> None:
        self.world, self.config = world, config or Px4Config()
        config = self.config
        only_possible(config.faults, _FAULTS, ("start", "armed"), "--px4")
        self.dynamics = MotorDynamics()
        self.simulation = Simulation(
            *(world, NONE_IRIS, LidarConfig.device(), "none", WindConfig(mean_m_s=config.wind_m_s), config.seed),
            dynamics=self.dynamics,
        )
        standing = standing_height_m(NONE_IRIS)
        self.simulation.carry((*world.start[:2], standing), world.start_yaw_rad)
        for fault in config.faults:
            self.simulation.inject(fault)
        self.line = open_line(config.address)
        if not self.line.lockstep and config.speed != 1.0:
            self.line.close()
            raise Px4LineError("a flight controller has its own time: leave --speed out")
        self.frame = LocalFrame((*world.start[:2], standing), config.heading_rad)
        self.sensors = HilSensors(
            *(self.simulation, self.dynamics, self.frame, config.seed), gps=config.gps, truth=self.line.lockstep
        )
        self.recorder = FlightRecorder(self.simulation, {**world_facts(world), "seed": config.seed, "dynamics": "motors"})
        self.pace = Pace(config.speed or 1.0, time.monotonic())
        self.answered_steps = 0
        self._answering, self._armed = False, False
        self._heard_s = self._started_s = math.nan
        self._ended: str | None = None
        try:
            kinds = (config.lidar_port, config.serial_lidar, config.serial_link, config.seed)
            self.lidars = LidarDevices(self.simulation, lambda: self.device_time_s, *kinds)
        except Exception:
            self.line.close()
            raise

    def __enter__(self) -> Px4Gateway:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free all ports and lines."""
        self.lidars.close()
        self.line.close()

    @property
    def device_time_s(self) -> float:
        """What the LiDARs' own clocks show: they run on while vehicle time stands still."""
        return self.simulation.time_s + self.pace.dropped_s * self.config.speed

    def ready_message(self) -> dict[str, Any]:
        """What a program that started the gateway needs to know."""
        world = self.world
        return {
            "ready": True,
            "px4": f"tcp:{self.line.port}" if isinstance(self.line, TcpLine) else self.config.address,
            **self.lidars.ready_message(),
            "start": list(world.start),
            "start_yaw_rad": world.start_yaw_rad,
            "goal": list(world.goal),
            "boxes": world.static_boxes.tolist(),
        }

    def run(self, stop: threading.Event) -> None:
        """Wait for PX4, then fly until it has gone, `stop` is set or `max_time_s` is over; write the report.

        Raises `DivergedError`, after the report is written, when the vehicle can no longer be simulated.
        """
        if not self.line.connect(stop):
            return
        _log.info("PX4 is connected" if self.line.lockstep else "the serial line is open")
        self._started_s = self._heard_s = time.monotonic()
        self.pace = Pace(self.config.speed or 1.0, self._started_s)
        try:
            while not stop.is_set() and self.simulation.time_s < self.config.max_time_s:
                self._turn(stop)
        except Px4GoneError as error:
            self._ended = str(error)
            _log.info("%s after %.2f s of vehicle time", error, self.simulation.time_s)
        except DynamicsError as error:
            self._ended = str(error)
            raise
        finally:
            self.write_report()

    def _turn(self, stop: threading.Event) -> None:
        """Sleep until a step is due, then make the steps that are."""
        if not self.config.speed:
            self._exchange(stop)
            return
        behind_s = self.pace.behind_s(time.monotonic(), self.simulation.time_s)
        for _ in range(min(int(behind_s / STEP_S), _MAX_STEPS_PER_TURN)):
            self._exchange(stop)
        wait_s = self.pace.due_s(self.simulation.time_s + STEP_S) - time.monotonic()
        if wait_s > 0.0 and self.line.lockstep:
            time.sleep(wait_s)
        elif wait_s > 0.0:
            self._take(self.line.receive(wait_s))

    def _exchange(self, stop: threading.Event) -> None:
        """One step of the vehicle, what its sensors saw of it, and PX4's answer."""
        self.simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
        self.recorder.watch()
        self.lidars.step()
        self.line.send(self.sensors.frames())
        if self.line.lockstep:
            self._await_answer(round(self.simulation.time_s * 1e6), stop)
        else:
            self._hear_controller()

    def _await_answer(self, time_us: int, stop: threading.Event) -> None:
        """PX4's answer to this step. Before its first one PX4 is starting and needs further steps; so does one that lost one."""
        started_s = time.monotonic()
        patience_s = _PATIENCE_S if self._answering else _FREE_WAIT_S
        while not stop.is_set():
            left_s = started_s + patience_s - time.monotonic()
            answers = self.line.receive(max(0.0, min(left_s, 0.1)))
            self._take(answers)
            if any(answer.time_us >= time_us for answer in answers):
                self._answering = True
                self.answered_steps += 1
                return
            if left_s <= 0.0:
                if self._answering:
                    _log.warning("PX4 has not answered the step at %.3f s for %g s", self.simulation.time_s, patience_s)
                return

    def _hear_controller(self) -> None:
        """What a controller in HITL says, and whether it still does."""
        if self.simulation.steps % _HEARTBEAT_STEPS == 1:
            self.line.send(self.sensors.heartbeat())
        self._take(self.line.receive(0.0))
        if time.monotonic() - self._heard_s > _SILENCE_S and self.dynamics.commands.any():
            _log.warning("the flight controller is silent: motors stopped")
            self.dynamics.commands[:] = 0.0

    def _take(self, answers: list[Controls]) -> None:
        if not answers:
            return
        newest = answers[-1]
        self._heard_s = time.monotonic()
        self.dynamics.commands[:] = newest.motors
        if newest.armed != self._armed:
            self._armed = newest.armed
            self.recorder.note_event(self.simulation.time_s, armed=newest.armed)
            _log.info("%.2f s: %s", self.simulation.time_s, "armed" if newest.armed else "disarmed")
            if newest.armed:
                self.simulation.faults.happened("armed", self.simulation.time_s)
            else:
                self.write_report()

    def write_report(self) -> None:
        """Write the report file, if one was asked for."""
        if self.config.report is None:
            return
        elapsed_s = max(time.monotonic() - self._started_s, 1e-9)
        factor = round(self.simulation.time_s / elapsed_s, 4)
        content = self.recorder.as_dict(real_time_factor=factor, dropped_s=round(self.pace.dropped_s, 3))
        lost = self.line.lost_messages if isinstance(self.line, SerialLine) else 0
        facts = {"ended": self._ended, "answered_steps": self.answered_steps, "lost_messages": lost}
        write_report(self.config.report, content | facts)


def warm_up(world: World) -> None:
    """Compile or load every kernel once: PX4 must not wait for the compiler in the middle of a step."""
    dynamics = MotorDynamics()
    simulation = Simulation(world, NONE_IRIS, LidarConfig.device(), "none", dynamics=dynamics)
    simulation.advance(2, np.zeros(3), 0.0)
    simulation.scan()
    HilSensors(simulation, dynamics, LocalFrame()).frames()
