"""Is the vehicle inside its geofence? Polygons and circles as uploaded, and GF_MAX_HOR_DIST and GF_MAX_VER_DIST around home.

As in PX4 (geofence.json): looked at five times a second, told once per breach, and again only when the vehicle has been
back inside. What is done about a breach is in `failsafes`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from sim_gateway.local_frame import Vector
from sim_gateway.parameters import ParameterStore

CHECK_PERIOD_S = 0.2
OUTSIDE_SHAPES = "Geofence: approaching or outside geofence"
TOO_HIGH = "Geofence: exceeding maximum altitude above Home"
TOO_FAR = "Geofence: exceeding maximum distance to Home"

Corner = tuple[float, float]  # north, east; metres in the local frame


@dataclass(frozen=True, slots=True)
class Polygon:
    """An area the vehicle must stay in (`inclusion`) or out of."""

    inclusion: bool
    corners: tuple[Corner, ...]

    def contains(self, north_m: float, east_m: float) -> bool:
        """Even-odd rule: how many edges does a ray to the east cross?"""
        inside, previous = False, self.corners[-1]
        for corner in self.corners:
            (n0, e0), (n1, e1) = previous, corner
            if (n0 > north_m) != (n1 > north_m) and east_m < e0 + (north_m - n0) / (n1 - n0) * (e1 - e0):
                inside = not inside
            previous = corner
        return inside


@dataclass(frozen=True, slots=True)
class Circle:
    """A disc the vehicle must stay in (`inclusion`) or out of."""

    inclusion: bool
    centre: Corner
    radius_m: float

    def contains(self, north_m: float, east_m: float) -> bool:
        """Whether the point is on the disc."""
        return math.hypot(north_m - self.centre[0], east_m - self.centre[1]) < self.radius_m


Shape = Polygon | Circle


class GeofenceMonitor:
    """The fence of one vehicle. `breached`: the verdict of the last look."""

    def __init__(self, parameters: ParameterStore) -> None:
        self._parameters = parameters
        self.shapes: tuple[Shape, ...] = ()
        self.breached = False
        self._next_s = -math.inf

    def set_shapes(self, shapes: Iterable[Shape]) -> None:
        """Replace the uploaded fence."""
        self.shapes = tuple(shapes)

    def new_breach(self, now_s: float, position: Vector, home: Vector) -> str | None:
        """PX4's text for a breach that has just been found, else None. Local NED."""
        if now_s < self._next_s:
            return None
        self._next_s = now_s + CHECK_PERIOD_S
        text = self.problem(position, home)
        new = text is not None and not self.breached
        self.breached = text is not None
        return text if new else None

    def problem(self, position: Vector, home: Vector) -> str | None:
        """What is wrong with a place, or None."""
        furthest, highest = self._parameters.get("GF_MAX_HOR_DIST"), self._parameters.get("GF_MAX_VER_DIST")
        if furthest > 0.0 and math.hypot(position[0] - home[0], position[1] - home[1]) > furthest:
            return TOO_FAR
        if highest > 0.0 and home[2] - position[2] > highest:
            return TOO_HIGH
        return None if self._allowed(position[0], position[1]) else OUTSIDE_SHAPES

    def _allowed(self, north_m: float, east_m: float) -> bool:
        """Outside every exclusion, and inside at least one inclusion if there is any."""
        inclusions = [shape for shape in self.shapes if shape.inclusion]
        if any(shape.contains(north_m, east_m) for shape in self.shapes if not shape.inclusion):
            return False
        return not inclusions or any(shape.contains(north_m, east_m) for shape in inclusions)
