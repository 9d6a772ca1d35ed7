"""The pilot's sticks (MANUAL_CONTROL): what they say now, whether they are there at all, and when they count as moved.

PX4 takes sticks as moved by how fast they move, not by where they are: in override.json a step of 20 % takes over although
COM_RC_STICK_OV is 30 % (per second), and centred sticks at 25 Hz never do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

MIN_INTERVAL_S = 0.004


@dataclass(frozen=True, slots=True)
class Sticks:
    """Stick positions, -1 to 1: `ahead` (pitch forward), `right` (roll), `up` (throttle, 0 = hover), `turn` (yaw, clockwise)."""

    time_s: float = -math.inf
    ahead: float = 0.0
    right: float = 0.0
    up: float = 0.0
    turn: float = 0.0

    @property
    def axes(self) -> tuple[float, float, float, float]:
        """The four positions."""
        return self.ahead, self.right, self.up, self.turn


def from_manual_control(time_s: float, x: int, y: int, z: int, r: int) -> Sticks | None:
    """MANUAL_CONTROL's axes (x, y, r -1000..1000; z 0..1000) as sticks; None when one is not given or out of range."""
    if not (all(-1000 <= value <= 1000 for value in (x, y, r)) and 0 <= z <= 1000):
        return None
    return Sticks(time_s, x / 1000.0, y / 1000.0, (z - 500) / 500.0, r / 1000.0)


def moved(before: Sticks, after: Sticks, threshold_per_s: float) -> bool:
    """Whether any stick moves faster than `threshold_per_s` (full deflections a second) from one message to the next."""
    if not math.isfinite(before.time_s):
        return False
    interval_s = max(after.time_s - before.time_s, MIN_INTERVAL_S)
    return any(abs(b - a) / interval_s > threshold_per_s for a, b in zip(before.axes, after.axes, strict=True))


def shaped(axis: float, dead_zone: float, expo: float) -> float:
    """A stick as PX4's position mode takes it: nothing inside the dead zone, then a mix of straight and cubic."""
    beyond = max(abs(axis) - dead_zone, 0.0) / max(1.0 - dead_zone, 1e-3)
    return math.copysign((1.0 - expo) * beyond + expo * beyond**3, axis)
