"""Ticks of a made-up flight, for what is computed from ticks."""

from __future__ import annotations

import math

from flight.tick import TickRecord
from flight.trajectory import FlightLog
from safety.frames import CorridorVector
from safety.messages import Intervention, SafeCommand, VelocityCommand, Verdict

TICK_S = 0.05
GOAL = CorridorVector(14.0, 0.0, 2.0)
NAN = math.nan


def record(k: int, **changes: object) -> TickRecord:
    """Tick k of a straight flight along x at 0.5 m/s from x = 4, weaving in y."""
    now_s = 500.0 + TICK_S * k
    position = CorridorVector(4.0 + 0.025 * k, 0.8 * math.sin(0.03 * k), 2.0)
    velocity = CorridorVector(0.5, 0.48 * math.cos(0.03 * k), 0.0)
    command = VelocityCommand(velocity, 0.1)
    distance_m = math.dist((position.x, position.y, position.z), (GOAL.x, GOAL.y, GOAL.z))
    fields: dict[str, object] = {
        "now_s": now_s,
        "scan_time_s": now_s - 0.03,
        "state_time_s": now_s - 0.01,
        "position": position,
        "velocity": velocity,
        "yaw_rad": 0.0,
        "wanted": command,
        "sent": SafeCommand(velocity, 0.1),
        "verdict": Verdict(False, (), 0.03, 0.01, 1.5, 0.7),
        "distance_to_goal_m": distance_m,
        "goal_reached": distance_m <= 0.3,
        "inference_s": 100e-6,
        "hidden_norm": 3.0,
        "hidden_reset": k == 0,
    }
    return TickRecord(**{**fields, **changes})  # type: ignore[arg-type]


def limited(rule: str, *, braking: bool = False, clearance_m: float = 0.6, fence_margin_m: float = 0.5) -> Verdict:
    return Verdict(braking, (Intervention(rule, 1.0, 0.5),), 0.03, 0.01, clearance_m, fence_margin_m)


def flown(ticks: int = 400) -> FlightLog:
    """A log with every kind of tick: free, limited, braking, without samples."""
    log = FlightLog()
    for k in range(ticks):
        changes: dict[str, object] = {}
        if 100 <= k < 140:
            changes = {"verdict": limited("obstacle")}
        elif 250 <= k < 256:
            changes = {"verdict": limited("scan_stale", braking=True), "wanted": None, "inference_s": NAN, "scan_time_s": NAN}
        elif k == 300:
            changes = {"position": None, "velocity": None, "yaw_rad": NAN, "distance_to_goal_m": NAN, "wanted": None}
        one = record(k, **changes)
        log.append(one, one.now_s + 0.002)
    return log
