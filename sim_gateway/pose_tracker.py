"""Where a vehicle is now, out of what it reported a moment ago: its messages' stamps on our clock, and its motion since then."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

from sim_gateway.local_frame import Vector
from sim_gateway.snapshot import Quaternion

MESSAGES = ("LOCAL_POSITION_NED", "ATTITUDE", "ATTITUDE_QUATERNION", "ODOMETRY", "TIMESYNC")
_WINDOW_S = 3.0  # of the clock's samples: a simulated vehicle's clock may stand still for a while
_REBOOT_S = 1.0  # a stamp that steps back by more is that of a new start
_FORGET_S = 5.0  # then another vehicle may be followed
_AHEAD_S = 0.05  # a clock that was measured badly puts stamps this far into the future, at most
_BODY_FRD, _NED_FRAMES = 12, (1, 20)


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and velocity NED from the local origin, attitude FRD to NED (w, x, y, z), body rates FRD; age of the report."""

    position_m: Vector
    velocity_m_s: Vector
    attitude: Quaternion
    rates_rad_s: Vector
    age_s: float


class VehicleClock:
    """The vehicle's time on our clock: our time less its own.

    A message cannot arrive before it was stamped, so the least difference seen is an upper bound; an answered TIMESYNC gives
    the difference itself, to half of its round trip. Both are kept for some seconds only, because clocks drift.
    """

    def __init__(self) -> None:
        self._bounds: deque[tuple[float, float]] = deque()
        self._answers: deque[tuple[float, float, float]] = deque()

    def message(self, stamp_s: float, now_s: float) -> None:
        """A message arrived."""
        bound = now_s - stamp_s
        while self._bounds and self._bounds[-1][1] >= bound:
            self._bounds.pop()
        self._bounds.append((now_s, bound))
        while now_s - self._bounds[0][0] > _WINDOW_S:
            self._bounds.popleft()

    def answer(self, sent_s: float, vehicle_s: float, now_s: float) -> None:
        """A TIMESYNC that we sent then was answered."""
        trip_s = now_s - sent_s
        if 0.0 <= trip_s < 1.0:
            self._answers.append((now_s, trip_s, 0.5 * (sent_s + now_s) - vehicle_s))
        while self._answers and now_s - self._answers[0][0] > _WINDOW_S:
            self._answers.popleft()

    @property
    def offset_s(self) -> float:
        """The difference as it is known now; NaN before anything was heard."""
        bound = self._bounds[0][1] if self._bounds else math.nan
        best = min(self._answers, key=lambda answer: answer[1], default=None)
        return bound if best is None else min(best[2], bound) if self._bounds else best[2]


@dataclass(slots=True)
class _Part:
    """Position or attitude as last reported: vehicle's stamp, value, its rate of change (m/s or rad/s)."""

    stamp_s: float = -math.inf
    value: tuple[float, ...] = ()
    rate: tuple[float, ...] = ()


