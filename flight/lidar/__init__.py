"""LiDAR drivers: pure decoders over one transport, delivering vehicle-centred scans, 0 ahead and positive left."""

from __future__ import annotations

from flight.lidar.config import LidarSource
from flight.lidar.devices import open_lidar
from flight.lidar.driver import LidarDriver, LidarHealth
from flight.lidar.motion import BodyMotion, body_motion
from flight.lidar.recording import ScanSource
from flight.lidar.reduce import BeamReducer, fill_unknown

__all__ = [
    "BeamReducer",
    "BodyMotion",
    "LidarDriver",
    "LidarHealth",
    "LidarSource",
    "ScanSource",
    "body_motion",
    "fill_unknown",
    "open_lidar",
]
