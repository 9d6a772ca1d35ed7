"""The PPO update over whole sequences (Schulman et al. 2017, with a KL-adaptive step size), for recurrent and plain networks.

Actions are kept before their tanh ("raw"). The exploration noise may be correlated in time: raw = mean + std * n with
n = rho * n_before + sqrt(1 - rho^2) * e, so given the noise before, raw is Gaussian with mean ``mean + std * rho * n_before``
and standard deviation ``std * sqrt(1 - rho^2)``; that exact conditional density is what the update uses. The Jacobian of the
tanh is the same in the old and the new density, cancels in their ratio, and is therefore left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from policy_export.memory import LstmMemory
from policy_export.network import PolicyNetwork
from training.config import PpoConfig
from training.fast_lstm import fast_lstm_sequence
from training.team import Team

_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
# Beyond this |mean| a tanh is flat: means are pulled back so that gradients stay alive.
_SATURATION_START = 2.0
_SATURATION_WEIGHT = 1e-3
# An epoch whose mean KL exceeds the target by this factor is the last of its update.
_STOP_AT_KL = 4.0


class TrainingDivergedError(RuntimeError):
    """A loss or gradient became NaN or infinite; the last checkpoint is still good."""


def correlated_log_prob(raw: Tensor, mean: Tensor, log_std: Tensor, noise_before: Tensor, rho: Tensor | float) -> Tensor:
    """Log-density [...] of raw actions [..., 4] given the noise before [..., 4] (standard units) and its correlation."""
    rho = torch.as_tensor(rho, dtype=raw.dtype, device=raw.device)
    std = log_std.exp()
    log_scale = log_std + 0.5 * torch.log1p(-rho * rho)
    z = (raw - mean - std * rho * noise_before) / log_scale.exp()
    return (-0.5 * z * z - log_scale - _HALF_LOG_TWO_PI).sum(dim=-1)


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Entropy (nats) of the action distribution before its tanh."""
    return (log_std + 0.5 + _HALF_LOG_TWO_PI).sum()


def advantages(
    rewards: Tensor,
    values: Tensor,
    last_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    final_values: Tensor,
    decay: tuple[float, float],
) -> tuple[Tensor, Tensor]:
    """Generalised advantage estimates and returns, both [T, B] (Schulman et al. 2016).

    ``terminated`` and ``truncated`` [T, B] mark the episode's last step. After a truncation the future is worth
    ``final_values`` [T, B], the value of the state the episode was cut at; ``last_value`` [B] is the value after the last
    step. ``decay`` is (gamma, lambda) per decision.
    """
    gamma, lam = decay
    following = torch.cat((values[1:], last_value.unsqueeze(0)))
    next_value = torch.where(truncated, final_values, torch.where(terminated, torch.zeros_like(following), following))
    result = rewards + gamma * next_value - values  # temporal differences, summed up from the end
    carried = gamma * lam * (~(terminated | truncated)).to(rewards.dtype)
    for t in range(rewards.shape[0] - 2, -1, -1):
        result[t].addcmul_(carried[t], result[t + 1])
    return result, result + values


@dataclass(slots=True)
class Batch:
    """One rollout, time first. Shapes [T, B, ...]; states [B, H]. ``reset[t]``: the episode began at step t."""

    features: Tensor
    raw: Tensor
    noise_before: Tensor
    rho: Tensor
    log_prob: Tensor
    advantage: Tensor
    target: Tensor
    reset: Tensor
    h0: Tensor
    c0: Tensor

    def select(self, index: Tensor) -> Batch:
        """The sequences of the environments in ``index``."""
        parts = {name: getattr(self, name)[:, index] for name in self.__slots__ if name not in ("h0", "c0")}
        return Batch(**parts, h0=self.h0[index], c0=self.c0[index])


def evaluate_sequences(network: PolicyNetwork, features: Tensor, h0: Tensor, c0: Tensor, reset: Tensor) -> tuple[Tensor, Tensor]:
    """Means [T, B, 4] and values [T, B] of whole sequences of features, with gradients."""
    memory = network.memory
    if isinstance(memory, LstmMemory):
        output, _, _ = fast_lstm_sequence(memory, features, h0, c0, reset)
    else:
        output, _, _ = memory.sequence(features, h0, c0, reset)
    return network.heads(output, features)


