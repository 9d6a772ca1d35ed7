"""Where episodes' corridors come from: a pool that is renewed steadily while training, a fixed list while evaluating."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.scene import World
from training.config import EVALUATION_SEED_START, TRAINING_SEED_START, EnvironmentConfig


class WorldSource(Protocol):
    """Gives the corridor of each new episode."""

    def next_world(self, environment: int, rng: np.random.Generator) -> World:
        """The corridor for the next episode of ``environment``."""
        ...


def corridor_configs(config: EnvironmentConfig) -> tuple[CorridorConfig, CorridorConfig]:
    """Generator settings of static corridors and of corridors with moving pillars."""
    static = CorridorConfig(pillars=config.pillars, vehicle_radius_m=config.vehicle_radius_m)
    slowest = min(0.2, config.mover_speed_max_mps)
    moving = static.model_copy(update={"movers": config.moving_pillars, "mover_speed_m_s": (slowest, config.mover_speed_max_mps)})
    return static, moving


def world_for_seed(seed: int, config: EnvironmentConfig) -> World:
    """The corridor of ``seed``: a share ``moving_share`` of all seeds (by their low digits) has moving pillars."""
    static, moving = corridor_configs(config)
    return generate_corridor(seed, moving if seed % 1000 < 1000 * config.moving_share else static)


class FixedWorlds:
    """Environment i always gets world i (modulo their number): evaluation and tests."""

    def __init__(self, worlds: Sequence[World]) -> None:
        self._worlds = list(worlds)

    def next_world(self, environment: int, rng: np.random.Generator) -> World:
        """See WorldSource."""
        return self._worlds[environment % len(self._worlds)]


class FreshWorlds:
    """A new corridor from the training seeds for every episode."""

    def __init__(self, config: EnvironmentConfig) -> None:
        self._config = config

    def next_world(self, environment: int, rng: np.random.Generator) -> World:
        """See WorldSource."""
        return world_for_seed(int(rng.integers(TRAINING_SEED_START, EVALUATION_SEED_START)), self._config)


class WorldPool:
    """``world_pool`` corridors drawn from the training seeds; the oldest is replaced every ``world_renewal_episodes``."""

    def __init__(self, config: EnvironmentConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._oldest = self._begun = 0
        self.seeds = rng.integers(TRAINING_SEED_START, EVALUATION_SEED_START, config.world_pool)
        self._worlds = [world_for_seed(int(seed), config) for seed in self.seeds]

    def next_world(self, environment: int, rng: np.random.Generator) -> World:
        """A random corridor of the pool."""
        self._begun += 1
        if self._begun % self._config.world_renewal_episodes == 0:
            slot = self._oldest
            self._oldest = (slot + 1) % len(self._worlds)
            self.seeds[slot] = rng.integers(TRAINING_SEED_START, EVALUATION_SEED_START)
            self._worlds[slot] = world_for_seed(int(self.seeds[slot]), self._config)
        return self._worlds[int(rng.integers(len(self._worlds)))]

    def state(self) -> dict[str, NDArray[np.int64] | int]:
        """Seeds in the pool, the next slot to renew, and the episodes begun."""
        return {"seeds": self.seeds.copy(), "oldest": self._oldest, "begun": self._begun}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of ``state``: draws the same corridors again."""
        self.seeds = np.asarray(state["seeds"], dtype=np.int64).copy()
        self._oldest, self._begun = int(state["oldest"]), int(state["begun"])
        self._worlds = [world_for_seed(int(seed), self._config) for seed in self.seeds]
