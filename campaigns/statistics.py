"""Proportions with honest intervals, and the summary of many episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from training.intervals import wilson_interval


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """What one flight came to. Lengths in m, times in s; `failure` is None or one of the causes in `FAILURES`.

    `success`: the true position came within the goal's radius. `arrived`: the vehicle took itself to be there.
    """

    seed: int
    success: bool
    arrived: bool
    contacts: int
    failure: str | None
    ticks: int
    duration_s: float
    path_length_m: float
    shortest_path_m: float
    min_clearance_m: float
    mean_jerk_m_s3: float
    interventions: dict[str, int]

    @property
    def clean_success(self) -> bool:
        """The goal within its radius and nothing touched."""
        return self.success and self.contacts == 0

    @property
    def clean_arrival(self) -> bool:
        """At the goal as far as the vehicle could know, nothing touched, the fence not left."""
        return self.arrived and self.contacts == 0 and self.failure in (None, "missed_goal")

    @property
    def path_efficiency(self) -> float:
        """Shortest over flown, at most 1 (the reference path is itself an approximation)."""
        return min(1.0, self.shortest_path_m / self.path_length_m) if self.path_length_m > 0.0 else 0.0


FAILURES = ("hit_static", "hit_moving", "wall", "fence", "timeout", "missed_goal", "diverged")


def proportion(flags: Sequence[bool]) -> dict[str, float | int]:
    """Rate with its 95 % interval and n."""
    n, successes = len(flags), sum(flags)
    low, high = wilson_interval(successes, n)
    return {"rate": successes / n if n else 0.0, "low": low, "high": high, "n": n}


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean; NaN for nothing."""
    return sum(values) / len(values) if values else float("nan")


def summarise(results: Sequence[EpisodeResult]) -> dict[str, Any]:
    """The figures of an evaluation as one JSON-able object. Efficiency and steps are over successful episodes."""
    done = [r for r in results if r.success]
    rules: dict[str, int] = {}
    for result in results:
        for rule, count in result.interventions.items():
            rules[rule] = rules.get(rule, 0) + count
    ticks = sum(r.ticks for r in results)
    return {
        "success": proportion([r.success for r in results]),
        "clean_success": proportion([r.clean_success for r in results]),
        "clean_arrival": proportion([r.clean_arrival for r in results]),
        "collisions_per_episode": mean([r.contacts for r in results]),
        "path_efficiency": mean([r.path_efficiency for r in done]),
        "episode_steps": mean([r.ticks for r in done]),
        "duration_s": mean([r.duration_s for r in done]),
        "min_clearance_m": min((r.min_clearance_m for r in results), default=float("nan")),
        "mean_min_clearance_m": mean([r.min_clearance_m for r in results]),
        "mean_jerk_m_s3": mean([r.mean_jerk_m_s3 for r in done]),
        "ticks": ticks,
        "interventions_per_tick": {rule: count / ticks for rule, count in sorted(rules.items())} if ticks else {},
        "failures": {
            cause: [r.seed for r in results if r.failure == cause]
            for cause in FAILURES
            if any(r.failure == cause for r in results)
        },
    }
