"""Typed vectors and the only conversions between the frames of this project.

Frames (all SI, radians):

* **NED**: PX4's local frame, x north, y east, z down, yaw positive clockwise seen from above.
* **Corridor**: x along the corridor, y left, z up, yaw positive counter-clockwise seen from above.
* **Heading**: corridor axes turned by the vehicle's yaw only: x ahead, y left, z up.

A vector of one frame is not accepted where another is wanted: each frame is its own type.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CorridorVector:
    """A vector in the corridor frame: x along the corridor, y left, z up."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class HeadingVector:
    """A vector in the heading frame: x ahead, y left, z up."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class NedVector:
    """A vector in PX4's local frame: x north, y east, z down."""

    x: float
    y: float
    z: float


def wrap_angle_rad(angle_rad: float) -> float:
    """The same angle in [-pi, pi]."""
    return math.remainder(angle_rad, 2.0 * math.pi)


def heading_to_corridor(vector: HeadingVector, yaw_rad: float) -> CorridorVector:
    """Turn a heading-frame vector by the vehicle's corridor yaw."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return CorridorVector(cos * vector.x - sin * vector.y, sin * vector.x + cos * vector.y, vector.z)


def corridor_to_heading(vector: CorridorVector, yaw_rad: float) -> HeadingVector:
    """Inverse of `heading_to_corridor`."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return HeadingVector(cos * vector.x + sin * vector.y, -sin * vector.x + cos * vector.y, vector.z)


@dataclass(frozen=True, slots=True)
class CorridorFrame:
    """Where the corridor lies in PX4's local NED frame.

    `origin_ned`: the corridor's origin in NED, m. `heading_rad`: NED yaw of the corridor's x axis.
    """

    origin_ned: NedVector
    heading_rad: float

    @staticmethod
    def anchored(position_ned: NedVector, position_corridor: CorridorVector, heading_rad: float) -> CorridorFrame:
        """The frame in which the point `position_ned` has the corridor coordinates `position_corridor`."""
        offset = CorridorFrame(position_ned, heading_rad).vector_to_ned(position_corridor)
        origin = NedVector(position_ned.x - offset.x, position_ned.y - offset.y, position_ned.z - offset.z)
        return CorridorFrame(origin, heading_rad)

    def vector_to_ned(self, vector: CorridorVector) -> NedVector:
        """Velocity, acceleration or offset: corridor to NED (left is minus east at heading 0)."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return NedVector(cos * vector.x + sin * vector.y, sin * vector.x - cos * vector.y, -vector.z)

    def vector_to_corridor(self, vector: NedVector) -> CorridorVector:
        """Velocity, acceleration or offset: NED to corridor."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return CorridorVector(cos * vector.x + sin * vector.y, sin * vector.x - cos * vector.y, -vector.z)

    def point_to_ned(self, point: CorridorVector) -> NedVector:
        """A position: corridor to NED."""
        turned, origin = self.vector_to_ned(point), self.origin_ned
        return NedVector(origin.x + turned.x, origin.y + turned.y, origin.z + turned.z)

    def point_to_corridor(self, point: NedVector) -> CorridorVector:
        """A position: NED to corridor."""
        origin = self.origin_ned
        return self.vector_to_corridor(NedVector(point.x - origin.x, point.y - origin.y, point.z - origin.z))

    def yaw_to_ned(self, yaw_rad: float) -> float:
        """Corridor yaw (counter-clockwise) to NED yaw (clockwise), in [-pi, pi]."""
        return wrap_angle_rad(self.heading_rad - yaw_rad)

    def yaw_to_corridor(self, yaw_ned_rad: float) -> float:
        """NED yaw to corridor yaw, in [-pi, pi]."""
        return wrap_angle_rad(self.heading_rad - yaw_ned_rad)

    @staticmethod
    def yaw_rate_to_ned(yaw_rate_rad_s: float) -> float:
        """Corridor yaw rate (counter-clockwise) to NED yaw rate (clockwise); its own inverse."""
        return -yaw_rate_rad_s
