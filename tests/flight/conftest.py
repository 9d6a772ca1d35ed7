"""Shared by the tests of whole flights."""

from __future__ import annotations

from pathlib import Path

import pytest
from seeker import write_seeker


@pytest.fixture(scope="session")
def seeker_policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy file that flies straight at the goal."""
    return write_seeker(tmp_path_factory.mktemp("policy") / "seeker.onnx")
