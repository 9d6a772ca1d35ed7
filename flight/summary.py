"""What one flight came to: `summary.json`. Field names are fixed; a number that is not known is null, never invented."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flight.rate_keeper import LatenessStatistics, RateStatistics, percentiles_ms
from flight.tick import TickRecord
from flight.trajectory import FlightLog
from safety.config import Fence
from safety.frames import CorridorVector


def build_summary(
    log: FlightLog,
    loop: RateStatistics,
    *,
    outcome: str,
    goal: CorridorVector,
    goal_reached: bool,
    policy_path: str,
    policy_sha256: str,
    dynamics: str,
    collisions: int | None = None,
    min_clearance_m: float | None = None,
    shortest_path_m: float | None = None,
    failsafe_events: Sequence[str] = (),
    extra: Mapping[str, object] | None = None,
) -> dict[str, object]:
    """The fields every flight reports, ready for `write_json_atomic`.

    `collisions`: contacts counted by a simulator, None on a real vehicle. `min_clearance_m`: true clearance where a
    simulator knows it; None takes the smallest that the safety filter measured. `geofence_breaches` counts how often
    the fence margin went below zero. `path_efficiency`: `shortest_path_m` (None: the straight line from the first position to the
    goal) over the path flown, None unless the goal was reached. `interventions`: ticks per rule. `extra` adds fields, and may not
    replace one.
    """
    positions = log.positions_m
    length_m = path_length_m(positions)
    summary: dict[str, object] = {
        "outcome": outcome,
        "goal_reached": goal_reached,
        "collisions": collisions,
        "min_clearance_m": _smallest_clearance_m(log.records) if min_clearance_m is None else min_clearance_m,
        "path_length_m": length_m,
        "path_efficiency": _efficiency(positions, length_m, goal, shortest_path_m) if goal_reached else None,
        "duration_s": log.records[-1].now_s - log.records[0].now_s if log.records else 0.0,
        "loop": {**loop.as_dict(), "scan_to_setpoint_ms": asdict(_scan_to_setpoint_ms(log))},
        "inference_us": _inference_us(log.records),
        "interventions": interventions_by_rule(log.records),
        "geofence_breaches": geofence_breaches(log.records),
        "failsafe_events": list(failsafe_events),
        "policy": {"path": policy_path, "sha256": policy_sha256},
        "dynamics": dynamics,
    }
    if extra and (taken := summary.keys() & extra.keys()):
        raise ValueError(f"extra may not replace {', '.join(sorted(taken))}")
    return {**summary, **(extra or {})}


def write_json_atomic(path: Path, document: Mapping[str, object]) -> None:
    """Write JSON so that a reader or a power cut finds the old file or the whole new one. NaN and infinity become null."""
    write_text_atomic(path, json.dumps(_plain(document), indent=2, allow_nan=False) + "\n")


def write_text_atomic(path: Path, text: str) -> None:
    """Write UTF-8 text so that a reader or a power cut finds the old file or the whole new one."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def path_length_m(positions_m: NDArray[np.float64]) -> float:
    """Length of the polyline through [n, 3] positions."""
    return float(np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum()) if len(positions_m) > 1 else 0.0


def interventions_by_rule(records: Sequence[TickRecord]) -> dict[str, int]:
    """Ticks in which each safety rule changed or judged the command, by name."""
    counts = Counter(rule for record in records for rule in {i.rule for i in record.verdict.interventions})
    return dict(sorted(counts.items()))


def geofence_breaches(records: Sequence[TickRecord]) -> int:
    """How often the vehicle went from inside the fence to outside."""
    breaches, inside = 0, True
    for record in records:
        margin_m = record.verdict.fence_margin_m
        if math.isnan(margin_m):
            continue
        breaches += inside and margin_m < 0.0
        inside = margin_m >= 0.0
    return breaches


def fence_summary(fence: Fence) -> dict[str, object]:
    """The fence for the summary: the box around it, and its polygons, m."""
    return {"min": fence.low_m, "max": fence.high_m, "inclusion": fence.polygon, "exclusion": fence.exclusion}


def _smallest_clearance_m(records: Sequence[TickRecord]) -> float:
    clearances = [r.verdict.clearance_m for r in records if math.isfinite(r.verdict.clearance_m)]
    return min(clearances, default=math.nan)


def _efficiency(positions_m: NDArray[np.float64], length_m: float, goal: CorridorVector, shortest_m: float | None) -> float:
    """At most 1: a flight ends inside the goal's radius, a little short of the shortest way."""
    if length_m <= 0.0:
        return math.nan
    if shortest_m is None:
        shortest_m = math.dist(positions_m[0], (goal.x, goal.y, goal.z))
    return min(1.0, shortest_m / length_m)


def _scan_to_setpoint_ms(log: FlightLog) -> LatenessStatistics:
    """From the scan's own measurement time to the moment its tick's setpoint was sent."""
    return percentiles_ms([sent_s - record.scan_time_s for record, sent_s in log])


def _inference_us(records: Sequence[TickRecord]) -> dict[str, float]:
    taken = percentiles_ms([record.inference_s for record in records])
    return {"p50": 1e3 * taken.p50, "p99": 1e3 * taken.p99}


def _plain(value: object) -> object:
    """Only what JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    raise TypeError(f"{type(value).__name__} has no place in a summary")
