"""The training loop: collect, update, record, evaluate, checkpoint; resumable at the last checkpoint."""

from __future__ import annotations

import json
import subprocess
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from policy_export.contract import ActionLayout, ObservationLayout, default_layout, paper_layout
from policy_export.network import NetworkConfig, PolicyNetwork
from training.checkpoint import load_checkpoint, save_checkpoint, to_plain
from training.config import PpoConfig, TrainingConfig
from training.environment import CorridorVectorEnv
from training.evaluation import evaluate, evaluation_environment
from training.ppo import PpoLearner
from training.rollout import RolloutCollector, RolloutSummary

_RECENT_EPISODES = 500


def layouts(config: TrainingConfig) -> tuple[ObservationLayout, ActionLayout]:
    """Observation and action layout of the run."""
    if config.layout == "paper":
        return paper_layout(), ActionLayout(frame="corridor")
    return default_layout(), ActionLayout()


def hold_ticks(config: PpoConfig, progress: float) -> int:
    """Ticks for which an action is held when a share ``progress`` of the decisions is done."""
    return [stage.ticks for stage in config.hold if stage.share <= progress][-1]


def git_commit() -> str:
    """Short commit of the source tree, or "unknown" outside of one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() if done.returncode == 0 else "unknown"


@dataclass(slots=True)
class Status:
    """What a display wants to know after each update."""

    decisions: int
    total: int
    decisions_per_s: float
    hold: int
    success: float
    contacts: float
    evaluation: dict[str, Any] | None
    metrics: dict[str, float]


class Trainer:
    """One run in one folder. ``updates`` yields after every update; stopping the iteration at any point loses nothing saved."""

    def __init__(self, config: TrainingConfig, out: Path, device: str = "cpu") -> None:
        self.config, self.out = config, out
        torch.manual_seed(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.layout, self.action_layout = layouts(config)
        limits = {"action_low": self.action_layout.low, "action_high": self.action_layout.high}
        self.network = PolicyNetwork(NetworkConfig(**({"memory": config.memory} | limits | config.network))).to(device)
        self.learner = PpoLearner(self.network, config.ppo)
        self.env = CorridorVectorEnv(config.ppo.environments, config.environment, config.seed, self.layout, self.action_layout)
        self.collector = RolloutCollector(self.env, self.network, config.ppo, self.generator)
        self.decisions = self.update_count = 0
        self.seconds = 0.0
        self.commit = git_commit()  # of the code that is running, whatever is checked out later
        self.best = -1.0
        self.evaluation: dict[str, Any] | None = None
        self.next_evaluation = config.evaluation.every_decisions
        self._recent: deque[str] = deque(maxlen=_RECENT_EPISODES)
        self._evaluation_env: CorridorVectorEnv | None = None

    @property
    def progress(self) -> float:
        """Share of the decisions done."""
        return min(1.0, self.decisions / self.config.decisions)

    def updates(self) -> Iterator[Status]:
        """Train until ``config.decisions`` are done. Raises TrainingDivergedError with the last checkpoint intact."""
        self.out.mkdir(parents=True, exist_ok=True)
        with _Recorder(self.out, self.decisions) as recorder:
            while self.decisions < self.config.decisions:
                status = self._one_update()
                recorder.write(self, status)
                yield status
            self.save("last.pt")

    def _one_update(self) -> Status:
        began = time.perf_counter()
        hold = hold_ticks(self.config.ppo, self.progress)
        batch, summary = self.collector.collect(hold)
        metrics = self.learner.update(batch, self.generator, self.progress)
        self.decisions += summary.decisions
        self.update_count += 1
        self.seconds += (elapsed := time.perf_counter() - began)
        fresh = None
        if self.decisions >= self.next_evaluation or self.decisions >= self.config.decisions:
            fresh = self._evaluate()
        if self.update_count % self.config.checkpoint_every_updates == 0:
            self.save("last.pt")
        return self._status(summary, metrics, hold, elapsed, fresh)

    def _evaluate(self) -> dict[str, Any]:
        config = self.config
        if self._evaluation_env is None:
            self._evaluation_env = evaluation_environment(config.environment, config.evaluation, self.layout, self.action_layout)
        self.evaluation = evaluate(self.network, self._evaluation_env)
        self.next_evaluation = self.decisions + config.evaluation.every_decisions
        if self.evaluation["success"] >= self.best:
            self.best = self.evaluation["success"]
            self.save("best.pt")
        return self.evaluation

    def _status(
        self, summary: RolloutSummary, metrics: dict[str, float], hold: int, elapsed: float, evaluation: dict[str, Any] | None
    ) -> Status:
        for outcome, count in summary.outcomes.items():
            self._recent.extend([outcome] * count)
        total = max(len(self._recent), 1)
        success = self._recent.count("goal") / total
        contacts = sum(1 for outcome in self._recent if outcome not in ("goal", "time_out")) / total
        metrics = metrics | {f"reward/{name}": value / summary.decisions for name, value in summary.reward_terms.items()}
        metrics |= {f"std/{i}": value for i, value in enumerate(self.network.log_std.detach().exp().tolist())}
        metrics["mean_episode_ticks"] = sum(summary.episode_ticks) / max(len(summary.episode_ticks), 1)
        speed = summary.decisions / elapsed
        return Status(self.decisions, self.config.decisions, speed, hold, success, contacts, evaluation, metrics)

    def save(self, name: str) -> None:
        """Write a checkpoint that both the exporter and ``resume`` read."""
        config, learner, network = self.config, self.learner, self.network
        training = {"config_hash": config.digest(), "seed": config.seed, "steps": self.decisions, "git_commit": self.commit}
        training |= {"updates": self.update_count, "seconds": round(self.seconds, 1), "evaluation": self.evaluation or {}}
        resume = {"config": config.model_dump(mode="json"), "best": self.best, "next_evaluation": self.next_evaluation}
        resume |= {"seconds": self.seconds, "learning_rate": learner.learning_rate, "generator": self.generator.get_state()}
        resume |= {"collector": self.collector.state(), "environment": self.env.state(), "recent": list(self._recent)}
        layout = {"observation": self.layout.model_dump(mode="json"), "action": self.action_layout.model_dump(mode="json")}
        content = {"network_config": network.config.to_dict(), "state_dict": _on_cpu(network.state_dict()), "training": training}
        content |= {"layout": layout, "optimizer": learner.optimizer.state_dict(), "resume": resume}
        save_checkpoint(self.out / name, to_plain(content))

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of a run with the same configuration."""
        content = load_checkpoint(path, resume=True)
        saved = content["resume"]
        self.network.load_state_dict(content["state_dict"])
        self.learner.optimizer.load_state_dict(content["optimizer"])
        self.learner.learning_rate = saved["learning_rate"]
        self.generator.set_state(saved["generator"])
        self.collector.restore(saved["collector"])
        self.env.restore(saved["environment"])
        self.decisions, self.update_count = content["training"]["steps"], content["training"]["updates"]
        self.evaluation = content["training"]["evaluation"] or None
        self.best, self.next_evaluation, self.seconds = saved["best"], saved["next_evaluation"], saved["seconds"]
        self._recent.extend(saved["recent"])


