"""Throughput of training, whole loop: environment, LiDAR, rollout and learning, beside RecurrentPPO of sb3-contrib in one run.

Like for like: the same compiled corridors, 64 of them for 128 steps, batches of 2,048, 4 epochs, an LSTM of 128 over the 190 raw
channels, heads of 64. One core is compared by CPU time in turns, two cores by wall clock: run it on a calm machine.
"""

from __future__ import annotations

import json as json_text
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

ENVIRONMENTS, STEPS, BATCH, EPOCHS = 64, 128, 2048, 4
SEQUENCE = 64  # as the article; SB3 cuts its sequences at episode ends and once at random
ROUNDS, TWO_CORE_UPDATES = 4, 16
ONE_CORE_TARGET, TWO_CORE_TARGET, LIMIT_TARGET = 6.0, 10.0, 0.35
ARTICLE_DECISIONS, ARTICLE_MINUTES = 27_000 * 170, 15.0
WIDTH, HIDDEN, HEAD, ACTIONS = 190, 128, 64, 4

CONFIG: dict[str, Any] = {
    "decisions": 10**9,
    "checkpoint_every_updates": 10**6,
    "network": {"preprocessing": "channels", "feature_skip": False},
    "environment": {"world_pool": 256},
    "ppo": {
        "environments": ENVIRONMENTS,
        "steps": STEPS,
        "sequence": SEQUENCE,
        "epochs": EPOCHS,
        "minibatches": ENVIRONMENTS * STEPS // BATCH,
        "target_kl": None,
        "noise_correlation_per_tick": 0.0,
        "hold": [{"share": 0.0, "ticks": 1}],
    },
    "evaluation": {"every_decisions": 10**9, "episodes": 1},
}


def flop_per_decision() -> float:
    """Of the matrix products alone: one forward pass in the rollout, per epoch one more and the gradients of weights and states.

    Nobody needs the gradient of the observations.
    """
    into, recurrent = 2 * WIDTH * 4 * HIDDEN, 2 * HIDDEN * 4 * HIDDEN
    heads = 2 * (2 * HIDDEN * HEAD + HEAD * (ACTIONS + 1))
    forward = into + recurrent + heads
    return float(forward + EPOCHS * (3 * forward - into))


def matrix_flops(seconds: float = 0.4) -> float:
    """FLOP/s of one large product of this network's shape, by CPU time."""
    import torch

    clock = time.process_time

    a, b = torch.randn(BATCH, WIDTH + HIDDEN), torch.randn(WIDTH + HIDDEN, 4 * HIDDEN)
    count, began = 0, clock()
    while clock() - began < seconds:
        torch.mm(a, b)
        count += 1
    return count * 2.0 * a.shape[0] * a.shape[1] * b.shape[1] / (clock() - began)


class Own:
    """Our trainer; `update` makes one and says how many decisions it took."""

    def __init__(self, folder: Path) -> None:
        from training.config import TrainingConfig
        from training.trainer import Trainer

        self._updates = Trainer(TrainingConfig.model_validate(CONFIG), folder).updates()

    def update(self) -> int:
        """One rollout and its epochs."""
        next(self._updates)
        return ENVIRONMENTS * STEPS


class Sb3:
    """RecurrentPPO on the same corridors.

    `shared`: one LSTM for actor and critic, the same network as ours; else one each, as it comes. `authors`: one corridor and
    the settings of the article's repository.
    """

    def __init__(self, *, shared: bool = False, authors: bool = False) -> None:
        from benchmarks._sb3_corridors import recurrent_ppo
        from training.config import EnvironmentConfig
        from training.environment import CorridorVectorEnv

        count, self._steps = (1, 512) if authors else (ENVIRONMENTS, ENVIRONMENTS * STEPS)
        settings: dict[str, Any] = {"n_steps": STEPS, "batch_size": BATCH, "n_epochs": EPOCHS}
        if authors:
            settings = {"n_steps": 512, "batch_size": 64, "ent_coef": 0.05, "vf_coef": 0.1, "max_grad_norm": 0.3}
        env = CorridorVectorEnv(count, EnvironmentConfig(world_pool=256))
        self._model = recurrent_ppo(env, shared=shared or authors, **settings)

    def update(self) -> int:
        """One rollout and its epochs."""
        self._model.learn(self._steps, reset_num_timesteps=False)
        return self._steps


