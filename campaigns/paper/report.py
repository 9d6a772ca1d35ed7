"""Table 2, theirs beside ours, with significance tests and a reading that follows from them."""

from __future__ import annotations

import json
import math
from importlib.resources import files
from typing import Any

import numpy as np

from campaigns.paper.measures import MEASURES
from campaigns.paper.significance import LEVEL, permutation_p

# Measures whose unit or definition differs from the article's, and how.
NOTES = {
    "final_return": "another scale: the article does not publish its weights",
    "initial_collisions": "the article counts several contacts per episode; here a contact ends it",
    "final_collisions": "as above",
    "final_entropy": "of the Gaussian before its tanh, all four actions together",
}


def article() -> dict[str, Any]:
    """The article's figures; null where it gives words only."""
    return dict(json.loads(files("campaigns.paper").joinpath("article.json").read_text(encoding="utf-8")))


def make_table(measured: dict[str, list[dict[str, float]]]) -> dict[str, Any]:
    """Every measure of two algorithms over their seeds, with the p-value of their difference."""
    theirs, (first, second) = article(), measured
    rows = {}
    for name in MEASURES:
        values = {algorithm: [run[name] for run in runs] for algorithm, runs in measured.items()}
        rows[name] = {
            "theirs": {algorithm: theirs[algorithm][name] for algorithm in measured},
            "ours": {algorithm: _spread(one) for algorithm, one in values.items()},
            "p": permutation_p(*(_known(values[algorithm]) for algorithm in (first, second))),
        }
    return {"algorithms": [first, second], "rows": rows}


def _known(values: list[float]) -> list[float]:
    return [value for value in values if math.isfinite(value)]


def _spread(values: list[float]) -> dict[str, Any]:
    known = _known(values) or [math.nan]
    return {"mean": float(np.mean(known)), "low": min(known), "high": max(known), "seeds": values}


def markdown(table: dict[str, Any], command: str) -> str:
    """The whole report."""
    first, second = table["algorithms"]
    words = article()["words"]
    lines = ["# The article's comparison, run again", "", f"`{command}`", ""]
    lines += [f"| measure | article {first} | article {second} | here {first} | here {second} | p |", "|---|---|---|---|---|---|"]
    for name, row in table["rows"].items():
        theirs = [_theirs(words.get(name, {}).get(a), row["theirs"][a]) for a in (first, second)]
        ours = [_ours(row["ours"][a]) for a in (first, second)]
        lines.append(f"| {' | '.join((MEASURES[name][0], *theirs, *ours))} | {row['p']:.3f} |")
    seeds = len(table["rows"]["final_return"]["ours"][first]["seeds"])
    lines += [
        "",
        f"Here: mean over {seeds} seeds, lowest and highest in brackets; p of an exact permutation test over seeds, which cannot "
        f"be below {2.0 / math.comb(2 * seeds, seeds):.2g} with so many.",
        "",
    ]
    lines += [f"- {MEASURES[name][0]}: {note}." for name, note in NOTES.items()]
    return "\n".join([*lines, "", "## Reading", "", *reading(table), ""])


def reading(table: dict[str, Any]) -> list[str]:
    """Where the memory helps, where it harms, and where these runs cannot tell."""
    first, second = table["algorithms"]
    helps: list[str] = []
    harms: list[str] = []
    unclear: list[str] = []
    for name, (label, more_is_better) in MEASURES.items():
        row = table["rows"][name]
        difference = row["ours"][second]["mean"] - row["ours"][first]["mean"]
        if more_is_better is None or not math.isfinite(difference):
            continue
        chosen = unclear if row["p"] > LEVEL else helps if (difference > 0.0) == more_is_better else harms
        chosen.append(f"{label} (p = {row['p']:.3f})")
    groups = ((f"{second} is better", helps), (f"{first} is better", harms), ("No difference that these seeds show", unclear))
    return [f"- {title}: {'; '.join(found) or 'in no measure'}." for title, found in groups]


def _theirs(word: str | None, value: float | None) -> str:
    return word or ("no figure" if value is None else _number(value))


def _ours(spread: dict[str, Any]) -> str:
    if not math.isfinite(spread["mean"]):
        return "no flight reached the goal"
    return f"{_number(spread['mean'])} [{_number(spread['low'])}, {_number(spread['high'])}]"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
