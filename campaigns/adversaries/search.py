"""Search for the command sequence that brings the hull nearest to an obstacle or the fence: the cross-entropy method.

Rubinstein and Kroese, The Cross-Entropy Method (2004): draw a population, keep the best, fit a normal distribution to them,
draw again. A sequence is a few segments of constant command and of the sign with which the estimate errs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from campaigns.adversaries.flight import Outcome
from campaigns.adversaries.policies import FAST_M_S, Policy, View, command
from safety.messages import VelocityCommand

Array = NDArray[np.float64]
SEGMENTS, PER_SEGMENT = 6, 5  # velocity x, y, z, yaw rate, sign of the errors
POPULATION, ELITE, GENERATIONS = 20, 5, 8
SEQUENCE_TICKS = 90
SMOOTHING, LEAST_SPREAD = 0.7, 0.15
SPEED_SCALE = np.array((FAST_M_S, FAST_M_S, 1.0, 1.5))


@dataclass(frozen=True)
class Attack:
    """One command sequence: `genes` [segments, 5], each about standard normal."""

    genes: Array

    def policy(self, view: View) -> VelocityCommand:
        """The command of the segment that the tick falls into."""
        return command(*(np.tanh(self._now(view.tick)[:4]) * SPEED_SCALE))

    def error_sign(self, tick: int) -> float:
        """-1: the estimate lags behind the threat; 1: it runs ahead."""
        return 1.0 if self._now(tick)[4] > 1.0 else -1.0

    def _now(self, tick: int) -> Array:
        segment: Array = self.genes[min(tick * SEGMENTS // SEQUENCE_TICKS, SEGMENTS - 1)]
        return segment


Fly = Callable[[Policy, Callable[[int], float]], Outcome]


def attacks(fly: Fly, random: np.random.Generator) -> Iterator[tuple[Attack, Outcome]]:
    """All attacks of one search with what each came to. `fly` must give every attack the same start and the same noise."""
    mean, spread = np.zeros((SEGMENTS, PER_SEGMENT)), np.ones((SEGMENTS, PER_SEGMENT))
    for _ in range(GENERATIONS):
        drawn = [Attack(mean + spread * random.standard_normal(mean.shape)) for _ in range(POPULATION)]
        outcomes = [fly(attack.policy, attack.error_sign) for attack in drawn]
        yield from zip(drawn, outcomes, strict=True)
        best = np.argsort([outcome.worst_m for outcome in outcomes])[:ELITE]
        elite = np.stack([drawn[i].genes for i in best])
        mean = SMOOTHING * elite.mean(axis=0) + (1.0 - SMOOTHING) * mean
        spread = np.maximum(SMOOTHING * elite.std(axis=0) + (1.0 - SMOOTHING) * spread, LEAST_SPREAD)
