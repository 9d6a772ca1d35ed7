"""The figures people read are those that were measured."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from campaigns.publish import publish

ROOT = Path(__file__).resolve().parents[2]


def test_readme_and_model_cards_are_what_the_results_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("policies", "results", "docs"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    shutil.copy(ROOT / "README.md", tmp_path)
    monkeypatch.chdir(tmp_path)
    publish()
    for path in [Path("README.md"), Path("docs/safety.md"), *Path("policies").glob("*.md")]:
        assert path.read_text() == (ROOT / path).read_text(), f"{path} is out of date: run python -m campaigns.publish"


def test_every_shipped_policy_has_a_card_with_results() -> None:
    policies = sorted((ROOT / "policies").glob("*.onnx"))
    assert policies
    for path in policies:
        assert path.stat().st_size < 1_000_000
        assert "clean success" in path.with_suffix(".md").read_text(), f"no result was measured on {path.name}"
