"""The corridors of the trainer as an SB3 `VecEnv`, all of them in one compiled call: what SB3's RecurrentPPO trains on here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import VecEnv

from training.environment import CorridorVectorEnv

SIZES = {"lstm_hidden_size": 128, "net_arch": {"pi": [64], "vf": [64]}}
SHARED = {"shared_lstm": True, "enable_critic_lstm": False}


class Sb3Corridors(VecEnv):
    """`CorridorVectorEnv` under SB3's interface; nothing is copied or looped over that SB3 does not ask for."""

    def __init__(self, env: CorridorVectorEnv) -> None:
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.env = env
        self._actions: np.ndarray = np.zeros((env.num_envs, 4), np.float32)

    def reset(self) -> np.ndarray:
        return self.env.reset()[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, info = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in info["ended"]:
            infos[i] = {"terminal_observation": info["final_obs"][i], "TimeLimit.truncated": bool(truncated[i])}
        return observations, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"{attr_name} cannot be set from outside")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise AttributeError(f"no method {method_name}")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> Sequence[bool]:
        return [False] * self.num_envs


def recurrent_ppo(env: CorridorVectorEnv, *, shared: bool, **settings: Any) -> RecurrentPPO:
    """RecurrentPPO with an LSTM of 128 and heads of 64, tanh; its critic has one of its own, unless it is `shared`, as ours."""
    policy = SIZES | (SHARED if shared else {})
    return RecurrentPPO("MlpLstmPolicy", Sb3Corridors(env), policy_kwargs=policy, device="cpu", seed=0, **settings)
