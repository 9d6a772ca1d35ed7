"""The run folder of one flight, and what the flight came to as a whole."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flight.errors import ExitCode, MissionError
from flight.flight_log import FlightLog
from flight.offboard import Ending
from flight.scan_log import write_scans
from flight.trajectory import write_timing_csv, write_trajectory_csv
from safety.frames import CorridorVector

log = logging.getLogger("flight.results")


@dataclass(slots=True)
class FlightResult:
    """What came of it. `summary` is the content of summary.json; empty where nothing was flown."""

    exit_code: ExitCode
    outcome: str
    message: str
    folder: Path
    summary: dict[str, object] = field(default_factory=dict)


def make_run_folder(wanted: Path | None, name: str) -> Path:
    """The folder for this flight, new and writable: `wanted`, or `runs/<time>-<name>`. Raises `MissionError`."""
    folder = wanted if wanted is not None else Path("runs") / f"{time.strftime('%Y%m%d-%H%M%S')}-{name}"
    try:
        if wanted is None:
            folder = _unused(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise MissionError(f"{folder} is not empty: give another folder with --out")
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise MissionError(f"cannot write to {folder}: {error.strerror}; give another folder with --out") from None
    return folder


def _unused(folder: Path) -> Path:
    candidate, number = folder, 1
    while candidate.exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    return candidate


def remove_if_empty(folder: Path) -> None:
    """Leave no empty folder behind when nothing was flown."""
    try:
        folder.rmdir()
    except OSError:
        log.debug("%s is kept", folder)


def truth_from_report(report: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """[n, 3] true positions of a gateway report, corridor frame, or None."""
    trajectory = report.get("trajectory")
    rows = trajectory.get("rows") if isinstance(trajectory, dict) else None
    if not isinstance(rows, list) or not rows:
        return None
    try:
        table = np.array(rows, dtype=np.float64)
    except (ValueError, TypeError):
        return None
    return table[:, 1:4] if table.ndim == 2 and table.shape[1] >= 4 else None


def write_log(folder: Path, flight_log: FlightLog) -> None:
    """Write what was logged tick by tick: trajectory.csv, timing.csv and scans.npz."""
    write_trajectory_csv(folder / "trajectory.csv", flight_log)
    write_timing_csv(folder / "timing.csv", flight_log)
    start_s = flight_log.records[0].now_s if flight_log.records else 0.0
    write_scans(folder / "scans.npz", flight_log.scans.scans(), start_s)


def judge_flight(ending: Ending, landed: bool, contacts: Any) -> tuple[ExitCode, str, str]:
    """Exit code, outcome and message of the whole flight: a contact or a failed landing outweighs a reached goal."""
    if contacts:
        return ExitCode.NOT_REACHED, "contact", f"touched an obstacle {contacts} time(s); {ending.message}"
    if ending.exit_code is ExitCode.GOAL_REACHED and not landed:
        return ExitCode.NOT_REACHED, "not_landed", f"{ending.message}, but not landed"
    return ending.exit_code, ending.outcome, ending.message


def true_distance_m(report: Mapping[str, Any], goal: CorridorVector) -> float | None:
    """Nearest true distance to the goal, where a simulator knows it."""
    truth = truth_from_report(report)
    if truth is None:
        return None
    return float(np.min(np.linalg.norm(truth - (goal.x, goal.y, goal.z), axis=1)))
