"""Section `recording` of the mission file."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class RecordingConfig(BaseModel):
    """Section `recording` of the mission. The live view is off unless `live_port` is given; it has no password."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    enabled: bool = Field(default=True, description="write flight.mcap")
    max_size_mb: float = Field(
        default=512.0, ge=1.0, le=100_000.0, description="recording stops at this size; the flight goes on"
    )
    live_port: int | None = Field(default=None, ge=1, le=65535, description="serve the flight to Foxglove on this websocket port")
    live_host: str = Field(default="127.0.0.1", max_length=100, description="address to listen on; loopback unless changed")
    px4_log: bool = Field(default=False, description="fetch PX4's own log after landing")
