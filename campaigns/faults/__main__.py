"""`python -m campaigns.faults`: the fault campaign in lockstep, or with `--realtime` over MAVSDK against the running gateway."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from campaigns.command_line import positive, prepare_output, run_command


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m campaigns.faults", description=__doc__)
    parser.add_argument("--mission", type=Path, default=Path("configs/corridor.yaml"))
    parser.add_argument("--seeds", type=positive, default=5, help="runs of each fault in each scene")
    parser.add_argument("--only", help="ids of the catalogue, separated by commas")
    parser.add_argument("--scenes", help="scenes, separated by commas; default: all")
    parser.add_argument("--jobs", type=positive, help="processes; default: all cores")
    parser.add_argument("--realtime", action="store_true", help="fly over MAVSDK against the gateway, one flight per fault")
    parser.add_argument("--out", type=Path, default=Path("runs/faults.json"), help="JSON; the plot and the table lie beside it")
    return parser.parse_args()


def _lockstep(arguments: argparse.Namespace) -> dict[str, Any]:
    from campaigns.faults.campaign import Result, cases, run_all, summarise
    from campaigns.faults.scenes import FLIGHT_SCENES, SCENES

    only = arguments.only.split(",") if arguments.only else None
    scenes = tuple(arguments.scenes.split(",")) if arguments.scenes else FLIGHT_SCENES
    if set(scenes) - set(SCENES):
        raise ValueError(f"scenes are: {', '.join(SCENES)}")

    def summary(results: list[Result]) -> dict[str, Any]:
        return summarise(results, "python -m campaigns.faults " + " ".join(sys.argv[1:]), arguments.seeds)

    def keep(results: list[Result]) -> None:
        _keep(summary(results) | {"partial": True}, arguments.out)

    return summary(run_all(cases(arguments.seeds, only, scenes), arguments.mission, arguments.jobs, keep))


def _realtime(arguments: argparse.Namespace) -> dict[str, Any]:
    from campaigns.faults.realtime import fly_all

    only = arguments.only.split(",") if arguments.only else None
    return fly_all(
        arguments.mission, only, "python -m campaigns.faults " + " ".join(sys.argv[1:]), lambda r: _keep(r, arguments.out)
    )


def main() -> int:
    """Exit code 1 when any reaction was wrong or late."""
    arguments = _arguments()
    prepare_output(arguments.out, beside=(".md", ".png"))
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    result = _realtime(arguments) if arguments.realtime else _lockstep(arguments)
    _write(result, arguments.out)
    for wrong in result["wrong"]:
        print(f"WRONG {wrong['fault']} {wrong['scene']} seed {wrong['seed']}: {wrong['problem']}")
    print(f"{result['faults']} faults, {result['runs']} runs, {result['right']} right")
    return 0 if not result["wrong"] else 1


def _keep(result: dict[str, Any], out: Path) -> None:
    out.write_text(json.dumps(result, indent=1) + "\n")


def _write(result: dict[str, Any], out: Path) -> None:
    from campaigns.faults.report import draw, markdown

    _keep(result, out)
    out.with_suffix(".md").write_text(markdown(result) + "\n")
    draw(result, out.with_suffix(".png"))


if __name__ == "__main__":
    run_command("faults", main, ValueError)
