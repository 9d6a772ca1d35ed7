"""What a flight and a check of a flight prepare alike: the simulator's arguments, the mission's places, the corridor's frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flight.errors import MissionError, RefusedError
from flight.gateway_process import GatewayReady
from flight.lidar.config import LidarSource
from flight.link import VehicleLink
from flight.mission import Mission, goal_problem, takeoff_point_problem
from safety.frames import CorridorFrame, CorridorVector, NedVector

ANCHOR_SAMPLES = 25
ANCHOR_PERIOD_S = 0.04


@dataclass(frozen=True, slots=True)
class Place:
    """Mission geometry with every `world` filled in. Corridor frame, m."""

    takeoff_point: tuple[float, float]
    start_yaw_rad: float
    goal: CorridorVector


def vehicle_url(mission: Mission) -> str:
    """MAVSDK's URL of the vehicle, or of the simulator that is started for it."""
    sim = mission.sim
    return f"udpin://127.0.0.1:{sim.onboard_port}" if mission.simulated and sim else mission.vehicle.connection


def lidar_source(mission: Mission) -> LidarSource:
    """The LiDAR to open: the simulator's, where there is one."""
    return mission.lidar.model_copy(update={"host": "127.0.0.1"}) if mission.simulated else mission.lidar


def gateway_arguments(mission: Mission) -> list[str]:
    """Command line of `sim-gateway` for a mission. Raises `MissionError` without a `sim` section, or without its world's file."""
    sim = mission.sim
    if sim is None:
        raise MissionError("the mission has no `sim` section: the simulator cannot be started")
    if not sim.world.is_file():
        raise MissionError(f"sim.world {sim.world}: no such file")
    arguments = [
        "--world",
        str(sim.world),
        "--seed",
        str(sim.seed),
        "--dynamics",
        sim.dynamics,
        "--vehicle",
        sim.vehicle,
        "--estimate",
        sim.estimate,
    ]
    arguments += [f"--fault={fault}" for fault in sim.faults]
    arguments += ["--onboard-port", str(sim.onboard_port), "--gcs-port", str(sim.gcs_port)]
    arguments += ["--lidar-port", str(mission.lidar.port), "--wind=" + ",".join(map(repr, sim.wind_m_s))]
    if mission.frame.takeoff_point_m != "world":
        arguments.append("--start=" + ",".join(map(repr, mission.frame.takeoff_point_m)))
    if mission.goal.position_m != "world":
        arguments.append("--goal=" + ",".join(map(repr, mission.goal.position_m)))
    if mission.frame.heading_deg != "vehicle":
        arguments.append(f"--heading={mission.frame.heading_deg!r}")
    return arguments


def resolve_place(mission: Mission, ready: GatewayReady | None) -> Place:
    """Takeoff point and goal as numbers. What the world filled in is checked like what the file said.

    Raises `MissionError` where a `world` position has no world, `RefusedError` where the world does not fit the fence.
    """
    takeoff, goal = mission.frame.takeoff_point_m, mission.goal.position_m
    if ready is not None:
        takeoff = ready.start[:2] if takeoff == "world" else takeoff
        goal = ready.goal if goal == "world" else goal
    if takeoff == "world" or goal == "world":
        raise MissionError("`world` positions need vehicle.connection: sim; give numbers")
    place = Place(takeoff, ready.start_yaw_rad if ready is not None else 0.0, CorridorVector(*goal))
    for problem in (goal_problem(place.goal, mission.safety), takeoff_point_problem(takeoff, mission.safety)):
        if problem is not None:
            raise RefusedError(f"this world does not fit the mission: {problem}")
    return place


def anchor_frame(link: VehicleLink, mission: Mission, place: Place, keep_waiting: Callable[[], None]) -> CorridorFrame:
    """The corridor frame through the spot where the vehicle stands, from the mean of a second of samples.

    Raises `RefusedError` when no position arrives.
    """
    positions: list[NedVector] = []
    yaws: list[float] = []
    for _ in range(ANCHOR_SAMPLES):
        keep_waiting()
        if link.telemetry.position is not None and link.telemetry.attitude is not None:
            positions.append(link.telemetry.position.position)
            yaws.append(link.telemetry.attitude.yaw_rad)
        time.sleep(ANCHOR_PERIOD_S)
    if not positions:
        raise RefusedError("the vehicle stopped telling its position before arming: check the link")
    yaw = math.atan2(float(np.mean(np.sin(yaws))), float(np.mean(np.cos(yaws))))
    heading_deg = mission.frame.heading_deg
    heading = yaw + place.start_yaw_rad if heading_deg == "vehicle" else math.radians(heading_deg)
    mean = NedVector(*(float(np.mean([getattr(p, axis) for p in positions])) for axis in "xyz"))
    return CorridorFrame.anchored(mean, CorridorVector(*place.takeoff_point, 0.0), heading)
