"""From the world's corridor frame to PX4's frames and back: the only place of the gateway that turns axes.

The local NED origin is where the vehicle boots. `heading_rad` is the compass heading of the corridor's x axis (clockwise from
north); with 0, north = corridor x, east = -y, down = -z, and NED yaw = -corridor yaw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# Where PX4's SITL boots unless it is told otherwise; altitude is above mean sea level.
DEFAULT_LATITUDE_DEG, DEFAULT_LONGITUDE_DEG, DEFAULT_ALTITUDE_M = 47.397742, 8.545594, 489.4
_EARTH_RADIUS_M = 6371000.0

Vector = tuple[float, float, float]


def wrap_pi(angle_rad: float) -> float:
    """The same angle in [-pi, pi]."""
    return math.remainder(angle_rad, 2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class NedState:
    """What the autopilot knows about the vehicle, at vehicle time `time_s`: its own estimate, NED and FRD, SI, radians.

    `on_ground` is the ground contact switch that stands in for PX4's thrust-based ground contact detection.
    """

    time_s: float
    position: Vector
    velocity: Vector
    yaw_rad: float
    on_ground: bool


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """Corridor frame <-> local NED <-> WGS84 (azimuthal equidistant on a sphere, good to millimetres over a corridor)."""

    origin: Vector = (0.0, 0.0, 0.0)
    heading_rad: float = 0.0
    latitude_deg: float = DEFAULT_LATITUDE_DEG
    longitude_deg: float = DEFAULT_LONGITUDE_DEG
    altitude_m: float = DEFAULT_ALTITUDE_M

    def vector_to_ned(self, vector: Vector) -> Vector:
        """A corridor-frame vector (velocity, acceleration) in NED."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        x, y, z = vector
        return (cos * x + sin * y, sin * x - cos * y, -z)

    def vector_to_world(self, ned: Vector) -> Vector:
        """A NED vector in the corridor frame."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        north, east, down = ned
        return (cos * north + sin * east, sin * north - cos * east, -down)

    def point_to_ned(self, point: Vector) -> Vector:
        """A corridor-frame point in local NED."""
        x, y, z = self.origin
        return self.vector_to_ned((point[0] - x, point[1] - y, point[2] - z))

    def point_to_world(self, ned: Vector) -> Vector:
        """A local NED point in the corridor frame."""
        vector = self.vector_to_world(ned)
        return (self.origin[0] + vector[0], self.origin[1] + vector[1], self.origin[2] + vector[2])

    def yaw_to_ned(self, yaw_rad: float) -> float:
        """A corridor yaw (counter-clockwise) as NED yaw (clockwise from north), in [-pi, pi]."""
        return wrap_pi(self.heading_rad - yaw_rad)

    def to_global(self, ned: Vector) -> Vector:
        """A local NED point as (latitude deg, longitude deg, altitude above mean sea level m)."""
        latitude = self.latitude_deg + math.degrees(ned[0] / _EARTH_RADIUS_M)
        longitude = self.longitude_deg + math.degrees(ned[1] / (_EARTH_RADIUS_M * math.cos(math.radians(self.latitude_deg))))
        return (latitude, longitude, self.altitude_m - ned[2])

    def from_global(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vector:
        """Inverse of `to_global`."""
        north = math.radians(latitude_deg - self.latitude_deg) * _EARTH_RADIUS_M
        east = math.radians(longitude_deg - self.longitude_deg) * _EARTH_RADIUS_M * math.cos(math.radians(self.latitude_deg))
        return (north, east, self.altitude_m - altitude_m)
