"""Whole runs in small: rollouts agree with the learner's view of them, resume, checkpoints, the command line, evaluation."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from typer.testing import CliRunner

from strict_yaml import load_config
from training import cli
from training.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from training.config import EvaluationConfig, PpoConfig, TrainingConfig
from training.evaluation import evaluate, evaluation_environment
from training.intervals import wilson_interval
from training.ppo import TrainingDivergedError, advantages, correlated_log_prob, evaluate_sequences
from training.trainer import Trainer, hold_ticks, layouts

ROOT = Path(__file__).parents[2]
PRESETS = sorted((ROOT / "configs" / "training").glob("*.yaml"))
UPDATE = 8 * 16


TINY_PPO = {"environments": 8, "steps": 16, "epochs": 2, "minibatches": 2}


def tiny(**changes):
    base = {
        "decisions": 4 * UPDATE,
        "checkpoint_every_updates": 1,
        "environment": {"world_pool": 4, "time_limit_s": 3.0},
        "network": {"hidden_size": 16, "head_size": 8},
        "ppo": TINY_PPO,
        "evaluation": {"every_decisions": 2 * UPDATE, "episodes": 3},
    }
    return TrainingConfig.model_validate(base | changes)


def weights(trainer):
    return [parameter.detach().clone() for parameter in trainer.network.parameters()]


def run(trainer):
    return list(trainer.updates())


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_presets_load_and_make_a_network(path):
    config = load_config(path, TrainingConfig)
    small = config.model_copy(update={"environment": config.environment.model_copy(update={"world_pool": 1})})
    trainer = Trainer(small, Path("unused"))
    observation, action = layouts(config)
    assert observation.size == 190
    assert trainer.network.config.memory == config.memory
    assert trainer.network.config.action_low == action.low


@pytest.mark.parametrize("sequence", [None, 4])
@pytest.mark.parametrize("memory", ["lstm", "gru", "stack", "none"])
def test_the_learner_sees_what_the_rollout_did(tmp_path, memory, sequence):
    trainer = Trainer(tiny(memory=memory, ppo={**TINY_PPO, "sequence": sequence}), tmp_path)
    resets = 0
    for hold in (4, 1):
        batch, summary = trainer.collector.collect(hold)
        with torch.no_grad():
            mean, value = evaluate_sequences(trainer.network, batch.features, batch.h0, batch.c0, batch.reset)
            log_prob = correlated_log_prob(batch.raw, mean, trainer.network.log_std, batch.noise_before, batch.rho.unsqueeze(-1))
        torch.testing.assert_close(log_prob, batch.log_prob, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(value, batch.target - batch.advantage, atol=1e-4, rtol=1e-4)
        assert summary.decisions == UPDATE
        assert batch.reset.shape == (sequence or 16, UPDATE // (sequence or 16))
        resets += int(batch.reset[1:].sum())
    assert resets > 0  # three-second episodes end inside the rollouts


def test_values_beyond_the_rollout_and_beyond_a_time_out_use_the_state_that_led_there(tmp_path, monkeypatch):
    """Replays every environment's flight by itself, one step at a time, and values what it saw last."""
    trainer = Trainer(tiny(environment={"world_pool": 4, "time_limit_s": 0.4}), tmp_path)
    collector, network, seen = trainer.collector, trainer.network, []
    step_held = trainer.env.step_held

    def watched(actions, hold):
        result = step_held(actions, hold)
        seen.append((result[0].copy(), result[3].copy(), result[4].get("final_obs")))
        return result

    monkeypatch.setattr(trainer.env, "step_held", watched)
    first = collector.observation.clone()
    given = {}

    def spy(rewards, values, last_value, terminated, truncated, final_values, decay):
        given.update(last=last_value, truncated=truncated, final=final_values)
        return advantages(rewards, values, last_value, terminated, truncated, final_values, decay)

    monkeypatch.setattr("training.rollout.advantages", spy)
    collector.collect(1)
    assert given["truncated"].sum() > 0
    with torch.no_grad():
        for b in range(8):
            h, c = network.initial_state(1)
            observation = first[b : b + 1]
            for t, (following, truncated, final) in enumerate(seen):
                _, _, h, c = network.step(observation, h, c)
                if truncated[b]:
                    value = network.step(torch.from_numpy(final[b : b + 1]), h, c)[1]
                    torch.testing.assert_close(given["final"][t, b], value[0], atol=1e-5, rtol=1e-5)
                    h, c = network.initial_state(1)
                observation = torch.from_numpy(following[b : b + 1])
            torch.testing.assert_close(given["last"][b], network.step(observation, h, c)[1][0], atol=1e-5, rtol=1e-5)


