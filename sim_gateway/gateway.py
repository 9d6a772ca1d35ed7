"""The gateway in real time: a simulated vehicle, its autopilot, its MAVLink links and its LiDAR, paced by the clock.

Several vehicles are several `Gateway`s under one pace (`run_together`, `fleet`).
"""

from __future__ import annotations

import logging
import math
import select
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_gateway.errors import DynamicsError
from sim_gateway.faults import Fault
from sim_gateway.flight_report import FlightRecorder, world_facts, write_report
from sim_gateway.incidents import Incidents
from sim_gateway.lidar import LidarConfig
from sim_gateway.lidar_devices import LidarDevices
from sim_gateway.link_faults import LinkFaults
from sim_gateway.link_spec import LinkSpec
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.open_links import link_plan, open_links, ready_links
from sim_gateway.pace import Pace
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.report_faults import ReportFaults
from sim_gateway.scene import Point, World
from sim_gateway.scip import DEFAULT_PORT
from sim_gateway.simulation import Simulation, WindConfig
from sim_gateway.telemetry import Telemetry
from sim_gateway.vehicle import STEP_S
from sim_gateway.vehicle_params import PROFILES

_TELL_EVERY_S = 0.2
_MAX_STEPS_PER_TURN = 25
_LONGEST_WAIT_S = 0.02

_log = logging.getLogger("sim_gateway")


@dataclass(frozen=True, slots=True)
class GatewayConfig:
    """How to run. Ports are those the clients use; `gcs_port` 0 leaves that link out, `lidar_port` 0 takes a free one.

    `links`: further links, or the quality of these two (a UDP link to the same port).

    `dynamics`: a name of `dynamics.DYNAMICS`, `vehicle` one of `vehicle_params.PROFILES`. `system_id`: 1 to 250; as with PX4's
    instances, the own ground station port lies that many less one further up. `serial_lidar`: also a spinning LiDAR of this kind
    (`serial_lidar.KINDS`) on a pseudo-terminal, `serial_link` a name for it.
    """

    seed: int = 0
    onboard_port: int = 14540
    gcs_port: int = 14550
    lidar_port: int = DEFAULT_PORT
    system_id: int = 1
    dynamics: str = "internal"
    vehicle: str = "iris"
    estimate: str = "nominal"
    wind_m_s: Point = (0.0, 0.0, 0.0)
    heading_rad: float = 0.0
    speed: float = 1.0
    max_time_s: float = math.inf
    report: Path | None = None
    serial_lidar: str | None = None
    serial_link: Path | None = None
    faults: tuple[Fault, ...] = ()
    links: tuple[LinkSpec, ...] = ()


def connect_faults(vehicle: PilotedVehicle, server: MavlinkServer, telemetry: Telemetry, seed: int) -> Incidents:
    """Let the faults of the vehicle's simulation reach its reports and its first link; call the result's `step`."""
    schedule = vehicle.simulation.faults
    telemetry.faults = ReportFaults(schedule, vehicle.simulation.motion_faults)
    server.links[0].faults = LinkFaults(schedule, seed)
    server.commands.schedule = schedule
    return Incidents(vehicle, server, telemetry)


def _simulation(world: World, config: GatewayConfig) -> Simulation:
    wind = WindConfig(mean_m_s=config.wind_m_s)
    params, dynamics = PROFILES[config.vehicle], config.dynamics
    return Simulation(world, params, LidarConfig.device(), config.estimate, wind, config.seed, dynamics=dynamics)


def warm_up(world: World, dynamics: str = "internal") -> None:
    """Compile or load every kernel once, on a vehicle of its own, so that no flight waits for the compiler."""
    simulation = Simulation(world, lidar=LidarConfig.device(), hover_height_m=1.0, dynamics=dynamics)
    simulation.advance(2, (0.0, 0.0, 0.0), 0.0)
    simulation.advance_motors_off(2)
    simulation.scan()
    PilotedVehicle(simulation).snapshot()


