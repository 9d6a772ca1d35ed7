"""Figures 4 to 9 of the article, drawn from our runs; the data of each stands beside it as JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from campaigns.evaluate import Campaign
from campaigns.lockstep import StackConfig
from campaigns.paper.measures import MEASURES, Curves, write_json
from campaigns.paper.report import NOTES
from campaigns.paper.runs import Run
from campaigns.splits import Split
from campaigns.training_flight import TrainingFlight
from policy_export.runner import PolicyRunner
from safety.config import SafetyConfig
from sim_gateway.scene import World

COLOURS = ("#1f77b4", "#d62728")
CURVES = {
    "figure_4_reward": ("reward", "episodes", "mean reward per episode (unscaled)"),
    "figure_5_collisions": ("collisions", "episodes", "collisions per episode"),
    "figure_6_value_loss": ("value_loss", "decisions", "value loss"),
    "figure_7_entropy": ("entropy", "episodes", "policy entropy, nats"),
}
# Where the article's own figure means the same thing in the same unit, its last value is drawn as a dashed line.
COMPARABLE = {"figure_7_entropy": "final_entropy"}
BARS = (
    *("known_success", "unseen_success", "moving_success", "path_efficiency"),
    *("episode_steps", "mean_jerk_m_s3", "final_collisions", "final_entropy"),
)
DOTS_PER_INCH = 120


def draw_curves(out: Path, curves: dict[str, list[Curves]], article: dict[str, Any]) -> None:
    """Figures 4 to 7: every seed as a thin line, their mean as a thick one."""
    for name, (what, along, label) in CURVES.items():
        figure = Figure(figsize=(7.0, 4.0), layout="constrained")
        axes = figure.add_subplot()
        for colour, (algorithm, runs) in zip(COLOURS, curves.items(), strict=True):
            _draw_runs(axes, runs, (along, what), colour, f"{algorithm}, {len(runs)} seeds")
            if name in COMPARABLE:
                theirs = article[algorithm][COMPARABLE[name]]
                axes.axhline(theirs, color=colour, linestyle="--", linewidth=1.0, label=f"{algorithm}, article's last value")
        axes.set(xlabel=f"training {along}", ylabel=label)
        axes.legend()
        figure.savefig(out / f"{name}.png", dpi=DOTS_PER_INCH)
        data = {a: [{key: value.tolist() for key, value in asdict(run).items()} for run in runs] for a, runs in curves.items()}
        write_json(out / f"{name}.json", {a: [{along: run[along], what: run[what]} for run in runs] for a, runs in data.items()})


def _draw_runs(axes: Axes, runs: list[Curves], names: tuple[str, str], colour: str, label: str) -> None:
    along, what = ([getattr(run, name) for run in runs] for name in names)
    for x, y in zip(along, what, strict=True):
        axes.plot(x, y, color=colour, alpha=0.25, linewidth=0.8)
    grid = np.linspace(max(x[0] for x in along), min(x[-1] for x in along), 200)
    mean = np.mean([np.interp(grid, x, y) for x, y in zip(along, what, strict=True)], axis=0)
    axes.plot(grid, mean, color=colour, linewidth=2.0, label=label)


def draw_flights(out: Path, runs: list[Run], split: Split, safety: SafetyConfig) -> None:
    """Figure 8: the first moving corridor from above, flown by one policy of each algorithm."""
    world = split.world(0)
    figure = Figure(figsize=(11.0, 3.0 * len(runs)), layout="constrained")
    data: dict[str, Any] = {"seed": world.seed}
    for row, (colour, run) in enumerate(zip(COLOURS, runs, strict=False)):
        axes = figure.add_subplot(len(runs), 1, row + 1)
        stack: StackConfig = Campaign(run.policy, split, safety, filtered=False).stack()
        flight = TrainingFlight(world, stack, PolicyRunner.load(run.policy))
        result = flight.run()
        path = flight.log.positions_m
        _draw_world(axes, world)
        axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.5)
        outcome = result.failure or f"goal after {result.duration_s:.0f} s"
        axes.set(title=f"{run.algorithm}, seed {run.config.seed}: {outcome}", xlabel="x, m", ylabel="y, m", aspect="equal")
        data[run.algorithm] = {"outcome": outcome, "path_m": path[:, :2].round(3).tolist()}
    figure.savefig(out / "figure_8_flight.png", dpi=DOTS_PER_INCH)
    write_json(out / "figure_8_flight.json", data)


def _draw_world(axes: Axes, world: World) -> None:
    for x0, y0, _, x1, y1, _ in world.static_boxes:
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color="0.6"))
    for mover in world.movers:
        half_x, half_y = 0.5 * mover.size_m[0], 0.5 * mover.size_m[1]
        low, height = mover.y_low_m - half_y, mover.y_high_m - mover.y_low_m + 2.0 * half_y
        axes.add_patch(Rectangle((mover.x_m - half_x, low), 2.0 * half_x, height, color="#ffbb78"))
    axes.plot(*world.start[:2], "k^", *world.goal[:2], "g*", markersize=9)
    axes.set(xlim=(-1.0, world.length_m + 1.0), ylim=(-0.5 * world.width_m - 0.5, 0.5 * world.width_m + 0.5))


def draw_bars(out: Path, table: dict[str, Any]) -> None:
    """Figure 9: eight measures, the article's two bars beside our two."""
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    for place, measure in enumerate(BARS):
        axes = figure.add_subplot(2, 4, place + 1)
        row = table["rows"][measure]
        for k, (algorithm, colour) in enumerate(zip(table["algorithms"], COLOURS, strict=True)):
            theirs, ours = row["theirs"][algorithm], row["ours"][algorithm]
            if theirs is not None:
                axes.bar(k, theirs, color=colour, alpha=0.35)
            else:
                axes.text(k, 0.0, "no figure", ha="center", va="bottom", rotation=90, fontsize=7)
            spread = [[ours["mean"] - ours["low"]], [ours["high"] - ours["mean"]]]
            axes.bar(2.5 + k, ours["mean"], yerr=np.nan_to_num(spread), color=colour, capsize=3)
        axes.set_xticks([0.5, 3.0], ["article *" if measure in NOTES else "article", "here"])
        axes.set_xlim(-0.6, 4.1)
        axes.set_title(MEASURES[measure][0], fontsize=9)
    figure.supxlabel(
        f"blue: {table['algorithms'][0]}, red: {table['algorithms'][1]}; * defined otherwise, see README.md", fontsize=9
    )
    figure.savefig(out / "figure_9_measures.png", dpi=DOTS_PER_INCH)
    write_json(out / "figure_9_measures.json", {measure: table["rows"][measure] for measure in BARS})
