"""Deterministic flights on held-out corridors with the training kernels: the mean action, 20 Hz, one episode per corridor."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import torch

from policy_export.contract import ActionLayout, ObservationLayout
from policy_export.network import PolicyNetwork
from training.config import EVALUATION_SEED_START, EnvironmentConfig, EvaluationConfig
from training.environment import CorridorVectorEnv
from training.intervals import wilson_interval
from training.worlds import FixedWorlds, world_for_seed


def evaluation_environment(
    config: EnvironmentConfig, settings: EvaluationConfig, layout: ObservationLayout, action: ActionLayout
) -> CorridorVectorEnv:
    """Held-out corridors from the world's own start, with the estimate errors of ``settings``."""
    if settings.seed < EVALUATION_SEED_START:
        raise ValueError(f"evaluation seeds start at {EVALUATION_SEED_START}")
    estimate = config.estimate.model_copy(update={"harsh_share": 0.0, "nominal": settings.estimate})
    fixed = config.model_copy(update={"spread_start_share": 0.0, "estimate": estimate})
    worlds = FixedWorlds([world_for_seed(settings.seed + i, config) for i in range(settings.episodes)])
    return CorridorVectorEnv(settings.episodes, fixed, seed=settings.seed, layout=layout, action=action, worlds=worlds)


@torch.no_grad()
def evaluate(network: PolicyNetwork, env: CorridorVectorEnv) -> dict[str, Any]:
    """Fly every corridor of ``env`` once. Returns the success rate with its 95 % interval, failures by cause, path figures."""
    observation, _ = env.reset(seed=int(np.random.default_rng(env.num_envs).integers(2**31)))
    h, c = network.initial_state(env.num_envs)
    device = network.log_std.device
    outcome = np.full(env.num_envs, "time_out", dtype=object)
    ticks, length, clearance = (np.zeros(env.num_envs) for _ in range(3))
    straight = np.linalg.norm(env.arena.goal - env.arena.start, axis=1)
    active = env.arena.active
    while active.any():
        index = np.flatnonzero(active)
        mean, _, h_next, c_next = network.step(torch.from_numpy(observation[index]).to(device), h[:, index], c[:, index])
        h[:, index], c[:, index] = h_next, c_next
        actions = np.zeros((env.num_envs, 4), np.float32)
        actions[index] = network.action(mean).cpu().numpy()
        observation, _, _, _, info = env.step(actions)
        ended = info["ended"]
        outcome[ended] = info["outcomes"]
        ticks[ended], length[ended], clearance[ended] = info["episode_ticks"], info["path_length_m"], info["min_clearance_m"]
        active[ended] = False
    return _report(env, outcome, ticks, length, clearance, straight)


def _report(
    env: CorridorVectorEnv,
    outcome: np.ndarray,
    ticks: np.ndarray,
    length: np.ndarray,
    clearance: np.ndarray,
    straight: np.ndarray,
) -> dict[str, Any]:
    goal = outcome == "goal"
    low, high = wilson_interval(int(goal.sum()), len(goal))
    result: dict[str, Any] = {"success": float(goal.mean()), "low": low, "high": high, "episodes": len(goal)}
    result["failures"] = dict(Counter(outcome[~goal].tolist()))
    result["failed_corridors"] = np.flatnonzero(~goal).tolist()[:50]
    if goal.any():
        # the last 0.3 m are inside the goal's radius and need not be flown
        result["path_efficiency"] = float(np.mean((straight[goal] - env.config.goal_radius_m) / length[goal]))
        result["mean_ticks"] = float(ticks[goal].mean())
        result["min_clearance_p10_m"] = float(np.quantile(clearance[goal], 0.1))
    return result
