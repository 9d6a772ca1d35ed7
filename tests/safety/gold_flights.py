"""Scripted flights whose every decision is kept in tests/safety/gold/: what the filter does today, to the digit.

    python tests/safety/gold_flights.py

writes the files anew. Do so only for a change of behaviour that is meant, and read the difference: each line is one tick.
"""

from __future__ import annotations

import dataclasses
import json
import math
import random
from pathlib import Path

import numpy as np
from safety_plant import Plant, command, config

from safety.config import Fence
from safety.escalation import EscalationConfig, EscalationState, escalate
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import Health

FOLDER = Path(__file__).parent / "gold"
TICKS = 36
CALM_FLIGHTS = range(24)
FAULTY_FLIGHTS = range(100, 130)
QUICK = EscalationConfig(hold_after_s=0.4, land_after_s=0.5, healthy_s=0.2, blocked_hold_s=0.6)

CORNERED = ((2.0, -2.5), (9.0, -2.5), (9.0, 0.5), (6.5, 0.8), (6.2, 2.5), (2.0, 2.5))
HOLE = ((6.6, -1.4), (7.2, -1.6), (7.3, -0.7))
FENCES = (
    {"min_m": (-2.0, -6.0, 0.3), "max_m": (37.0, 6.0, 4.0)},
    {"min_m": (3.9, -0.9, 1.2), "max_m": (6.6, 1.3, 2.7)},
    {"floor_m": 1.1, "ceiling_m": 2.9, "inclusion": CORNERED},
    {"floor_m": 1.3, "ceiling_m": 2.6, "inclusion": CORNERED[::-1], "exclusion": (HOLE,)},
)
OTHER = ({}, {"obstacle_speed_m_s": 0.3}, {"dead_time_s": 0.1, "lag_s": 0.5, "margin_m": 0.1}, {"max_acceleration_m_s2": 3.0})


def pillars(chance: random.Random) -> np.ndarray:
    """Boxes around the start, none at it."""
    boxes = []
    for _ in range(chance.randint(1, 5)):
        away, bearing, size = chance.uniform(0.6, 1.6), chance.uniform(-math.pi, math.pi), chance.uniform(0.05, 0.6)
        x, y = 5.0 + (away + size) * math.cos(bearing), (away + size) * math.sin(bearing)
        boxes.append((x - size / 2, y - size / 2, x + size / 2, y + size / 2))
    return np.array(boxes).reshape(-1, 4)


def wishes(chance: random.Random, plant: Plant, fence: Fence):
    """Fly at pillars, corners and places beyond the fence, each for a while; some commands beyond the limits."""
    corners = [*fence.polygon, *(vertex for ring in fence.exclusion for vertex in ring)]
    aims = [(0.5 * (b[0] + b[2]), 0.5 * (b[1] + b[3])) for b in plant.boxes] + [(5.0, 5.0)] + corners
    left = 0
    while True:
        if left == 0:
            left, (x, y) = chance.randint(4, 16), chance.choice(aims)
            speed, up, spread = chance.uniform(0.2, 1.5), chance.uniform(-0.7, 0.7), chance.uniform(-0.5, 0.5)
        left -= 1
        bearing = math.atan2(y - plant.y, x - plant.x) + spread
        turn = 1.5 * math.remainder(bearing - plant.yaw, 2.0 * math.pi)
        yield command(speed * math.cos(bearing), speed * math.sin(bearing), up, turn)


def tilted(state, chance: random.Random):
    """The estimate with some attitude, as a flying vehicle has."""
    return dataclasses.replace(state, roll_rad=chance.uniform(-0.2, 0.2), pitch_rad=chance.uniform(-0.2, 0.2))


def moved(state, x=0.0, y=0.0, z=0.0):
    p = state.position
    return dataclasses.replace(state, position=CorridorVector(p.x + x, p.y + y, p.z + z))


def ranges_of(scan, values):
    return dataclasses.replace(scan, ranges_m=np.asarray(values, dtype=np.float32))


