"""Stable-Baselines3 models trained for a few thousand steps on a small task, and a comparison with their own `predict`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from policy_export.runner import PolicyRunner

LOW, HIGH = (-0.5, -0.4, -0.3, -1.0), (1.0, 0.5, 0.6, 1.2)
TRAINED_STEPS = 2048
LAYOUT = """
lidar: {beams: 8, fov_rad: 3.0, range_max_m: 4.0}
observation:
  - {name: lidar}
  - {name: goal_offset, frame: heading}
  - {name: other_wind, size: 2, unit: m/s}
"""
SIZE = 13


class Follow(gymnasium.Env):
    """Answer with what was seen two steps ago: worth remembering, and quick to step. The first value hardly moves."""

    def __init__(self, low: tuple[float, ...] = LOW, high: tuple[float, ...] = HIGH) -> None:
        self.observation_space = spaces.Box(-20.0, 20.0, (SIZE,), np.float32)
        self.action_space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
        self.seen = [np.zeros(len(low), np.float32)] * 3

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.count, self.place = 0, self.np_random.normal(size=SIZE)
        return self._observe(), {}

    def _observe(self) -> np.ndarray:
        self.place = 0.8 * self.place + 0.6 * self.np_random.normal(size=SIZE)
        observation = np.concatenate(([4.0 + 1e-3 * self.place[0]], 2.0 + 3.0 * self.place[1:])).astype(np.float32)
        self.seen = [*self.seen[1:], observation[1 : 1 + self.action_space.shape[0]]]
        return observation

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.count += 1
        reward = -float(np.abs(action - 0.2 * self.seen[0]).sum())
        return self._observe(), reward, False, self.count >= 40, {}


@dataclass(frozen=True)
class Setting:
    """One configuration: the policy's keyword arguments and what lies around it."""

    kwargs: dict[str, Any] = field(default_factory=dict)
    recurrent: bool = True
    normalised: bool = False
    squash: bool = False
    low: tuple[float, ...] = LOW
    high: tuple[float, ...] = HIGH


SETTINGS: dict[str, Setting] = {
    "separate critic LSTM, defaults": Setting(),
    "shared LSTM, tanh, list": Setting({"shared_lstm": True, "enable_critic_lstm": False, "net_arch": [24, 16]}),
    "no critic LSTM, relu, dict": Setting(
        {"enable_critic_lstm": False, "net_arch": {"pi": [24], "vf": [16, 16]}, "activation_fn": torch.nn.ReLU}
    ),
    "two layers, elu": Setting({"n_lstm_layers": 2, "activation_fn": torch.nn.ELU, "net_arch": {"pi": [20], "vf": []}}),
    "three layers, shared, no hidden": Setting(
        {"n_lstm_layers": 3, "shared_lstm": True, "enable_critic_lstm": False, "net_arch": [], "lstm_kwargs": {"dropout": 0.1}}
    ),
    "gelu, VecNormalize": Setting({"activation_fn": torch.nn.GELU}, normalised=True),
    "squashed, silu": Setting({"activation_fn": torch.nn.SiLU, "squash_output": True}, squash=True),
    "squashed, VecNormalize, two layers": Setting({"squash_output": True, "n_lstm_layers": 2}, squash=True, normalised=True),
    "no bias, leaky relu, only pi": Setting(
        {"lstm_kwargs": {"bias": False}, "activation_fn": torch.nn.LeakyReLU, "net_arch": {"pi": [16]}}
    ),
    "mlp": Setting(recurrent=False),
    "mlp, VecNormalize, mish": Setting({"activation_fn": torch.nn.Mish, "net_arch": [16]}, recurrent=False, normalised=True),
    "mlp, squashed, no hidden": Setting({"squash_output": True, "net_arch": []}, recurrent=False, squash=True),
    "mlp, uneven limits": Setting(
        {"log_std_init": 0.5}, recurrent=False, low=(-1 / 3, -0.1, -1e-3, -2.0), high=(0.7, 0.3, 0.123456789, 2.0)
    ),
}


@dataclass(frozen=True)
class Trained:
    model: BaseAlgorithm
    archive: Path
    statistics: Path | None
    normaliser: VecNormalize | None


def train(setting: Setting, folder: Path, steps: int = TRAINED_STEPS) -> Trained:
    """Train and save the model, and beside it the statistics as docs/export_sb3.md has them written."""
    environment: Any = DummyVecEnv([lambda: Follow(setting.low, setting.high)] * 4)
    normaliser = VecNormalize(environment, clip_obs=5.0) if setting.normalised else None
    common = {"n_steps": 128, "batch_size": 256, "n_epochs": 1, "learning_rate": 3e-3, "seed": 1, "use_sde": setting.squash}
    # SB3 starts with actions a hundred times smaller than the memory's output; so few steps would leave them constant.
    kwargs = setting.kwargs | {"ortho_init": False}
    if setting.recurrent:
        kwargs |= {"lstm_hidden_size": 24}
        model: BaseAlgorithm = RecurrentPPO("MlpLstmPolicy", normaliser or environment, policy_kwargs=kwargs, **common)
    else:
        model = PPO("MlpPolicy", normaliser or environment, policy_kwargs=kwargs, **common)
    model.learn(steps)
    archive = folder / "model.zip"
    model.save(archive)
    if normaliser is None:
        return Trained(model, archive, None, None)
    statistics, rms = folder / "stats.npz", normaliser.obs_rms
    np.savez(statistics, mean=rms.mean, var=rms.var, clip_obs=normaliser.clip_obs, epsilon=normaliser.epsilon)
    return Trained(model, archive, statistics, normaliser)


def largest_differences(trained: Trained, path: Path, steps: int = 1000) -> tuple[float, float]:
    """(action, h and c): the runner against `model.predict`, each carrying its own state, over steps with resets.

    That the actions move at all is asserted: constant ones would agree for nothing.
    """
    runner = PolicyRunner.load(path, allow_foreign=True)
    environment, rng = Follow(), np.random.default_rng(5)
    observation, _ = environment.reset(seed=9)
    state, start, worst, drift, answers = None, True, 0.0, 0.0, []
    for _ in range(steps):
        seen = observation if trained.normaliser is None else trained.normaliser.normalize_obs(observation)
        wanted, state = trained.model.predict(seen, state=state, episode_start=np.array([start]), deterministic=True)
        if start:
            runner.reset()
        answers.append(wanted)
        worst = max(worst, float(np.abs(runner.step(observation) - wanted).max()))
        if state is not None:
            pairs = zip(runner.hidden_state, state, strict=True)
            drift = max(drift, *(float(np.abs(mine - theirs[:, 0]).max()) for mine, theirs in pairs))
        start = rng.random() < 0.02
        observation = environment.reset()[0] if start else environment._observe()
    assert np.ptp(answers, axis=0).min() > 0.01
    return worst, drift
