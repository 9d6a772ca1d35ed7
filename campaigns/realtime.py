"""Real flights of the `fly` command in a row, each on a corridor of its own, over MAVSDK in wall-clock time.

    python -m campaigns.realtime --flights 20 --out results/realtime.json

Each flight is the very command a user types, in a process of its own, judged by the simulator's truth, which `fly` never sees.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from campaigns.command_line import positive, prepare_output, run_command
from campaigns.statistics import mean, proportion
from flight.mission import load_mission
from safety.config import SafetyConfig

FIRST_SEED = 3_000_000
FLIGHT_DEADLINE_S = 600.0
SUCCESS_RADIUS_M = 0.3


@dataclass(frozen=True, slots=True)
class RealFlight:
    """One flight. Distances in m; `fence_margin_m`: least true distance from the vehicle's hull to the fence in OFFBOARD."""

    seed: int
    exit_code: int
    outcome: str
    goal_reached: bool
    true_distance_to_goal_m: float | None
    contacts: int | None
    min_clearance_m: float | None
    fence_margin_m: float | None
    duration_s: float | None
    loop: dict[str, Any]

    @property
    def clean(self) -> bool:
        """Landed after truly reaching the goal, nothing touched, never outside the fence."""
        near = self.true_distance_to_goal_m is not None and self.true_distance_to_goal_m <= SUCCESS_RADIUS_M
        return self.exit_code == 0 and near and self.contacts == 0 and not self.left_fence

    @property
    def left_fence(self) -> bool:
        """Whether any part of the vehicle was outside the fence while the policy flew."""
        return self.fence_margin_m is not None and self.fence_margin_m < 0.0


def fly_once(mission: Path, seed: int, folder: Path) -> RealFlight:
    """Run `fly` on one corridor and read what it wrote."""
    command = [sys.executable, "-m", "flight", "--mission", str(mission), "--seed", str(seed), "--out", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=FLIGHT_DEADLINE_S, check=False)
    summary = _read(folder / "summary.json")
    if not summary:
        print(f"seed {seed}: {done.stderr.strip().splitlines()[-1:] or done.returncode}", file=sys.stderr)
    report = _read(folder / "gateway.json")
    return RealFlight(
        seed=seed,
        exit_code=done.returncode,
        outcome=str(summary.get("outcome", "not flown")),
        goal_reached=bool(summary.get("goal_reached", False)),
        true_distance_to_goal_m=summary.get("true_distance_to_goal_m"),
        contacts=report.get("contacts"),
        min_clearance_m=report.get("min_clearance_m"),
        fence_margin_m=fence_margin_m(report, load_mission(mission).safety),
        duration_s=summary.get("duration_s"),
        loop=summary.get("loop", {}),
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content


def fence_margin_m(report: dict[str, Any], safety: SafetyConfig) -> float | None:
    """Least distance of the vehicle's hull to the fence while the mode was OFFBOARD, by the gateway's truth; None if never."""
    spans = _offboard_spans(report)
    rows = [row for row in report.get("trajectory", {}).get("rows", []) if any(a <= row[0] <= b for a, b in spans)]
    hull = (safety.vehicle_radius_m, safety.vehicle_half_height_m)
    return min((safety.fence.margin_m(row[1], row[2], row[3], *hull) for row in rows), default=None)


def _offboard_spans(report: dict[str, Any]) -> list[tuple[float, float]]:
    events = [*report.get("events", []), {"t": float("inf"), "mode": "end"}]
    return [(a["t"], b["t"]) for a, b in pairwise(events) if a["mode"] == "OFFBOARD"]


def summarise(mission: Path, flights: list[RealFlight]) -> dict[str, Any]:
    """All flights as one JSON-able object."""
    loops = [f.loop for f in flights if f.loop]
    return {
        "command": f"{_priority()}python -m campaigns.realtime {' '.join(sys.argv[1:])}",
        "mission": str(mission),
        "flights": len(flights),
        "goal_reached_and_landed": sum(f.exit_code == 0 for f in flights),
        "clean_success": proportion([f.clean for f in flights]),
        "contacts": sum(f.contacts or 0 for f in flights),
        "left_fence": sum(f.left_fence for f in flights),
        "least_fence_margin_m": min((f.fence_margin_m for f in flights if f.fence_margin_m is not None), default=None),
        "least_clearance_m": min((f.min_clearance_m for f in flights if f.min_clearance_m is not None), default=None),
        "loop_rate_hz": {
            "mean": mean([loop["rate_hz"] for loop in loops]),
            "worst": max((loop["rate_hz"] for loop in loops), key=lambda hz: abs(hz - 20.0), default=None),
        },
        "ticks": sum(loop["ticks"] for loop in loops),
        "deadline_misses": sum(loop["deadline_misses"] for loop in loops),
        "scan_to_setpoint_ms_p50": mean([loop["scan_to_setpoint_ms"]["p50"] for loop in loops]),
        "scan_to_setpoint_ms_p99_worst": max((loop["scan_to_setpoint_ms"]["p99"] for loop in loops), default=None),
        "load_average_at_end": os.getloadavg()[0],
        "each": [asdict(f) | {"clean": f.clean} for f in flights],
    }


def _priority() -> str:
    """How the command was started, where it was not started plainly."""
    return f"nice -n {os.nice(0)} " if os.nice(0) else ""


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.realtime", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mission", type=Path, default=Path("configs/corridor.yaml"))
    parser.add_argument("--flights", type=positive, default=20)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED, help="seeds from 2000000 up were never trained on")
    parser.add_argument("--out", type=Path, default=Path("runs/realtime.json"))
    parser.add_argument("--keep", type=Path, help="keep every run folder below this one")
    arguments = parser.parse_args()
    load_mission(arguments.mission)
    prepare_output(arguments.out)
    flights: list[RealFlight] = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.flights):
            flight = fly_once(arguments.mission, seed, (arguments.keep or Path(scratch)) / f"seed{seed}")
            flights.append(flight)
            clean = sum(f.clean for f in flights)
            print(f"seed {seed}: {flight.outcome}, exit {flight.exit_code}; clean so far {clean} of {len(flights)}", flush=True)
            arguments.out.write_text(json.dumps(summarise(arguments.mission, flights), indent=1) + "\n")
    result = summarise(arguments.mission, flights)
    print(json.dumps({key: value for key, value in result.items() if key != "each"}, indent=1))
    return 0 if result["clean_success"]["rate"] >= 0.9 and result["left_fence"] == 0 else 1


if __name__ == "__main__":
    run_command("realtime", main)
