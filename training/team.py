"""Data-parallel training: every process flies its own environments, gradients are averaged. One process is a team of one.

torchrun --nproc-per-node 2 -m training.cli --config configs/training/ppo_lstm.yaml
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import timedelta

import torch
from torch import Tensor, distributed

# The first process evaluates and saves while the others wait for it.
TIMEOUT = timedelta(minutes=30)
# So far apart are the seeds of the processes of one run.
SEED_STRIDE = 1_000_003


@dataclass(frozen=True, slots=True)
class Team:
    """Which process this is, and of how many. All of them must make the same calls in the same order."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process evaluates, records and shows progress."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """The seed of this process's environments and noise."""
        return seed + SEED_STRIDE * self.rank

    def average(self, tensors: Iterable[Tensor]) -> None:
        """Replace each tensor by its mean over all processes."""
        if self.size == 1:
            return
        parts = list(tensors)
        flat = torch.cat([part.reshape(-1) for part in parts])
        distributed.all_reduce(flat)
        flat /= self.size
        for part, mean in zip(parts, torch.split(flat, [part.numel() for part in parts]), strict=True):
            part.copy_(mean.view_as(part))

    def mean(self, value: float) -> float:
        """Mean of a number over all processes."""
        box = torch.tensor([value], dtype=torch.float64)
        self.average([box])
        return box.item()

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            distributed.barrier()


def join(device: str) -> tuple[Team, str]:
    """The team that torchrun started, and this process's device; a team of one without torchrun."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        return Team(), device
    on_cuda = device == "cuda"
    distributed.init_process_group("cpu:gloo,cuda:nccl" if on_cuda else "gloo", timeout=TIMEOUT)
    return Team(distributed.get_rank(), size), f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if on_cuda else device


def leave(team: Team) -> None:
    """Close the connections that ``join`` made."""
    if team.size > 1:
        distributed.destroy_process_group()
