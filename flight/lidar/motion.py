"""The vehicle's own motion while a scan is taken, and how it is taken out again."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.messages import VehicleState

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """Horizontal motion in the heading frame: m/s ahead and left, rad/s counter-clockwise."""

    ahead_m_s: float
    left_m_s: float
    yaw_rate_rad_s: float


def body_motion(state: VehicleState | None) -> BodyMotion | None:
    """The estimate's motion as seen from the vehicle; None without an estimate, or when it is not finite."""
    if state is None:
        return None
    cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    x, y = state.velocity.x, state.velocity.y
    motion = BodyMotion(cos * x + sin * y, cos * y - sin * x, state.yaw_rate_rad_s)
    finite = math.isfinite(motion.ahead_m_s + motion.left_m_s + motion.yaw_rate_rad_s)
    return motion if finite else None


def seen_later(x_m: Floats, y_m: Floats, later_s: Floats, motion: BodyMotion) -> tuple[Floats, Floats]:
    """Points [n] seen from the vehicle at some time, as they lie to it `later_s` [n] afterwards (negative: before).

    Constant velocity and yaw rate in between; the chord of the arc is taken along its middle heading.
    """
    turned = motion.yaw_rate_rad_s * later_s
    cos_half, sin_half = np.cos(0.5 * turned), np.sin(0.5 * turned)
    x = x_m - (cos_half * motion.ahead_m_s - sin_half * motion.left_m_s) * later_s
    y = y_m - (sin_half * motion.ahead_m_s + cos_half * motion.left_m_s) * later_s
    cos, sin = np.cos(turned), np.sin(turned)
    return cos * x + sin * y, cos * y - sin * x
