"""The figures people read are those that were measured."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from campaigns.evaluation_table import commands, evaluation_table
from campaigns.publish import evaluations, publish, read_results, trained_on
from campaigns.safety_summary import safety_rows
from training.config import EnvironmentConfig

ROOT = Path(__file__).resolve().parents[2]


def test_readme_and_model_cards_are_what_the_results_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("policies", "results", "docs", "configs"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    shutil.copy(ROOT / "README.md", tmp_path)
    monkeypatch.chdir(tmp_path)
    publish()
    for path in [Path("README.md"), Path("docs/safety.md"), *Path("policies").glob("*.md")]:
        assert path.read_text() == (ROOT / path).read_text(), f"{path} is out of date: run python -m campaigns.publish"


def evaluation(split: str, dynamics: str) -> dict[str, object]:
    rate = {"rate": 0.9, "low": 0.8, "high": 0.95, "n": 50}
    where = {"policy": "p.onnx", "weights_sha256": "w", "split": split, "dynamics": dynamics, "safety": True, "description": "d"}
    return where | {"clean_success": rate, "clean_arrival": rate, "path_efficiency": 0.95, "failures": {"wall": [1, 2]}}


def test_a_file_of_several_evaluations_gives_a_row_each_with_its_command(tmp_path: Path) -> None:
    (tmp_path / "splits.json").write_text(json.dumps([evaluation("wind", "jsbsim"), evaluation("unseen", "internal")]))
    found = evaluations(read_results(tmp_path), "w")
    unseen, wind = evaluation_table(found).splitlines()[2:]
    assert unseen == "| `p` | `unseen` | on | six degrees of freedom | 90.0 % (80.0 to 95.0) of 50 | 90.0 % | 0.950 | `wall` 2 |"
    assert "| `wind` | on | JSBSim |" in wind
    assert commands(found).splitlines()[1:-1] == [
        "evaluate-policy p.onnx --split unseen --episodes 50 --safety on",
        "evaluate-policy p.onnx --split wind --episodes 50 --safety on --dynamics jsbsim",
    ]
    assert evaluations(read_results(tmp_path), "other weights") == []


def test_every_shipped_policy_has_a_card_with_results() -> None:
    policies = sorted((ROOT / "policies").glob("*.onnx"))
    assert policies
    for path in policies:
        assert path.stat().st_size < 1_000_000
        assert "clean success" in path.with_suffix(".md").read_text(), f"no result was measured on {path.name}"


def test_a_card_says_whether_anything_moved_in_training() -> None:
    assert "Never on moving obstacles" in trained_on(EnvironmentConfig())
    moving = trained_on(EnvironmentConfig(moving_share=0.25, mover_speed_max_mps=0.6))
    assert "in 25% of the corridors" in moving
    assert "up to 0.6 m/s" in moving
    assert "Never on moving obstacles" not in moving


def test_a_safety_campaign_gives_its_row_with_the_command_that_made_it() -> None:
    deaths = {"command": "c", "good": 78, "runs": 79, "late_moving_setpoints": 1, "contacts": 2}
    ((_, figure, command),) = safety_rows({"process_death": deaths, "another": {}})
    assert figure == "78 of 79 good: 1 moving setpoints more than 150 ms later, 2 contacts"
    assert command == "c"
