"""What the guard sends and when: a state machine without clock and without I/O.

    IDLE --engage--> FOLLOW --no fresh command for beat_s--> BRAKE --brake_s later--> SILENT
                       ^---------- a fresh command ------------'

FOLLOW sends each command at once, one message per command, only while it is young. BRAKE sends zero velocity. SILENT is final
until the next `engage`, which only a new engagement of OFFBOARD does. Any sign that the vehicle is no longer ours (its own mode
report, the loop's `disengage`) leads to silence directly, without a braking message: pilot first.

Times are seconds of one monotonic clock. A guard that was itself held up finds its deadlines passed and skips what it missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from flight.guard.wire import ModeReport

OFFBOARD = 6
Velocity = tuple[float, float, float, float]
STILL: Velocity = (0.0, 0.0, 0.0, 0.0)


class State(IntEnum):
    """What the guard is doing."""

    IDLE = 0
    FOLLOW = 1
    BRAKE = 2
    SILENT = 3


class Reason(IntEnum):
    """Why the guard brakes or is silent."""

    NONE = 0
    MISSED_BEAT = 1  # no fresh command in time
    MODE_CHANGED = 2  # the vehicle left OFFBOARD
    DISARMED = 3
    ORPHANED = 4  # the loop's process is gone
    TERMINATED = 5  # SIGTERM to the guard: the flight must end, the way to the ground stays open
    DISENGAGED = 6


@dataclass(frozen=True, slots=True)
class Timing:
    """Bounds in s. `max_age_s`: of a command that may still go out. `beat_s`: without a fresh command until the guard brakes."""

    max_age_s: float = 0.1
    beat_s: float = 0.1
    brake_s: float = 0.5
    period_s: float = 0.05


@dataclass(frozen=True, slots=True)
class Command:
    """One setpoint: velocity north, east, down (m/s) and yaw rate (rad/s, clockwise); `stamp_s`: when the loop decided it."""

    engagement: int
    sequence: int
    stamp_s: float
    setpoint: Velocity


class GuardCore:
    """One guard. Every method takes the time of the call, which never runs back."""

    def __init__(self, timing: Timing | None = None) -> None:
        self.timing = timing or Timing()
        self.state = State.IDLE
        self.reason = Reason.NONE
        self.engagement = 0
        self.braked = 0
        self.orphaned = False
        self._terminated = False
        self._sequence = -1
        self._stamp_s = self._fresh_s = -math.inf
        self._next_brake_s = math.inf
        self._in_offboard = self._was_armed = False

    # -- what the loop wants

    def engage(self, engagement: int) -> None:
        """Follow commands of this engagement; its number must be higher than all before."""
        if engagement <= self.engagement or self._terminated or self.orphaned:
            return
        self.engagement = engagement
        self.state, self.reason = State.FOLLOW, Reason.NONE
        self._sequence, self._stamp_s, self._fresh_s = -1, -math.inf, math.inf
        self._in_offboard = self._was_armed = False

    def disengage(self) -> None:
        """Silent at once: the loop stops on purpose."""
        self._fall_silent(Reason.DISENGAGED)

    def admit(self, command: Command, now_s: float) -> bool:
        """Whether this command may go out now. Call directly before the send; True counts it as sent."""
        self.advance(now_s)
        age_s = now_s - command.stamp_s
        fresh = 0.0 <= age_s <= self.timing.max_age_s and command.stamp_s > self._stamp_s and command.sequence > self._sequence
        open_ = self.state in (State.FOLLOW, State.BRAKE) and not self.orphaned and command.engagement == self.engagement
        if not (open_ and fresh and all(map(math.isfinite, command.setpoint))):
            return False
        if self._terminated and command.setpoint != STILL:
            return False
        self._sequence, self._stamp_s, self._fresh_s = command.sequence, command.stamp_s, now_s
        self._next_brake_s = now_s + self.timing.beat_s
        if not self._terminated:
            self.state, self.reason = State.FOLLOW, Reason.NONE
        return True

    # -- what happens

    def advance(self, now_s: float) -> None:
        """Let time pass: a missed beat brakes, a brake that has lasted is followed by silence."""
        since_s = now_s - self._fresh_s
        if self.state is State.FOLLOW and since_s > self.timing.beat_s:
            self._brake(now_s, Reason.MISSED_BEAT)
        if self.state is State.BRAKE and since_s > self.timing.beat_s + self.timing.brake_s:
            self._fall_silent(self.reason)

    def brake_due(self, now_s: float) -> bool:
        """Whether a message of zero velocity is due now. True counts it as sent; what was missed is not made up for."""
        self.advance(now_s)
        if self.state is not State.BRAKE or now_s < self._next_brake_s:
            return False
        self._next_brake_s = now_s + self.timing.period_s
        self.braked += self._in_offboard
        return self._in_offboard  # before OFFBOARD there is nothing to brake, and a pilot may be flying

    def next_s(self) -> float:
        """When to call `brake_due` next; infinity when there is nothing to wait for."""
        if self.state is State.FOLLOW:
            return self._fresh_s + self.timing.beat_s
        if self.state is State.BRAKE:
            return min(self._next_brake_s, self._fresh_s + self.timing.beat_s + self.timing.brake_s)
        return math.inf

    def heard(self, report: ModeReport) -> None:
        """The vehicle's own word: once in OFFBOARD, any other mode or a disarming ends the engagement without another message."""
        if self.state not in (State.FOLLOW, State.BRAKE):
            return
        if report.main_mode == OFFBOARD:
            self._in_offboard = True
        elif self._in_offboard:
            self._fall_silent(Reason.MODE_CHANGED)
        if report.armed:
            self._was_armed = True
        elif report.armed is False and self._was_armed:
            self._fall_silent(Reason.DISARMED)

    def orphan(self, now_s: float) -> None:
        """The loop's process is gone: brake, then silence."""
        self.orphaned = True
        self._brake_now(now_s, Reason.ORPHANED)

    def terminate(self, now_s: float) -> None:
        """Asked to end: from now on nothing but zero velocity, as long as the loop streams it (it lands) or the brake lasts."""
        self._terminated = True
        self._brake_now(now_s, Reason.TERMINATED)

    def overran(self, command: Command, now_s: float) -> bool:
        """After a send: whether the process was held up between check and send. Then one zero must follow, and silence."""
        if now_s - command.stamp_s <= self.timing.max_age_s + self.timing.period_s or command.setpoint == STILL:
            return False
        self._fall_silent(Reason.MISSED_BEAT)
        return True

    @property
    def finished(self) -> bool:
        """Whether nothing more will ever be sent and nobody is served."""
        return self.orphaned and self.state in (State.IDLE, State.SILENT)

    def _brake_now(self, now_s: float, reason: Reason) -> None:
        self.advance(now_s)
        if self.state in (State.FOLLOW, State.BRAKE):
            self._brake(now_s, reason)
            self._fresh_s = now_s - self.timing.beat_s

    def _brake(self, now_s: float, reason: Reason) -> None:
        self.state, self.reason = State.BRAKE, reason
        self._next_brake_s = now_s

    def _fall_silent(self, reason: Reason) -> None:
        if self.state in (State.FOLLOW, State.BRAKE):
            self.state, self.reason = State.SILENT, reason
