"""The navigation network: input shaping, a memory, a policy head and a value head. Needs torch.

Observations enter in SI units as `policy_export.contract` lays them out (LiDAR ranges, goal vector, velocity, acceleration,
yaw); every normalisation is inside the network, so that an exported file cannot be fed wrongly scaled values.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn

from policy_export.memory import GruMemory, LstmMemory, Memory, NoMemory, StackMemory

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
    the goal as direction and squashed distance; `channels` only scales the raw channels, as the article does. `memory`:
    `stack` sees the last `stack_frames` observations side by side, as the article's 64-step history.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    memory: Literal["lstm", "gru", "stack", "none"] = "lstm"
    stack_frames: int = Field(default=64, ge=2, le=256)
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
        """Width of h and of c in a policy file: `hidden_size`, or 0 without memory."""
        return self.hidden_size if self.memory in {"lstm", "gru"} else 0

    @property
    def layers(self) -> int:
        """Stacked recurrent layers; this network has one."""
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

    Shapes: observations [B, 190]; states h, c [1, B, W] with the memory's widths W; means [B, 4] before tanh; values [B].
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        memory = _make_memory(config)
        self.lstm = memory if isinstance(memory, LstmMemory) else None
        self.gru = memory if isinstance(memory, GruMemory) else None
        self.encoder = memory if isinstance(memory, NoMemory | StackMemory) else None
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
        if self.encoder is None:
            for name, parameter in self.memory.named_parameters():
                if name.startswith("weight"):
                    nn.init.orthogonal_(parameter)
                else:
                    nn.init.zeros_(parameter)

    @property
    def memory(self) -> Memory:
        """The memory; its weights are stored under its kind."""
        memory = self.lstm or self.gru or self.encoder
        assert memory is not None
        return memory

    def observation_spread(self) -> None:
        """Mean and deviation of training's observations: unknown, the network scales them by fixed numbers."""
        return

    def initial_state(self, batch: int) -> State:
        """Zero h and c [1, batch, H] in the network's own type and device."""
        h, c = (self.action_low.new_zeros(1, batch, width) for width in self.memory.widths)
        return h, c

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
        joined = self.join(memory, features)
        return self.policy_head(joined), self.value_head(joined).squeeze(-1)

    def join(self, memory: Tensor, features: Tensor) -> Tensor:
        """What both heads read: memory [..., H], with the features [..., F] beside it if the network is built so."""
        return torch.cat((memory, features), dim=-1) if self.config.feature_skip else memory

    def step(self, obs: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """One decision for a batch: (mean [B, 4] before tanh, value [B], h', c' [1, B, H])."""
        features = self.features(obs)
        memory, h_next, c_next = self.memory.step(features, h[0], c[0])
        mean, value = self.heads(memory, features)
        return mean, value, h_next.unsqueeze(0), c_next.unsqueeze(0)

    def sequence(self, obs: Tensor, h0: Tensor, c0: Tensor, reset: Tensor) -> tuple[Tensor, Tensor, State]:
        """Whole sequences: obs [T, B, 190], h0, c0 [1, B, W], reset [T, B] (state zeroed before step t where true).

        Returns means [T, B, 4] before tanh, values [T, B] and the last state. Differentiable in everything but `reset`.
        """
        features = self.features(obs)
        memory, h, c = self.memory.sequence(features, h0[0], c0[0], reset)
        mean, value = self.heads(memory, features)
        return mean, value, (h.unsqueeze(0), c.unsqueeze(0))


def _make_memory(config: NetworkConfig) -> Memory:
    features, hidden = config.feature_size, config.hidden_size
    match config.memory:
        case "lstm":
            return LstmMemory(features, hidden)
        case "gru":
            return GruMemory(features, hidden)
        case "stack":
            return StackMemory(features, hidden, config.stack_frames)
        case "none":
            return NoMemory(features, hidden)
