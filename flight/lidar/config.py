"""The `lidar` section of a mission: which device, where, and how it is mounted."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Bearing = Annotated[float, Field(ge=-180.0, le=180.0)]


class LidarSource(BaseModel):
    """A LiDAR device and its mounting. Bearings in degrees: 0 ahead of the vehicle, positive left."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    driver: Literal["scip-tcp"] = Field(default="scip-tcp", description="protocol and transport")
    host: str = Field(default="127.0.0.1", min_length=1, max_length=253, description="device address")
    port: int = Field(default=10940, ge=1, le=65535, description="device TCP port")
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
    connect_timeout_s: float = Field(default=1.0, gt=0.0, le=10.0, description="wait for the TCP connection")
    reply_timeout_s: float = Field(default=1.0, gt=0.0, le=10.0, description="wait for one reply of the handshake")
    stall_timeout_s: float = Field(default=0.5, gt=0.0, le=10.0, description="no scan for this long: reconnect")
    reconnect_min_s: float = Field(default=0.05, gt=0.0, le=10.0, description="first pause before a new connection")
    reconnect_max_s: float = Field(default=1.0, gt=0.0, le=60.0, description="longest pause: each failure doubles it")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.reconnect_max_s < self.reconnect_min_s:
            raise ValueError(f"reconnect_max_s must be at least reconnect_min_s ({self.reconnect_min_s:g})")
        return self

    @property
    def mount_yaw_rad(self) -> float:
        """Bearing of the device's front on the vehicle, rad."""
        return math.radians(self.mount_yaw_deg)
