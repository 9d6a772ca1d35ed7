"""What the article measures, of our runs: curves over episodes, and the figures of its Table 2."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from campaigns.evaluate import TRAINING, Campaign, run_campaign
from campaigns.paper.runs import Run
from campaigns.splits import Split
from campaigns.statistics import summarise
from safety.config import SafetyConfig

BINS = 50
# Shares of a run that count as its beginning and its end.
BEGINNING, END = 0.05, 0.1
# A run has converged once its success, averaged over a bin, stays above this share of its final one.
CONVERGED = 0.9

Array = NDArray[np.float64]
MEASURES: dict[str, tuple[str, bool | None]] = {
    "final_return": ("final reward per episode (unscaled)", True),
    "known_success": ("success, known worlds", True),
    "unseen_success": ("success, unseen worlds", True),
    "convergence_episode": ("convergence episode", False),
    "initial_collisions": ("collisions per 100 episodes, first", None),
    "final_collisions": ("collisions per 100 episodes, last", False),
    "value_loss_variance": ("variance of the value loss, second half", False),
    "final_entropy": ("final policy entropy, nats", None),
    "mean_jerk_m_s3": ("path smoothness: mean jerk, m/s3", False),
    "moving_success": ("success among moving obstacles", True),
    "episode_steps": ("episode length, steps", False),
    "path_efficiency": ("path efficiency", True),
}
"""Name of each measure, and whether more of it is better."""


@dataclass(frozen=True, slots=True)
class Curves:
    """Of one run, in bins of equally many updates: episodes and decisions so far, then means over the bin."""

    episodes: Array
    decisions: Array
    reward: Array
    collisions: Array
    success: Array
    value_loss: Array
    entropy: Array


def read_curves(run: Run) -> Curves:
    """From the run's metrics."""
    rows = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    ended = np.array([sum(row["outcomes"].values()) for row in rows], dtype=np.float64)
    bins = np.array_split(np.arange(len(rows)), min(BINS, len(rows)))

    def per_episode(values: Array) -> Array:
        return np.array([values[b].sum() / max(ended[b].sum(), 1.0) for b in bins])

    def plain(name: str) -> Array:
        return np.array([np.mean([rows[k][name] for k in b]) for b in bins])

    def count(*names: str) -> Array:
        return np.array([sum(row["outcomes"].get(name, 0) for name in names) for row in rows], dtype=np.float64)

    last = [int(b[-1]) for b in bins]
    return Curves(
        episodes=np.cumsum(ended)[last],
        decisions=np.array([rows[k]["decisions"] for k in last], dtype=np.float64),
        reward=per_episode(np.array([row.get("mean_return", 0.0) for row in rows]) * ended),
        collisions=per_episode(count("contact", "left_band")),
        success=per_episode(count("goal")),
        value_loss=plain("value_loss"),
        entropy=plain("entropy"),
    )


def training_measures(curves: Curves) -> dict[str, float]:
    """The rows of Table 2 that training itself gives."""
    bins = len(curves.episodes)
    first, last = max(1, round(BEGINNING * bins)), max(1, round(END * bins))
    return {
        "final_return": float(curves.reward[-last:].mean()),
        "convergence_episode": convergence_episode(curves, last),
        "initial_collisions": 100.0 * float(curves.collisions[:first].mean()),
        "final_collisions": 100.0 * float(curves.collisions[-last:].mean()),
        "value_loss_variance": float(curves.value_loss[bins // 2 :].var()),
        "final_entropy": float(curves.entropy[-last:].mean()),
    }


def convergence_episode(curves: Curves, last: int) -> float:
    """Episodes until the success stays above `CONVERGED` of its final value."""
    below = np.flatnonzero(curves.success < CONVERGED * curves.success[-last:].mean())
    return float(curves.episodes[min(int(below[-1]) + 1, len(curves.episodes) - 1)] if below.size else curves.episodes[0])


def flown_measures(
    run: Run, splits: dict[str, Split], safety: SafetyConfig, episodes: int, workers: int | None
) -> dict[str, Any]:
    """The rows that flights of the trained policy give: training dynamics, no safety layer, as in the article.

    They are kept in the run's folder.
    """
    path = run.folder / "flights.json"
    asked = {"episodes": episodes, "decisions": run.config.decisions}
    if path.exists() and (kept := json.loads(path.read_text()))["asked"] == asked:
        return dict(kept["measures"])
    fly = partial(_summary, run, safety, episodes, workers)
    known, unseen, moving = (fly(splits[name]) for name in ("static", "unseen", "dynamic"))
    measures = {
        "known_success": known["success"]["rate"],
        "unseen_success": unseen["success"]["rate"],
        "moving_success": moving["success"]["rate"],
        "mean_jerk_m_s3": unseen["mean_jerk_m_s3"],
        "episode_steps": unseen["episode_steps"],
        "path_efficiency": unseen["path_efficiency"],
    }
    path.write_text(json.dumps({"asked": asked, "measures": measures}, indent=1) + "\n")
    return measures


def _summary(run: Run, safety: SafetyConfig, episodes: int, workers: int | None, split: Split) -> dict[str, Any]:
    campaign = Campaign(run.policy, split, safety, filtered=False, dynamics=TRAINING)
    return summarise(run_campaign(campaign, episodes, workers))


def write_json(path: Path, content: Any) -> None:
    """Numbers that are not finite become null: a measure over no successful flight says nothing."""
    path.write_text(json.dumps(_finite(content), indent=1, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