def test_same_seed_same_weights_another_seed_others(tmp_path):
    trainers = [Trainer(tiny(seed=seed), tmp_path / str(i)) for i, seed in enumerate((1, 1, 2))]
    for trainer in trainers:
        run(trainer)
    assert same(weights(trainers[0]), weights(trainers[1]))
    assert not same(weights(trainers[0]), weights(trainers[2]))
    assert curve(tmp_path / "0") == curve(tmp_path / "1") != curve(tmp_path / "2")


def curve(folder):
    """All that an update recorded, but for the time it took."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name not in ("seconds", "decisions_per_s")} for row in rows]


def test_a_loss_that_is_not_a_number_stops_and_leaves_the_last_good_checkpoint(tmp_path):
    trainer = Trainer(tiny(), tmp_path)
    updates = trainer.updates()
    for _ in range(2):
        next(updates)
    trainer.env.rules = trainer.env.rules._replace(scale=1e300)  # rewards beyond float32
    with pytest.raises(TrainingDivergedError, match=r"loss nan.*lower ppo\.learning_rate"):
        next(updates)
    again = Trainer(tiny(), tmp_path)
    again.resume(tmp_path / "last.pt")
    assert again.update_count == 2
    assert all(torch.isfinite(parameter).all() for parameter in again.network.parameters())
    assert [status.decisions for status in again.updates()] == [3 * UPDATE, 4 * UPDATE]


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path):
    whole = Trainer(tiny(), tmp_path / "whole")
    statuses = run(whole)
    first = Trainer(tiny(), tmp_path / "cut")
    for _, status in zip(range(2), first.updates(), strict=False):
        assert status.decisions
    second = Trainer(tiny(), tmp_path / "cut")
    second.resume(tmp_path / "cut" / "last.pt")
    assert second.decisions == 2 * UPDATE
    rest = run(second)
    assert same(weights(whole), weights(second))
    assert [status.metrics["kl"] for status in rest] == [status.metrics["kl"] for status in statuses[2:]]
    assert second.evaluation == whole.evaluation
    rows = [json.loads(line) for line in (tmp_path / "cut" / "metrics.jsonl").read_text().splitlines()]
    assert [row["decisions"] for row in rows] == [UPDATE * k for k in (1, 2, 3, 4)]


def test_a_run_can_begin_with_the_weights_of_another_and_says_so(tmp_path):
    first = Trainer(tiny(), tmp_path / "first")
    run(first)
    second = Trainer(tiny(seed=9), tmp_path / "second")
    second.start_from(tmp_path / "first" / "last.pt")
    assert same(weights(first), weights(second))
    assert (second.decisions, second.evaluation) == (0, None)
    run(second)
    origin = {"config_hash": tiny().digest(), "seed": tiny().seed, "steps": 4 * UPDATE}
    saved = load_checkpoint(tmp_path / "second" / "last.pt", resume=True)
    assert saved["training"]["started_from"] == [origin]
    again = Trainer(tiny(seed=9), tmp_path / "second")
    again.resume(tmp_path / "second" / "last.pt")
    assert again.ancestry == [origin]
    with pytest.raises(CheckpointError, match="its network differs"):
        Trainer(tiny(memory="gru"), tmp_path / "third").start_from(tmp_path / "first" / "last.pt")


def test_rows_of_repeated_updates_and_torn_lines_are_dropped_on_resume(tmp_path):
    trainer = Trainer(tiny(decisions=UPDATE), tmp_path)
    run(trainer)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"decisions": 5 * UPDATE}) + '\n{"decisions": 12')
    again = Trainer(tiny(decisions=2 * UPDATE), tmp_path)
    again.resume(tmp_path / "last.pt")
    run(again)
    rows = [json.loads(line)["decisions"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert rows == [UPDATE, 2 * UPDATE]


def test_checkpoint_holds_what_the_exporter_reads(tmp_path):
    trainer = Trainer(tiny(decisions=UPDATE), tmp_path)
    run(trainer)
    content = torch.load(tmp_path / "last.pt", weights_only=True)
    assert content["training"]["steps"] == UPDATE
    assert content["training"]["config_hash"] == trainer.config.digest()
    assert content["layout"]["observation"]["size"] == 190
    assert content["network_config"]["hidden_size"] == 16
    assert not list(tmp_path.glob("*.tmp"))


def test_unusable_checkpoints_are_refused_by_name(tmp_path):
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "none.pt")
    torn = tmp_path / "torn.pt"
    torn.write_bytes(b"PK\x03\x04 not really")
    with pytest.raises(CheckpointError, match=r"torn\.pt: not a readable checkpoint"):
        load_checkpoint(torn)
    other = tmp_path / "other.pt"
    save_checkpoint(other, {"weights": torch.zeros(1)})
    with pytest.raises(CheckpointError, match="lacks network_config"):
        load_checkpoint(other)


def test_hold_falls_with_the_schedule():
    config = PpoConfig()
    assert [hold_ticks(config, share) for share in (0.0, 0.34, 0.35, 0.59, 0.6, 1.0)] == [4, 4, 2, 2, 1, 1]


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"ppo": {"environments": 10, "minibatches": 4}}, "multiple of minibatches"),
        ({"ppo": {"steps": 64, "sequence": 48}}, "multiple of sequence"),
        ({"ppo": {"hold": [{"share": 0.5, "ticks": 1}]}}, "start at share 0"),
        ({"evaluation": {"seed": 12}}, "greater than or equal to 1000000"),
        ({"decision": 3}, "Extra inputs"),
        ({"environment": {"reward": {"goal": float("nan")}}}, "finite"),
    ],
)
def test_configuration_mistakes_are_named(section, message):
    with pytest.raises(ValidationError, match=message):
        TrainingConfig.model_validate(section)


def test_evaluation_is_deterministic_and_flies_held_out_worlds_from_their_start(tmp_path):
    trainer = Trainer(tiny(), tmp_path)
    config, settings = trainer.config.environment, EvaluationConfig(episodes=4)
    env = evaluation_environment(config, settings, trainer.layout, trainer.action_layout)
    first, second = evaluate(trainer.network, env), evaluate(trainer.network, env)
    assert first == second
    assert first["episodes"] == 4
    assert sum(first["failures"].values()) == 4 - round(4 * first["success"])
    assert (env.arena.start[:, 0] <= 5.0).all()


def test_wilson_interval_matches_known_values():
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-4)  # Newcombe 1998, table I
    low, high = wilson_interval(0, 20)
    assert low == pytest.approx(0.0, abs=1e-12)
    assert high == pytest.approx(0.1611, abs=5e-4)
    assert np.isclose(wilson_interval(20, 20)[1], 1.0)


# the command


def write_preset(path, **changes):
    import yaml

    path.write_text(yaml.safe_dump(tiny(**changes).model_dump(mode="json", exclude_defaults=True)))
    return path


def test_command_trains_and_reports_json(tmp_path):
    preset = write_preset(tmp_path / "small.yaml")
    result = CliRunner().invoke(
        cli.app, ["--config", str(preset), "--out", str(tmp_path / "run"), "--json", "--decisions", "256"]
    )
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["finished"]
    assert report["decisions"] == 2 * UPDATE
    assert (tmp_path / "run" / "best.pt").exists()
    assert list((tmp_path / "run" / "tensorboard").iterdir())
    again = CliRunner().invoke(cli.app, ["--config", str(preset), "--out", str(tmp_path / "run")])
    assert again.exit_code == 2
    assert "--resume" in again.stderr


def test_command_takes_another_memory_and_refuses_an_unknown_one(tmp_path):
    preset = write_preset(tmp_path / "small.yaml", decisions=UPDATE)
    result = CliRunner().invoke(cli.app, ["--config", str(preset), "--out", str(tmp_path / "run"), "--memory", "gru"])
    assert result.exit_code == 0, result.output
    assert load_checkpoint(tmp_path / "run" / "last.pt")["network_config"]["memory"] == "gru"
    result = CliRunner().invoke(cli.app, ["--config", str(preset), "--out", str(tmp_path / "other"), "--memory", "ltsm"])
    assert result.exit_code == 2
    assert "memory: Input should be 'lstm', 'gru', 'stack' or 'none'" in result.stderr


def test_command_says_that_training_diverged(tmp_path):
    preset = write_preset(tmp_path / "wild.yaml", environment={"world_pool": 4, "reward": {"progress_per_m": 1e300}})
    result = CliRunner().invoke(cli.app, ["--config", str(preset), "--out", str(tmp_path / "run")])
    assert result.exit_code == 1
    assert "training diverged: loss nan" in result.stderr
    assert not (tmp_path / "run" / "last.pt").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "either --config"),
        (["--config", "absent.yaml"], "absent.yaml: cannot be read"),
        (["--resume", "nowhere"], "no such checkpoint"),
        (["--config", str(ROOT / "configs" / "training" / "ppo.yaml"), "--out", __file__], "is a file; give --out a folder"),
        (["--resume", "run", "--start-from", "other.pt"], "--start-from belongs to a new run"),
    ],
)
def test_command_mistakes_are_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def wait_for(path, deadline_s=120.0):
    end = time.monotonic() + deadline_s
    while not path.exists():
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.05)


def start(arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "training.cli", *arguments], env=environment, stderr=subprocess.PIPE, text=True
    )


def last_decisions(metrics):
    """Of the last whole line; the file is written anew when a run goes on, and may be empty at that moment."""
    lines = metrics.read_text().split("\n")[:-1]
    return json.loads(lines[-1])["decisions"] if lines else 0


def test_killed_run_goes_on_alone_and_a_terminated_one_saves(tmp_path):
    preset = write_preset(
        tmp_path / "long.yaml", decisions=10_000_000, checkpoint_every_updates=1, evaluation={"every_decisions": 10_000_000}
    )
    out = tmp_path / "run"
    process = start(["--config", str(preset), "--out", str(out)])
    wait_for(out / "last.pt")
    process.kill()
    process.communicate(timeout=30)
    before = load_checkpoint(out / "last.pt", resume=True)["training"]["steps"]
    assert last_decisions(out / "metrics.jsonl") - before <= UPDATE
    process = start(["--resume", str(out)])
    metrics = out / "metrics.jsonl"
    end = time.monotonic() + 120.0
    while last_decisions(metrics) < before + 3 * UPDATE:
        assert time.monotonic() < end
        assert process.poll() is None
        time.sleep(0.05)
    _, refused = (second := start(["--resume", str(out)])).communicate(timeout=60)
    assert second.returncode == 2
    assert "another process trains there" in refused
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "stopped" in errors
    assert load_checkpoint(out / "last.pt", resume=True)["training"]["steps"] >= before + 3 * UPDATE
