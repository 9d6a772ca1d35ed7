"""What the campaign found: one JSON-able object, a table, and a heat map of the worst distances."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from campaigns.adversaries.cases import MAIN, Result

LISTED = 40
BOUND_95 = 3.0  # nothing seen in N independent trials: the rate is below 3 / N with 95 % confidence


@dataclass
class Cell:
    """One policy in one scene."""

    flights: int = 0
    ticks: int = 0
    clearance_m: float = math.inf
    fence_m: float = math.inf
    events: Counter[str] = field(default_factory=Counter)

    def add(self, result: Result) -> None:
        """Take in one more result."""
        outcome = result.outcome
        self.flights, self.ticks = self.flights + 1, self.ticks + outcome.ticks
        self.clearance_m, self.fence_m = min(self.clearance_m, outcome.clearance_m), min(self.fence_m, outcome.fence_m)
        self.events.update(outcome.events)

    def row(self, scene: str, policy: str) -> dict[str, Any]:
        """For the result file."""
        return {"scene": scene, "policy": policy, "flights": self.flights, "ticks": self.ticks, **self.worst()}

    def worst(self) -> dict[str, Any]:
        """Least distances, rounded to a tenth of a millimetre, and what was broken."""
        clearance = round(self.clearance_m, 4) if self.clearance_m < 100.0 else None
        return {"clearance_m": clearance, "fence_m": round(self.fence_m, 4), "events": dict(self.events)}


class Block:
    """All results under one set of assumptions."""

    def __init__(self) -> None:
        self.total, self.cells = Cell(), dict[tuple[str, str], Cell]()
        self.faults: Counter[str] = Counter()
        self.bad: list[Result] = []
        self.changed = 0

    def add(self, result: Result) -> None:
        """Take in one more result."""
        for cell in (self.total, self.cells.setdefault((result.case.scene, result.case.policy), Cell())):
            cell.add(result)
        self.faults.update(result.outcome.faults)
        self.changed += result.outcome.changed
        if result.outcome.events:
            self.bad.append(result)

    def summary(self) -> dict[str, Any]:
        """Figures of the block. `violations`: the deepest first, at most `LISTED`."""
        total, broken = self.total, bool(self.bad)
        bad = sorted(self.bad, key=lambda result: result.outcome.worst_m)[:LISTED]
        return {
            "ticks": total.ticks,
            "flights": total.flights,
            **total.worst(),
            "flights_with_violations": len(self.bad),
            "rate_per_tick_below": None if broken else BOUND_95 / total.ticks,
            "commands_changed": round(self.changed / total.ticks, 3),
            "faults": dict(self.faults),
            "violations": [result.row() for result in bad],
            "cells": [cell.row(*key) for key, cell in sorted(self.cells.items())],
        }


def gather(blocks: dict[str, Block], results: Iterable[Result]) -> Iterable[Result]:
    """Sort results into blocks as they pass."""
    for result in results:
        blocks.setdefault(result.case.block, Block()).add(result)
        yield result


def passed(report: dict[str, Any]) -> bool:
    """Nothing broken in the main block, and every liveness test left in time."""
    main = report["blocks"].get(MAIN, {"events": {}})
    return not main["events"] and all(row["passed"] for row in report.get("liveness", []))


def markdown(report: dict[str, Any]) -> str:
    """The blocks and the liveness tests as tables."""
    lines = ["| block | ticks | flights | violations | least clearance | least fence distance |", "|---|---|---|---|---|---|"]
    for name, block in sorted(report["blocks"].items()):
        events = ", ".join(f"{count} {kind}" for kind, count in block["events"].items()) or _none_in(block)
        lines.append(
            f"| {name} | {block['ticks']:,} | {block['flights']:,} | {events} | {_length(block['clearance_m'])} "
            f"| {_length(block['fence_m'])} |"
        )
    if report.get("liveness"):
        lines += ["", "| liveness | flights | slowest | bound | in time, untouched |", "|---|---|---|---|---|"]
        lines += [
            f"| {row['name']} | {row['flights']} | {_seconds(row['slowest_s'])} | {row['bound_s']:.1f} s "
            f"| {'yes' if row['passed'] else 'no'} |"
            for row in report["liveness"]
        ]
    return "\n".join(lines)


def _none_in(block: dict[str, Any]) -> str:
    return f"0 (rate below {block['rate_per_tick_below']:.1e} per tick)"


def _length(value: float | None) -> str:
    return "nothing near" if value is None else f"{value:.3f} m"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f} s"


def heat_map(block: dict[str, Any], path: Path) -> None:
    """Worst distance per scene and policy, cm, as a picture."""
    import matplotlib as mpl  # noqa: PLC0415  slow to import, and only here

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    cells = {(c["scene"], c["policy"]): 100.0 * min(c["fence_m"], _or_inf(c["clearance_m"])) for c in block["cells"]}
    scenes, policies = sorted({key[0] for key in cells}), sorted({key[1] for key in cells})
    values = [[cells.get((scene, policy), math.nan) for scene in scenes] for policy in policies]
    figure, axes = plt.subplots(figsize=(1.6 + 0.75 * len(scenes), 1.2 + 0.28 * len(policies)), layout="constrained")
    image = axes.imshow(values, cmap="RdYlGn", vmin=-20.0, vmax=20.0, aspect="auto")
    for i, row in enumerate(values):
        for j, value in enumerate(row):
            axes.text(j, i, "" if math.isnan(value) else f"{value:.1f}", ha="center", va="center", fontsize=6)
    axes.set_xticks(range(len(scenes)), scenes, fontsize=7, rotation=30)
    axes.set_yticks(range(len(policies)), policies, fontsize=7)
    figure.colorbar(image, label="least distance to obstacle or fence, cm")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _or_inf(value: float | None) -> float:
    return math.inf if value is None else value


def section(report: dict[str, Any]) -> str:
    """The campaign as docs/safety.md shows it."""
    main = report["blocks"][MAIN]
    ended = ", stopped before its end" if report.get("partial") else ""
    total = f"`{report['command']}`{ended}: {main['ticks']:,} ticks of 0.05 s in {main['flights']:,} cases"
    return f"{total}, {_none_in(main) if not main['events'] else main['events']} violations.\n\n{markdown(report)}"
