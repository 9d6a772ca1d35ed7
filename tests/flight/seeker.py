"""A policy whose weights are set by hand: it flies straight at the goal and slows down near it. A real file, through the
real exporter: what the stack does with it is what it does with a trained one."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from policy_export.checkpoint import Checkpoint, PolicyLayout
from policy_export.contract import ActionLayout, TrainingRecord, default_layout
from policy_export.export import export_policy
from policy_export.network import NetworkConfig, PolicyNetwork


def write_seeker(path: Path, gain: float = 3.0) -> Path:
    """Write the policy to `path` and return it. Memory is present but has no weight in the decision."""
    torch.manual_seed(0)
    config = NetworkConfig()
    network = PolicyNetwork(config).eval()
    direction = config.hidden_size + 2 * (config.beams // config.beam_group)
    first, last = network.policy_head[0], network.policy_head[2]
    low, high = torch.tensor(config.action_low), torch.tensor(config.action_high)
    with torch.no_grad():
        for layer in (first, last):
            layer.weight.zero_()
            layer.bias.zero_()
        for axis in range(3):
            first.weight[axis, direction + axis] = 1.5
            last.weight[axis, axis] = gain
        # mean 0 is the middle of the limits; this bias makes no wish no motion
        last.bias.copy_(torch.atanh(-(high + low) / (high - low)))
    layout = PolicyLayout(observation=default_layout(), action=ActionLayout())
    export_policy(Checkpoint(network, layout, TrainingRecord()), path, name="seeker")
    assert math.isfinite(path.stat().st_size)
    return path
