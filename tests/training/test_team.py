"""Several processes as one trainer: averaged gradients, equal weights, resumed together."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from typer.testing import CliRunner

from training import cli
from training.checkpoint import CheckpointError, load_checkpoint
from training.config import TrainingConfig
from training.team import Team
from training.trainer import Trainer

ROOT = Path(__file__).parents[2]
UPDATE = 8 * 16
TINY = {
    "decisions": 4 * UPDATE,
    "environment": {"world_pool": 4, "time_limit_s": 3.0},
    "network": {"hidden_size": 16, "head_size": 8},
    # nothing depends on the share of the run that is done, so that runs of different lengths agree
    "ppo": {
        "environments": 8, "steps": 16, "epochs": 2, "minibatches": 2, "target_kl": None,
        "entropy_coefficient": [0.003, 0.003], "hold": [{"share": 0.0, "ticks": 1}],
    },
    "evaluation": {"every_decisions": 10_000_000, "episodes": 1},
}  # fmt: skip


def start(arguments, processes=2):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    return subprocess.Popen(
        [*command, "-m", "training.cli", *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def rows_so_far(run):
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().split("\n")[:-1]]


def finished(arguments):
    process = start(arguments)
    out, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    return json.loads(out)


def preset(folder, **changes):
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY | changes))
    return str(path)


def test_two_processes_train_one_policy_and_go_on_together_after_a_kill(tmp_path):
    config, cut, whole = preset(tmp_path, decisions=10_000_000), tmp_path / "cut", tmp_path / "whole"
    process = start(["--config", config, "--out", str(cut)])
    end = time.monotonic() + 120.0
    while not (cut / "metrics.jsonl").exists() or len(rows_so_far(cut)) < 6:
        assert time.monotonic() < end, "no updates"
        assert process.poll() is None
        time.sleep(0.05)
    for worker in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        os.kill(int(worker), signal.SIGKILL)
    process.communicate(timeout=60)
    saved = load_checkpoint(cut / "last.pt", resume=True)["training"]["updates"]
    assert saved >= rows_so_far(cut)[-1]["update"] - 1  # at most one update is lost
    total = ["--decisions", str((saved + 3) * UPDATE), "--json"]
    assert finished(["--resume", str(cut), *total])["decisions"] == (saved + 3) * UPDATE
    finished(["--config", config, "--out", str(whole), *total])
    one, two = (load_checkpoint(run / "last.pt")["state_dict"] for run in (whole, cut))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert [path.name for path in cut.glob("last.*-*.pt")] == [f"last.1-{saved + 3}.pt"]
    assert [row["update"] for row in rows_so_far(cut)] == list(range(1, saved + 4))
    with pytest.raises(CheckpointError, match="trained by 2 processes"):
        Trainer(TrainingConfig.model_validate(TINY), cut).resume(cut / "last.pt")


def test_every_process_has_seeds_of_its_own():
    assert len({Team(rank, 4).seed(1) for rank in range(4)}) == 4


def test_shares_that_do_not_come_out_even_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("training.team.join", lambda device: (Team(0, 3), device))
    monkeypatch.setattr("training.team.leave", lambda team: None)
    result = CliRunner().invoke(cli.app, ["--config", preset(tmp_path), "--out", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert "multiple of processes x minibatches (6)" in result.stderr
