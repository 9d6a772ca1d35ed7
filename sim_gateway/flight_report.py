"""The gateway's record of what really happened: true path, contacts, clearance, events; written as one JSON file."""

from __future__ import annotations

import json
import logging
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from sim_gateway.autopilot_output import ModeChange
from sim_gateway.scene import World
from sim_gateway.simulation import Simulation

SAMPLE_STEPS = 12.5  # 20 Hz in steps of 4 ms
TRAJECTORY_COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz", "yaw")
_MAX_ROWS = 72_000  # an hour; then every other row is dropped and the interval doubles
_MAX_EVENTS = 10_000

_log = logging.getLogger("sim_gateway")


class FlightRecorder:
    """Collects from a running simulation. Call `watch` after every step; memory is bounded."""

    def __init__(self, simulation: Simulation, facts: dict[str, Any]) -> None:
        self._simulation = simulation
        self._facts = facts
        self._rows = np.full((_MAX_ROWS, len(TRAJECTORY_COLUMNS)), math.nan)  # all of it from the start: memory stays flat
        self._count = 0
        self.events: list[dict[str, Any]] = []
        self.contacts = 0
        self.min_clearance_m = math.inf
        self._touching = False
        self._interval_steps = SAMPLE_STEPS
        self._next_sample = 0.0

    def watch(self) -> None:
        """Take note of the present step. On the ground nothing is a contact."""
        simulation = self._simulation
        if not simulation.landed:
            clearance = simulation.clearance_m
            self.min_clearance_m = min(self.min_clearance_m, clearance)
            self.contacts += clearance < 0.0 and not self._touching
            self._touching = clearance < 0.0
        if simulation.steps >= self._next_sample:
            self._sample()

    def _sample(self) -> None:
        truth = self._simulation.truth
        row = (truth.time_s, *truth.position_m, *truth.velocity_m_s, truth.yaw_rad)
        self._rows[self._count] = [round(value, 5) for value in row]
        self._count += 1
        if self._count >= _MAX_ROWS:
            kept = self._rows[: self._count : 2].copy()
            self._count = len(kept)
            self._rows[: self._count] = kept
            self._interval_steps *= 2
        self._next_sample += self._interval_steps

    @property
    def rows(self) -> list[list[float]]:
        """The samples so far, each as in `TRAJECTORY_COLUMNS`."""
        rows: list[list[float]] = self._rows[: self._count].tolist()
        return rows

    def note(self, change: ModeChange) -> None:
        """A mode change, an arming or a disarming."""
        modes = {"mode": change.mode.px4_name, "intended": change.intended.px4_name}
        self.note_event(change.time_s, **modes, armed=change.armed, failsafe=change.failsafe)

    def note_event(self, time_s: float, **facts: Any) -> None:
        """Something that happened at a vehicle time."""
        if len(self.events) < _MAX_EVENTS:
            self.events.append({"t": round(time_s, 3), **facts})

    def as_dict(self, **timing: float) -> dict[str, Any]:
        """The report; `timing` is added as it is."""
        flown = math.isfinite(self.min_clearance_m)
        return {
            **self._facts,
            **timing,
            "duration_s": round(self._simulation.time_s, 3),
            "contacts": self.contacts,
            "min_clearance_m": round(self.min_clearance_m, 5) if flown else None,
            "events": self.events,
            "trajectory": {"columns": TRAJECTORY_COLUMNS, "rows": self.rows},
        }


def world_facts(world: World) -> dict[str, Any]:
    """What a report says about the world."""
    return {
        "world": world.name,
        "world_seed": world.seed,
        "size_m": [world.length_m, world.width_m, world.height_m],
        "start": list(world.start),
        "start_yaw_rad": world.start_yaw_rad,
        "goal": list(world.goal),
        "boxes": world.static_boxes.tolist(),
        "movers": [
            {
                "size_m": list(mover.size_m),
                "x_m": mover.x_m,
                "z_m": mover.z_m,
                "y_m": [mover.y_low_m, mover.y_high_m],
                "speed_m_s": mover.speed_m_s,
                "phase_m": mover.phase_m,
            }
            for mover in world.movers
        ],
    }


def write_report(path: Path, content: dict[str, Any]) -> None:
    """Write a report; a file that cannot be written is said, not fatal."""
    try:
        write_json_atomically(path, content)
    except OSError as error:
        _log.error("the report %s cannot be written: %s", path, error.strerror)


def write_json_atomically(path: Path, content: dict[str, Any]) -> None:
    """Write beside the target, then rename: a reader sees the old file or the new one, never half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
