"""The navigation network: input shaping, one LSTM layer (or none), a policy head and a value head. Needs torch.

Observations enter in SI units as `policy_export.contract` lays them out (LiDAR ranges, goal vector, velocity, acceleration,
yaw); every normalisation is inside the network, so that an exported file cannot be fed wrongly scaled values.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn

from policy_export.lstm_sequence import lstm_sequence

State = tuple[Tensor, Tensor]

OWN_MOTION_SIZE = 10
"""Channels after the LiDAR: goal vector 3, velocity 3, acceleration 3, yaw 1."""

SHARP_LENGTH_M = 0.4
POSITION_SCALE_M = 35.0
VELOCITY_SCALE_M_S = 1.0
ACCELERATION_SCALE_M_S2 = 3.0
MOTION_LIMIT = 5.0
DIRECTION_SOFTENING_M = 0.1
"""Keeps the direction to the goal smooth where the distance goes to zero."""


class NetworkConfig(BaseModel):
    """Everything that fixes the network's shape. `to_dict` and `from_dict` are the form kept in checkpoints.

    `preprocessing`: `shaped` takes the closest return of each `beam_group` beams, a copy of it sharpened near contact, and
    the goal as direction and squashed distance; `channels` only scales the raw channels, as the article does.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    memory: Literal["lstm", "none"] = "lstm"
    preprocessing: Literal["shaped", "channels"] = "shaped"
    beams: int = Field(default=180, gt=0, le=4096)
    beam_group: int = Field(default=5, gt=0)
    range_max_m: float = Field(default=4.0, gt=0.0)
    vehicle_radius_m: float = Field(default=0.35, gt=0.0)
    hidden_size: int = Field(default=128, gt=0, le=4096)
    head_size: int = Field(default=64, gt=0, le=4096)
    feature_skip: bool = True
    initial_log_std: float = -0.5
    action_low: tuple[float, float, float, float] = (-0.5, -0.5, -0.5, -1.0)
    action_high: tuple[float, float, float, float] = (1.0, 0.5, 0.5, 1.0)

    @model_validator(mode="after")
    def _consistent(self) -> NetworkConfig:
        if self.beams % self.beam_group:
            raise ValueError(f"beams ({self.beams}) must be a multiple of beam_group ({self.beam_group})")
        if any(low >= high for low, high in zip(self.action_low, self.action_high, strict=True)):
            raise ValueError("every action_low must be below its action_high")
        return self

    @property
    def observation_size(self) -> int:
        """Length of one observation."""
        return self.beams + OWN_MOTION_SIZE

    @property
    def state_size(self) -> int:
        """Width of h and of c: `hidden_size`, or 0 without memory."""
        return self.hidden_size if self.memory == "lstm" else 0

    @property
    def layers(self) -> int:
        """Stacked LSTM layers; this network has one."""
        return 1

    @property
    def action_size(self) -> int:
        """Number of actions."""
        return 4

    @property
    def feature_size(self) -> int:
        """Width of `PolicyNetwork.features`."""
        if self.preprocessing == "channels":
            return self.observation_size
        return 2 * (self.beams // self.beam_group) + 13

    def to_dict(self) -> dict[str, Any]:
        """Plain dict of numbers, strings and lists."""
        return self.model_dump(mode="json")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkConfig:
        """Inverse of `to_dict`; unknown or impossible values raise pydantic's ValidationError."""
        return cls.model_validate(values)


class PolicyNetwork(nn.Module):
    """Actor and critic over one shared memory.

    Shapes: observations [B, 190]; states h, c [1, B, H] (H is 0 without memory); means [B, 4] before tanh; values [B].
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.lstm = nn.LSTM(config.feature_size, config.hidden_size) if config.memory == "lstm" else None
        # A feed-forward network gets a hidden layer of the memory's width, so that both have similar capacity.
        self.encoder = None if self.lstm is not None else nn.Linear(config.feature_size, config.hidden_size)
        head_input = config.hidden_size + (config.feature_size if config.feature_skip else 0)
        self.policy_head = nn.Sequential(nn.Linear(head_input, config.head_size), nn.Tanh(), nn.Linear(config.head_size, 4))
        self.value_head = nn.Sequential(nn.Linear(head_input, config.head_size), nn.Tanh(), nn.Linear(config.head_size, 1))
        self.log_std = nn.Parameter(torch.full((4,), config.initial_log_std))
        self.register_buffer("action_low", torch.tensor(config.action_low))
        self.register_buffer("action_high", torch.tensor(config.action_high))
        self._initialise()

    def _initialise(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.orthogonal_(module.weight, gain=math.sqrt(2.0))
                nn.init.zeros_(module.bias)
        for head, gain in ((self.policy_head, 0.01), (self.value_head, 1.0)):
            last = head[-1]
            assert isinstance(last, nn.Linear)
            nn.init.orthogonal_(last.weight, gain=gain)
        if self.lstm is not None:
            for name, parameter in self.lstm.named_parameters():
                if name.startswith("weight"):
                    nn.init.orthogonal_(parameter)
                else:
                    nn.init.zeros_(parameter)

    def observation_spread(self) -> None:
        """Mean and deviation of training's observations: unknown, the network scales them by fixed numbers."""
        return

    def initial_state(self, batch: int) -> State:
        """Zero h and c [1, batch, H] in the network's own type and device."""
        zeros = self.action_low.new_zeros(1, batch, self.config.state_size)
        return zeros, zeros.clone()

    def features(self, obs: Tensor) -> Tensor:
        """Observations [..., 190] in SI units to features [..., F] of order one."""
        beams = self.config.beams
        ranges = obs[..., :beams].clamp(0.0, self.config.range_max_m)
        goal, velocity, acceleration = (obs[..., beams + 3 * k : beams + 3 * k + 3] for k in range(3))
        yaw = obs[..., beams + 9 : beams + 10]
        velocity = (velocity / VELOCITY_SCALE_M_S).clamp(-MOTION_LIMIT, MOTION_LIMIT)
        acceleration = (acceleration / ACCELERATION_SCALE_M_S2).clamp(-MOTION_LIMIT, MOTION_LIMIT)
        if self.config.preprocessing == "channels":
            scaled = (ranges / self.config.range_max_m, goal / POSITION_SCALE_M, velocity, acceleration, yaw / math.pi)
            return torch.cat(scaled, dim=-1)
        group = self.config.beam_group
        nearest = ranges.reshape(*ranges.shape[:-1], beams // group, group).amin(dim=-1)
        sharp = torch.exp((self.config.vehicle_radius_m - nearest) / SHARP_LENGTH_M)
        distance = goal.square().sum(dim=-1, keepdim=True).sqrt()
        direction = goal / (distance + DIRECTION_SOFTENING_M)
        squashed = (torch.log1p(distance) / math.log1p(POSITION_SCALE_M), distance / (distance + 1.0))
        turn = (torch.sin(yaw), torch.cos(yaw))
        return torch.cat((nearest / self.config.range_max_m, sharp, direction, *squashed, velocity, acceleration, *turn), dim=-1)

    def action(self, mean: Tensor) -> Tensor:
        """Pre-tanh values [..., 4] to vx, vy, vz (m/s) and yaw rate (rad/s) within the limits."""
        half = 0.5 * (self.action_high - self.action_low)
        return self.action_low + half * (1.0 + torch.tanh(mean))

    def heads(self, memory: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Memory [..., H] and features [..., F] to means [..., 4] and values [...]."""
        joined = torch.cat((memory, features), dim=-1) if self.config.feature_skip else memory
        return self.policy_head(joined), self.value_head(joined).squeeze(-1)

    def step(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One decision for a batch: (mean [B, 4] before tanh, value [B], h', c' [1, B, H])."""
        features = self.features(obs)
        if self.lstm is None:
            mean, value = self.heads(self.encode(features), features)
            return mean, value, h, c
        h_next, c_next = self.cell(features, h[0], c[0])
        mean, value = self.heads(h_next, features)
        return mean, value, h_next.unsqueeze(0), c_next.unsqueeze(0)

    def cell(self, features: Tensor, h: Tensor, c: Tensor) -> State:
        """The LSTM's equations written out for one step: features [B, F], h, c [B, H]."""
        weight_ih, weight_hh, bias_ih, bias_hh = self.lstm_weights()
        gates = nn.functional.linear(features, weight_ih, bias_ih + bias_hh) + nn.functional.linear(h, weight_hh)
        i, f, g, o = gates.chunk(4, dim=-1)
        c_next = torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        return torch.sigmoid(o) * torch.tanh(c_next), c_next

    def encode(self, features: Tensor) -> Tensor:
        """The hidden layer that stands in for the memory in a feed-forward network."""
        assert self.encoder is not None
        return torch.tanh(self.encoder(features))

    def lstm_weights(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """w_ih [4H, F], w_hh [4H, H], b_ih [4H], b_hh [4H], gate order i, f, g, o."""
        assert self.lstm is not None
        weight_ih, weight_hh, bias_ih, bias_hh = self.lstm.parameters()
        return weight_ih, weight_hh, bias_ih, bias_hh

    def sequence(self, obs: Tensor, h0: Tensor, c0: Tensor, reset: Tensor) -> tuple[Tensor, Tensor, State]:
        """Whole sequences: obs [T, B, 190], h0, c0 [1, B, H], reset [T, B] (state zeroed before step t where true).

        Returns means [T, B, 4] before tanh, values [T, B] and the last state. Differentiable in everything but `reset`.
        """
        features = self.features(obs)
        if self.lstm is None:
            mean, value = self.heads(self.encode(features), features)
            return mean, value, (h0, c0)
        output, (h, c) = lstm_sequence(features, self.lstm_weights(), (h0[0], c0[0]), reset)
        mean, value = self.heads(output, features)
        return mean, value, (h.unsqueeze(0), c.unsqueeze(0))