FAULTS = {
    "no command": lambda t: t | {"command": None},
    "broken command": lambda t: t | {"command": command(math.nan)},
    "no state": lambda t: t | {"state": None},
    "state jumps": lambda t: t | {"state": moved(t["state"], x=0.6 * (t["k"] % 2))},
    "height jumps": lambda t: t | {"state": moved(t["state"], z=0.7)},
    "old state": lambda t: t | {"state": dataclasses.replace(t["state"], time_s=t["now_s"] - 0.15)},
    "wrong velocity": lambda t: t | {"state": dataclasses.replace(t["state"], velocity=CorridorVector(1.4, 1.3, 0.4))},
    "turned yaw": lambda t: t | {"state": dataclasses.replace(t["state"], yaw_rad=t["state"].yaw_rad + 1.5)},
    "tilt": lambda t: t | {"state": dataclasses.replace(t["state"], roll_rad=0.8, pitch_rad=0.6)},
    "tumbling": lambda t: t | {"state": dataclasses.replace(t["state"], roll_rad=1.5)},
    "reset": lambda t: t | {"state": dataclasses.replace(t["state"], reset_counter=t["k"] // 3)},
    "still estimate": lambda t: t | {"state": dataclasses.replace(t["state"], position=CorridorVector(5.0, 0.0, 2.0))},
    "no scan": lambda t: t | {"scan": None},
    "old scan": lambda t: t | {"scan": dataclasses.replace(t["scan"], time_s=t["now_s"] - 0.2)},
    "empty scan": lambda t: t | {"scan": ranges_of(t["scan"], np.full(180, np.inf))},
    "unknown beams": lambda t: t | {"scan": ranges_of(t["scan"], np.where(np.arange(180) % 3, t["scan"].ranges_m, np.nan))},
    "half unknown": lambda t: t | {"scan": ranges_of(t["scan"], np.where(np.arange(180) < 100, np.nan, t["scan"].ranges_m))},
    "mirrored scan": lambda t: t | {"scan": ranges_of(t["scan"], t["scan"].ranges_m[::-1])},
    "leg in view": lambda t: t | {"scan": ranges_of(t["scan"], np.where(np.arange(180) < 8, 0.2, t["scan"].ranges_m))},
    "late": lambda t: t | {"health": Health(lateness_s=0.035 + 0.01 * (t["k"] % 4))},
    "slow link": lambda t: t | {"health": Health(link_delay_s=0.1 + 0.05 * (t["k"] % 12))},
    "slow policy": lambda t: t | {"health": Health(inference_s=0.03 + 0.005 * (t["k"] % 6))},
    "memory": lambda t: t | {"health": Health(hidden_norm=8.0 + 0.5 * (t["k"] % 4))},
    "echo": lambda t: t | {"health": Health(echo=CorridorVector(0.9, -0.4, 0.1), echo_time_s=t["now_s"])},
    "battery": lambda t: t | {"health": Health(battery_fraction=0.2 - 0.01 * (t["k"] % 15))},
    "inaccurate": lambda t: t | {"health": Health(accuracy_m=1.5, estimate_valid=True, in_control=True, landed=False, boots=2)},
    "invalid": lambda t: t | {"health": Health(estimate_valid=False)},
    "taken": lambda t: t | {"health": Health(in_control=False)},
    "rebooted": lambda t: t | {"health": Health(boots=t["k"] // 5)},
    "overruled": lambda t: t | {"health": Health(overruled=True)},
}


def fly(number: int) -> list[list]:
    """Every tick of one flight: what was sent, why, and what followed."""
    chance = random.Random(number)
    changes = OTHER[number // 4 % 4] | {"fence": Fence(**FENCES[number % 4])}
    safety = SafetyFilter(config(**changes))
    plant = Plant(boxes=pillars(chance), yaw=chance.uniform(-3.0, 3.0), seed=number, noise_m=0.01, beams=180)
    plan, faulty = wishes(chance, plant, safety.config.fence), number >= 100
    name = sorted(FAULTS)[number % len(FAULTS)]
    first = chance.randint(8, 14)
    last = first + chance.choice((2, 6, 25))
    level, rows = EscalationState(), []
    for k in range(TICKS):
        tick = {
            "k": k,
            "command": next(plan),
            "state": tilted(plant.estimate(), chance),
            "scan": plant.scan(),
            "now_s": plant.time_s,
        }
        if faulty and first <= k < last:
            tick = FAULTS[name](tick)
        tick.pop("k")
        sent, verdict = safety.apply(**tick)
        level = escalate(level, verdict, tick["now_s"], QUICK)
        plant.fly(sent)
        rows.append(row(sent, verdict, level))
    return rows


def row(sent, verdict, level) -> list:
    """One tick as JSON: rounded far below anything that matters, far above rounding errors."""
    v, found = sent.velocity, [[i.rule, short(i.value), short(i.limit)] for i in verdict.interventions]
    numbers = (
        v.x,
        v.y,
        v.z,
        sent.yaw_rate_rad_s,
        verdict.clearance_m,
        verdict.fence_margin_m,
        verdict.scan_age_s,
        verdict.state_age_s,
    )
    return [[short(x) for x in numbers], verdict.braking, verdict.fault, found, int(level.level), level.cause]


def short(value: float) -> float | str:
    """Eight digits; what JSON has no number for as text."""
    return float(f"{value:.8g}") + 0.0 if math.isfinite(value) else str(value)


def path(number: int) -> Path:
    return FOLDER / f"flight_{number}.json"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for flight in (*CALM_FLIGHTS, *FAULTY_FLIGHTS):
        path(flight).write_text("[\n" + ",\n".join(json.dumps(one, separators=(",", ":")) for one in fly(flight)) + "\n]\n")