def rate(update: Callable[[], int]) -> tuple[float, float]:
    """Decisions per second of one update, by CPU time and by wall clock."""
    cpu, wall = time.process_time(), time.perf_counter()
    decisions = update()
    return decisions / (time.process_time() - cpu), decisions / (time.perf_counter() - wall)


def two_processes() -> float:
    """Decisions per second of two processes under torchrun, wall clock, median of the later updates."""
    with tempfile.TemporaryDirectory() as folder:
        preset, run = Path(folder) / "two.yaml", Path(folder) / "run"
        preset.write_text(json_text.dumps(CONFIG))  # JSON is YAML
        launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "training.cli"]
        decisions = str(TWO_CORE_UPDATES * ENVIRONMENTS * STEPS)
        command = [*launch, "--config", str(preset), "--out", str(run), "--decisions", decisions]
        subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, timeout=600)
        rows = [json_text.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return median(row["decisions_per_s"] for row in rows[TWO_CORE_UPDATES // 2 :])


def measure() -> dict[str, float]:
    """Decisions per second of every candidate, FLOP/s of the machine; medians over rounds in which all take turns."""
    import torch

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        own, peer, shared, authors = Own(Path(folder)), Sb3(), Sb3(shared=True), Sb3(authors=True)
        for candidate in (own, peer, shared, authors):
            candidate.update()  # compiles kernels, makes corridors, fills caches
        rounds = []
        for _ in range(ROUNDS):
            one = {"flops": matrix_flops(), "own": rate(own.update)[0], "shared": rate(shared.update)[0]}
            one["peer"], one["peer wall"] = rate(peer.update)
            torch.set_num_threads(2)
            one["peer wall, two threads"] = rate(peer.update)[1]
            torch.set_num_threads(1)
            rounds.append(one)
        found = {name: median(one[name] for one in rounds) for name in rounds[0]}
        found["authors"] = rate(authors.update)[0]
    found["own, two cores"] = two_processes()
    return found


def run(json: bool) -> list[dict[str, Any]]:
    """Ratios within this run; the authors' settings are marked as not like for like."""
    if not json:
        print("   some minutes; the targets hold for a machine with nothing else to do", file=sys.stderr, flush=True)
    return figures(measure())


def figures(found: dict[str, float]) -> list[dict[str, Any]]:
    """What `measure` found, as ratios. No network of this size can pass its matrix products: that ceiling stands beside them."""
    own, two = found["own"], found["own, two cores"]
    limit = found["flops"] / flop_per_decision()
    peer_two = max(found["peer wall"], found["peer wall, two threads"])
    minutes = ARTICLE_DECISIONS / two / 60.0
    like = "64 corridors x 128 steps, batch 2,048, 4 epochs, LSTM 128"
    return [
        _figure(f"one core, to sb3-contrib RecurrentPPO ({like}; its critic's LSTM on)", own, found["peer"], ONE_CORE_TARGET),
        _figure("two cores, to the same with one or two threads, the faster, wall clock", two, peer_two, TWO_CORE_TARGET),
        _figure("one core, to RecurrentPPO with one LSTM for both, as ours", own, found["shared"], None),
        _figure("ceiling of the line above: this core's matrix products alone", limit, found["shared"], None),
        _figure("one core, share of its matrix products' limit", own, limit, LIMIT_TARGET),
        _figure("NOT like for like: one core, to RecurrentPPO with the authors' settings", own, found["authors"], None),
        {
            "name": f"the article's volume ({ARTICLE_DECISIONS:,} decisions) on two cores", "value": minutes, "unit": "min",
            "target": f"<= {ARTICLE_MINUTES:g} min", "ok": minutes <= ARTICLE_MINUTES,
        },
    ]  # fmt: skip


def _figure(name: str, value: float, peer: float, target: float | None) -> dict[str, Any]:
    ratio = value / peer
    return {
        "name": name, "value": value, "unit": "decisions/s", "peer": peer, "ratio": ratio,
        "target": None if target is None else f">= {target:g}", "ok": None if target is None else ratio >= target,
    }  # fmt: skip
