"""The process-death matrix: every way for a process to fail in flight, and what the autopilot still receives.

    python -m campaigns.process_death --repeats 3 --pauses 20 --out results/process_death.json

Each run is the real `fly` with its guard against the gateway, in processes of their own and in real time. At full speed one of
them is hung, stopped, killed or silenced. Counted are the setpoints that arrive at the vehicle's side of the wire, by a relay
of this campaign with its own clock; whether the vehicle braked, touched nothing and ended in good hands says the simulator's
truth.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from campaigns.command_line import positive, prepare_output, run_command
from campaigns.death_scene import CELLS, Cell, Scene
from campaigns.wire_tap import WireTap

FIRST_SEED = 5_000_000
LATEST_PHASE_S = 0.5
BRAKED_M_S = 0.25
"""Speed that counts as standing: PX4's hold on a noisy estimate drifts by so much."""


@dataclass(frozen=True, slots=True)
class Run:
    """One flight and its fault. Times in s after the fault; distances in m; `ended`: in whose hands the vehicle is at the end."""

    process: str
    fault: str
    seed: int
    speed_m_s: float
    late_moving: int
    last_moving_s: float | None
    first_still_s: float | None
    last_setpoint_s: float | None
    left_offboard_s: float | None
    distance_m: float
    final_speed_m_s: float
    contacts: int
    ended: str
    exit_code: int | None

    @property
    def good(self) -> bool:
        """Nothing late, nothing touched, braked, and not in OFFBOARD any more."""
        still = self.final_speed_m_s < BRAKED_M_S or self.ended in ("landed", "landing")
        return self.late_moving == 0 and self.contacts == 0 and still and self.ended != "OFFBOARD"


def fly_once(cell: Cell, seed: int, folder: Path, phase_s: float) -> Run:
    """One run; the fault comes `phase_s` after full speed was reached."""
    with Scene(cell, seed, folder) as scene:
        scene.wait_for_full_speed()
        time.sleep(phase_s)
        struck_s = scene.strike()
        exit_code = scene.watch()
        scene.gateway.stop()  # it writes its report when it ends
        return judge(cell, seed, scene.wire, struck_s, scene.gateway.report(), exit_code)


def judge(cell: Cell, seed: int, wire: WireTap, struck_s: float, report: dict[str, Any], exit_code: int | None) -> Run:
    """What the wire and the simulator's truth say about a run."""
    seen = wire.seen()
    after = [(setpoint.time_s - struck_s, setpoint.moving) for setpoint in wire.setpoints() if setpoint.time_s > struck_s]
    moving, still = [t for t, moves in after if moves], [t for t, moves in after if not moves]
    left = [time_s - struck_s for time_s, mode in seen.modes if time_s > struck_s and mode & 0xFF != 6]
    offset_s = min(arrival - boot for arrival, boot in seen.boot_s if abs(arrival - struck_s) < 1.0)
    rows = [row for row in report["trajectory"]["rows"] if row[0] >= struck_s - offset_s]
    last = rows[-10:]
    return Run(
        process=cell.process,
        fault=cell.name,
        seed=seed,
        speed_m_s=round(_speed(rows[0]), 3),
        late_moving=sum(t > cell.bound_s for t in moving),
        last_moving_s=_rounded(max(moving, default=None)),
        first_still_s=_rounded(min(still, default=None)),
        last_setpoint_s=_rounded(max((t for t, _ in after), default=None)),
        left_offboard_s=_rounded(min(left, default=None)),
        distance_m=round(max(_distance(rows[0], row) for row in rows[: int(3.0 * 20)]), 3),
        final_speed_m_s=round(sum(map(_speed, last)) / len(last), 3),
        contacts=int(report["contacts"]),
        ended=_hands(report["events"][-1]),
        exit_code=exit_code,
    )


def _hands(event: dict[str, Any]) -> str:
    if not event["armed"]:
        return "landed"
    if event["failsafe"]:
        return f"PX4 failsafe ({event['mode']})"
    return {"AUTO.LAND": "landing", "AUTO.LOITER": "Hold by fly"}.get(event["mode"], str(event["mode"]))


def _speed(row: list[float]) -> float:
    return float((row[4] ** 2 + row[5] ** 2 + row[6] ** 2) ** 0.5)


