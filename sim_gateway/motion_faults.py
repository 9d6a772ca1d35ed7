"""Faults of the air, the vehicle and its estimator: they change how it really moves, not only what is told of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_gateway import vehicle_params as vp
from sim_gateway.faults import MOTION, Active, FaultSchedule
from sim_gateway.readings import Motion
from sim_gateway.vehicle import STEP_S

Array = NDArray[np.float64]
_CHUNK_STEPS = 5  # what changes while a fault lasts (a gust, a drift) is renewed every 20 ms


class MotionFaults:
    """What the faults at work make of wind, vehicle, setpoint and estimate at a time."""

    def __init__(self, schedule: FaultSchedule) -> None:
        self._schedule = schedule

    @property
    def any(self) -> bool:
        """Whether there is any such fault."""
        return self._schedule.has(MOTION)

    def steps_alike(self, step: int, wanted: int) -> int:
        """How many of the `wanted` steps from `step` on may be flown under the same faults; on a fixed grid of steps."""
        now_s = step * STEP_S
        until_s = min(self._schedule.next_edge_s(MOTION, now_s) - now_s, wanted * STEP_S)
        to_edge = math.ceil(until_s / STEP_S - 1e-6)
        if self._schedule.group(MOTION, now_s):
            to_edge = min(to_edge, _CHUNK_STEPS - step % _CHUNK_STEPS)
        return max(1, min(wanted, to_edge))

    def wind(self, time_s: float) -> Array:
        """Wind on top of the simulation's own, world frame [3], m/s."""
        total = np.zeros(3)
        for item in self._schedule.group(MOTION, time_s):
            if item.kind in ("wind", "gust"):
                shape = 1.0 if item.kind == "wind" else math.sin(math.pi * _progress(item, _held(item, time_s)))
                total += shape * np.array([item["x_m_s"], item["y_m_s"], item["z_m_s"]])
        return total

    def params(self, row: Array, time_s: float) -> Array:
        """The vehicle's parameter row, weakened."""
        for item in self._schedule.group(MOTION, time_s):
            for index, factor in _weakened(item):
                row = row.copy()
                row[index] *= factor
        return row

    def setpoint(self, velocity: Array, time_s: float) -> Array:
        """The velocity [3] that a loop closed on the wrong estimate really flies, m/s."""
        yaw, error = self._yaw_rad(time_s), self._velocity_m_s(time_s)
        cos, sin = math.cos(yaw), math.sin(yaw)
        x, y = cos * velocity[0] + sin * velocity[1], -sin * velocity[0] + cos * velocity[1]
        return np.array([x, y, velocity[2]]) - error

    def estimate(self, motion: Motion) -> Motion:
        """The estimate with the faults' errors added."""
        time_s = motion.time_s
        position, velocity = self._position_m(time_s), self._velocity_m_s(time_s)
        return replace(
            motion,
            position_m=_sum(motion.position_m, position),
            velocity_m_s=_sum(motion.velocity_m_s, velocity),
            yaw_rad=math.remainder(motion.yaw_rad + self._yaw_rad(time_s), 2.0 * math.pi),
        )

    def accuracy_m(self, time_s: float) -> float:
        """How much worse the estimator believes its position to be (ESTIMATOR_STATUS)."""
        drifting = [item for item in self._schedule.group(MOTION, time_s) if item.kind in ("estimate_drift", "gps_loss")]
        return sum(float(np.linalg.norm(_drift_m(item, time_s))) for item in drifting)

    def _position_m(self, time_s: float) -> Array:
        total = np.zeros(3)
        for item in self._schedule.group(MOTION, time_s):
            if item.kind == "estimate_jump":
                total += np.array([item["x_m"], item["y_m"], item["z_m"]])
            total += _drift_m(item, time_s)
        return total

    def _velocity_m_s(self, time_s: float) -> Array:
        total = np.zeros(3)
        for item in self._schedule.group(MOTION, time_s):
            if item.kind in ("estimate_velocity", "estimate_drift"):
                total += np.array([item["x_m_s"], item["y_m_s"], item["z_m_s"]])
            elif item.kind == "gps_loss":
                total[1] += item["drift_m_s2"] * (_held(item, time_s) - item.begin_s)
        return total

    def _yaw_rad(self, time_s: float) -> float:
        item = self._schedule.active("estimate_yaw", time_s)
        return 0.0 if item is None else math.radians(item["offset_deg"])


def _held(item: Active, time_s: float) -> float:
    """The time at which what changes with time was last renewed: the same however the steps are grouped."""
    grid_s = _CHUNK_STEPS * STEP_S
    return max(item.begin_s, grid_s * math.floor(time_s / grid_s + 1e-6))


def _drift_m(item: Active, time_s: float) -> Array:
    since_s = time_s - item.begin_s
    if item.kind == "estimate_drift":
        return since_s * np.array([item["x_m_s"], item["y_m_s"], item["z_m_s"]])
    if item.kind == "gps_loss":
        return np.array([0.0, 0.5 * item["drift_m_s2"] * since_s * since_s, 0.0])
    return np.zeros(3)


def _weakened(item: Active) -> tuple[tuple[int, float], ...]:
    """(parameter index, factor) of a fault of the vehicle."""
    if item.kind == "motor_weak":
        return ((vp.MOTOR_THRUST_MAX, item["share"]),)
    if item.kind == "sluggish":
        return ((vp.VEL_P_XY, item["share"]), (vp.VEL_I_XY, item["share"]), (vp.VEL_D_XY, item["share"]))
    return ((vp.DRAG_LINEAR, item["factor"]),) if item.kind == "heavy" else ()


def _progress(item: Active, time_s: float) -> float:
    """Share of a fault's time that is over; one without end is at its middle after 1.5 s, and stays there."""
    if math.isinf(item.end_s):
        return min(0.5, (time_s - item.begin_s) / 3.0)
    return (time_s - item.begin_s) / (item.end_s - item.begin_s)


def _sum(point: tuple[float, float, float], error: Array) -> tuple[float, float, float]:
    return point[0] + float(error[0]), point[1] + float(error[1]), point[2] + float(error[2])
