"""Evaluations beside each other, a row each with the command that makes it: for README and the model cards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

RATES = ("clean success (95 %)", "clean arrival, by its own estimate")
HEAD = ("policy", "corridors", "safety layer", "vehicle", *RATES, "path efficiency", "failures")
VEHICLES = {"internal": "six degrees of freedom", "training": "the trainer's", "jsbsim": "JSBSim"}


def rate(p: dict[str, Any]) -> str:
    """A proportion with its interval."""
    return f"{100 * p['rate']:.1f} % ({100 * p['low']:.1f} to {100 * p['high']:.1f}) of {p['n']:,}"


def evaluation_table(results: list[dict[str, Any]]) -> str:
    """Markdown: `unseen` first, the whole stack before the policy alone."""
    ordered = sorted(results, key=_rank)
    return "\n".join([_row(HEAD), "|---" * len(HEAD) + "|", *(_row(_cells(one)) for one in ordered)])


def commands(results: list[dict[str, Any]]) -> str:
    """What makes the rows, in their order, as a block of shell."""
    return "\n".join(["```", *(command(one) for one in sorted(results, key=_rank)), "```"])


def command(one: dict[str, Any]) -> str:
    """What makes one row."""
    dynamics = "" if one["dynamics"] == "internal" else f" --dynamics {one['dynamics']}"
    safety, episodes = "on" if one["safety"] else "off", one["clean_success"]["n"]
    return f"evaluate-policy {one['policy']} --split {one['split']} --episodes {episodes} --safety {safety}{dynamics}"


def _rank(one: dict[str, Any]) -> tuple[object, ...]:
    return one["split"] != "unseen", one["split"], one["policy"], not one["safety"], list(VEHICLES).index(one["dynamics"])


def _cells(one: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"`{Path(one['policy']).stem}`",
        f"`{one['split']}`",
        "on" if one["safety"] else "off",
        VEHICLES[one["dynamics"]],
        rate(one["clean_success"]),
        f"{100 * one['clean_arrival']['rate']:.1f} %",
        f"{one['path_efficiency']:.3f}",
        ", ".join(f"`{cause}` {len(seeds)}" for cause, seeds in one["failures"].items()) or "none",
    )


def _row(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"
