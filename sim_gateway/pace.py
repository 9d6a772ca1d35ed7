"""Vehicle time against the clock: when the next step is due, and what happens on a computer that cannot keep up."""

from __future__ import annotations

import math

GIVE_UP_S = 0.5
"""A backlog this long is given up at once."""

PATIENCE_S = 0.1
"""Shorter ones may be worked off for this long; what was never worked off meanwhile is given up as well."""

_TOLERATED_S = 0.01


class Pace:
    """Vehicle time follows the clock, `speed` times as fast. Times of the clock are the caller's, s.

    To give a backlog up means that vehicle time stood still for that long. Otherwise a computer that is a little too slow would
    leave the vehicle ever later than the clock, and everything measured on it would look old.
    """

    def __init__(self, speed: float, now_s: float) -> None:
        self.dropped_s = 0.0
        self._speed = speed
        self._origin_s = now_s
        self._least_s = math.inf
        self._judged_s = now_s

    def behind_s(self, now_s: float, vehicle_s: float) -> float:
        """Vehicle seconds that are due but not yet simulated, less what is given up now."""
        behind_s = self._behind_s(now_s, vehicle_s)
        self._least_s = min(self._least_s, behind_s)
        if behind_s > GIVE_UP_S * self._speed:
            self._drop(behind_s, now_s)
        elif now_s - self._judged_s >= PATIENCE_S:
            self._drop(self._least_s if self._least_s > _TOLERATED_S * self._speed else 0.0, now_s)
        return self._behind_s(now_s, vehicle_s)

    def due_s(self, vehicle_s: float) -> float:
        """When on the clock a vehicle time is due."""
        return self._origin_s + vehicle_s / self._speed

    def _behind_s(self, now_s: float, vehicle_s: float) -> float:
        return (now_s - self._origin_s) * self._speed - vehicle_s

    def _drop(self, backlog_s: float, now_s: float) -> None:
        self._origin_s += backlog_s / self._speed
        self.dropped_s += backlog_s / self._speed
        self._least_s, self._judged_s = math.inf, now_s
