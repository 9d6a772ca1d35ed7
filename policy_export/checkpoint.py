"""Reads training checkpoints for export. Nothing in them is executed: torch reads them with `weights_only`. Needs torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from policy_export.contract import (
    ActionLayout,
    ObservationLayout,
    ResetRules,
    TrainingRecord,
    first_problem,
    training_record,
)
from policy_export.errors import CheckpointError
from policy_export.network import NetworkConfig, PolicyNetwork
from policy_export.sb3_network import Sb3Network
from policy_export.weights import UNREADABLE

MAX_CHECKPOINT_BYTES = 512 * 1024 * 1024
_NEEDED = ("network_config", "state_dict", "training", "layout")
_MOTION_ORDERS = {
    ("lidar", "goal_offset", "velocity", "acceleration", "yaw"),
    ("lidar", "position", "velocity", "acceleration", "yaw"),
}


TrainedNetwork = PolicyNetwork | Sb3Network


class PolicyLayout(BaseModel):
    """The `layout` entry of a checkpoint."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    observation: ObservationLayout
    action: ActionLayout
    rate_hz: float = Field(default=20.0, gt=0.0, le=1000.0)
    reset: ResetRules = ResetRules()


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A network with everything that its file will say about it."""

    network: TrainedNetwork
    layout: PolicyLayout
    training: TrainingRecord


def checkpoint_content(network: PolicyNetwork, layout: PolicyLayout, training: dict[str, Any]) -> dict[str, Any]:
    """The dict to give to `torch.save`; a trainer may add its own keys beside these."""
    return {
        "network_config": network.config.to_dict(),
        "state_dict": network.state_dict(),
        "layout": layout.model_dump(mode="json"),
        "training": training,
    }


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint written by train-policy; raises `CheckpointError` with what is wrong."""
    path = Path(path)
    content = _read(path)
    missing = [key for key in _NEEDED if key not in content]
    if missing:
        raise CheckpointError(f"{path}: lacks {', '.join(missing)}; give a checkpoint written by train-policy")
    try:
        config = NetworkConfig.from_dict(content["network_config"])
        layout = PolicyLayout.model_validate(content["layout"])
        training = training_record(content["training"])
    except ValidationError as error:
        field, message = first_problem(error)
        raise CheckpointError(f"{path}: {error.title}.{field}: {message}") from None
    except TypeError as error:
        raise CheckpointError(f"{path}: training must be a dict of named values ({error})") from None
    _check_layout(path, config, layout)
    network = PolicyNetwork(config)
    try:
        network.load_state_dict(content["state_dict"])
    except (RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path}: weights do not fit network_config ({' '.join(str(error).split())[:200]})") from None
    if not all(torch.isfinite(tensor).all() for tensor in network.state_dict().values()):
        raise CheckpointError(f"{path}: weights hold NaN or infinity; take an earlier checkpoint")
    return Checkpoint(network.eval(), layout, training)


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise CheckpointError(f"{path}: {'is no file' if path.exists() else 'no such file'}")
    if path.stat().st_size > MAX_CHECKPOINT_BYTES:
        raise CheckpointError(f"{path}: larger than {MAX_CHECKPOINT_BYTES} bytes")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except UNREADABLE as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({type(error).__name__})") from None
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: not a checkpoint written by train-policy")
    return content


def _check_layout(path: Path, config: NetworkConfig, layout: PolicyLayout) -> None:
    """The network's fixed order of inputs and its limits must be those that the layout tells the pilot."""
    observation, action = layout.observation, layout.action
    if tuple(channel.name for channel in observation.channels) not in _MOTION_ORDERS:
        raise CheckpointError(f"{path}: layout.observation: the network takes lidar, goal_offset, velocity, acceleration, yaw")
    if observation.lidar.beams != config.beams or observation.lidar.range_max_m != config.range_max_m:
        raise CheckpointError(f"{path}: layout.observation.lidar: beams or range_max_m differ from network_config")
    if action.low != config.action_low or action.high != config.action_high:
        raise CheckpointError(f"{path}: layout.action: limits differ from network_config")
