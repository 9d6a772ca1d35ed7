"""The mission file: what to fly, where, within which limits. See docs/mission.md.

`load_mission` reads YAML strictly (`strict_yaml`) and checks every value against the others, so that a contradiction is
refused before anything is started. Paths in the file are relative to the file's own folder.
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from flight.errors import MissionError
from flight.lidar.config import LidarSource
from flight.px4 import LossAction
from flight.realtime import RealTimeConfig
from flight.recording_config import RecordingConfig
from safety.config import SafetyConfig
from safety.escalation import EscalationConfig
from safety.frames import CorridorVector
from strict_yaml import ConfigError, load_config

SIM = "sim"
_LESS = "(fence less vehicle, position error and margin)"
Coordinate = Annotated[float, Field(ge=-10_000.0, le=10_000.0)]
Seconds = Annotated[float, Field(gt=0.0, le=3600.0)]
Port = Annotated[int, Field(ge=1, le=65535)]
FaultText = Annotated[str, Field(max_length=200, pattern=r"^[a-z0-9_]+@[a-z0-9_.:+=,-]+$")]

_URL = re.compile(r"(udpin|udpout|tcpin|tcpout)://[^\s:/]+:\d{1,5}$|serial(_flowcontrol)?:///[^\s:]+:\d{3,8}$")


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class VehicleSection(_Section):
    """The vehicle. `connection`: `sim` starts sim-gateway; otherwise a MAVSDK URL, which is the only address used."""

    connection: str = Field(default=SIM, max_length=200, description="sim, udpin://127.0.0.1:14540, serial:///dev/ttyAMA0:921600")
    stream_rate_hz: float = Field(default=50.0, ge=20.0, le=200.0, description="rate asked for position, attitude and IMU")

    @field_validator("connection")
    @classmethod
    def _known(cls, value: str) -> str:
        if value != SIM and not _URL.fullmatch(value):
            raise ValueError("give `sim`, or a MAVSDK URL such as udpin://127.0.0.1:14540 or serial:///dev/ttyAMA0:921600")
        if not value.startswith((SIM, "serial")) and not 0 < int(value.rpartition(":")[2]) < 65536:
            raise ValueError("the port must lie in 1..65535")
        return value


class PolicySection(_Section):
    """The policy file, and optionally the SHA-256 it must have."""

    path: Path
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-fA-F]{64}$")


class FrameSection(_Section):
    """Where the corridor lies. It is anchored where the vehicle stands at arming.

    `takeoff_point_m`: that spot's corridor x and y, `world` (sim) the world's own start. `heading_deg`: compass heading of
    the corridor's x axis, clockwise from north; `vehicle` the way the vehicle's nose points at arming.
    """

    takeoff_point_m: tuple[Coordinate, Coordinate] | Literal["world"] = (0.0, 0.0)
    heading_deg: Annotated[float, Field(ge=-360.0, le=360.0)] | Literal["vehicle"] = "vehicle"


class GoalSection(_Section):
    """Where to: corridor frame, m. `world` (sim) is the world's own goal."""

    position_m: tuple[Coordinate, Coordinate, Coordinate] | Literal["world"]
    radius_m: float = Field(default=0.3, ge=0.05, le=10.0, description="reached within this distance (3D)")


class TimeoutSection(_Section):
    """Deadlines, s. Every wait of `fly` has one."""

    connect_s: Seconds = Field(default=10.0, description="for the vehicle's first heartbeat")
    lidar_s: Seconds = Field(default=10.0, description="for the first scan")
    gateway_s: Seconds = Field(default=300.0, description="for sim-gateway (its first start compiles for a minute)")
    ready_s: Seconds = Field(default=30.0, description="for a position estimate and PX4's consent to arm")
    takeoff_s: Seconds = Field(default=40.0, description="to reach the takeoff height")
    flight_s: Seconds = Field(default=180.0, description="from OFFBOARD to the goal")
    stuck_s: Seconds = Field(default=30.0, description="without coming 0.5 m nearer to the goal")
    pilot_s: Seconds = Field(default=600.0, description="with --shadow: for the pilot to take off")
    land_s: Seconds = Field(default=60.0, description="from the landing command to disarm")


