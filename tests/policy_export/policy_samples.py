"""Networks with uneven weights, exported once per run, and helpers that damage files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import onnx
import pytest
import torch

from policy_export.checkpoint import Checkpoint, PolicyLayout, checkpoint_content
from policy_export.contract import DIGEST_KEY, ActionLayout, TrainingRecord, default_layout
from policy_export.export import export_policy
from policy_export.network import NetworkConfig, PolicyNetwork
from policy_export.onnx_reader import file_sha256, read_model

LAYOUT = PolicyLayout(observation=default_layout(), action=ActionLayout())


def make_network(seed: int = 0, spread: float = 0.05, **config: object) -> PolicyNetwork:
    """A network whose actions move: freshly initialised ones answer nearly the same to everything."""
    torch.manual_seed(seed)
    network = PolicyNetwork(NetworkConfig.from_dict(config)).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(spread * torch.randn_like(parameter))
    return network


def make_checkpoint(network: PolicyNetwork) -> Checkpoint:
    return Checkpoint(network, LAYOUT, TrainingRecord(seed=3, steps=100, config_hash="abc", git_commit="0" * 40))


def save_checkpoint(network: PolicyNetwork, path: Path) -> Path:
    training = {"seed": 3, "steps": 100, "config_hash": "abc", "git_commit": "0" * 40, "preset": "test"}
    torch.save(checkpoint_content(network, LAYOUT, training) | {"optimizer": {"lr": 1e-3}}, path)
    return path


@pytest.fixture(scope="session")
def network() -> PolicyNetwork:
    return make_network()


@pytest.fixture(scope="session")
def policy_path(network: PolicyNetwork, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "lstm.onnx"
    export_policy(make_checkpoint(network), path, name="test")
    return path


@pytest.fixture(scope="session")
def feed_forward_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "mlp.onnx"
    export_policy(make_checkpoint(make_network(memory="none")), path)
    return path


@pytest.fixture(scope="session")
def policy_bytes(policy_path: Path) -> bytes:
    return policy_path.read_bytes()


Damage = Callable[[onnx.ModelProto], None]


def seal(data: bytes) -> bytes:
    """The bytes with a digest that fits them, so that a test reaches the check behind the digest."""
    start, stop = read_model(data).spans[DIGEST_KEY]
    return data[:start] + file_sha256(data, (start, stop)).encode() + data[stop:]


def damaged(data: bytes, damage: Damage, sealed: bool = True) -> bytes:
    model = onnx.load_from_string(data)
    damage(model)
    changed = model.SerializeToString(deterministic=True)
    return seal(changed) if sealed else changed
