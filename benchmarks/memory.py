"""Memory of the flight stack over a simulated hour, and its file descriptors and threads: 72,000 ticks of policy, safety filter,
log and recording in one process.

The process imports what `fly` imports and is fed with scans and states that another process has written, so it holds no
simulator. Its memory is read every five simulated minutes, with the garbage collector off as in flight, once without and once
with the recorder. Takes some five minutes.
"""

from __future__ import annotations

import json as json_module
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
LIMIT_MIB = 250.0
SLOPE_MIB_H = {"without recording": 1.0, "with recording": 2.0}
"""Allowed growth after the first sixth: the allocator's rounding, and the index of the recording (300 bytes every 0.8 s), which
ends with `recording.max_size_mb`: a full file of 512 MB, some four hours, has 5 MiB of it."""
SHORT_MIN, SHORT_MIB = 30.0, 2.0
"""A shorter run says nothing about an hour: it may grow by the allocator's rounding."""
LOOP_TICKS = 1200
BEAMS = 361
DEADLINE_S = 1800.0

Figure = dict[str, Any]


def run(json: bool, policy: Path | None = None, minutes: float = 60.0) -> list[Figure]:
    """Resident memory and its slope, without and with the recorder, and the modules that must not be there."""
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs.npz"
        write_inputs(inputs)
        for name, record in zip(SLOPE_MIB_H, (False, True), strict=True):
            seen = soak(policy or _shipped_policy(), inputs, minutes, Path(folder) / name.replace(" ", "_"), record=record)
            figures += _figures(name, seen, minutes)
    return figures


def _figures(name: str, seen: dict[str, Any], minutes: float) -> list[Figure]:
    resident, peak = seen["resident_mib"], seen["peak_mib"]
    growth = slope_mib_h(resident, minutes)
    allowed = SLOPE_MIB_H[name] if minutes >= SHORT_MIN else 60.0 * SHORT_MIB / minutes
    rows = (
        ("resident at the end", resident[-1], "MiB", LIMIT_MIB, resident[-1] <= LIMIT_MIB),
        ("largest, results written", peak, "MiB", LIMIT_MIB, peak <= LIMIT_MIB),
        ("slope after a sixth of the time", growth, "MiB/h", allowed, growth <= allowed),
        ("descriptors and threads gained", float(seen["gained"]), "", 0.0, seen["gained"] <= 0),
        ("simulated time", seen["minutes"], "min", minutes, seen["minutes"] >= minutes),
        ("ticks that the policy flew", 100.0 * seen["flown"], "%", 95.0, seen["flown"] >= 0.95),
        ("ticks taken by the recorder", 100.0 * seen["recorded"], "%", 99.9, seen["recorded"] >= 0.999),
        ("simulator or torch modules", float(len(seen["foreign"])), "modules", 0.0, not seen["foreign"]),
    )
    return [_figure(f"{name}: {row[0]}", *row[1:]) for row in rows]


def slope_mib_h(resident_mib: list[float], minutes: float) -> float:
    """Slope of a straight line through the samples (equally spaced, the last at the end) after the first sixth."""
    hours = np.arange(1, len(resident_mib) + 1) * minutes / 60.0 / len(resident_mib)
    late = slice(len(resident_mib) // 6 - 1, None)
    return float(np.polyfit(hours[late], np.array(resident_mib)[late], 1)[0])


def soak(policy: Path, inputs: Path, minutes: float, folder: Path, *, record: bool) -> dict[str, Any]:
    """Run the ticks in a process of their own; gives what it reports."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [
        sys.executable,
        "-m",
        "benchmarks._soak",
        str(policy),
        str(inputs),
        str(minutes),
        str(folder),
        "1" if record else "0",
    ]
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, timeout=DEADLINE_S, check=True)
    seen: dict[str, Any] = json_module.loads(done.stdout)
    return seen


def write_inputs(path: Path) -> None:
    """A minute of scans and states of a vehicle that weaves down a corridor with pillars, over and over."""
    rng = np.random.default_rng(7)
    bearings = np.linspace(-math.pi / 2, math.pi / 2, BEAMS)
    k = np.arange(LOOP_TICKS)
    x = 4.0 + 0.02 * k
    y = 0.8 * np.sin(2.0 * math.pi * 4.0 * k / LOOP_TICKS)
    yaw = 0.2 * np.cos(2.0 * math.pi * 4.0 * k / LOOP_TICKS)
    angle = yaw[:, None] + bearings
    with np.errstate(divide="ignore"):
        wall = np.where(np.sin(angle) > 0.0, 4.0 - y[:, None], 4.0 + y[:, None]) / np.abs(np.sin(angle))
    ranges = np.where(wall <= 4.0, wall, np.inf)
    for pillar_x, pillar_y in ((9.0, -2.2), (14.0, 2.4), (20.0, -2.3), (25.0, 2.2)):
        ranges = np.minimum(ranges, _pillar(pillar_x - x, pillar_y - y, angle))
    ranges += rng.normal(0.0, 0.01, ranges.shape)
    states = np.column_stack(
        (x, y, np.full(LOOP_TICKS, 2.0), np.gradient(x, 0.05), np.gradient(y, 0.05), np.zeros(LOOP_TICKS), yaw)
    )
    np.savez_compressed(path, ranges_m=ranges.astype(np.float32), states=states)


def _pillar(dx: np.ndarray, dy: np.ndarray, angle: np.ndarray, radius: float = 0.4) -> np.ndarray:
    """Distance along every beam to a round pillar at (dx, dy) from the vehicle; inf where it is missed or out of range."""
    along = dx[:, None] * np.cos(angle) + dy[:, None] * np.sin(angle)
    across = dy[:, None] * np.cos(angle) - dx[:, None] * np.sin(angle)
    depth = along - np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    return np.where((np.abs(across) < radius) & (depth > 0.1) & (depth <= 4.0), depth, np.inf)


def _shipped_policy() -> Path:
    return ROOT / "policies" / "corridor_ppo_lstm.onnx"


def _figure(name: str, value: float, unit: str, peer: float, ok: bool) -> Figure:
    ratio = value / peer if peer else None
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio, "target": peer, "ok": ok}