class FailsafeSection(_Section):
    """What happens when something is wrong. Braking comes first always; `escalation` gives the steps after it.

    `setpoint_loss_*` are PX4's own reaction when the setpoint stream stops (COM_OF_LOSS_T, COM_OBL_RC_ACT): set and read
    back before OFFBOARD.
    """

    escalation: EscalationConfig = EscalationConfig.model_validate({})
    stall_s: float = Field(default=0.15, gt=0.05, le=0.5, description="a loop this late brakes before it flies on")
    setpoint_loss_timeout_s: float = Field(default=0.5, ge=0.3, le=2.0)
    setpoint_loss_action: Literal["hold", "land"] = "hold"

    @property
    def loss_action(self) -> LossAction:
        """Value of COM_OBL_RC_ACT."""
        return LossAction[self.setpoint_loss_action.upper()]


class TetherSection(_Section):
    """Limits of `fly --tether`, for first flights on a line. They only ever reduce the mission's own."""

    max_horizontal_speed_m_s: float = Field(default=0.4, gt=0.05, le=5.0)
    max_vertical_speed_m_s: float = Field(default=0.3, gt=0.05, le=2.0)
    max_yaw_rate_rad_s: float = Field(default=0.5, gt=0.05, le=3.0)
    max_height_m: float = Field(default=2.0, ge=0.5, le=50.0, description="top of the fence, corridor z")
    max_distance_m: float = Field(default=3.0, ge=0.5, le=100.0, description="from the takeoff point to the fence")
    max_flight_s: Seconds = Field(default=60.0, description="from OFFBOARD to the landing")


