"""summary.json: the promised fields, honest nulls, and a file that is whole or not there."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from flight_records import GOAL, flown, limited, record

from flight.rate_keeper import LatenessStatistics, RateStatistics
from flight.summary import build_summary, geofence_breaches, interventions_by_rule, path_length_m, write_json_atomic
from flight.trajectory import FlightLog

LOOP = RateStatistics(20.01, 400, 2, LatenessStatistics(0.1, 0.4, 6.0))
FIELDS = {
    "outcome", "goal_reached", "collisions", "min_clearance_m", "path_length_m", "path_efficiency", "duration_s", "loop",
    "inference_us", "interventions", "geofence_breaches", "failsafe_events", "policy", "dynamics",
}  # fmt: skip


def summary(log: FlightLog | None = None, **changes: object) -> dict[str, object]:
    fields: dict[str, object] = {
        "outcome": "goal_reached",
        "goal": GOAL,
        "goal_reached": True,
        "policy_path": "policies/a.onnx",
        "policy_sha256": "ab" * 32,
        "dynamics": "internal",
    }
    return build_summary(flown() if log is None else log, LOOP, **{**fields, **changes})  # type: ignore[arg-type]


def written(document: dict[str, object], folder: Path) -> dict[str, object]:
    write_json_atomic(folder / "summary.json", document)
    return json.loads((folder / "summary.json").read_text())


def test_every_promised_field_is_there(tmp_path: Path) -> None:
    found = written(summary(collisions=0, min_clearance_m=0.41), tmp_path)
    assert set(found) == FIELDS
    assert found["loop"]["rate_hz"] == 20.01
    assert (found["loop"]["ticks"], found["loop"]["deadline_misses"]) == (400, 2)
    assert found["loop"]["lateness_ms"] == {"p50": 0.1, "p99": 0.4, "max": 6.0}
    assert set(found["loop"]["scan_to_setpoint_ms"]) == {"p50", "p99", "max"}
    assert found["policy"] == {"path": "policies/a.onnx", "sha256": "ab" * 32}
    assert (found["collisions"], found["min_clearance_m"]) == (0, 0.41)
    assert found["duration_s"] == pytest.approx(399 * 0.05)


def test_scan_to_setpoint_runs_from_the_scans_own_time_to_the_send() -> None:
    found = summary()["loop"]["scan_to_setpoint_ms"]
    assert found == pytest.approx({"p50": 32.0, "p99": 32.0, "max": 32.0})
    assert summary()["inference_us"] == pytest.approx({"p50": 100.0, "p99": 100.0})


def test_what_nobody_knows_is_null(tmp_path: Path) -> None:
    found = written(summary(FlightLog(), goal_reached=False, outcome="refused"), tmp_path)
    assert found["collisions"] is None
    assert found["min_clearance_m"] is None
    assert found["path_efficiency"] is None
    assert found["loop"]["scan_to_setpoint_ms"] == {"p50": None, "p99": None, "max": None}
    assert found["inference_us"] == {"p50": None, "p99": None}
    assert (found["duration_s"], found["path_length_m"], found["interventions"]) == (0.0, 0.0, {})


def test_clearance_comes_from_the_lidar_where_no_simulator_knows() -> None:
    assert summary()["min_clearance_m"] == pytest.approx(0.6)


def test_path_and_efficiency() -> None:
    assert path_length_m(np.array([[0, 0, 0], [3, 4, 0], [3, 4, 2.0]])) == pytest.approx(7.0)
    assert path_length_m(np.zeros((1, 3))) == 0.0
    log = FlightLog()
    for k in (0, 200, 390):
        log.append(record(k), 0.0)
    length_m = float(summary(log)["path_length_m"])
    assert summary(log)["path_efficiency"] == pytest.approx(min(1.0, 10.0 / length_m))
    assert summary(log, shortest_path_m=0.5 * length_m)["path_efficiency"] == pytest.approx(0.5)
    assert summary(log, goal_reached=False)["path_efficiency"] is None


def test_interventions_are_ticks_per_rule() -> None:
    assert interventions_by_rule(flown().records) == {"obstacle": 40, "scan_stale": 6}


def test_a_fence_breach_is_counted_once_however_long_it_lasts() -> None:
    margins = [0.5, -0.1, -0.2, math.nan, -0.1, 0.1, -0.1, 0.2]
    records = [record(k, verdict=limited("fence", fence_margin_m=margin)) for k, margin in enumerate(margins)]
    assert geofence_breaches(records) == 2
    assert geofence_breaches(records[1:3]) == 1, "a flight that begins outside has left it"
    assert geofence_breaches([]) == 0


def test_extra_fields_may_not_replace_the_promised_ones() -> None:
    assert summary(extra={"seed": 7})["seed"] == 7
    with pytest.raises(ValueError, match="outcome"):
        summary(extra={"outcome": "fine"})


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    write_json_atomic(path, {"a": 1})
    with pytest.raises(TypeError, match="set"):
        write_json_atomic(path, {"a": {1, 2}})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


def test_numpy_numbers_and_infinities_become_plain_json(tmp_path: Path) -> None:
    document = {"a": np.float32(1.5), "b": np.int64(3), "c": [math.inf, np.nan], "d": (True, None), "e": np.bool_(True)}
    assert written(document, tmp_path) == {"a": 1.5, "b": 3, "c": [None, None], "d": [True, None], "e": True}
    assert (tmp_path / "summary.json").stat().st_mode & 0o777 == 0o644
