"""Faults of what the vehicle tells: its messages say something else than its estimator believes."""

from __future__ import annotations

import math
from dataclasses import replace

from sim_gateway.faults import REPORT, Active, FaultSchedule
from sim_gateway.local_frame import Vector
from sim_gateway.motion_faults import MotionFaults
from sim_gateway.snapshot import Snapshot
from sim_gateway.telemetry import Message

_PLACE = ("LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT")
_MOTION = (*_PLACE, "ATTITUDE", "ATTITUDE_QUATERNION", "HIGHRES_IMU")
_CLOCKS = {"report_backwards": -1.0, "report_clock": 1.0}
_ON_GROUND = 1
_VELOCITY_FLAGS = 2 | 4  # of ESTIMATOR_STATUS
_ACCURACY_M = 0.3


class ReportFaults:
    """Stands between the estimate and telemetry."""

    def __init__(self, schedule: FaultSchedule, motion: MotionFaults) -> None:
        self._schedule = schedule
        self._motion = motion
        self._kept: dict[int, Snapshot] = {}

    def silences(self, name: str, now_s: float) -> bool:
        """Whether a message is not sent now."""
        return name in _MOTION and self._schedule.active("report_silent", now_s) is not None

    def snapshot(self, name: str, now: Snapshot) -> Snapshot:
        """The motion that message `name` tells of instead of `now`."""
        if not self._schedule.has(REPORT):
            return now
        told = now
        for item in self._schedule.group(REPORT, now.time_s):
            told = self._told(item, name, told)
        return told

    def _told(self, item: Active, name: str, now: Snapshot) -> Snapshot:
        kept = self._kept.setdefault(item.number, now)
        if item.kind in _CLOCKS:
            return replace(now, time_s=now.time_s + _CLOCKS[item.kind] * item["step_s"])
        if name not in _PLACE:
            return now
        if item.kind == "report_freeze":
            return replace(now, position=kept.position, velocity=kept.velocity)
        if item.kind == "report_stale":
            return replace(now, position=kept.position, velocity=kept.velocity, time_s=kept.time_s)
        if item.kind == "report_velocity":
            return replace(now, velocity=_moved(now.velocity, item, "m_s"))
        return replace(now, position=_moved(now.position, item, "m")) if item.kind == "report_reset" else now

    def alter(self, name: str, message: Message, now_s: float) -> None:
        """Change the finished message."""
        if name == "ESTIMATOR_STATUS" and self._motion.any:
            message.pos_horiz_accuracy = _ACCURACY_M + self._motion.accuracy_m(now_s)
        for item in self._schedule.group(REPORT, now_s):
            _alter(item, name, message)


def _moved(vector: Vector, item: Active, unit: str) -> Vector:
    x, y, z = vector
    return (x + item[f"x_{unit}"], y + item[f"y_{unit}"], z + item[f"z_{unit}"])


def _alter(item: Active, name: str, message: Message) -> None:
    if item.kind == "report_nan" and name in ("LOCAL_POSITION_NED", "ODOMETRY"):
        message.x = message.vx = math.nan
    elif item.kind == "report_attitude" and name in ("ATTITUDE", "ATTITUDE_QUATERNION"):
        message.roll = message.pitch = message.yaw = message.q1 = math.nan
    elif item.kind == "report_reset" and name == "ODOMETRY":
        message.reset_counter = (message.reset_counter + 1) & 0xFF
    elif item.kind == "report_invalid" and name == "ESTIMATOR_STATUS":
        message.flags &= ~_VELOCITY_FLAGS
    elif item.kind == "report_landed" and name == "EXTENDED_SYS_STATE":
        message.landed_state = _ON_GROUND
