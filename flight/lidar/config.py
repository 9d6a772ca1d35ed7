"""The `lidar` section of a mission: which device, where, and how it is mounted."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Bearing = Annotated[float, Field(ge=-180.0, le=180.0)]
DriverName = Literal["scip-tcp", "scip-serial", "ld06", "ld19", "stl27l", "rplidar", "mavlink", "recording"]

SPINNING = frozenset({"ld06", "ld19", "stl27l", "rplidar"})
SERIAL = SPINNING | {"scip-serial"}
DEFAULT_BAUD = {"scip-serial": 115_200, "ld06": 230_400, "ld19": 230_400, "stl27l": 921_600, "rplidar": 115_200}

# fields that mean something to some drivers only: elsewhere they are a mistake, not a wish to be ignored
_ONLY_FOR: dict[str, frozenset[str]] = {
    "host": frozenset({"scip-tcp"}),
    "port": frozenset({"scip-tcp"}),
    "device": SERIAL,
    "baud": SERIAL,
    "grid_deg": SPINNING,
    "scans_per_turn": SPINNING,
    "no_return": SPINNING,
    "motion_compensation": SPINNING,
    "min_intensity": frozenset({"ld06", "ld19", "stl27l"}),
    "extra_age_s": SPINNING | {"mavlink"},
    "rplidar_mode": frozenset({"rplidar"}),
    "motor_pwm": frozenset({"rplidar"}),
    "motor_rpm": frozenset({"rplidar"}),
    "path": frozenset({"recording"}),
    "speed": frozenset({"recording"}),
    "repeat": frozenset({"recording"}),
}
_NEEDED = {"path": frozenset({"recording"}), "device": SERIAL}


class LidarSource(BaseModel):
    """A LiDAR device and its mounting. Bearings in degrees: 0 ahead of the vehicle, positive left."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    driver: DriverName = Field(default="scip-tcp", description="protocol and transport")
    host: str = Field(default="127.0.0.1", min_length=1, max_length=253, description="scip-tcp: device address")
    port: int = Field(default=10940, ge=1, le=65535, description="scip-tcp: device TCP port")
    device: str | None = Field(default=None, min_length=1, max_length=200, description="serial drivers: /dev/ttyUSB0, ...")
    baud: int | None = Field(default=None, ge=1200, le=4_000_000, description="serial drivers; default: the driver's usual rate")

    mount_yaw_deg: Bearing = Field(default=0.0, description="bearing of the device's front on the vehicle")
    mirror: bool = Field(default=False, description="device mounted upside down: its angles run clockwise")
    mount_x_m: float = Field(default=0.0, ge=-2.0, le=2.0, description="device ahead of the vehicle's centre")
    mount_y_m: float = Field(default=0.0, ge=-2.0, le=2.0, description="device left of the vehicle's centre")
    range_max_m: float | None = Field(default=None, gt=0.0, description="trust returns up to here; default: the device's limit")
    blind_sectors_deg: tuple[tuple[Bearing, Bearing], ...] = Field(
        default=(),
        max_length=16,
        description="vehicle bearings [from, to], counter-clockwise, hidden by the vehicle: unknown",
    )

    no_return: Literal["unknown", "nothing"] = Field(
        default="unknown", description="spinning devices do not say why a beam has no return: unknown, or nothing within range"
    )
    min_intensity: int = Field(default=0, ge=0, le=255, description="LDROBOT: weaker returns are no return")
    grid_deg: float = Field(default=0.5, ge=0.125, le=2.0, description="spinning devices: beam width of the scans delivered")
    scans_per_turn: int = Field(default=2, ge=1, le=4, description="spinning devices: a scan of the last full turn this often")
    motion_compensation: bool = Field(default=False, description="spinning devices: undo the vehicle's motion within a scan")
    tilt_compensation: bool = Field(
        default=False, description="show the policy horizontal distances instead of those along beams"
    )
    extra_age_s: float = Field(default=0.0, ge=0.0, le=0.2, description="known delay inside device or sender, added to the age")
    rplidar_mode: Literal["auto", "standard", "express", "dense"] = Field(default="auto", description="scan format to ask for")
    motor_pwm: int | None = Field(default=None, ge=0, le=1023, description="RPLIDAR A2, A3: motor command (660 is usual)")
    motor_rpm: int | None = Field(default=None, ge=0, le=2000, description="RPLIDAR S, C, T: motor speed")

    path: Path | None = Field(default=None, description="recording: file to play")
    speed: float = Field(default=1.0, gt=0.0, le=100.0, description="recording: recorded seconds per second")
    repeat: bool = Field(default=False, description="recording: begin again at its end")

    connect_timeout_s: float = Field(default=1.0, gt=0.0, le=10.0, description="wait for the TCP connection")
    reply_timeout_s: float = Field(default=1.0, gt=0.0, le=10.0, description="wait for one reply of the handshake")
    stall_timeout_s: float = Field(default=0.5, gt=0.0, le=10.0, description="no scan for this long: reconnect")
    reconnect_min_s: float = Field(default=0.05, gt=0.0, le=10.0, description="first pause before a new connection")
    reconnect_max_s: float = Field(default=1.0, gt=0.0, le=60.0, description="longest pause: each failure doubles it")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.reconnect_max_s < self.reconnect_min_s:
            raise ValueError(f"reconnect_max_s must be at least reconnect_min_s ({self.reconnect_min_s:g})")
        if abs(360.0 / self.grid_deg - round(360.0 / self.grid_deg)) > 1e-9:
            raise ValueError(f"grid_deg {self.grid_deg:g} does not divide a full turn: use 0.25, 0.5 or 1")
        for name, drivers in _ONLY_FOR.items():
            if name in self.model_fields_set and self.driver not in drivers:
                raise ValueError(
                    f"{name} means nothing to driver {self.driver} (only to {', '.join(sorted(drivers))}): remove it"
                )
        for name, drivers in _NEEDED.items():
            if self.driver in drivers and getattr(self, name) is None:
                raise ValueError(f"driver {self.driver} needs {name}")
        return self

    @property
    def mount_yaw_rad(self) -> float:
        """Bearing of the device's front on the vehicle, rad."""
        return math.radians(self.mount_yaw_deg)

    @property
    def bit_rate(self) -> int:
        """Of the serial line, bit/s."""
        return self.baud or DEFAULT_BAUD.get(self.driver, 115_200)

    @property
    def byte_s(self) -> float:
        """Time of one byte on the serial line (8N1: ten bits), s."""
        return 10.0 / self.bit_rate

    @property
    def place(self) -> str:
        """Where the device is, for messages to the user."""
        places = {"scip-tcp": f"{self.host}:{self.port}", "mavlink": "the vehicle's MAVLink", "recording": str(self.path)}
        return places.get(self.driver) or f"{self.device} at {self.bit_rate} baud"

    @property
    def advice(self) -> str:
        """Which fields of the section to look at when nothing comes."""
        fields = {"scip-tcp": "`lidar.host` and `lidar.port`", "mavlink": "`lidar.driver`", "recording": "`lidar.path`"}
        return fields.get(self.driver) or "`lidar.device` and `lidar.baud`"
