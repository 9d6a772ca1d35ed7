"""PX4's mode numbers and the few MAVLink constants `flight` uses (PX4 v1.17, MAVLink common)."""

from __future__ import annotations

from enum import IntEnum

AUTOPILOT_PX4 = 12
AUTOPILOT_COMPONENT = 1
MODE_FLAG_ARMED = 0x80
LANDED_STATE_ON_GROUND = 1
RESULT_ACCEPTED = 0
RESULT_NAMES = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}

COMMAND_DO_SET_MODE = 176
COMMAND_SET_MESSAGE_INTERVAL = 511
COMMAND_REQUEST_MESSAGE = 512
MODE_FLAG_CUSTOM = 1

MESSAGE_ID = {
    "ATTITUDE": 30,
    "LOCAL_POSITION_NED": 32,
    "POSITION_TARGET_LOCAL_NED": 85,
    "HIGHRES_IMU": 105,
    "AUTOPILOT_VERSION": 148,
    "ESTIMATOR_STATUS": 230,
    "OBSTACLE_DISTANCE": 330,
    "ODOMETRY": 331,
    "CURRENT_MODE": 436,
}

GRAVITY_M_S2 = 9.80665


class FlightMode(IntEnum):
    """PX4 custom modes as (main | sub << 8), the upper half of HEARTBEAT.custom_mode."""

    MANUAL = 1
    ALTCTL = 2
    POSCTL = 3
    MISSION = 4 | 4 << 8
    TAKEOFF = 4 | 2 << 8
    HOLD = 4 | 3 << 8
    RTL = 4 | 5 << 8
    LAND = 4 | 6 << 8
    ACRO = 5
    OFFBOARD = 6
    STABILIZED = 7

    @property
    def main(self) -> int:
        """PX4's main mode number."""
        return self.value & 0xFF

    @property
    def sub(self) -> int:
        """PX4's sub mode number, 0 where there is none."""
        return self.value >> 8


class LossAction(IntEnum):
    """COM_OBL_RC_ACT: what PX4 does by itself when the setpoint stream stops. Only the two that this project uses."""

    LAND = 4
    HOLD = 5


def mode_of(custom_mode: int) -> int:
    """HEARTBEAT.custom_mode to the numbering of `FlightMode` (unknown modes keep their number)."""
    return (custom_mode >> 16) & 0xFFFF


def mode_name(mode: int | None) -> str:
    """A mode for people: its name, or its numbers when PX4 has one that is not listed here."""
    if mode is None:
        return "unknown"
    try:
        return FlightMode(mode).name
    except ValueError:
        return f"mode {mode & 0xFF}.{mode >> 8}"
