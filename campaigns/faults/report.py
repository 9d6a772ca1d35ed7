"""The campaign's results for people: a Markdown table and a plot of reaction times against their bounds."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def markdown(result: dict[str, Any]) -> str:
    """One row per fault."""
    head = "| fault | | expected | right | reaction, median | worst | bound | first named |\n|---|---|---|---|---|---|---|---|"
    return "\n".join([head, *(_line(row) for row in result["each"])])


def _line(row: dict[str, Any]) -> str:
    times = [_ms(row[key]) for key in ("reaction_median_s", "reaction_worst_s", "bound_s")]
    named = ", ".join(f"`{rule}`" for rule in row["rules"])
    note = f" ({row['note']})" if row["note"] else ""
    return (
        f"| {row['fault']} | {row['title']}{note} | {', '.join(row['expected'])} | {row['right']} of {row['runs']} | "
        f"{' | '.join(times)} | {named} |"
    )


def _ms(seconds: float | None) -> str:
    return "" if seconds is None else f"{1e3 * seconds:.0f} ms"


def draw(result: dict[str, Any], path: Path) -> None:
    """Every reaction time as a dot, its bound as a bar, one row per fault."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    timed = [row for row in result["each"] if row["bound_s"] is not None]
    figure, axes = plt.subplots(figsize=(9.0, 1.0 + 0.22 * len(timed)), layout="constrained")
    for y, row in enumerate(timed):
        runs = [r for r in result["results"] if r["fault"] == row["fault"] and r["reaction_s"] is not None and r["bound_s"]]
        axes.barh(y, 1e3 * row["bound_s"], color="#dddddd", zorder=1)
        right = [1e3 * r["reaction_s"] for r in runs if r["problem"] is None]
        wrong = [1e3 * r["reaction_s"] for r in runs if r["problem"] is not None]
        axes.scatter(right, [y] * len(right), s=9, color="#1f6fb4", zorder=2)
        axes.scatter(wrong, [y] * len(wrong), s=16, color="#c62828", marker="x", zorder=3)
    axes.set_yticks(range(len(timed)), [f"{row['fault']}  {row['title']}" for row in timed], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("reaction, ms (bar: bound)")
    axes.set_title(f"{result['runs']} runs, {result['right']} right")
    figure.savefig(path, dpi=110)
    plt.close(figure)
