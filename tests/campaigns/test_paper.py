"""The paper's comparison in small: trained, flown, drawn, resumed; and its arithmetic."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from campaigns.paper.__main__ import main
from campaigns.paper.measures import BINS, MEASURES, Curves, convergence_episode, training_measures
from campaigns.paper.report import article, make_table, markdown, reading
from campaigns.paper.runs import finished_decisions, study_runs
from campaigns.paper.significance import permutation_p
from training.checkpoint import CheckpointError, load_checkpoint
from training.config import TrainingConfig

ROOT = Path(__file__).resolve().parents[2]
UPDATE = 8 * 16
FIGURES = ("4_reward", "5_collisions", "6_value_loss", "7_entropy", "8_flight", "9_measures")


def preset(folder, memory):
    content = {
        "decisions": 3 * UPDATE,
        "memory": memory,
        "environment": {"world_pool": 4, "time_limit_s": 2.0},
        "network": {"hidden_size": 16, "head_size": 8},
        "ppo": {"environments": 8, "steps": 16, "epochs": 1, "minibatches": 2},
        "evaluation": {"every_decisions": 10_000, "episodes": 1},
    }
    path = folder / f"{memory}.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_a_tiny_study_writes_everything_and_keeps_what_is_finished(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    arguments = ["--ppo", preset(tmp_path, "none"), "--lstm", preset(tmp_path, "lstm"), "--seeds", "2", "--episodes", "1"]
    arguments += ["--workers", "1", "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]
    arguments += ["--decisions", str(3 * UPDATE)]
    assert main(arguments) == 0
    out = tmp_path / "out"
    for name in FIGURES:
        assert (out / f"figure_{name}.png").stat().st_size > 5_000
        assert json.loads((out / f"figure_{name}.json").read_text())
    table = json.loads((out / "table_2.json").read_text())
    assert set(table["rows"]) == set(MEASURES)
    assert len(table["rows"]["final_entropy"]["ours"]["PPO-LSTM"]["seeds"]) == 2
    assert "| path efficiency | 0.6 | 0.85 |" in (out / "README.md").read_text()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("last.pt")}
    (out / "README.md").unlink()
    assert main(arguments) == 0
    assert len(before) == 4
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert (out / "README.md").exists()
    longer = [*arguments, "--decisions", str(5 * UPDATE)]
    assert main(longer) == 0
    assert all(load_checkpoint(path)["training"]["steps"] == 5 * UPDATE for path in before)


def test_a_folder_with_another_configuration_is_refused(tmp_path):
    config = TrainingConfig.model_validate(yaml.safe_load(Path(preset(tmp_path, "none")).read_text()))
    (run,) = study_runs({"PPO": config}, 1, 3 * UPDATE, tmp_path / "runs")
    assert finished_decisions(run) == 0
    from training.trainer import Trainer

    list(Trainer(run.config, run.folder).updates())
    assert finished_decisions(run) == 3 * UPDATE
    other = study_runs({"PPO": config.model_copy(update={"memory": "lstm"})}, 1, 3 * UPDATE, tmp_path / "runs")[0]
    with pytest.raises(CheckpointError, match="another configuration"):
        finished_decisions(other)


def test_permutation_test_counts_all_divisions():
    assert permutation_p([1, 2, 3, 4, 5], [6, 7, 8, 9, 10]) == pytest.approx(2 / 252)
    assert permutation_p([1.0, 2.0], [1.0, 2.0]) == 1.0
    assert permutation_p([0.0, 1.0], [2.0, 3.0]) == pytest.approx(2 / 6)
    assert permutation_p([], [1.0]) == 1.0


def curves(success):
    bins = len(success)
    plain = np.linspace(1.0, 2.0, bins)
    return Curves(100.0 * np.arange(1, bins + 1), plain, 10.0 * plain, 1.0 - success, success, plain**2, 3.0 - plain)


def test_training_measures_come_from_the_ends_of_the_curves():
    success = np.concatenate([np.zeros(30), np.full(20, 0.8)])
    found = training_measures(curves(success))
    assert found["convergence_episode"] == 3100.0
    assert found["initial_collisions"] == 100.0
    assert found["final_collisions"] == pytest.approx(20.0)
    assert found["final_return"] == pytest.approx(10.0 * np.linspace(1.0, 2.0, BINS)[-5:].mean())
    assert convergence_episode(curves(np.full(10, 0.5)), 1) == 100.0


def measured(ppo, lstm):
    return {
        "PPO": [dict.fromkeys(MEASURES, value) for value in ppo],
        "PPO-LSTM": [dict.fromkeys(MEASURES, value) for value in lstm],
    }


def test_the_reading_follows_the_tests():
    clear = make_table(measured([1, 2, 3, 4, 5], [6, 7, 8, 9, 10]))
    helps, harms, unclear = reading(clear)
    assert "PPO-LSTM is better: final reward" in helps
    assert "path efficiency" in helps
    assert "mean jerk" in harms
    assert "in no measure" in unclear
    helps, harms, unclear = reading(make_table(measured([1, 2, 3], [1, 2, 3])))
    assert "in no measure" in helps
    assert "in no measure" in harms
    assert "path efficiency (p = 1.000)" in unclear


def test_what_no_flight_could_measure_is_said():
    text = markdown(make_table(measured([float("nan")], [0.5])), "command")
    assert "no flight reached the goal" in text
    assert "nan" not in text


def test_the_articles_table_is_complete():
    for algorithm in ("PPO", "PPO-LSTM"):
        assert set(article()[algorithm]) == set(MEASURES)
