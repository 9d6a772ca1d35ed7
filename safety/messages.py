"""Messages of one 20 Hz tick. Frozen, slotted, no behaviour: what flows between sensor, policy, filter and link.

Times are seconds on one monotonic clock (the caller's). Vectors are in the corridor frame; see `safety.frames`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.frames import CorridorVector


@dataclass(frozen=True, slots=True)
class LidarScan:
    """One horizontal scan, beams ordered by increasing bearing (0 ahead, positive left).

    `time_s`: when it was measured (not when it arrived). `ranges_m`: float32 [beams]; `inf` = nothing
    within range, `nan` = unknown, 0 = nearer than the sensor can measure.
    """

    time_s: float
    ranges_m: NDArray[np.float32]
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Estimated motion in the corridor frame. `yaw_rad` is counter-clockwise from the corridor's x axis.

    `roll_rad` positive right side down, `pitch_rad` positive nose up (aerospace signs, as PX4 reports them).
    """

    time_s: float
    position: CorridorVector
    velocity: CorridorVector
    acceleration: CorridorVector
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    yaw_rate_rad_s: float


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Wanted velocity in the corridor frame, m/s, and yaw rate, rad/s, counter-clockwise positive."""

    velocity: CorridorVector
    yaw_rate_rad_s: float


BRAKE = VelocityCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)


@dataclass(frozen=True, slots=True)
class Intervention:
    """One rule that changed or judged the command. `value` and `limit` are in the rule's own unit."""

    rule: str
    value: float
    limit: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Why the command sent is what it is.

    `braking`: the wanted command was refused and zero velocity is sent. `fault`: the rule that found the input or the filter
    itself unfit (escalates, see `safety.escalation`); None when braking is for a fence or an obstacle, or not at all.
    """

    braking: bool
    interventions: tuple[Intervention, ...] = ()
    scan_age_s: float = float("nan")
    state_age_s: float = float("nan")
    clearance_m: float = float("nan")
    fence_margin_m: float = float("nan")
    fault: str | None = None


@dataclass(frozen=True, slots=True)
class SafeCommand:
    """What may go to the vehicle: finite, inside every limit."""

    velocity: CorridorVector
    yaw_rate_rad_s: float