class Gateway:
    """Everything that answers on a port. Use as a context manager; `run` returns when asked to stop.

    For tests in process: `carry` gives position and yaw at a vehicle time, as if a hand moved the vehicle (motors off);
    `alter_scan` changes a scan before it is sent, or swallows it (None); `telemetry` has switches for its messages.
    """

    def __init__(self, world: World, config: GatewayConfig | None = None) -> None:
        self.world, self.config = world, config or GatewayConfig()
        config = self.config
        self.vehicle = PilotedVehicle(_simulation(world, config), heading_rad=config.heading_rad)
        pilot, frame = self.vehicle.autopilot, self.vehicle.frame
        self.recorder = FlightRecorder(self.vehicle.simulation, self._facts())
        self.telemetry = Telemetry(pilot, frame, self.vehicle.snapshot, lambda: self.vehicle.time_s, config.system_id)
        links = open_links(link_plan(config.onboard_port, config.gcs_port, config.links), self.telemetry.now_s, config)
        self.server = MavlinkServer(pilot, frame, self.telemetry, links=links)
        self.incidents = connect_faults(self.vehicle, self.server, self.telemetry, config.seed)
        for fault in config.faults:
            self.vehicle.simulation.inject(fault)
        self.carry: Callable[[float], tuple[Point, float]] | None = None
        self.alter_scan: Callable[[NDArray[np.float32]], NDArray[np.float32] | None] | None = None
        self.pace = Pace(config.speed, time.monotonic())
        self._told_s = 0.0
        self._started_s = math.nan
        self._was_armed = False
        self._ended: str | None = None
        try:
            kinds = (config.lidar_port, config.serial_lidar, config.serial_link, config.seed)
            self.lidars = LidarDevices(self.vehicle.simulation, lambda: self.device_time_s, *kinds)
        except Exception:
            self.server.close()
            raise
        self.lidar, self.serial_lidar = self.lidars.scip, self.lidars.serial

    def __enter__(self) -> Gateway:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free all ports."""
        self.lidars.close()
        self.server.close()

    def ready_message(self) -> dict[str, Any]:
        """What a program that started the gateway needs to know."""
        world, config = self.world, self.config
        return {
            "ready": True,
            "system_id": config.system_id,
            "onboard_port": config.onboard_port,
            "gcs_port": config.gcs_port,
            "links": ready_links(self.server.links),
            **self.lidars.ready_message(),
            "start": list(world.start),
            "start_yaw_rad": world.start_yaw_rad,
            "goal": list(world.goal),
            "boxes": world.static_boxes.tolist(),
        }

    def run(self, stop: threading.Event) -> None:
        """Pace vehicle time to the clock until `stop` is set or `max_time_s` of vehicle time is over, then write the report.

        Raises `DivergedError`, after the report is written, when the vehicle can no longer be simulated.
        """
        run_together([self], stop)

    def start(self, pace: Pace) -> None:
        """Vehicle time begins now and follows this pace."""
        self._started_s, self.pace = time.monotonic(), pace

    @property
    def device_time_s(self) -> float:
        """What the LiDARs' own clocks show: they run on while vehicle time stands still."""
        return self.vehicle.time_s + self.pace.dropped_s * self.config.speed

    def tell_dropped(self) -> None:
        """Warn, now and then, that vehicle time stood still."""
        dropped_s = self.pace.dropped_s
        if dropped_s - self._told_s >= _TELL_EVERY_S:
            _log.warning("this computer is too slow: vehicle time stood still for %.2f s so far", dropped_s)
            self._told_s = dropped_s

    def step(self) -> None:
        """One physics step of 4 ms with everything that hangs on it."""
        vehicle = self.vehicle
        if self.carry is not None:
            vehicle.simulation.carry(*self.carry(vehicle.time_s))
        vehicle.advance(1)
        self.recorder.watch()
        for scan in self.lidars.step(self.alter_scan):
            self.telemetry.scan = scan
        self.incidents.step()
        self.server.poll()
        self._note_changes()

    def give_up(self, error: DynamicsError) -> None:
        """The vehicle can no longer be simulated: the report will say why."""
        self._ended = str(error)

    def _note_changes(self) -> None:
        pilot = self.vehicle.autopilot
        while pilot.mode_changes:
            change = pilot.mode_changes.popleft()
            self.recorder.note(change)
            armed = "armed" if change.armed else "disarmed"
            _log.info("%.2f s: %s, %s%s", change.time_s, change.mode.px4_name, armed, ", failsafe" if change.failsafe else "")
        if self._was_armed and not pilot.armed:
            self.write_report()
        self._was_armed = pilot.armed

    def write_report(self) -> None:
        """Write the report file, if one was asked for; a file that cannot be written is said, not fatal."""
        if self.config.report is None:
            return
        elapsed_s = max(time.monotonic() - self._started_s, 1e-9)
        factor = round(self.vehicle.time_s / elapsed_s, 4)
        content = self.recorder.as_dict(real_time_factor=factor, dropped_s=round(self.pace.dropped_s, 3))
        content["ended"] = self._ended
        content["received"] = self._received()
        content["setpoints"] = self._setpoints()
        content["faults"] = [
            {"kind": item.kind, "begin_s": round(item.begin_s, 3), "end_s": item.end_s if math.isfinite(item.end_s) else None}
            for item in self.vehicle.simulation.faults.placed
        ]
        write_report(self.config.report, content)

    def _received(self) -> list[dict[str, Any]]:
        """What moved, armed or configured the vehicle came over the wire: kind, sender, how often, first and last time."""
        found: dict[tuple[str, tuple[int, int]], list[float]] = {}
        for item in self.server.wire_log.entries:
            found.setdefault((item.what, item.sender), []).append(round(item.time_s, 3))
        return [
            {"what": what, "from": f"{sender[0]}/{sender[1]}", "count": len(times), "first_s": times[0], "last_s": times[-1]}
            for (what, sender), times in found.items()
        ]

    def _setpoints(self) -> dict[str, Any]:
        """The newest velocity setpoints as they arrived: vehicle time, NED m/s, clockwise rad/s, sender."""
        log = [item for item in self.server.wire_log.entries if item.velocity is not None]
        rows = [[round(item.time_s, 3), *(round(v, 5) for v in item.velocity or ()), *item.sender] for item in log]
        return {"columns": ["t", "north", "east", "down", "yaw_rate", "system", "component"], "rows": rows}

    def _facts(self) -> dict[str, Any]:
        config = self.config
        return {
            **world_facts(self.world),
            "seed": config.seed,
            "system_id": config.system_id,
            "dynamics": config.dynamics,
            "vehicle": config.vehicle,
            "estimate": config.estimate,
            "wind_m_s": list(config.wind_m_s),
        }


