"""Stable-Baselines3's `MlpPolicy` and sb3-contrib's `MlpLstmPolicy` rebuilt from plain torch layers. Needs torch, not SB3.

Module names are SB3's own, so that `policy.pth` loads as it is. `action` is what `model.predict(deterministic=True)` answers:
the Gaussian's mean, through tanh and scaled where the policy squashes (gSDE), clipped to the action space where it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Critic = Literal["shared", "separate", "linear", "none"]

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "tanh": nn.Tanh,
    "relu": nn.ReLU,
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "leakyrelu": nn.LeakyReLU,
    "silu": nn.SiLU,
    "selu": nn.SELU,
    "sigmoid": nn.Sigmoid,
    "softplus": nn.Softplus,
    "softsign": nn.Softsign,
    "mish": nn.Mish,
    "relu6": nn.ReLU6,
    "hardtanh": nn.Hardtanh,
    "identity": nn.Identity,
}
"""By lower-case class name; each as SB3 makes it, without arguments."""


@dataclass(frozen=True, slots=True)
class Normalisation:
    """VecNormalize's observation statistics: `clip((obs - mean) / sqrt(variance + epsilon), -clip, clip)`."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]
    clip: float
    epsilon: float

    @property
    def deviation(self) -> NDArray[np.float64]:
        """What differences to the mean are divided by [size]."""
        return np.asarray(np.sqrt(self.variance + self.epsilon))


@dataclass(frozen=True, slots=True)
class ActionMap:
    """From the policy's own action space to the file's action.

    `low`, `high` [n]: the policy's space, to which `predict` clips or scales. `to_low`, `to_high` [n]: where these limits lie
    in the file, in SI units. `places`: which of the file's `size` actions each of the n is; the others are 0.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    to_low: NDArray[np.float64]
    to_high: NDArray[np.float64]
    places: tuple[int, ...]
    size: int
    squash: bool

    @property
    def is_rescaled(self) -> bool:
        """Whether the file's limits are not the policy's own."""
        return not (np.array_equal(self.low, self.to_low) and np.array_equal(self.high, self.to_high))


@dataclass(frozen=True, slots=True)
class Sb3Config:
    """Everything that fixes the network. `pi`, `vf`: sizes of the hidden layers."""

    observation_size: int
    memory: Literal["lstm", "none"]
    hidden_size: int
    layers: int
    critic: Critic
    pi: tuple[int, ...]
    vf: tuple[int, ...]
    activation: str
    actions: ActionMap
    normalisation: Normalisation | None

    @property
    def state_size(self) -> int:
        """Width of h and of c of one layer; 0 without memory."""
        return self.hidden_size if self.memory == "lstm" else 0

    @property
    def action_size(self) -> int:
        """Number of actions in the file."""
        return self.actions.size

    @property
    def has_value(self) -> bool:
        """Whether the critic needs no memory of its own."""
        return self.critic in {"shared", "linear"}


class Sb3Network(nn.Module):
    """The actor, and the critic where it has no memory of its own.

    Shapes: observations [B, N]; states h, c [layers, B, H] (H is 0 without memory); means [B, n]; values [B] or None.
    """

    def __init__(self, config: Sb3Config) -> None:
        super().__init__()
        self.config = config
        width = config.observation_size
        self.lstm_actor = nn.LSTM(width, config.hidden_size, config.layers) if config.memory == "lstm" else None
        linear_critic = config.memory == "lstm" and config.critic == "linear"
        self.critic = nn.Linear(width, config.hidden_size) if linear_critic else None
        latent = config.hidden_size if config.memory == "lstm" else width
        self.mlp_extractor = nn.ModuleDict({"policy_net": _layers(latent, config.pi, config.activation)})
        self.action_net = nn.Linear(config.pi[-1] if config.pi else latent, len(config.actions.places))
        self.value_net: nn.Linear | None = None
        if config.has_value:
            self.mlp_extractor["value_net"] = _layers(latent, config.vf, config.activation)
            self.value_net = nn.Linear(config.vf[-1] if config.vf else latent, 1)

    def observation_spread(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Mean and deviation [N] of training's observations, where VecNormalize kept them."""
        kept = self.config.normalisation
        return None if kept is None else (kept.mean, kept.deviation)

    def initial_state(self, batch: int) -> tuple[Tensor, Tensor]:
        """Zero h and c [layers, batch, H] in the network's own type and device."""
        zeros = self.action_net.weight.new_zeros(self.config.layers, batch, self.config.state_size)
        return zeros, zeros.clone()

    def normalise(self, obs: Tensor) -> Tensor:
        """What VecNormalize makes of the observations."""
        kept = self.config.normalisation
        if kept is None:
            return obs
        mean, deviation = (torch.from_numpy(values).to(obs) for values in (kept.mean, kept.deviation))
        return ((obs - mean) / deviation).clamp(-kept.clip, kept.clip)

    def step(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
        """One decision for a batch: (mean [B, n], value [B] or None, h', c' [layers, B, H])."""
        features = self.normalise(obs)
        latent = features
        if self.lstm_actor is not None:
            output, (h, c) = self.lstm_actor(features.unsqueeze(0), (h, c))
            latent = output[0]
        mean = self.action_net(self.mlp_extractor["policy_net"](latent))
        if self.value_net is None:
            return mean, None, h, c
        seen = latent if self.critic is None else self.critic(features)
        return mean, self.value_net(self.mlp_extractor["value_net"](seen)).squeeze(-1), h, c

    def action(self, mean: Tensor) -> Tensor:
        """Means [B, n] to the file's action [B, size]."""
        actions = self.config.actions
        low, high, to_low, to_high = (
            torch.from_numpy(values).to(mean) for values in (actions.low, actions.high, actions.to_low, actions.to_high)
        )
        chosen = low + 0.5 * (torch.tanh(mean) + 1.0) * (high - low) if actions.squash else torch.clamp(mean, low, high)
        if actions.is_rescaled:
            chosen = to_low + (chosen - low) / (high - low) * (to_high - to_low)
        result = mean.new_zeros(*mean.shape[:-1], actions.size)
        result[..., list(actions.places)] = chosen
        return result

    def lstm_weights(self) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Per layer w_ih [4H, F], w_hh [4H, H], b_ih [4H], b_hh [4H], gate order i, f, g, o."""
        assert self.lstm_actor is not None
        parts = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        rows = [[getattr(self.lstm_actor, f"{part}_l{k}") for part in parts] for k in range(self.config.layers)]
        return [(w_ih, w_hh, b_ih, b_hh) for w_ih, w_hh, b_ih, b_hh in rows]

    def load_weights(self, weights: dict[str, Any]) -> None:
        """Load SB3's own state dict; what the file does not hold (an own critic, log_std) is left out."""
        own = self.state_dict()
        self.load_state_dict({name: weights.get(name, torch.zeros_like(own[name])) for name in own})


def _layers(width: int, sizes: tuple[int, ...], activation: str) -> nn.Sequential:
    parts: list[nn.Module] = []
    for size in sizes:
        parts += [nn.Linear(width, size), ACTIVATIONS[activation]()]
        width = size
    return nn.Sequential(*parts)
