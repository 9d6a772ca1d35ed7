"""What follows a fault: FLY -> BRAKE -> HOLD -> LAND -> YIELD, as data. The loop asks once per tick and does what `level` says.

* A fault (`Verdict.fault`) makes BRAKE at once, or the level that `safety.reactions` gives it. A fault that lasts
  `hold_after_s` makes HOLD; HOLD that lasts `land_after_s` with the fault still there makes LAND.
  A fault that leaves no usable estimate makes LAND instead of HOLD, which needs one.
* BRAKE ends by itself only after `healthy_s` without any fault: that is a pause, not a decision. HOLD and LAND never end by
  themselves: only `re_engage`, an operator's act, leaves them. YIELD ends never: the vehicle is somebody else's.
* Braking for an obstacle or the fence is no fault; only when it lasts `blocked_hold_s` without a break does it make HOLD.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field

from safety.config import Positive
from safety.messages import Verdict
from safety.reactions import Level, level_of

__all__ = ["ESTIMATE_FAULTS", "EscalationConfig", "EscalationState", "Level", "escalate", "re_engage"]

ESTIMATE_FAULTS = frozenset(
    {
        "state_missing",
        "state_stale",
        "state_not_finite",
        "state_future",
        "state_backwards",
        "estimate_frozen",
        "velocity_mismatch",
    }
)


class EscalationConfig(BaseModel):
    """Times of the escalation, s."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    hold_after_s: Positive = Field(2.0, description="a fault that lasts this long makes HOLD (LAND without an estimate)")
    land_after_s: Positive = Field(10.0, description="a fault that outlasts HOLD by this long makes LAND")
    healthy_s: Positive = Field(1.0, description="time without fault after which BRAKE ends")
    blocked_hold_s: Positive = Field(15.0, description="unbroken braking for an obstacle or the fence that makes HOLD")


@dataclass(frozen=True, slots=True)
class EscalationState:
    """Where the escalation stands. Times on the caller's clock; None = not so at present."""

    level: Level = Level.FLY
    level_since_s: float | None = None
    fault_since_s: float | None = None
    fault_last_s: float | None = None
    blocked_since_s: float | None = None
    cause: str | None = None


def escalate(state: EscalationState, verdict: Verdict, now_s: float, config: EscalationConfig) -> EscalationState:
    """The state after one tick. Its level is never lower than before, but for BRAKE that ends after `healthy_s`."""
    noted = _note(state, verdict, now_s)
    level = max(_wanted(noted, verdict, now_s, config), _kept(noted, now_s, config))
    if level == state.level:
        return noted
    cause = None if level == Level.FLY else verdict.fault or noted.cause or "blocked"
    return dataclasses.replace(noted, level=level, level_since_s=now_s, cause=cause)


def re_engage(state: EscalationState, now_s: float, config: EscalationConfig) -> EscalationState:
    """An operator's decision to fly on: FLY when no fault was seen for `healthy_s`, else the state as it is. YIELD is final."""
    if state.level == Level.YIELD:
        return state
    if state.fault_last_s is not None and now_s - state.fault_last_s < config.healthy_s:
        return state
    return EscalationState(Level.FLY, now_s)


def _note(state: EscalationState, verdict: Verdict, now_s: float) -> EscalationState:
    """Since when there is a fault, when the last one was, since when the way is blocked."""
    fault, blocked = verdict.fault is not None, verdict.fault is None and verdict.braking
    return dataclasses.replace(
        state,
        fault_since_s=(now_s if state.fault_since_s is None else state.fault_since_s) if fault else None,
        fault_last_s=now_s if fault else state.fault_last_s,
        blocked_since_s=(now_s if state.blocked_since_s is None else state.blocked_since_s) if blocked else None,
    )


def _wanted(noted: EscalationState, verdict: Verdict, now_s: float, config: EscalationConfig) -> Level:
    """The level that this tick alone asks for."""
    if verdict.fault is not None and noted.fault_since_s is not None:
        at_once, lasted = level_of(verdict.fault), now_s - noted.fault_since_s
        on_hold = noted.level == Level.HOLD and noted.level_since_s is not None
        if on_hold and now_s - (noted.level_since_s or 0.0) >= config.land_after_s:
            return max(at_once, Level.LAND)
        if lasted < config.hold_after_s:
            return at_once
        return max(at_once, Level.LAND if verdict.fault in ESTIMATE_FAULTS else Level.HOLD)
    if noted.blocked_since_s is not None and now_s - noted.blocked_since_s >= config.blocked_hold_s:
        return Level.HOLD
    return Level.FLY


def _kept(noted: EscalationState, now_s: float, config: EscalationConfig) -> Level:
    """The level that must not be left yet."""
    cured = noted.fault_last_s is None or now_s - noted.fault_last_s >= config.healthy_s
    return Level.FLY if noted.level == Level.BRAKE and cured else noted.level
