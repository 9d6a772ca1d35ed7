"""A LiDAR that is connected to the autopilot: its messages come over the vehicle's MAVLink link."""

from __future__ import annotations

from flight.lidar.config import LidarSource
from flight.lidar.driver import LidarDriver
from flight.lidar.obstacle_distance import NAME
from flight.link import VehicleLink

RATE_HZ = 20.0


def feed_from_link(lidar: LidarDriver, config: LidarSource, link: VehicleLink) -> None:
    """For `driver: mavlink`: from now on every OBSTACLE_DISTANCE of the vehicle goes to the driver. Nothing for others.

    Raises `VehicleCommandError` when the vehicle does not send it.
    """
    if config.driver != "mavlink":
        return
    link.subscribe(NAME, lambda fields_json, arrived_s, component: _put(lidar, fields_json, arrived_s, component))
    link.request_message_rate(NAME, RATE_HZ)


def _put(lidar: LidarDriver, fields_json: str, arrived_s: float, component: int) -> None:
    lidar.inbox.put(fields_json, arrived_s, component)
