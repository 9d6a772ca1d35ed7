"""The usual case, judged by bounds alone: a box around the tubes of the wanted command and of braking, with nothing in its way.

What is claimed here the exact way (safety.shield) would find as well: with the vehicle clear of all margins and the box clear
of points, fence and unseen cells, braking sets no bound that the wanted command could break. Where a bound does not show it, the
exact way decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safety.braking import Start, slow_after_s, stop_gain_s, stop_time_s
from safety.config import SafetyConfig
from safety.fence_tube import Room
from safety.frames import CorridorVector

Floats = NDArray[np.float64]
ROUNDING_M = 1e-6  # far more than what the exact way and the bounds differ by


@dataclass(frozen=True, slots=True)
class TubeBox:
    """Two corners (x, y, z) of a box around the vehicle and all tubes of a command and of braking, corridor frame, m."""

    low_m: tuple[float, ...]
    high_m: tuple[float, ...]

    @staticmethod
    def around(position: CorridorVector, start: Start, command: CorridorVector, config: SafetyConfig) -> TubeBox:
        """Per axis a vehicle is never faster than at the start or than the command, for a tick and the time of braking."""
        (x, y, z), wanted = (position.x, position.y, position.z), (command.x, command.y, command.z)
        slow, fast = start.velocity_m_s.tolist()
        time_s = config.tick_s + stop_time_s(max(math.hypot(*slow), math.hypot(*fast), math.hypot(*wanted)), config)
        low, high = [], []
        for here, begin, other, u, v, w in zip((x, y, z), *start.position_m.tolist(), slow, fast, wanted, strict=True):
            low.append(min(here, begin, other, min(begin, other) + min(u, v, w) * time_s) - ROUNDING_M)
            high.append(max(here, begin, other, max(begin, other) + max(u, v, w) * time_s) + ROUNDING_M)
        return TubeBox(tuple(low), tuple(high))

    def apart_from(self, x_m: Floats, y_m: Floats, kept_m: Floats) -> bool:
        """Whether points [k] are further from the box than what is kept to each."""
        (left, below, _), (right, above, _) = self.low_m, self.high_m
        dx = np.minimum(np.maximum(x_m, left), right) - x_m
        dy = np.minimum(np.maximum(y_m, below), above) - y_m
        return bool(np.count_nonzero(dx * dx + dy * dy > kept_m * kept_m) == x_m.shape[0])  # what is not a number is not apart

    def inside(self, position: CorridorVector, room: Room, climb_m: float) -> bool:
        """Whether no place of the box is further from the vehicle than its room to the fence, sideways and upright.

        `climb_m`: what else is kept to floor and ceiling.
        """
        (left, below, bottom), (right, above, top) = self.low_m, self.high_m
        furthest = math.hypot(max(position.x - left, right - position.x), max(position.y - below, above - position.y))
        down, up = position.z - bottom + climb_m, top - position.z + climb_m
        return furthest < room.sideways_m and down < room.below_m and up < room.above_m


def kept_to_points_m(box: TubeBox, config: SafetyConfig) -> float:
    """Distance from a tube at which a point is never too near, whatever way the vehicle takes in the box, m."""
    blind_s, lag_s = config.dead_time_s + config.tick_s, config.lag_s
    errors_m = config.velocity_error_m_s * (blind_s + lag_s)
    if config.obstacle_speed_m_s > 0.0:
        longest = math.dist(box.low_m, box.high_m)
        errors_m += config.obstacle_speed_m_s * (blind_s + float(slow_after_s(longest, config)))
    return config.keep_out_m + errors_m + ROUNDING_M


def climb_room_m(command: CorridorVector, config: SafetyConfig) -> float:
    """Room to floor and ceiling at which braking does not bound a vertical command, m."""
    return abs(command.z) * stop_gain_s(config) + ROUNDING_M
