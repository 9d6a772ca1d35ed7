"""Cost of one `SafetyFilter.apply` with 180 beams and a fence of 12 vertices, and how much memory many calls keep.

Undisturbed flight, sliding along obstacles, and a braked fault.

Times are the thread's own CPU time: on a shared machine the wall clock measures the neighbours.
"""

from __future__ import annotations

import gc
import math
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from safety.config import Fence, SafetyConfig
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState, VelocityCommand

TICKS = 3000
WARM_UP = 200
MEDIAN_LIMIT_US, P99_LIMIT_US = 500.0, 2000.0
BEAMS = 180
SETTLING = 2000  # calls after which all memories of the filter are full
GROWTH_CALLS = 50_000  # `growth_mib(1_000_000)` takes about ten minutes
GROWTH_LIMIT_MIB = 1.0
FENCE = Fence(
    floor_m=0.3, ceiling_m=4.0,
    inclusion=(
        (-1.0, -4.0), (40.0, -4.5), (80.0, -4.0), (120.0, -4.5), (165.0, -4.0), (166.0, 0.0),
        (165.0, 4.0), (120.0, 4.5), (80.0, 4.0), (40.0, 4.5), (-1.0, 4.0), (-1.5, 0.0),
    ),
)  # fmt: skip
ZERO = CorridorVector(0.0, 0.0, 0.0)


def _bearings() -> np.ndarray:
    return -math.pi / 2 + math.pi / BEAMS * (np.arange(BEAMS) + 0.5)


def _wall_ranges(random: np.random.Generator, y: float, wall_y: float, pillar: bool) -> np.ndarray:
    """Ranges to a wall on either side, and to a wall across the way 0.7 m ahead when `pillar`."""
    bearing = _bearings()
    with np.errstate(divide="ignore"):
        side = np.where(bearing > 0, wall_y - y, wall_y + y) / np.abs(np.sin(bearing))
        ahead = np.where(pillar, 0.7, np.inf) / np.cos(bearing)
    ranges = np.minimum(side, ahead) + 0.01 * random.standard_normal(BEAMS)
    return np.where(ranges > 4.0, np.inf, np.maximum(ranges, 0.1)).astype(np.float32)


Tick = tuple[VelocityCommand, VehicleState, LidarScan | None, float]


def _tick(case: str, k: int, ranges: np.ndarray) -> Tick:
    """The inputs of one tick of a flight along a corridor; `intervening` stands before a wall."""
    now, blocked = 0.05 * k, case == "intervening"
    wobble = 0.002 * math.sin(0.7 * k)  # an estimate that never changes is a fault
    place = CorridorVector(1.0 if blocked else 1.0 + 0.05 * k, 0.5 + wobble, 2.0 + wobble)
    velocity = CorridorVector(0.0 if blocked else 1.0, wobble, wobble)
    scan = None if case == "fault" else LidarScan(now, ranges, -math.pi / 2, math.pi / BEAMS, 0.1, 4.0)
    wanted = VelocityCommand(CorridorVector(1.0, 0.3 if blocked else 0.0, 0.0), 0.1)
    return wanted, VehicleState(now, place, velocity, ZERO, 0.02 + wobble, 0.03, 0.0, 0.0), scan, now


def _ticks(case: str) -> list[Tick]:
    """The inputs of a flight, made before the clock runs."""
    random, blocked = np.random.default_rng(1), case == "intervening"
    return [_tick(case, k, _wall_ranges(random, 0.5, 1.2 if blocked else 3.0, blocked)) for k in range(TICKS + WARM_UP)]


def growth_mib(calls: int) -> float:
    """Resident memory that `calls` calls leave behind, after as many for warming up as the memories of the filter need."""
    safety, random = SafetyFilter(SafetyConfig(fence=FENCE)), np.random.default_rng(1)
    scans = [_wall_ranges(random, 0.5, 1.2, True) for _ in range(50)]
    begin = 0
    for k in range(SETTLING + calls):
        if k == SETTLING:
            gc.collect()
            begin = _resident_pages()
        safety.apply(*_tick("intervening", k, scans[k % len(scans)]))
    gc.collect()
    return (_resident_pages() - begin) * resource.getpagesize() / 2**20


def _resident_pages() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])


def _costs_us(case: str) -> tuple[np.ndarray, int]:
    """Cost of each call, us, and how many of them were interventions."""
    safety = SafetyFilter(SafetyConfig(fence=Fence(min_m=(-1.0, -4.0, 0.3), max_m=(300.0, 4.0, 4.0))))
    ticks, costs, touched = _ticks(case), [], 0
    gc.collect()
    gc.disable()  # as the control loop flies
    for command, state, scan, now in ticks:
        begin = time.thread_time_ns()
        _, verdict = safety.apply(command, state, scan, now)
        costs.append((time.thread_time_ns() - begin) / 1000.0)
        touched += bool(verdict.interventions)
    gc.enable()
    return np.array(costs[WARM_UP:]), touched


def run(json: bool) -> list[dict[str, Any]]:
    """Median and 99th percentile per case against the limits of one tick's budget (500 us and 2 ms)."""
    figures: list[dict[str, Any]] = []
    for case in ("undisturbed", "intervening", "fault"):
        costs, touched = _costs_us(case)
        if not json:
            print(f"{case}: {touched} of {TICKS + WARM_UP} calls intervened")
        for name, share, limit in (("median", 50, MEDIAN_LIMIT_US), ("p99", 99, P99_LIMIT_US)):
            value = float(np.percentile(costs, share))
            figures.append(
                {
                    "name": f"safety filter, {case}, {name}",
                    "value": round(value, 1),
                    "unit": "us",
                    "peer": limit,
                    "ratio": round(value / limit, 3),
                    "target": f"<= {limit:g} us",
                    "ok": value <= limit,
                }
            )
    grown = growth_mib(GROWTH_CALLS)
    figures.append(
        {
            "name": f"safety filter, memory kept by {GROWTH_CALLS} calls",
            "value": round(grown, 3),
            "unit": "MiB",
            "target": f"<= {GROWTH_LIMIT_MIB:g} MiB",
            "ok": grown <= GROWTH_LIMIT_MIB,
        }
    )
    return figures