class PoseTracker:
    """Follows the first vehicle that reports a pose. Times are the caller's clock.

    `latency_s`: how much older a report is than its clock tells: a delay that both ways of TIMESYNC do not share, or the
    estimator's own.
    """

    def __init__(self, timeout_s: float = 0.3, latency_s: float = 0.0) -> None:
        self._timeout_s, self._latency_s = timeout_s, latency_s
        self.system_id: int | None = None
        self._heard_s = -math.inf
        self._asked_ns: deque[int] = deque(maxlen=20)
        self._start_over()

    def ask(self, now_s: float) -> int:
        """The number of a TIMESYNC that is sent now, ns: only answers to these count."""
        self._asked_ns.append(round(now_s * 1e9))
        return self._asked_ns[-1]

    def _start_over(self) -> None:
        self._clock = VehicleClock()
        self._place, self._turn = _Part(), _Part()

    def take(self, message: Any, now_s: float) -> None:
        """A message arrived. Numbers that are not finite, other messages and other vehicles are passed over."""
        kind, sender = message.get_type(), message.get_srcSystem()
        if kind not in MESSAGES or not self._follows(sender, now_s):
            return
        if kind == "TIMESYNC":
            if message.tc1 > 0 and message.ts1 in self._asked_ns and self.system_id is not None:
                self._clock.answer(message.ts1 * 1e-9, message.tc1 * 1e-9, now_s)
            return
        stamp_s = message.time_usec * 1e-6 if kind == "ODOMETRY" else message.time_boot_ms * 1e-3
        place, turn = _place_of(kind, message), _turn_of(kind, message)
        if not all(map(math.isfinite, (*(place or ()), *(turn or ())))) or (place is None and turn is None):
            return
        if stamp_s < max(self._place.stamp_s, self._turn.stamp_s) - _REBOOT_S:
            self._start_over()
        self.system_id, self._heard_s = sender, now_s
        self._clock.message(stamp_s, now_s)
        if place is not None and stamp_s > self._place.stamp_s:
            self._place = _Part(stamp_s, place[:3], place[3:])
        if turn is not None and stamp_s > self._turn.stamp_s:
            self._turn = _Part(stamp_s, turn[:4], turn[4:])

    def _follows(self, sender: int, now_s: float) -> bool:
        if self.system_id not in (None, sender) and now_s - self._heard_s > _FORGET_S:
            self.system_id = None
            self._start_over()
        return self.system_id in (None, sender)

    def pose(self, now_s: float) -> Pose | None:
        """Where it is now; None if its position or attitude is older than the time-out, or unknown."""
        if not self._place.value or not self._turn.value:
            return None
        vehicle_s = now_s - self._clock.offset_s + self._latency_s
        place_age_s, turn_age_s = vehicle_s - self._place.stamp_s, vehicle_s - self._turn.stamp_s
        age_s = max(place_age_s, turn_age_s)
        if age_s > self._timeout_s or min(place_age_s, turn_age_s) < -_AHEAD_S:
            return None
        x, y, z = self._place.value
        vx, vy, vz = self._place.rate
        position = (x + vx * place_age_s, y + vy * place_age_s, z + vz * place_age_s)
        p, q, r = self._turn.rate
        return Pose(position, (vx, vy, vz), _turned(self._turn.value, (p, q, r), turn_age_s), (p, q, r), age_s)


def _place_of(kind: str, m: Any) -> tuple[float, ...] | None:
    """Position and velocity NED of a message that has them."""
    if kind == "LOCAL_POSITION_NED":
        return (m.x, m.y, m.z, m.vx, m.vy, m.vz)
    if kind != "ODOMETRY" or m.frame_id not in _NED_FRAMES:
        return None
    velocity = (m.vx, m.vy, m.vz)
    if m.child_frame_id == _BODY_FRD:
        velocity = _from_body(tuple(m.q), velocity)
    return (m.x, m.y, m.z, *velocity)


def _turn_of(kind: str, m: Any) -> tuple[float, ...] | None:
    """Attitude quaternion and body rates of a message that has them; a quaternion that is none becomes NaN."""
    if kind == "ATTITUDE":
        return (*_quaternion(m.roll, m.pitch, m.yaw), m.rollspeed, m.pitchspeed, m.yawspeed)
    if kind == "ATTITUDE_QUATERNION":
        q = (m.q1, m.q2, m.q3, m.q4)
    elif kind == "ODOMETRY" and m.frame_id in _NED_FRAMES:
        q = tuple(m.q)
    else:
        return None
    size = math.sqrt(sum(value * value for value in q))
    scale = 1.0 / size if 0.9 < size < 1.1 else math.nan
    return (*(scale * value for value in q), m.rollspeed, m.pitchspeed, m.yawspeed)


def _quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    w, x, y, z = cr * cp, sr * cp, cr * sp, -sr * sp
    return (cy * w - sy * z, cy * x - sy * y, cy * y + sy * x, cy * z + sy * w)


def _from_body(q: tuple[float, ...], v: Vector) -> Vector:
    """A vector in FRD axes, in NED."""
    w, x, y, z = q
    a, b, c = v
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def _turned(q: tuple[float, ...], rates: Vector, time_s: float) -> Quaternion:
    """The attitude after turning at constant body rates."""
    w, x, y, z = q
    speed = math.sqrt(sum(rate * rate for rate in rates))
    half = 0.5 * speed * time_s
    scale = math.sin(half) / speed if speed > 1e-9 else 0.5 * time_s
    c, (a, b, d) = math.cos(half), (scale * rate for rate in rates)
    return (
        w * c - x * a - y * b - z * d,
        x * c + w * a + y * d - z * b,
        y * c + w * b + z * a - x * d,
        z * c + w * d + x * b - y * a,
    )
