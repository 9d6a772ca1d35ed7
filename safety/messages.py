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
    `reset_counter`: how often the estimator has set its state anew, modulo 256; None = not told.
    """

    time_s: float
    position: CorridorVector
    velocity: CorridorVector
    acceleration: CorridorVector
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    yaw_rate_rad_s: float
    reset_counter: int | None = None


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Wanted velocity in the corridor frame, m/s, and yaw rate, rad/s, counter-clockwise positive."""

    velocity: CorridorVector
    yaw_rate_rad_s: float


BRAKE = VelocityCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)


@dataclass(frozen=True, slots=True)
class Health:
    """What only the loop knows about a tick. NaN and None = unknown, which accuses nobody.

    `lateness_s`: how late the tick began. `link_delay_s`: newest measured round trip to the autopilot. `battery_fraction`: 0..1.
    `in_control`: False once a pilot, PX4 or a restart took the vehicle. `landed`: what the autopilot says. `boots`: restarts of
    the autopilot seen so far. `estimate_valid`: its estimator's own flags; `accuracy_m`: its own horizontal accuracy, one sigma.
    `echo`: the velocity setpoint that the autopilot says it follows, corridor frame; `echo_time_s`: when it said so.
    `inference_s`: time the policy took for this tick's command; `hidden_norm`: of its recurrent state.
    `overruled`: the loop sent zero velocity instead of what the filter let out last.
    """

    lateness_s: float = float("nan")
    link_delay_s: float = float("nan")
    battery_fraction: float = float("nan")
    in_control: bool | None = None
    landed: bool | None = None
    boots: int | None = None
    estimate_valid: bool | None = None
    accuracy_m: float = float("nan")
    echo: CorridorVector | None = None
    echo_time_s: float = float("nan")
    inference_s: float = float("nan")
    hidden_norm: float = float("nan")
    overruled: bool = False


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
