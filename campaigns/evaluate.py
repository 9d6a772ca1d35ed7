"""Many flights of one policy on one split, over all cores, with progress; the result as one JSON-able object."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from campaigns.lockstep import LockstepFlight, StackConfig
from campaigns.splits import Split
from campaigns.statistics import EpisodeResult, summarise
from policy_export.runner import PolicyRunner
from safety.config import SafetyConfig
from sim_gateway.lidar import LidarConfig
from sim_gateway.simulation import WindConfig

_runners: dict[Path, PolicyRunner] = {}


@dataclass(frozen=True, slots=True)
class Campaign:
    """A policy on a split: everything a worker process needs."""

    policy: Path
    split: Split
    safety: SafetyConfig
    filtered: bool = True
    arrival_radius_m: float = 0.2
    dynamics: str = "internal"

    def stack(self) -> StackConfig:
        """The conditions of every episode."""
        return StackConfig(
            policy=self.policy,
            safety=self.safety,
            filtered=self.filtered,
            takeoff_height_m=self.split.takeoff_height_m,
            arrival_radius_m=self.arrival_radius_m,
            estimate=self.split.estimate,
            dynamics=self.dynamics,
            wind=WindConfig(self.split.wind_m_s, self.split.gust_sigma_m_s),
            lidar=LidarConfig.device(self.split.dropout),
        )


def fly_episode(campaign: Campaign, index: int) -> EpisodeResult:
    """The `index`-th episode; the runner is loaded once per process, its hidden state is zeroed at each start."""
    if campaign.policy not in _runners:
        _runners[campaign.policy] = PolicyRunner.load(campaign.policy)
    return LockstepFlight(campaign.split.world(index), campaign.stack(), _runners[campaign.policy]).run()


def run_campaign(campaign: Campaign, episodes: int, workers: int | None = None) -> list[EpisodeResult]:
    """All episodes, in the order of their seeds, on `workers` processes (all cores by default)."""
    workers = min(workers or os.cpu_count() or 1, episodes)
    with _progress() as progress:
        bar = progress.add_task("flying", total=episodes, clean=0, done=0)
        results: dict[int, EpisodeResult] = {}
        for index, result in _results(campaign, episodes, workers):
            results[index] = result
            clean = sum(r.clean_success for r in results.values())
            progress.update(bar, advance=1, clean=f"{100 * clean / len(results):.1f}")
    return [results[i] for i in range(episodes)]


def _results(campaign: Campaign, episodes: int, workers: int) -> Iterator[tuple[int, EpisodeResult]]:
    if workers == 1:
        yield from ((i, fly_episode(campaign, i)) for i in range(episodes))
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(fly_episode, campaign, i): i for i in range(episodes)}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("clean {task.fields[clean]} %"))
    return Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True))


def report(campaign: Campaign, split_name: str, results: list[EpisodeResult]) -> dict[str, Any]:
    """The figures, what they were measured on, and every episode."""
    runner = PolicyRunner.load(campaign.policy)
    return {
        "policy": str(campaign.policy),
        "policy_sha256": runner.sha256,
        "weights_sha256": runner.metadata.weights_sha256,
        "split": split_name,
        "description": campaign.split.description,
        "first_seed": campaign.split.first_seed,
        "dynamics": campaign.dynamics,
        "safety": campaign.filtered,
        **summarise(results),
        "episodes": [asdict(r) for r in results],
    }
