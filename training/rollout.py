"""Fly the environments with the current policy and record what the learner needs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policy_export.memory import Memory
from policy_export.network import PolicyNetwork
from training.config import PpoConfig
from training.environment import CorridorVectorEnv
from training.fast_lstm import RolloutMemory, rollout_memory
from training.ppo import Batch, advantages, correlated_log_prob


@dataclass(slots=True)
class RolloutSummary:
    """What happened in one rollout: finished episodes by outcome, their lengths and (scaled) returns, sums of reward terms."""

    decisions: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    episode_ticks: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    reward_terms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Step:
    """What is the same in every decision of a rollout: ticks per action, noise correlation and deviation, the memory."""

    hold: int
    rho: float
    std: Tensor
    memory: Memory | RolloutMemory


class RolloutCollector:
    """Keeps observations, hidden state and exploration noise of all environments from one rollout to the next."""

    def __init__(self, env: CorridorVectorEnv, network: PolicyNetwork, config: PpoConfig, generator: torch.Generator) -> None:
        self.env, self.network, self.config, self.generator = env, network, config, generator
        count = env.num_envs
        self.device = network.log_std.device
        observations, _ = env.reset()
        self.observation = self._tensor(observations)
        self.reset = torch.ones(count, dtype=torch.bool, device=self.device)
        self.h, self.c = network.initial_state(count)
        self.noise = self._fresh_noise()

    def state(self) -> dict[str, Any]:
        """Everything needed to go on exactly here (the environment keeps its own state)."""
        return {name: getattr(self, name).cpu().clone() for name in ("observation", "reset", "h", "c", "noise")}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of ``state``."""
        for name in ("observation", "reset", "h", "c", "noise"):
            setattr(self, name, state[name].clone().to(self.device))

    def _fresh_noise(self) -> Tensor:
        return torch.randn(self.env.num_envs, 4, generator=self.generator).to(self.device)

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self.device)

    @torch.no_grad()
    def collect(self, hold: int) -> tuple[Batch, RolloutSummary]:
        """One rollout with every action held for ``hold`` ticks, cut into sequences: fields of the batch are [L, C * B, ...]."""
        network, summary = self.network, RolloutSummary()
        rho, length = self.config.noise_correlation_per_tick**hold, self.config.sequence or self.config.steps
        step = _Step(hold, rho, network.log_std.exp(), rollout_memory(network.memory, self.env.num_envs))
        rows, states = [], []
        for t in range(self.config.steps):
            if t % length == 0:
                states.append((self.h[0].clone(), self.c[0].clone()))
            rows.append(self._decide(step, summary))
        stacked = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        self._judge(stacked, rho, hold)
        h0, c0 = (torch.cat(parts) for parts in zip(*states, strict=True))
        return Batch(**{name: _cut(field, length) for name, field in stacked.items()}, h0=h0, c0=c0), summary

    def _judge(self, stacked: dict[str, Tensor], rho: float, hold: int) -> None:
        """Turn what the rollout left into what the learner needs: log-densities, advantages, targets. Fields are [T, B, ...]."""
        network = self.network
        values = network.value_head(stacked.pop("joined")).squeeze(-1)
        stacked["log_prob"] = correlated_log_prob(
            stacked["raw"], stacked.pop("mean"), network.log_std, stacked["noise_before"], rho
        )
        stacked["rho"] = torch.full_like(stacked["log_prob"], rho)
        last_value = self._value(self.observation, torch.arange(self.env.num_envs, device=self.device), keep_reset=True)
        decay = (self.config.gamma_per_tick**hold, self.config.gae_lambda)
        terminated, truncated, final = (stacked.pop(name) for name in ("terminated", "truncated", "final_value"))
        advantage, target = advantages(stacked.pop("reward"), values, last_value, terminated, truncated, final, decay)
        stacked |= {"advantage": advantage, "target": target}

    def _decide(self, step: _Step, summary: RolloutSummary) -> dict[str, Tensor]:
        """One decision of every environment; advances all state."""
        network, rho = self.network, step.rho
        features, reset, noise_before = network.features(self.observation), self.reset, self.noise
        keep = (~reset).float().unsqueeze(-1)
        memory, h, c = step.memory.step(features, self.h[0] * keep, self.c[0] * keep)
        self.h, self.c = h.unsqueeze(0), c.unsqueeze(0)
        joined = network.join(memory, features)
        mean = network.policy_head(joined)
        self.noise = rho * noise_before + math.sqrt(1.0 - rho * rho) * self._fresh_noise()
        raw = mean + step.std * self.noise
        observation, reward, terminated, truncated, info = self.env.step_held(network.action(raw).cpu().numpy(), step.hold)
        row = {"features": features, "joined": joined, "mean": mean, "raw": raw, "noise_before": noise_before, "reset": reset}
        row |= {"reward": self._tensor(reward.astype(np.float32)), "terminated": self._tensor(terminated)}
        row["truncated"] = self._tensor(truncated)
        row["final_value"] = self._final_values(row["truncated"], info)
        self.observation = self._tensor(observation)
        self.reset = row["terminated"] | row["truncated"]
        if len(info["ended"]):
            self.noise = torch.where(self.reset.unsqueeze(-1), self._fresh_noise(), self.noise)
        _summarise(summary, info, self.env.num_envs)
        return row

    def _value(self, observation: Tensor, index: Tensor, keep_reset: bool) -> Tensor:
        """Value of ``observation`` [K, 190] seen next by the environments ``index`` [K], without advancing their state."""
        h, c = self.h[:, index], self.c[:, index]
        if keep_reset:
            keep = (~self.reset[index]).float().view(1, -1, 1)
            h, c = h * keep, c * keep
        return self.network.step(observation, h, c)[1]

    def _final_values(self, truncated: Tensor, info: dict[str, Any]) -> Tensor:
        """Value of the observation an episode was cut at by its time limit, [B]; zero elsewhere."""
        result = torch.zeros(self.env.num_envs, device=self.device)
        index = truncated.nonzero()[:, 0]
        if len(index):
            final = self._tensor(info["final_obs"][index.cpu().numpy()])
            result[index] = self._value(final, index, keep_reset=False)
        return result


def _cut(field: Tensor, length: int) -> Tensor:
    """[T, B, ...] to sequences of ``length`` side by side, [length, T / length * B, ...]."""
    steps, batch = field.shape[:2]
    parts = field.reshape(steps // length, length, batch, *field.shape[2:])
    return parts.transpose(0, 1).reshape(length, -1, *field.shape[2:])


def _summarise(summary: RolloutSummary, info: dict[str, Any], environments: int) -> None:
    summary.decisions += environments
    for outcome in info["outcomes"]:
        summary.outcomes[outcome] = summary.outcomes.get(outcome, 0) + 1
    summary.episode_ticks.extend(info["episode_ticks"])
    summary.returns.extend(info["episode_return"])
    for name, value in info["reward_terms"].items():
        summary.reward_terms[name] = summary.reward_terms.get(name, 0.0) + value
