"""docs/policy_file.md is a contract: its program runs and its digests are the file's."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx

from policy_export.contract import DIGEST_KEY, PolicyMetadata
from policy_export.observation import ObservationBuilder
from policy_export.runner import PolicyRunner

DOCUMENT = (Path(__file__).resolve().parents[2] / "docs" / "policy_file.md").read_text()


def test_the_minimal_program_flies_the_file_as_the_runner_does(policy_path: Path, feed_forward_path: Path) -> None:
    program = re.search(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)
    assert program is not None
    assert len(program[1].splitlines()) <= 40
    for path in (policy_path, feed_forward_path):
        done = subprocess.run(
            [sys.executable, "-c", program[1], str(path)], capture_output=True, text=True, timeout=60, check=True
        )
        runner = PolicyRunner.load(path)
        builder = ObservationBuilder(runner.metadata.observation)
        zero = (0.0, 0.0, 0.0)
        lines = []
        for _ in range(3):
            observation = builder.build(np.full(180, np.inf), zero, (0.5, 0.0, 0.0), zero, 0.0, (25.0, 0.0, 0.0))
            vx, vy, vz, turn = runner.step(observation)
            lines.append(f"{vx:.4f} {vy:.4f} {vz:.4f} m/s, {turn:.4f} rad/s")
        assert done.stdout.splitlines() == lines


def test_every_metadata_field_is_documented() -> None:
    for field in PolicyMetadata.model_fields:
        assert f"`{field}`" in DOCUMENT, field


def test_the_file_digest_is_the_documented_one(policy_bytes: bytes) -> None:
    entries = {entry.key: entry.value for entry in onnx.load_from_string(policy_bytes).metadata_props}
    stated = entries[DIGEST_KEY].encode()
    assert policy_bytes.count(stated) == 1
    assert hashlib.sha256(policy_bytes.replace(stated, b"0" * 64)).hexdigest().encode() == stated
