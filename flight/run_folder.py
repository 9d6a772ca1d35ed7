"""Reading back a run folder, for the report. A flight may have broken off: what is damaged is left out, not trusted."""

from __future__ import annotations

import csv
import json
import math
from array import array
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flight.errors import FlyError
from flight.results import truth_from_report
from flight.scan_log import Scans, read_scans
from flight.trajectory import CSV_COLUMNS, TIMING_COLUMNS

MAX_JSON_BYTES = 64 << 20
MAX_CSV_ROWS = 200_000
MAX_BOXES = 2000

Column = NDArray[np.float64]


class ReportError(FlyError):
    """There is no flight to report on in this folder."""


@dataclass(frozen=True, slots=True)
class Run:
    """One flight as its folder tells it.

    `ticks`: `CSV_COLUMNS` without `rules`, one array [n] each, NaN where a cell is empty; `rules` the rules of each tick.
    `timing`: `TIMING_COLUMNS`, or None. `boxes` [k, 6]: obstacles a simulator knows, or None. `truth` [m, 3]: its true path.
    """

    summary: dict[str, Any]
    ticks: dict[str, Column]
    rules: list[tuple[str, ...]]
    timing: dict[str, Column] | None
    scans: Scans | None
    boxes: NDArray[np.float64] | None
    truth: NDArray[np.float64] | None

    def number(self, *keys: str) -> float:
        """A number of the summary by its path of keys; NaN where it is null, absent or no number."""
        value: object = self.summary
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return float(value) if isinstance(value, (int, float)) else math.nan

    def corner(self, *keys: str) -> tuple[float, float, float] | None:
        """Three finite numbers of the summary, or None."""
        value: object = self.summary
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        table = _table(value)
        return (float(table[0]), float(table[1]), float(table[2])) if table is not None and table.shape == (3,) else None

    def fence_rings(self) -> list[NDArray[np.float64]]:
        """Corners [k, 2] of the fence's inclusion polygon, then of each exclusion; empty without a fence in the summary."""
        fence = self.summary.get("fence_m")
        low, high = self.corner("fence_m", "min"), self.corner("fence_m", "max")
        if low is None or high is None or not isinstance(fence, dict):
            return []
        box = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        tables = [_table(ring) for ring in (fence.get("inclusion", box), *fence.get("exclusion", ()))]
        return [table for table in tables if table is not None and table.ndim == 2 and table.shape[1] == 2]


def read_run(folder: Path) -> Run:
    """Raises `ReportError` without a summary.json and a trajectory.csv that `fly` wrote."""
    summary = _read_json(folder / "summary.json")
    if not summary:
        raise ReportError(f"{folder} has no readable summary.json: give a folder that fly has written")
    ticks = _read_csv(folder / "trajectory.csv", CSV_COLUMNS)
    if ticks is None:
        raise ReportError(f"{folder / 'trajectory.csv'} is missing or not a file of fly's: give a folder that fly has written")
    timing = _read_csv(folder / "timing.csv", TIMING_COLUMNS)
    truth_report = _read_json(folder / "gateway.json")
    boxes = _table(truth_report.get("boxes") or summary.get("boxes_m"))
    return Run(
        summary=summary,
        ticks=ticks.columns,
        rules=ticks.rules,
        timing=timing.columns if timing is not None and timing.rules else None,
        scans=read_scans(folder / "scans.npz"),
        boxes=boxes[:MAX_BOXES] if boxes is not None and boxes.ndim == 2 and boxes.shape[1] == 6 else None,
        truth=truth_from_report(truth_report),
    )


@dataclass(frozen=True, slots=True)
class _Sheet:
    """A CSV file: its columns of numbers, and the words of its column `rules`, row by row."""

    columns: dict[str, Column]
    rules: list[tuple[str, ...]]


def _read_json(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            return {}
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _read_csv(path: Path, names: tuple[str, ...]) -> _Sheet | None:
    """The whole rows of a file with this header; None where it is another file. A torn last row is left out.

    Row by row into columns: as text, an hour of ticks would take some 200 MB.
    """
    columns = {name: array("d") for name in names}
    rules: list[tuple[str, ...]] = []
    words: dict[str, tuple[str, ...]] = {}
    try:
        with path.open(encoding="ascii", newline="") as file:
            reader = csv.reader(file)
            if tuple(next(reader, ())) != names:
                return None
            for row in islice(reader, MAX_CSV_ROWS):
                if len(row) != len(names):
                    continue
                cells = dict(zip(names, row, strict=True))
                text = cells.pop("rules", "")
                rules.append(words.setdefault(text, tuple(text.split())))
                for name, cell in cells.items():
                    columns[name].append(_cell(cell))
    except (OSError, ValueError, csv.Error):
        return None
    columns.pop("rules", None)
    return _Sheet({name: np.array(values, dtype=np.float64) for name, values in columns.items()}, rules)


def _cell(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _table(value: object) -> NDArray[np.float64] | None:
    """Finite numbers as an array, or None."""
    if not isinstance(value, list) or not value:
        return None
    try:
        table = np.array(value, dtype=np.float64)
    except (ValueError, TypeError):
        return None
    return table if np.isfinite(table).all() else None
