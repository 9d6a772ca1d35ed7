"""docs/policy_file.md is a contract: its program runs and its digests are the file's."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import onnx
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import RecurrentPPO

from policy_export.contract import DIGEST_KEY, PolicyMetadata
from policy_export.export import export_checkpoint
from policy_export.observation import ObservationBuilder
from policy_export.runner import PolicyRunner

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = (ROOT / "docs" / "policy_file.md").read_text()
EXAMPLE = ROOT / "examples" / "fly_policy_file.py"


@pytest.fixture(scope="module")
def two_layers_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of sb3-contrib with two LSTM layers over the built-in 190 values."""
    folder = tmp_path_factory.mktemp("two_layers")
    space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    kwargs = {"lstm_hidden_size": 32, "n_lstm_layers": 2}
    model = RecurrentPPO("MlpLstmPolicy", Still(space), policy_kwargs=kwargs, seed=1)
    with torch.no_grad():
        model.policy.action_net.weight.mul_(30.0)
    model.save(folder / "model.zip")
    export_checkpoint(folder / "model.zip", folder / "policy.onnx")
    return folder / "policy.onnx"


class Still(gymnasium.Env):
    """Only its spaces matter."""

    def __init__(self, action_space: spaces.Box) -> None:
        self.observation_space, self.action_space = spaces.Box(-np.inf, np.inf, (190,), np.float32), action_space


def test_the_minimal_program_flies_the_file_as_the_runner_does(
    policy_path: Path, feed_forward_path: Path, two_layers_path: Path
) -> None:
    program = EXAMPLE.read_text()
    assert len(program.splitlines()) <= 40
    assert not re.search(r"import (policy_export|flight|safety|training|torch)|from (policy_export|flight)", program)
    for path in (policy_path, feed_forward_path, two_layers_path):
        command = [sys.executable, str(EXAMPLE), str(path)]
        done = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, timeout=60, check=True)
        runner = PolicyRunner.load(path)
        builder = ObservationBuilder(runner.metadata.observation)
        zero, lines = (0.0, 0.0, 0.0), []
        for _ in range(3):
            observation = builder.build(np.full(180, np.inf), zero, (0.5, 0.0, 0.0), zero, 0.3, (25.0, 1.0, 0.0))
            vx, vy, vz, turn = runner.step(observation)
            lines.append(f"{vx:.4f} {vy:.4f} {vz:.4f} m/s {runner.metadata.action.frame}, {turn:.4f} rad/s")
        assert done.stdout.splitlines() == lines
        assert len(set(lines)) == (1 if path == feed_forward_path else 3)


def test_every_metadata_field_is_documented() -> None:
    for field in (*PolicyMetadata.model_fields, "names", "max_action_difference", "max_abs_difference", "max_state_drift"):
        assert f"`{field}`" in DOCUMENT, field


def test_the_file_digest_is_the_documented_one(policy_bytes: bytes) -> None:
    entries = {entry.key: entry.value for entry in onnx.load_from_string(policy_bytes).metadata_props}
    stated = entries[DIGEST_KEY].encode()
    assert policy_bytes.count(stated) == 1
    assert hashlib.sha256(policy_bytes.replace(stated, b"0" * 64)).hexdigest().encode() == stated
