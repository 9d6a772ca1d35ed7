"""What follows each fault at once, as one table: rule, level, the catalogue's ids it answers, and the time it may take.

Pure data. `safety.escalation` reads the level, tests and the fault campaign read the rest; docs/safety.md shows it as a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """How severe the reaction is; larger is more severe."""

    FLY = 0
    BRAKE = 1
    HOLD = 2
    LAND = 3
    YIELD = 4
    """Somebody or something else has the vehicle, or nobody can have it: no setpoint and no mode command any more."""


@dataclass(frozen=True, slots=True)
class Reaction:
    """`level`: what the rule asks for in the tick in which it speaks. `faults`: ids of the catalogue that it answers.

    `bound_s`: from the fault in the input to the reaction sent; for faults that show only in motion, while there is such motion.
    """

    rule: str
    level: Level
    faults: tuple[str, ...]
    bound_s: float


TICK_S = 0.1
"""One tick of the catalogue: 50 ms and the phase between fault and tick."""

_TABLE = (
    # input missing, broken or old
    Reaction("command_missing", Level.BRAKE, ("P1", "P4"), TICK_S),
    Reaction("command_not_finite", Level.BRAKE, ("P1", "P4"), TICK_S),
    Reaction("command_bad_again", Level.HOLD, ("P1",), 0.25),
    Reaction("state_missing", Level.BRAKE, ("K1",), TICK_S),
    Reaction("state_not_finite", Level.BRAKE, ("E4", "E10"), TICK_S),
    Reaction("state_stale", Level.BRAKE, ("E3", "K1", "K3"), 0.3),
    Reaction("state_future", Level.BRAKE, ("L10",), TICK_S),
    Reaction("state_backwards", Level.BRAKE, ("K5",), TICK_S),
    Reaction("scan_missing", Level.BRAKE, ("L1",), 0.3),
    Reaction("scan_shape", Level.BRAKE, ("L8",), TICK_S),
    Reaction("scan_not_finite", Level.BRAKE, ("L10",), TICK_S),
    Reaction("scan_geometry", Level.BRAKE, ("L8",), TICK_S),
    Reaction("scan_stale", Level.BRAKE, ("L1", "L3", "L11"), 0.3),
    Reaction("scan_future", Level.BRAKE, ("L10",), TICK_S),
    Reaction("scan_backwards", Level.BRAKE, ("K5",), TICK_S),
    Reaction("scan_unknown", Level.BRAKE, ("L6",), TICK_S),
    Reaction("scan_touching", Level.BRAKE, ("L5",), TICK_S),
    Reaction("scan_blank", Level.BRAKE, ("L4",), TICK_S),
    Reaction("scan_frozen", Level.BRAKE, ("L2",), 0.4),
    Reaction("clock_backwards", Level.BRAKE, ("C11",), TICK_S),
    Reaction("clock_not_finite", Level.BRAKE, ("C11",), TICK_S),
    Reaction("tick_gap", Level.BRAKE, ("C4", "C7"), TICK_S),
    # the estimate contradicts itself, the commands or the autopilot
    Reaction("estimate_jump", Level.BRAKE, ("E1",), TICK_S),
    Reaction("estimate_jump_again", Level.HOLD, ("E1",), TICK_S),
    Reaction("altitude_jump", Level.HOLD, ("E9",), TICK_S),
    Reaction("estimate_frozen", Level.BRAKE, ("E2",), 0.35),
    Reaction("velocity_mismatch", Level.BRAKE, ("E6",), 0.5),
    Reaction("motion_direction", Level.HOLD, ("E7",), 1.5),
    Reaction("estimate_reset", Level.HOLD, ("E8",), 0.2),
    Reaction("estimate_invalid", Level.LAND, ("E11",), 0.2),
    Reaction("estimate_inaccurate", Level.HOLD, ("E5",), 1.2),
    Reaction("tilt", Level.BRAKE, ("V7",), TICK_S),
    Reaction("tumbling", Level.YIELD, ("V9",), TICK_S),
    # the scan contradicts the motion, or has two sources
    Reaction("scan_source", Level.BRAKE, ("L8", "L18"), TICK_S),
    Reaction("scan_mirrored", Level.HOLD, ("L9",), 1.5),
    # policy
    Reaction("hidden_exploded", Level.BRAKE, ("P4", "P5"), TICK_S),
    Reaction("inference_hung", Level.BRAKE, ("P7",), TICK_S),
    # loop, link, vehicle
    Reaction("loop_late", Level.HOLD, ("C8", "C12"), 0.2),
    Reaction("link_slow", Level.HOLD, ("K4",), 1.0),
    Reaction("foreign_setpoint", Level.HOLD, ("K6",), 1.0),
    Reaction("control_lost", Level.YIELD, ("V1", "V2", "V3", "V4", "K2"), 1.1),
    Reaction("autopilot_rebooted", Level.YIELD, ("K10", "K11"), TICK_S),
    Reaction("landed", Level.YIELD, ("V9",), TICK_S),
    Reaction("battery_low", Level.HOLD, ("V6",), 1.0),
    Reaction("battery_critical", Level.LAND, ("V6",), 1.0),
    Reaction("braking_weak", Level.LAND, ("V7",), 3.0),
    # the filter itself
    Reaction("input_missing", Level.BRAKE, ("L1",), TICK_S),
    Reaction("internal_error", Level.BRAKE, ("P4",), TICK_S),
    Reaction("gate_not_finite", Level.BRAKE, ("P1",), TICK_S),
    Reaction("gate_limit", Level.BRAKE, ("P3",), TICK_S),
)

REACTIONS: dict[str, Reaction] = {reaction.rule: reaction for reaction in _TABLE}

NOTICES: dict[str, tuple[str, ...]] = {
    "speed_cap": ("L1", "L11", "L16", "K3", "K4", "P6", "C8", "C12", "V7", "A1", "A3"),
    "policy_saturated": ("P2",),
    "policy_oscillating": ("P10",),
    "scan_sector_masked": ("L15",),
}
"""Rules that only limit or tell: they appear in `Verdict.interventions`, never in `Verdict.fault`."""


def level_of(rule: str) -> Level:
    """What a fault asks for at once; a rule that the table does not know brakes."""
    reaction = REACTIONS.get(rule)
    return Level.BRAKE if reaction is None else reaction.level
