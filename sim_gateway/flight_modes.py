"""PX4 flight modes and how HEARTBEAT and CURRENT_MODE encode them.

PX4 packs its own mode number into the 32-bit `custom_mode`: main mode in bits 16 to 23, sub mode in bits 24 to 31.
Values as recorded from PX4 v1.17 (px4_reference/modes.json).
"""

from __future__ import annotations

from enum import Enum, IntEnum

AUTO_MAIN_MODE = 4
# MAV_SEVERITY
EMERGENCY, CRITICAL, ERROR, WARNING, INFO = 0, 2, 3, 4, 6

# MAV_MODE_FLAG bits of HEARTBEAT.base_mode
_CUSTOM, _AUTO, _GUIDED, _STABILIZE, _MANUAL, _ARMED = 1, 4, 8, 16, 64, 128


class FlightMode(Enum):
    """A mode as (main mode, sub mode, MAV_STANDARD_MODE, base_mode bits without the armed bit, name in PX4's messages)."""

    MANUAL = (1, 0, 0, _CUSTOM | _STABILIZE | _MANUAL, "Manual")
    ALTCTL = (2, 0, 0, _CUSTOM | _STABILIZE | _MANUAL, "Altitude")
    POSCTL = (3, 0, 0, _CUSTOM | _STABILIZE | _MANUAL, "Position")
    TAKEOFF = (AUTO_MAIN_MODE, 2, 8, _CUSTOM | _AUTO | _GUIDED | _STABILIZE, "Takeoff")
    LOITER = (AUTO_MAIN_MODE, 3, 0, _CUSTOM | _AUTO | _GUIDED | _STABILIZE, "Hold")
    MISSION = (AUTO_MAIN_MODE, 4, 6, _CUSTOM | _AUTO | _GUIDED | _STABILIZE, "Mission")
    RTL = (AUTO_MAIN_MODE, 5, 5, _CUSTOM | _AUTO | _GUIDED | _STABILIZE, "Return")
    LAND = (AUTO_MAIN_MODE, 6, 7, _CUSTOM | _AUTO | _GUIDED | _STABILIZE, "Land")
    OFFBOARD = (6, 0, 0, _CUSTOM | _STABILIZE, "Offboard")

    def __init__(self, main: int, sub: int, standard_mode: int, base_bits: int, label: str) -> None:
        self.main = main
        self.sub = sub
        self.standard_mode = standard_mode
        self.base_bits = base_bits
        self.label = label

    @property
    def custom_mode(self) -> int:
        """The value of HEARTBEAT.custom_mode."""
        return self.main << 16 | self.sub << 24

    @property
    def px4_name(self) -> str:
        """The name used in the recordings, e.g. `AUTO.LOITER`."""
        return f"AUTO.{self.name}" if self.main == AUTO_MAIN_MODE else self.name

    @property
    def needs_pilot(self) -> bool:
        """Whether the mode is flown with sticks, which a vehicle without manual input refuses."""
        return self.main in (1, 2, 3)

    def base_mode(self, armed: bool) -> int:
        """The value of HEARTBEAT.base_mode."""
        return self.base_bits | (_ARMED if armed else 0)

    @classmethod
    def from_numbers(cls, main: int, sub: int) -> FlightMode | None:
        """The mode of a main and sub mode number, or None if the gateway has no such mode."""
        return next((mode for mode in cls if (mode.main, mode.sub) == (main, sub)), None)

    @classmethod
    def from_custom_mode(cls, custom_mode: int) -> FlightMode | None:
        """The mode of a `custom_mode` value, or None if the gateway has no such mode."""
        return cls.from_numbers(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class SystemStatus(IntEnum):
    """MAV_STATE as PX4 uses it: UNINIT while a disarmed vehicle could not arm, CRITICAL while a failsafe flies it."""

    UNINIT = 0
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