def run_together(gateways: Sequence[Gateway], stop: threading.Event) -> None:
    """Run vehicles of one world under one pace, step by step in turn, until `stop` or the first one's `max_time_s`.

    Their reports are written at the end, also of a run that ends with `DivergedError`.
    """
    first = gateways[0]
    pace = Pace(first.config.speed, time.monotonic())
    for gateway in gateways:
        gateway.start(pace)
    try:
        while not stop.is_set() and first.vehicle.time_s < first.config.max_time_s:
            behind_s = pace.behind_s(time.monotonic(), first.vehicle.time_s)
            first.tell_dropped()
            for _ in range(min(int(behind_s / STEP_S), _MAX_STEPS_PER_TURN)):
                step_all(gateways)
            _wait(gateways, pace.due_s((first.vehicle.simulation.steps + 1) * STEP_S) - time.monotonic())
    finally:
        for gateway in gateways:
            gateway.write_report()


def step_all(gateways: Sequence[Gateway]) -> None:
    """One physics step of every vehicle. Raises `DivergedError`; that vehicle's report will say so."""
    for gateway in gateways:
        try:
            gateway.step()
        except DynamicsError as error:
            gateway.give_up(error)
            raise


def _wait(gateways: Sequence[Gateway], seconds: float) -> None:
    """Sleep until the next step is due; what arrives meanwhile is handled at once."""
    if seconds <= 0.0:
        return
    owners = {watched: gateway for gateway in gateways for link in gateway.server.links for watched in link.watched()}
    readable, _, _ = select.select(list(owners), [], [], min(seconds, _LONGEST_WAIT_S))
    for gateway in {owners[sock] for sock in readable}:
        gateway.server.poll()
