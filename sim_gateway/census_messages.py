"""Messages that PX4 sends beside the flight data: navigation target, remote id, integrity of GNSS.

Filled as far as a simulated vehicle knows; fields that it cannot know carry MAVLink's value for "unknown".
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot import Autopilot
from sim_gateway.local_frame import LocalFrame, Vector
from sim_gateway.newer_messages import CurrentEventSequence, LinkNodeStatus, TimeEstimateToTarget

_ID_UNUSED = [0] * 20
_SPEED_LIMIT_CM_S, _CLIMB_LIMIT_CM_S = 25425, 6200  # largest values that remote id can say
_NO_ALTITUDE_M = -1000.0


def _place(frame: LocalFrame, ned: Vector) -> tuple[int, int, float]:
    latitude, longitude, altitude = frame.to_global(ned)
    return round(latitude * 1e7), round(longitude * 1e7), altitude


def position_target_global_int(boot_ms: int, pilot: Autopilot, frame: LocalFrame) -> Any:
    """Where a mode with a position target is going."""
    target = pilot.target
    zero_or = tuple(value if math.isfinite(value) else 0.0 for value in target.velocity)
    yaw = target.yaw_rad if math.isfinite(target.yaw_rad) else 0.0
    place = _place(frame, target.position)
    return mav.MAVLink_position_target_global_int_message(
        boot_ms, mav.MAV_FRAME_GLOBAL, 0, *place, *zero_or, 0.0, 0.0, 0.0, yaw, 0.0
    )


def time_estimate_to_target() -> Any:
    """Unknown: there is no estimate."""
    return TimeEstimateToTarget(safe_return=-1, land=-1, mission_next_item=-1, mission_end=-1, commanded_action=-1)


def link_node_status(boot_us: int) -> Any:
    """A link without buffers, retries or losses."""
    rates = {"tx_buf": 0, "rx_buf": 0, "tx_rate": 0, "rx_rate": 0, "rx_parse_err": 0, "tx_overflows": 0, "rx_overflows": 0}
    counts = {"messages_sent": 0, "messages_received": 0, "messages_lost": 0}
    return LinkNodeStatus(timestamp=boot_us, **rates, **counts)


def current_event_sequence() -> Any:
    """There has been no event: numbering starts below zero, as PX4's does."""
    return CurrentEventSequence(sequence=0xFFFF, flags=0)


def gnss_integrity() -> Any:
    """A receiver that reports none of it."""
    hfom_vfom_unknown = (65535, 65535)
    return mav.MAVLink_gnss_integrity_message(0, 0, 0, 0, 0, 0, *hfom_vfom_unknown, 255, 255, 255, 255)


def open_drone_id_location(pilot: Autopilot, frame: LocalFrame, position: Vector, velocity: Vector) -> Any:
    """Remote id: where and how fast."""
    latitude, longitude, altitude = _place(frame, position)
    north, east, down = velocity
    course = round(math.degrees(math.atan2(east, north)) * 100) % 36000
    speed = min(round(100 * math.hypot(north, east)), _SPEED_LIMIT_CM_S)
    climb = min(max(round(-100 * down), -_CLIMB_LIMIT_CM_S), _CLIMB_LIMIT_CM_S)
    status = mav.MAV_ODID_STATUS_GROUND if pilot.landed else mav.MAV_ODID_STATUS_AIRBORNE
    height = pilot.home[2] - position[2]
    return mav.MAVLink_open_drone_id_location_message(
        *(0, 0, _ID_UNUSED, status, course, speed, climb, latitude, longitude, _NO_ALTITUDE_M, altitude),
        *(mav.MAV_ODID_HEIGHT_REF_OVER_TAKEOFF, height, 0, 0, 0, 0, pilot.now_s % 3600.0, 0),
    )


def open_drone_id_system(pilot: Autopilot, frame: LocalFrame) -> Any:
    """Remote id: the operator stands at home."""
    latitude, longitude, altitude = _place(frame, pilot.home)
    kind, undeclared = mav.MAV_ODID_OPERATOR_LOCATION_TYPE_TAKEOFF, mav.MAV_ODID_CLASSIFICATION_TYPE_UNDECLARED
    area = (1, 0, _NO_ALTITUDE_M, _NO_ALTITUDE_M)
    return mav.MAVLink_open_drone_id_system_message(
        0, 0, _ID_UNUSED, kind, undeclared, latitude, longitude, *area, 0, 0, altitude, round(pilot.now_s)
    )