class PpoLearner:
    """Owns the optimiser and the adaptive learning rate."""

    def __init__(self, network: PolicyNetwork, config: PpoConfig, team: Team | None = None) -> None:
        self.network = network
        self.config = config
        self.team = team or Team()
        self.learning_rate = config.learning_rate
        self.optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, eps=1e-5, fused=True)

    def update(self, batch: Batch, generator: torch.Generator, progress: float) -> dict[str, float]:
        """All epochs over one rollout; ``progress`` 0..1 is the share of training done. Returns the mean of each metric.

        Raises TrainingDivergedError before a bad gradient could reach the weights.
        """
        sums: dict[str, float] = {}
        count = 0
        for _ in range(self.config.epochs):
            kls = []
            for index in self._minibatches(batch.reset, generator):
                metrics = self._step(batch.select(index), progress)
                kls.append(metrics["kl"])
                for name, value in metrics.items():
                    sums[name] = sums.get(name, 0.0) + value
                count += 1
            kl = self.team.mean(sum(kls) / len(kls))
            if self.config.target_kl is not None and kl > _STOP_AT_KL * self.config.target_kl:
                break
        self._adapt(kl, progress)
        return {name: value / count for name, value in sums.items()} | {"learning_rate": self.learning_rate}

    def _minibatches(self, reset: Tensor, generator: torch.Generator) -> Iterator[Tensor]:
        order = torch.randperm(reset.shape[1], generator=generator).to(reset.device)
        yield from order.chunk(self.config.minibatches)

    def _step(self, batch: Batch, progress: float) -> dict[str, float]:
        loss, metrics = self._loss(batch, progress)
        self.optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        self.team.average([parameter.grad for parameter in self.network.parameters() if parameter.grad is not None])
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), self.config.max_grad_norm)
        mean_loss = self.team.mean(loss.item())
        if not (math.isfinite(mean_loss) and torch.isfinite(norm)):
            raise TrainingDivergedError(f"loss {mean_loss:g}, gradient norm {norm.item():g}: lower ppo.learning_rate and resume")
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.optimizer.step()
        with torch.no_grad():
            self.network.log_std.clamp_(*self.config.log_std_bounds)
        return metrics | {"grad_norm": norm.item()}

    def _loss(self, batch: Batch, progress: float) -> tuple[Tensor, dict[str, float]]:
        config, log_std = self.config, self.network.log_std
        mean, value = evaluate_sequences(self.network, batch.features, batch.h0, batch.c0, batch.reset)
        log_ratio = correlated_log_prob(batch.raw, mean, log_std, batch.noise_before, batch.rho.unsqueeze(-1)) - batch.log_prob
        ratio = log_ratio.exp()
        gain = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
        policy_loss = -torch.minimum(gain * ratio, gain * ratio.clamp(1.0 - config.clip, 1.0 + config.clip)).mean()
        value_loss = nn.functional.mse_loss(value, batch.target)
        entropy = gaussian_entropy(log_std)
        saturation = (mean.abs() - _SATURATION_START).clamp_min(0.0).square().mean()
        first, last = config.entropy_coefficient
        loss = policy_loss + config.value_coefficient * value_loss + _SATURATION_WEIGHT * saturation
        loss = loss - (first + (last - first) * progress) * entropy
        with torch.no_grad():
            metrics = {
                "policy_loss": policy_loss.item(),
                "value_loss": value_loss.item(),
                "entropy": entropy.item(),
                "kl": ((ratio - 1.0) - log_ratio).mean().item(),  # low-variance estimate of KL(old || new)
                "clip_share": ((ratio - 1.0).abs() > config.clip).float().mean().item(),
                "explained_variance": 1.0 - value_loss.item() / max(batch.target.var().item(), 1e-8),
            }
        return loss, metrics

    def _adapt(self, kl: float, progress: float) -> None:
        """Steer the learning rate by the last epoch's KL; its upper bound falls to a fifth over the run."""
        if self.config.target_kl is None:
            return
        low, high = self.config.learning_rate_bounds
        if kl > 2.0 * self.config.target_kl:
            self.learning_rate /= 1.5
        elif kl < 0.5 * self.config.target_kl:
            self.learning_rate *= 1.5
        high = max(low, high * (1.0 - 0.8 * progress))
        self.learning_rate = min(max(self.learning_rate, low), high)
