"""Adversarial policies against the safety filter, in closed loop on the six-degree-of-freedom vehicle.

    python -m campaigns.adversaries --ticks 1000000 --out results/adversaries.json
    python -m campaigns.adversaries --replay "main/pillars/bang/17" --out runs/case.png

Exit code 1 when anything was touched, left or exceeded, or something did not get out in time.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from campaigns.adversaries.cases import MAIN, Case, plan, replay
from campaigns.adversaries.liveness import run_liveness
from campaigns.adversaries.pool import run_all
from campaigns.adversaries.report import Block, gather, heat_map, markdown, passed
from campaigns.adversaries.trace import Trace
from campaigns.command_line import positive, prepare_output, run_command

SAVE_EVERY_S = 20.0


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.adversaries", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ticks", type=positive, default=1_000_000, help="at least this many in the main block")
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="processes; default: all cores")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--out", type=Path, help="result as JSON, with a heat map beside it; with --replay: the picture")
    parser.add_argument("--replay", metavar="CASE", help="fly one case of a result file again, tick by tick")
    return parser.parse_args()


def campaign(chosen: argparse.Namespace) -> int:
    """Fly everything; partial results are saved on the way."""
    out: Path = chosen.out or Path("results/adversaries.json")
    prepare_output(out, beside=(".png",))
    began = saved = time.monotonic()
    blocks: dict[str, Block] = {}
    try:
        for _ in gather(blocks, run_all(plan(chosen.ticks, chosen.seed), chosen.jobs)):
            if time.monotonic() - saved > SAVE_EVERY_S:
                saved = time.monotonic()
                _save(out, chosen, blocks, {"partial": True})
    except KeyboardInterrupt:
        print("stopped: what was flown so far is reported", file=sys.stderr)
    liveness = run_liveness(chosen.seed, chosen.jobs)
    report = _save(out, chosen, blocks, {"wall_s": round(time.monotonic() - began), "liveness": liveness})
    heat_map(report["blocks"][MAIN], out.with_suffix(".png"))
    print(markdown(report))
    for row in report["blocks"][MAIN]["violations"]:
        print(f"{row['case']}: {row['events']} clearance {row['clearance_m']:.3f} m, fence {row['fence_m']:.3f} m")
    return 0 if passed(report) else 1


def _save(out: Path, chosen: argparse.Namespace, blocks: dict[str, Block], more: dict[str, Any]) -> dict[str, Any]:
    report = {
        "command": f"python -m campaigns.adversaries --ticks {chosen.ticks} --seed {chosen.seed} --out {out}",
        **more,
        "blocks": {name: block.summary() for name, block in sorted(blocks.items())},
    }
    out.write_text(json.dumps(report, indent=1) + "\n")
    return report


def show(case: Case, out: Path | None) -> int:
    """Fly one case again; a line per tick, and a picture."""
    if out is not None:
        prepare_output(out)
    trace = Trace()
    result = replay(case, trace.watch)
    print("\n".join(trace.lines()))
    print(json.dumps(result.row()))
    if out is not None:
        trace.picture(out, str(case))
    return 1 if result.outcome.events else 0


def main() -> None:
    """Entry point."""
    chosen = arguments()
    fly = (lambda: campaign(chosen)) if chosen.replay is None else (lambda: show(Case.parse(chosen.replay), chosen.out))
    run_command("adversaries", fly, ValueError)