def _on_cpu(weights: dict[str, Any]) -> dict[str, Any]:
    return {name: tensor.cpu() for name, tensor in weights.items()}


def _forget_after(path: Path, decisions: int) -> None:
    """Drop the rows of updates that a resumed run will repeat, and a torn last line."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["decisions"] <= decisions:
                kept.append(line + "\n")
        except ValueError:
            continue
    path.write_text("".join(kept), encoding="utf-8")


class _Recorder:
    """Metrics of every update to ``metrics.jsonl`` and TensorBoard."""

    def __init__(self, out: Path, decisions: int) -> None:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  # slow import

        path = out / "metrics.jsonl"
        _forget_after(path, decisions)
        self._file = path.open("a", encoding="utf-8")
        self._board = SummaryWriter(str(out / "tensorboard"), purge_step=decisions + 1)

    def __enter__(self) -> _Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._board.close()

    def write(self, trainer: Trainer, status: Status) -> None:
        """One line, one TensorBoard step."""
        row: dict[str, Any] = {
            "decisions": status.decisions,
            "update": trainer.update_count,
            "seconds": round(trainer.seconds, 2),
        }
        row |= {"hold": status.hold, "decisions_per_s": round(status.decisions_per_s, 1)}
        row |= {"success": status.success, "contacts": status.contacts} | status.metrics
        for name, value in row.items():
            self._board.add_scalar(name, value, status.decisions)
        if status.evaluation is not None:
            row["evaluation"] = status.evaluation
            self._board.add_scalar("evaluation/success", status.evaluation["success"], status.decisions)
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
