"""LiDAR drivers: pure decoders over one transport, delivering vehicle-centred scans, 0 ahead and positive left."""

from __future__ import annotations

from flight.lidar.config import LidarSource
from flight.lidar.driver import LidarHealth, ScipDriver
from flight.lidar.reduce import BeamReducer, fill_unknown

__all__ = ["BeamReducer", "LidarHealth", "LidarSource", "ScipDriver", "fill_unknown", "open_lidar"]


def open_lidar(config: LidarSource) -> ScipDriver:
    """The driver that `config` names, not yet started: use it as a context manager or call `start` and `close`."""
    return ScipDriver(config)