def _distance(a: list[float], b: list[float]) -> float:
    return float(((a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2) ** 0.5)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


# -- the campaign -----------------------------------------------------------------------------------------------------


def summarise(runs: list[Run], failed: list[str]) -> dict[str, Any]:
    """All runs by cell, as one JSON-able object."""
    cells = []
    for cell in CELLS:
        own = [run for run in runs if (run.process, run.fault) == (cell.process, cell.name)]
        if own:
            cells.append(_summary_of(cell, own))
    return {
        "command": "python -m campaigns.process_death " + " ".join(sys.argv[1:]),
        "runs": len(runs),
        "good": sum(run.good for run in runs),
        "late_moving_setpoints": sum(run.late_moving for run in runs),
        "contacts": sum(run.contacts for run in runs),
        "not_flown": failed,
        "load_average_at_end": round(os.getloadavg()[0], 2),
        "process_death": cells,
        "each": [asdict(run) | {"good": run.good} for run in runs],
    }


def _summary_of(cell: Cell, runs: list[Run]) -> dict[str, Any]:
    ended: dict[str, int] = {}
    for run in runs:
        ended[run.ended] = ended.get(run.ended, 0) + 1
    return {
        "process": cell.process,
        "fault": cell.name,
        "bound_s": cell.bound_s,
        "runs": len(runs),
        "good": sum(run.good for run in runs),
        "late_moving": sum(run.late_moving for run in runs),
        "last_moving_s_max": _largest(runs, lambda run: run.last_moving_s),
        "first_still_s_max": _largest(runs, lambda run: run.first_still_s),
        "left_offboard_s_max": _largest(runs, lambda run: run.left_offboard_s),
        "distance_m_max": max(run.distance_m for run in runs),
        "speed_m_s_max": max(run.speed_m_s for run in runs),
        "contacts": sum(run.contacts for run in runs),
        "ended": ended,
        "exit_codes": sorted({str(run.exit_code) for run in runs}),
    }


def _largest(runs: list[Run], value: Callable[[Run], float | None]) -> float | None:
    return max((found for run in runs if (found := value(run)) is not None), default=None)


def markdown(result: dict[str, Any]) -> str:
    """The matrix as a table."""
    names = (
        "process",
        "fault",
        "runs",
        "moving too late",
        "last moving",
        "first zero",
        "left OFFBOARD",
        "way, m",
        "contacts",
        "ended",
    )
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    for cell in result["process_death"]:
        times = [_milliseconds(cell[f"{key}_s_max"]) for key in ("last_moving", "first_still", "left_offboard")]
        ended = ", ".join(f"{count} {how}" for how, count in cell["ended"].items())
        lines.append(
            f"| {cell['process']} | {cell['fault']} | {cell['runs']} | {cell['late_moving']} | {' | '.join(times)} "
            f"| {cell['distance_m_max']:.2f} | {cell['contacts']} | {ended} |"
        )
    return "\n".join(lines)


def _milliseconds(value: float | None) -> str:
    return "none" if value is None else f"{1e3 * value:.0f} ms"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.process_death", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=positive, default=3, help="runs of every cell")
    parser.add_argument("--pauses", type=positive, default=20, help="runs of the cells with SIGSTOP and SIGCONT of fly")
    parser.add_argument("--only", default="", help="only cells whose name holds this, e.g. 'guard SIGKILL'")
    parser.add_argument("--out", type=Path, default=Path("runs/process_death.json"))
    parser.add_argument("--jobs", type=positive, default=1, help="flights at a time")
    arguments = parser.parse_args()
    prepare_output(arguments.out)
    cells = [cell for cell in CELLS if arguments.only in f"{cell.process} {cell.name}"]
    if not cells:
        raise ValueError(f"no cell holds {arguments.only!r}; there are: {', '.join(f'{c.process} {c.name}' for c in CELLS)}")
    order = [cell for cell in cells for _ in range(arguments.pauses if _is_pause(cell) else arguments.repeats)]
    result = fly_all(order, arguments.out, arguments.jobs)
    print(markdown(result))
    return 0 if result["good"] == len(order) else 1


def _is_pause(cell: Cell) -> bool:
    return cell.process == "fly" and cell.resume_s is not None


def fly_all(order: list[Cell], out: Path, jobs: int) -> dict[str, Any]:
    """Fly all of them, the file written anew after each."""
    runs: list[Run] = []
    failed: list[str] = []
    phases = random.Random(0)
    with ThreadPoolExecutor(jobs) as pool:
        flights = [
            pool.submit(fly_or_say_why, cell, FIRST_SEED + k, phases.uniform(0.0, LATEST_PHASE_S)) for k, cell in enumerate(order)
        ]
        for done, flight in enumerate(as_completed(flights), 1):
            run = flight.result()
            if isinstance(run, str):
                failed.append(run)
                print(f"{done}/{len(order)} {run}", flush=True)
                continue
            runs.append(run)
            verdict = "good" if run.good else f"NOT GOOD {run}"
            print(f"{done}/{len(order)} {run.process} {run.fault}: {run.late_moving} late, {run.ended}, {verdict}", flush=True)
            out.write_text(json.dumps(summarise(runs, failed), indent=1) + "\n")
    return summarise(runs, failed)


def fly_or_say_why(cell: Cell, seed: int, phase_s: float) -> Run | str:
    """One run in a folder of its own; a line about it when it did not come to the fault."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return fly_once(cell, seed, Path(folder), phase_s)
        except (RuntimeError, OSError) as error:
            return f"{cell.process} {cell.name}: {error}"


if __name__ == "__main__":
    run_command("process_death", main, ValueError)
