"""What the autopilot says about itself: health and resets of its estimator, the setpoint it follows, how fast it answers.

Sources: ODOMETRY.reset_counter (PX4 adds up the resets of attitude, velocity and position), ESTIMATOR_STATUS (flags and
horizontal accuracy), POSITION_TARGET_LOCAL_NED (the setpoint in force), TIMESYNC answers to our own questions (round trip).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from safety.frames import NedVector

# ESTIMATOR_STATUS_FLAGS: attitude, both velocities, vertical position; and one of the two kinds of horizontal position
_NEEDED, _POSITION = 0x01 | 0x02 | 0x04 | 0x20, 0x08 | 0x10


@dataclass(frozen=True, slots=True)
class Echo:
    """The velocity setpoint that the autopilot follows, and when it said so on our clock."""

    time_s: float
    velocity: NedVector


@dataclass(slots=True)
class SelfReport:
    """The newest of each; None and NaN before the first. Written by MAVSDK's thread, read by the loop's."""

    reset_counter: int | None = None
    estimate_valid: bool | None = None
    accuracy_m: float = math.nan
    echo: Echo | None = None
    round_trip_s: float = math.nan

    def set_estimator(self, flags: int, accuracy_m: float) -> None:
        """From ESTIMATOR_STATUS."""
        self.estimate_valid = flags & _NEEDED == _NEEDED and flags & _POSITION != 0
        self.accuracy_m = accuracy_m
