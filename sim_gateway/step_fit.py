"""How well a vehicle profile flies recorded steps: the same commands from the same start, beside the recorded truth.

python -m sim_gateway.step_fit recordings/steps --vehicle sih_quadx
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from sim_gateway.step_recordings import StepRecordingError
from sim_gateway.step_response import StepFit, fit_all
from sim_gateway.vehicle_params import PROFILES


def _table(fits: list[StepFit], vehicle: str) -> Table:
    table = Table(title=f"steps: recorded / {vehicle}; medians over the repetitions")
    for column in (
        "step",
        "runs",
        "final",
        "dead time s",
        "t63 s",
        "t63 off",
        "peak tilt deg",
        "RMS m/s",
        "free: RMS",
        "free: t63 off",
        "ok",
    ):
        table.add_column(column, justify="left" if column == "step" else "right")
    for fit in fits:
        a, b = fit.recorded, fit.simulated
        table.add_row(
            fit.name,
            str(fit.repetitions),
            f"{a.final:.2f} / {b.final:.2f}",
            f"{a.dead_time_s:.2f} / {b.dead_time_s:.2f}",
            f"{a.t63_s:.2f} / {b.t63_s:.2f}",
            f"{100 * fit.t63_off:+.0f} %",
            f"{math.degrees(a.peak_tilt_rad):.1f} / {math.degrees(b.peak_tilt_rad):.1f}",
            f"{fit.rms_m_s:.3f}",
            f"{fit.rms_free:.3f}",
            f"{100 * fit.t63_free_off:+.0f} %",
            "yes" if fit.ok else "NO",
        )
    return table


def main(
    recordings: Annotated[list[Path], typer.Argument(help="CSV files of steps, or folders of them.")],
    vehicle: Annotated[str, typer.Option(help=f"Vehicle profile: {', '.join(PROFILES)}.")] = "sih_quadx",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of a table.")] = False,
) -> None:
    """Fly recorded steps with a vehicle profile and print the differences. Exit code 1 when a step misses a target."""
    if vehicle not in PROFILES:
        raise typer.BadParameter(f"{vehicle!r}: choose one of {', '.join(PROFILES)}", param_hint="--vehicle")
    try:
        fits = fit_all(recordings, PROFILES[vehicle])
    except StepRecordingError as error:
        print(f"step_fit: {error}", file=sys.stderr)
        raise typer.Exit(2) from None
    if as_json:
        print(json.dumps({"vehicle": vehicle, "steps": [asdict(fit) | {"ok": fit.ok} for fit in fits]}))
    else:
        Console(width=150).print(_table(fits, vehicle))
    if not all(fit.ok for fit in fits):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
