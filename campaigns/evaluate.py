"""Many flights of one policy on one split, over all cores or a Ray cluster, with progress; the result as one JSON-able object."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from campaigns.lockstep import LockstepFlight, StackConfig
from campaigns.splits import Split
from campaigns.statistics import EpisodeResult, summarise
from campaigns.workers import over_processes, over_ray
from policy_export.policy_file import check_policy_bytes
from policy_export.runner import PolicyRunner
from safety.config import SafetyConfig
from sim_gateway.simulation import WindConfig

TRAINING = "training"
TELL_EVERY_S = 30.0
"""How often a log file, not a screen, is told of progress."""
_runners: dict[bytes | Path, PolicyRunner] = {}


@dataclass(frozen=True, slots=True)
class Campaign:
    """A policy on a split: everything a worker process needs. `dynamics`: one of the gateway's, or `TRAINING`."""

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
            safety=self.split.safety(self.safety),
            filtered=self.filtered,
            takeoff_height_m=self.split.takeoff_height_m,
            arrival_radius_m=self.arrival_radius_m,
            estimate=self.split.estimate,
            dynamics=self.dynamics,
            wind=WindConfig(self.split.wind_m_s, self.split.gust_sigma_m_s),
            lidar=self.split.lidar(),
        )


def fly_episode(campaign: Campaign, index: int) -> EpisodeResult:
    """The `index`-th episode; the runner is loaded once per process, its hidden state is zeroed at each start."""
    if campaign.policy not in _runners:
        _runners[campaign.policy] = PolicyRunner.load(campaign.policy)
    return _fly(campaign, _runners[campaign.policy], index)


def fly_elsewhere(campaign: Campaign, policy: bytes, index: int) -> EpisodeResult:
    """As `fly_episode`, on a machine that may not have the policy's file: its bytes come along."""
    if policy not in _runners:
        _runners[policy] = PolicyRunner(check_policy_bytes(policy, campaign.policy))
    return _fly(campaign, _runners[policy], index)


def _fly(campaign: Campaign, runner: PolicyRunner, index: int) -> EpisodeResult:
    world, stack = campaign.split.world(index), campaign.stack()
    if campaign.dynamics != TRAINING:
        return LockstepFlight(world, stack, runner).run()
    from campaigns.training_flight import TrainingFlight  # noqa: PLC0415  # needs the trainer's libraries

    return TrainingFlight(world, stack, runner).run()


def run_campaign(
    campaign: Campaign, episodes: int, workers: int | None = None, ray_address: str | None = None
) -> list[EpisodeResult]:
    """All episodes, in the order of their seeds: on `workers` processes (all cores by default), or on a Ray cluster."""
    if ray_address is None:
        arriving = over_processes(partial(fly_episode, campaign), episodes, workers)
    else:
        arriving = over_ray(partial(fly_elsewhere, campaign, campaign.policy.read_bytes()), episodes, ray_address)
    with _progress() as progress:
        bar = progress.add_task("flying", total=episodes, clean=0, done=0)
        results: dict[int, EpisodeResult] = {}
        told_s = time.monotonic()
        for index, result in arriving:
            results[index] = result
            clean = f"{100 * sum(r.clean_success for r in results.values()) / len(results):.1f}"
            progress.update(bar, advance=1, clean=clean)
            if not progress.console.is_terminal and time.monotonic() - told_s > TELL_EVERY_S:  # a bar is for a screen
                told_s = time.monotonic()
                progress.console.print(f"{len(results)} of {episodes} flown, clean {clean} %", highlight=False)
    return [results[i] for i in range(episodes)]


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
