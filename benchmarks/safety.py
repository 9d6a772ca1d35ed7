"""Cost of one `SafetyFilter.apply` with 180 beams and a fence of 12 vertices, and how much memory many calls keep.

Undisturbed flight, a command that is refused at nearly every call, a braked fault, and mixed: a recorded flight through a
corridor with pillars, its 361 beams judged anew. That one is what the limits mean in flight; the others are its extremes.

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
from safety.messages import Health, LidarScan, VehicleState, VelocityCommand

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
RECORDING = Path(__file__).parents[1] / "tests" / "data" / "corridor_seed1.mcap"
RECORDED_FLIGHTS = 10  # the recording is short; each time the filter starts anew
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


Tick = tuple[VelocityCommand | None, VehicleState | None, LidarScan | None, float, Health | None]


def _tick(case: str, k: int, ranges: np.ndarray) -> Tick:
    """The inputs of one tick of a flight along a corridor; `intervening` stands before a wall."""
    now, blocked = 0.05 * k, case == "intervening"
    wobble = 0.002 * math.sin(0.7 * k)  # an estimate that never changes is a fault
    place = CorridorVector(1.0 if blocked else 1.0 + 0.05 * k, 0.5 + wobble, 2.0 + wobble)
    velocity = CorridorVector(0.0 if blocked else 1.0, wobble, wobble)
    scan = None if case == "fault" else LidarScan(now, ranges, -math.pi / 2, math.pi / BEAMS, 0.1, 4.0)
    wanted = VelocityCommand(CorridorVector(1.0, 0.3 if blocked else 0.0, 0.0), 0.1)
    return wanted, VehicleState(now, place, velocity, ZERO, 0.02 + wobble, 0.03, 0.0, 0.0), scan, now, None


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


def _recorded_ticks() -> list[Tick]:
    """The inputs of a flight that a policy flew."""
    from flight.recording_reader import read_recording

    ticks = read_recording(RECORDING).ticks
    return [(one.record.wanted, one.state, one.scan, one.record.now_s, one.record.health) for one in ticks]


def _timed_us(ticks: list[Tick]) -> tuple[list[float], int]:
    """Cost of each call of one flight, us, and how many of them were interventions."""
    safety, costs, touched = SafetyFilter(SafetyConfig(fence=FENCE)), list[float](), 0
    gc.collect()
    gc.disable()  # as the control loop flies
    for command, state, scan, now, health in ticks:
        begin = time.thread_time_ns()
        _, verdict = safety.apply(command, state, scan, now, health)
        costs.append((time.thread_time_ns() - begin) / 1000.0)
        touched += bool(verdict.interventions)
    gc.enable()
    return costs, touched


def _costs_us(case: str) -> tuple[np.ndarray, str]:
    """Cost of each call of a case, us, and how many of them were interventions."""
    if case == "mixed":
        ticks = _recorded_ticks()
        flights = [_timed_us(ticks) for _ in range(RECORDED_FLIGHTS)]
        costs, touched = np.concatenate([one for one, _ in flights[1:]]), flights[0][1]
    else:
        ticks = _ticks(case)
        every, touched = _timed_us(ticks)
        costs = np.array(every[WARM_UP:])
    return costs, f"{touched} of {len(ticks)} calls intervened"


def run(json: bool) -> list[dict[str, Any]]:
    """Median and 99th percentile per case against the limits of one tick's budget (500 us and 2 ms)."""
    figures: list[dict[str, Any]] = []
    for case in ("undisturbed", "intervening", "fault", "mixed"):
        costs, told = _costs_us(case)
        if not json:
            print(f"{case}: {told}")
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
