"""Evaluations as Markdown: one table of all of them, then each with its failures and the commands that fly these again."""

from __future__ import annotations

from typing import Any

SHOWN_FAILURES = 8


def markdown(reports: list[dict[str, Any]]) -> str:
    """A table with a row per evaluation where there are several, and every evaluation by itself."""
    parts = [overview(reports)] if len(reports) > 1 else []
    return "\n".join([*parts, *(one_evaluation(one) for one in reports)])


def overview(reports: list[dict[str, Any]]) -> str:
    """One row per evaluation."""
    rates = "clean success | clean arrival | success"
    head = f"policy | split | dynamics | safety | {rates} | collisions | path efficiency | mean jerk, m/s3"
    rows = [
        " | ".join(
            (
                *(str(one[key]) for key in ("policy", "split", "dynamics")),
                "on" if one["safety"] else "off",
                *(_rate(one[key]) for key in ("clean_success", "clean_arrival", "success")),
                *(f"{one[key]:.3f}" for key in ("collisions_per_episode", "path_efficiency", "mean_jerk_m_s3")),
            )
        )
        for one in reports
    ]
    return "\n".join([f"| {head} |", "|---" * 10 + "|", *(f"| {row} |" for row in rows), ""])


def one_evaluation(one: dict[str, Any]) -> str:
    """All figures of one evaluation."""
    rows = [
        ("policy", f"{one['policy']} ({one['policy_sha256'][:12]})"),
        ("corridors", f"{one['split']}: {one['description']}, seeds from {one['first_seed']}"),
        ("dynamics", one["dynamics"]),
        ("safety layer", "on" if one["safety"] else "off"),
        ("clean success (goal within 0.3 m, no contact), 95 % interval", _rate(one["clean_success"])),
        ("clean arrival (goal by its own estimate, no contact, inside the fence)", _rate(one["clean_arrival"])),
        ("success (contacts allowed)", _rate(one["success"])),
        ("collisions per episode", f"{one['collisions_per_episode']:.3f}"),
        ("path efficiency", f"{one['path_efficiency']:.3f}"),
        ("smoothness: mean jerk", f"{one['mean_jerk_m_s3']:.2f} m/s3"),
        ("episode length", f"{one['episode_steps']:.0f} ticks, {one['duration_s']:.1f} s"),
        ("least clearance", f"{one['min_clearance_m']:.2f} m (mean of episodes {one['mean_min_clearance_m']:.2f} m)"),
        ("failures", "; ".join(f"{cause}: {len(seeds)}" for cause, seeds in one["failures"].items()) or "none"),
    ]
    table = ["| figure | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows), ""]
    return "\n".join([*table, *_replays(one)])


def replay_command(one: dict[str, Any], seed: int) -> str:
    """The command that flies one episode again, bit for bit."""
    safety = "on" if one["safety"] else "off"
    return (
        f"evaluate-policy {one['policy']} --split {one['split']} --dynamics {one['dynamics']} --safety {safety} "
        f"--seed {seed} --episodes 1"
    )


def _replays(one: dict[str, Any]) -> list[str]:
    """The seeds of every kind of failure, and how to fly the first of them again."""
    if not one["failures"]:
        return []
    lines = [
        f"- {cause}: seeds {', '.join(map(str, seeds[:SHOWN_FAILURES]))}{', ...' if len(seeds) > SHOWN_FAILURES else ''}"
        for cause, seeds in one["failures"].items()
    ]
    first = next(iter(one["failures"].values()))[0]
    return [*lines, "", f"To fly one again: `{replay_command(one, first)}`", ""]


def _rate(p: dict[str, Any]) -> str:
    return f"{100 * p['rate']:.1f} % [{100 * p['low']:.1f}, {100 * p['high']:.1f}] of {p['n']}"
