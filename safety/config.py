"""What the safety layer is told: limits, fence, vehicle, and the assumptions under which its guarantee holds.

Every number is finite and checked against the others when the object is made, so that a contradiction is refused on the
ground (faults G1, G2 and G6 of docs/safety.md) and cannot surprise in flight.
"""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from safety.fence import PolygonFence, Ring, polygon_fence
from safety.fence_rules import fence_problem
from safety.monitor_config import MonitorConfig

Positive = Annotated[float, Field(gt=0.0, le=1000.0)]
NotNegative = Annotated[float, Field(ge=0.0, le=1000.0)]
Corner = tuple[float, float, float]
_FORMS = "give min_m and max_m, or floor_m, ceiling_m and inclusion"


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Fence(_Frozen):
    """Where the whole vehicle stays, corridor frame, m: a box, or polygons between a floor and a ceiling.

    Box: two opposite corners (x, y, z). Polygons: `inclusion`, less each of `exclusion`; vertices (x, y) in either order, concave
    allowed. A box is the polygon of its four corners, and is treated as nothing else.
    """

    min_m: Corner | None = None
    max_m: Corner | None = None
    floor_m: float | None = Field(default=None, description="lowest z (corridor z, 0 = ground at the corridor's origin)")
    ceiling_m: float | None = Field(default=None, description="highest z")
    inclusion: Ring | None = Field(default=None, description="the polygon inside which the vehicle stays")
    exclusion: tuple[Ring, ...] = Field(default=(), description="polygons outside which it stays")

    @property
    def polygon(self) -> Ring:
        """Vertices of the inclusion polygon."""
        if self.inclusion is not None:
            return self.inclusion
        (x0, y0, _), (x1, y1, _) = self._box()
        return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))

    @property
    def low_m(self) -> Corner:
        """Lowest x, y and z of the fence: two corners of the box around it, with `high_m`."""
        xs, ys = zip(*self.polygon, strict=True)
        return min(xs), min(ys), self.floor_m if self.floor_m is not None else self._box()[0][2]

    @property
    def high_m(self) -> Corner:
        """Highest x, y and z."""
        xs, ys = zip(*self.polygon, strict=True)
        return max(xs), max(ys), self.ceiling_m if self.ceiling_m is not None else self._box()[1][2]

    def margin_m(self, x: float, y: float, z: float, radius_m: float = 0.0, half_height_m: float = 0.0) -> float:
        """Distance of a point, or of a hull around it, to the fence, negative outside, m."""
        sideways = float(polygon_fence(self.polygon, self.exclusion).signed_margin_m(np.array((x, y))))
        return min(sideways - radius_m, min(z - self.low_m[2], self.high_m[2] - z) - half_height_m)

    def _box(self) -> tuple[Corner, Corner]:
        if self.min_m is None or self.max_m is None:
            raise ValueError(f"fence: {_FORMS}")
        return self.min_m, self.max_m

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        box, polygons = (self.min_m, self.max_m), (self.floor_m, self.ceiling_m, self.inclusion)
        if all(given is None for given in box) and all(given is not None for given in polygons):
            if self.low_m[2] >= self.high_m[2]:
                raise ValueError(f"fence z: floor_m {self.floor_m} must be smaller than ceiling_m {self.ceiling_m}")
        elif self.exclusion or any(given is not None for given in polygons):
            raise ValueError(f"fence: {_FORMS}, not some of both")
        for axis, low, high in zip("xyz", *self._box(), strict=True) if self.inclusion is None else ():
            if low >= high:
                raise ValueError(f"fence {axis}: min_m {low} must be smaller than max_m {high}")
        return self

    @model_validator(mode="after")
    def _polygons_are_simple(self) -> Self:
        problem = fence_problem(self.polygon, self.exclusion)
        if problem is not None:
            raise ValueError(f"fence {problem}")
        return self