class SimSection(_Section):
    """For `vehicle.connection: sim` only: what the gateway simulates."""

    world: Path
    seed: int = Field(default=0, ge=0, lt=2**63)
    dynamics: Literal["internal", "jsbsim"] = "internal"
    vehicle: Literal["iris", "sih_quadx"] = Field(default="iris", description="profile of the simulated vehicle")
    estimate: Literal["none", "nominal", "px4_sih"] = Field(default="nominal", description="errors of the vehicle's own estimate")
    wind_m_s: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    onboard_port: Port = 14540
    gcs_port: Port = 14550
    faults: tuple[FaultText, ...] = Field(
        default=(), max_length=100, description="what shall go wrong, such as lidar_freeze@offboard:12+3 (docs/gateway.md)"
    )

    @field_validator("wind_m_s")
    @classmethod
    def _flyable(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if math.hypot(*value) > 15.0:
            raise ValueError("more than 15 m/s of wind; no vehicle of this project flies in it")
        return value


class Mission(_Section):
    """A whole mission, checked. Made by `load_mission`.

    The order of the fields matters: each is checked against those above it, so that the error names its own line.
    """

    name: str = Field(default="flight", pattern=r"^[A-Za-z0-9_-]{1,40}$", description="part of the run folder's name")
    vehicle: VehicleSection = VehicleSection()
    policy: PolicySection
    safety: SafetyConfig
    frame: FrameSection = FrameSection()
    takeoff_height_m: float = Field(gt=0.3, le=50.0)
    goal: GoalSection
    lidar: LidarSource = LidarSource()
    timeouts: TimeoutSection = TimeoutSection()
    failsafe: FailsafeSection = FailsafeSection()
    realtime: RealTimeConfig = RealTimeConfig()
    recording: RecordingConfig = RecordingConfig()
    tether: TetherSection = TetherSection()
    sim: SimSection | None = Field(default=None, validate_default=True)

    @property
    def simulated(self) -> bool:
        """Whether the gateway is started for this mission."""
        return self.vehicle.connection == SIM

    @field_validator("frame")
    @classmethod
    def _frame_fits(cls, frame: FrameSection, info: ValidationInfo) -> FrameSection:
        point = frame.takeoff_point_m
        if point == "world":
            _needs_sim("takeoff_point_m", info)
        elif "safety" in info.data:
            _raise(takeoff_point_problem(point, info.data["safety"]))
        return frame

    @field_validator("takeoff_height_m")
    @classmethod
    def _height_fits(cls, height_m: float, info: ValidationInfo) -> float:
        if "safety" in info.data:
            _raise(height_problem("", height_m, info.data["safety"], "change it or widen safety.fence"))
        return height_m

    @field_validator("goal")
    @classmethod
    def _goal_fits(cls, goal: GoalSection, info: ValidationInfo) -> GoalSection:
        if goal.position_m == "world":
            _needs_sim("position_m", info)
        elif "safety" in info.data:
            _raise(goal_problem(CorridorVector(*goal.position_m), info.data["safety"]))
        return goal

    @field_validator("failsafe")
    @classmethod
    def _brake_is_followed_in_time(cls, failsafe: FailsafeSection, info: ValidationInfo) -> FailsafeSection:
        longest_s = info.data["safety"].fault_hold_s if "safety" in info.data else math.inf
        if failsafe.escalation.hold_after_s > longest_s:
            raise ValueError(
                f"escalation.hold_after_s is longer than the fence has room for; raise safety.fault_hold_s ({longest_s} s)"
            )
        return failsafe

    @field_validator("sim")
    @classmethod
    def _sim_is_there(cls, sim: SimSection | None, info: ValidationInfo) -> SimSection | None:
        if sim is None and "vehicle" in info.data and info.data["vehicle"].connection == SIM:
            raise ValueError("this section is required with vehicle.connection: sim; add it with at least a `world`")
        return sim


def goal_problem(goal: CorridorVector, safety: SafetyConfig) -> str | None:
    """What is wrong with a goal, or None: outside the eroded fence the safety filter would never let it be reached."""
    advice = "move the goal or widen safety.fence"
    return _outside("goal.position_m", (goal.x, goal.y), safety, advice) or height_problem(
        "goal.position_m z = ", goal.z, safety, advice
    )


def takeoff_point_problem(point: tuple[float, float], safety: SafetyConfig) -> str | None:
    """What is wrong with a takeoff point, or None: the vehicle hovers above it, so it must lie in the eroded fence."""
    return _outside("frame.takeoff_point_m", point, safety, "move it or widen safety.fence")


def height_problem(what: str, z_m: float, safety: SafetyConfig, advice: str) -> str | None:
    """What is wrong with a height, or None."""
    low, high = safety.keep_in_z()
    if low <= z_m <= high:
        return None
    return f"{what}{z_m:g} m is outside the safe part of the fence, {low:.2f} .. {high:.2f} m {_LESS}; {advice}"


def _outside(what: str, point: tuple[float, float], safety: SafetyConfig, advice: str) -> str | None:
    room_m = float(safety.eroded_fence().room_m(np.array(point)))
    if room_m >= 0.0:
        return None
    x, y = point
    return f"{what} ({x:g}, {y:g}) m is outside the safe part of the fence by {-room_m:.2f} m {_LESS}; {advice}"


def _needs_sim(field: str, info: ValidationInfo) -> None:
    if "vehicle" in info.data and info.data["vehicle"].connection != SIM:
        raise ValueError(f"{field}: `world` needs vehicle.connection: sim; give numbers")


def load_mission(path: str | Path, seed: int | None = None) -> Mission:
    """Read and check a mission. `seed` replaces `sim.seed`. Raises `MissionError`, one line per mistake (file:line: field)."""
    file = Path(path)
    try:
        mission = load_config(file, Mission)
    except ConfigError as error:
        raise MissionError(str(error)) from None
    updates: dict[str, object] = {"policy": mission.policy.model_copy(update={"path": _resolve(file, mission.policy.path)})}
    if mission.lidar.path is not None:
        updates["lidar"] = mission.lidar.model_copy(update={"path": _resolve(file, mission.lidar.path)})
    if mission.sim is not None:
        sim: dict[str, object] = {"world": _resolve(file, mission.sim.world)}
        if seed is not None:
            sim["seed"] = seed
        updates["sim"] = mission.sim.model_copy(update=sim)
    elif seed is not None:
        raise MissionError(f"{file}: --seed needs a `sim` section; a real world has no seed")
    return mission.model_copy(update=updates)


def _resolve(mission_file: Path, path: Path) -> Path:
    return path if path.is_absolute() else Path(os.path.normpath(mission_file.parent / path))


def _raise(problem: str | None) -> None:
    if problem is not None:
        raise ValueError(problem)
