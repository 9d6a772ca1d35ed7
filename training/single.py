"""The corridor task as a plain gymnasium environment, one corridor at a time.

    import gymnasium
    env = gymnasium.make("training.single:lstm_pilot/Corridor-v0")

Every episode flies a new corridor. Observations and actions are those of `training.environment`, one row of them.
"""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from policy_export.contract import ActionLayout, default_layout, paper_layout
from training import kernels
from training.config import EnvironmentConfig
from training.environment import CorridorVectorEnv
from training.worlds import FreshWorlds

ENVIRONMENT_ID = "lstm_pilot/Corridor-v0"
Observation = NDArray[np.float32]


class CorridorEnv(gymnasium.Env[Observation, Observation]):
    """Observations float32 [190], actions float32 [4] in SI units, 20 Hz.

    `config`: an EnvironmentConfig or a dict of its fields. `layout`: `default` (heading frame) or `paper` (corridor frame).
    """

    metadata = {"render_modes": [], "render_fps": 20}  # noqa: RUF012  # gymnasium's convention

    def __init__(
        self,
        config: EnvironmentConfig | dict[str, Any] | None = None,
        layout: Literal["default", "paper"] = "default",
        render_mode: None = None,
    ) -> None:
        settings = config if isinstance(config, EnvironmentConfig) else EnvironmentConfig.model_validate(config or {})
        paper = layout == "paper"
        observation, action = (
            paper_layout() if paper else default_layout(),
            ActionLayout(frame="corridor" if paper else "heading"),
        )
        self.render_mode = render_mode
        self.corridors = CorridorVectorEnv(1, settings, 0, observation, action, FreshWorlds(settings))
        self.observation_space = self.corridors.single_observation_space
        self.action_space = self.corridors.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in a new corridor; the same seed gives the same corridors and noise."""
        super().reset(seed=seed)
        self.corridors.rng = self.np_random
        observations, _ = self.corridors.reset()
        return observations[0], {}

    def step(self, action: Observation) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One 50 ms tick. `info` holds the reward's terms, and at the end how the episode came out."""
        corridors = self.corridors
        corridors.decide(np.asarray(action)[None], 1)
        outcome = int(corridors.arena.outcome[0])
        info: dict[str, Any] = {"reward_terms": dict(zip(kernels.TERM_NAMES, corridors.arena.terms[0].tolist(), strict=True))}
        if outcome != kernels.RUNNING:
            info["outcome"] = kernels.OUTCOME_NAMES[outcome]
        observation, reward = corridors.last_observations[0], float(corridors.last_rewards[0])
        return observation, reward, outcome not in {kernels.RUNNING, kernels.TIME_OUT}, outcome == kernels.TIME_OUT, info


gymnasium.register(ENVIRONMENT_ID, entry_point="training.single:CorridorEnv")