class SafetyConfig(_Frozen):
    """Limits, geometry and assumptions of `SafetyFilter`. SI units, corridor frame."""

    fence: Fence

    max_horizontal_speed_m_s: Positive = Field(1.2, description="longest horizontal velocity command")
    max_vertical_speed_m_s: Positive = Field(0.5, description="largest vertical velocity command, either way")
    max_acceleration_m_s2: Positive = Field(10.0, description="how fast a command may grow or turn; slowing down is free")
    max_jerk_m_s3: Positive = Field(150.0, description="how fast that growth may itself grow or turn; easing off is free")
    max_yaw_rate_rad_s: Positive = Field(1.0, description="largest yaw rate command, either way")

    vehicle_radius_m: Positive = Field(0.35, description="A5: the vehicle fits into this horizontal circle")
    vehicle_half_height_m: Positive = Field(0.1, description="the vehicle reaches this far above and below its position")
    margin_m: NotNegative = Field(0.05, description="distance kept beyond everything that is accounted for")

    tick_s: Positive = Field(0.05, description="A3: time between two calls")
    dead_time_s: NotNegative = Field(0.2, description="A3: from sending a command until the vehicle begins to follow it")
    lag_s: Positive = Field(0.6, description="A3: slowest first-order lag of the velocity loop (used to brake)")
    lag_min_s: Positive = Field(0.35, description="A2: fastest lag of the velocity loop (used to speed up)")
    braking_m_s2: Positive = Field(2.0, description="A1: deceleration that is always available")
    position_error_m: NotNegative = Field(0.05, description="A4: bound of the position error, per axis")
    velocity_error_m_s: NotNegative = Field(0.05, description="A4: bound of the velocity error, per axis")
    obstacle_speed_m_s: NotNegative = Field(0.0, description="A6: obstacles move no faster than this; 0 = they stand still")

    scan_stale_s: Positive = Field(0.25, description="a scan older than this is no scan")
    state_stale_s: Positive = Field(0.2, description="a state estimate older than this is no estimate")
    future_tolerance_s: NotNegative = Field(0.02, description="a stamp this far ahead of the clock is still accepted")

    return_speed_m_s: Positive = Field(0.3, description="speed allowed while nearer than the margin or outside the fence")
    hold_off_speed_m_s: NotNegative = Field(0.25, description="speed out of a margin when drift, not a command, leads into it")
    fov_margin_rad: NotNegative = Field(0.1, description="this much of each edge of the field of view counts as unseen")
    memory_s: NotNegative = Field(20.0, description="returns and free space that left the field of view are remembered this long")
    memory_hold_s: NotNegative = Field(0.12, description="a return is kept this long although newer scans look past it")
    fault_hold_s: NotNegative = Field(2.0, description="time until HOLD follows a fault's BRAKE: drift until then stays inside")
    ground_z_m: float = Field(0.0, description="corridor z of the ground; returns this low are the ground, not obstacles")
    monitors: MonitorConfig = Field(MonitorConfig.model_validate({}), description="thresholds of the monitors")
    ground_band_m: NotNegative = Field(0.2, description="height above the ground up to which a tilted beam's return is ground")

    @property
    def delay_s(self) -> float:
        """Total blind time T of the formulas: dead time, one tick of hold, and the lag of the velocity loop, s."""
        return self.dead_time_s + self.tick_s + self.lag_s

    @property
    def drift_m(self) -> float:
        """How much further than estimated a vehicle comes until it stands when its velocity is off by the bound, per axis, m."""
        return self.velocity_error_m_s * self.delay_s

    @property
    def braked_drift_m(self) -> float:
        """The same until HOLD takes over from a BRAKE that a fault has made; nothing leads back from the fence before, m."""
        return self.velocity_error_m_s * max(self.delay_s, self.fault_hold_s)

    @property
    def fault_room_m(self) -> float:
        """What of that is kept for a fault alone: no command enters it, but drift into it need not be led out, m."""
        return self.braked_drift_m - self.drift_m

    @property
    def keep_out_m(self) -> float:
        """Distance the vehicle's centre keeps from an obstacle, before estimate errors are added, m."""
        return self.vehicle_radius_m + self.margin_m

    def eroded_fence(self) -> PolygonFence:
        """The fence as the vehicle's centre must keep to it: radius, errors of the estimate and margin taken off by distance."""
        slack_m = self.position_error_m + self.braked_drift_m + self.margin_m
        return polygon_fence(self.fence.polygon, self.fence.exclusion, self.vehicle_radius_m, slack_m)

    def keep_in_z(self) -> tuple[float, float]:
        """Lowest and highest z of the vehicle's centre, m."""
        height = self.vehicle_half_height_m + self.position_error_m + self.braked_drift_m + self.margin_m
        return self.fence.low_m[2] + height, self.fence.high_m[2] - height

    def stop_distance_m(self, speed_m_s: float) -> float:
        """Distance flown from a speed until standstill, dead time and tick included, m. Grows with the speed."""
        return speed_m_s * (self.dead_time_s + self.tick_s) + braking_distance_m(speed_m_s, self.lag_s, self.braking_m_s2)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for low, high in (
            ("lag_min_s", "lag_s"),
            ("return_speed_m_s", "max_horizontal_speed_m_s"),
            ("hold_off_speed_m_s", "return_speed_m_s"),
            ("hold_off_speed_m_s", "max_vertical_speed_m_s"),
            ("memory_hold_s", "memory_s"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} {getattr(self, low)} must not exceed {high} {getattr(self, high)}")
        low_z, high_z = self.keep_in_z()
        left = "is left of the fence after radius, position error and margin are taken off; widen it"
        if low_z >= high_z:
            raise ValueError(f"fence z: nothing {left}")
        if self.eroded_fence().roomiest() is None:
            raise ValueError(f"fence: no place {left}")
        return self


def braking_distance_m(speed_m_s: float, lag_s: float, braking_m_s2: float) -> float:
    """Distance of a first-order velocity loop with lag tau and deceleration limit b from a speed to zero, m.

    v tau while v <= b tau; above, the loop is saturated first: (v^2 - (b tau)^2) / (2 b) + b tau^2.
    """
    knee = braking_m_s2 * lag_s
    if speed_m_s <= knee:
        return speed_m_s * lag_s
    return (speed_m_s * speed_m_s - knee * knee) / (2.0 * braking_m_s2) + knee * lag_s


def speed_cap_m_s(distance_m: float, delay_s: float, braking_m_s2: float) -> float:
    """Highest speed that can stop within a distance, m/s: min of b (sqrt(T^2 + 2 D / b) - T) and D / (e T); 0 for D <= 0.

    The second term keeps the approach free of overshoot under the delay. Needed, not sufficient in two dimensions:
    the brake tube decides, this is its quick bound and its oracle in tests.
    """
    if distance_m <= 0.0:
        return 0.0
    parabola = braking_m_s2 * (math.sqrt(delay_s * delay_s + 2.0 * distance_m / braking_m_s2) - delay_s)
    return min(parabola, distance_m / (math.e * delay_s))
