"""The training loop: collect, update, record, evaluate, checkpoint; resumable at the last checkpoint."""

from __future__ import annotations

import subprocess
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from policy_export.contract import ActionLayout, ObservationLayout, default_layout, paper_layout
from policy_export.network import NetworkConfig, PolicyNetwork
from training.checkpoint import CheckpointError, load_checkpoint, load_plain, only_writer, save_checkpoint, to_plain
from training.config import PpoConfig, TrainingConfig
from training.environment import CorridorVectorEnv
from training.evaluation import evaluate, evaluation_environment
from training.ppo import PpoLearner
from training.recorder import Recorder, Status
from training.rollout import RolloutCollector, RolloutSummary
from training.team import Team

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


class Trainer:
    """One run in one folder. ``updates`` yields after every update; stopping the iteration at any point loses nothing saved.

    In a ``team`` of several processes each has a share of the environments; the first one evaluates, records and saves.
    """

    def __init__(self, config: TrainingConfig, out: Path, device: str = "cpu", team: Team | None = None) -> None:
        self.config, self.out, self.team = config, out, team or Team()
        torch.manual_seed(config.seed)
        seed = self.team.seed(config.seed)
        self.generator = torch.Generator().manual_seed(seed)
        self.layout, self.action_layout = layouts(config)
        limits = {"action_low": self.action_layout.low, "action_high": self.action_layout.high}
        self.network = PolicyNetwork(NetworkConfig(**({"memory": config.memory} | limits | config.network))).to(device)
        self.learner = PpoLearner(self.network, config.ppo, self.team)
        share = config.ppo.environments // self.team.size
        self.env = CorridorVectorEnv(share, config.environment, seed, self.layout, self.action_layout)
        self.collector = RolloutCollector(self.env, self.network, config.ppo, self.generator)
        self.decisions = self.update_count = 0
        self.seconds = 0.0
        self.ancestry: list[dict[str, Any]] = []  # the runs whose weights this one began with, the first one first
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
        """Train until ``config.decisions`` are done.

        Raises TrainingDivergedError with the last checkpoint intact, CheckpointError where another process trains in the folder.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            recorder = None
            if self.team.leads:
                stack.enter_context(only_writer(self.out))
                recorder = stack.enter_context(Recorder(self.out, self.decisions))
            while self.decisions < self.config.decisions:
                status = self._one_update()
                if recorder is not None:
                    recorder.write(self.update_count, self.seconds, status)
                yield status
            self.save()

    def _one_update(self) -> Status:
        began = time.perf_counter()
        hold = hold_ticks(self.config.ppo, self.progress)
        batch, summary = self.collector.collect(hold)
        metrics = self.learner.update(batch, self.generator, self.progress)
        self.decisions += summary.decisions * self.team.size
        self.update_count += 1
        self.seconds += (elapsed := time.perf_counter() - began)
        fresh = None
        if self.decisions >= self.next_evaluation or self.decisions >= self.config.decisions:
            self.next_evaluation = self.decisions + self.config.evaluation.every_decisions
            fresh = self._evaluate() if self.team.leads else None
        if self.update_count % self.config.checkpoint_every_updates == 0:
            self.save()
        return self._status(summary, metrics, hold, elapsed, fresh)

    def _evaluate(self) -> dict[str, Any]:
        config = self.config
        if self._evaluation_env is None:
            self._evaluation_env = evaluation_environment(config.environment, config.evaluation, self.layout, self.action_layout)
        self.evaluation = evaluate(self.network, self._evaluation_env)
        if self.evaluation["success"] >= self.best:
            self.best = self.evaluation["success"]
            save_checkpoint(self.out / "best.pt", self._content())
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
        speed = self.team.size * summary.decisions / elapsed
        episodes = len(summary.episode_ticks)
        if episodes:
            metrics["mean_return"] = sum(summary.returns) / episodes / self.config.environment.reward.scale
            metrics["mean_episode_ticks"] = sum(summary.episode_ticks) / episodes
        return Status(
            self.decisions, self.config.decisions, speed, hold, success, contacts, evaluation, metrics, dict(summary.outcomes)
        )

    def save(self) -> None:
        """Write last.pt, which both the exporter and ``resume`` read, once the other processes have written their parts."""
        if not self.team.leads:
            save_checkpoint(self._part(), to_plain(self._own_state()))
        self.team.wait()
        if self.team.leads:
            save_checkpoint(self.out / "last.pt", self._content())
        self.team.wait()
        for old in set(self.out.glob(f"last.{self.team.rank}-*.pt")) - {self._part()}:
            old.unlink()

    def _part(self) -> Path:
        """Where a process that does not lead keeps its own state of this update."""
        return self.out / f"last.{self.team.rank}-{self.update_count}.pt"

    def _own_state(self) -> dict[str, Any]:
        """What every process has of its own."""
        return {"generator": self.generator.get_state(), "collector": self.collector.state(), "environment": self.env.state()}

    def _content(self) -> dict[str, Any]:
        config, learner, network = self.config, self.learner, self.network
        training = {"config_hash": config.digest(), "seed": config.seed, "steps": self.decisions, "git_commit": self.commit}
        training |= {"started_from": self.ancestry} if self.ancestry else {}
        training |= {"updates": self.update_count, "seconds": round(self.seconds, 1), "evaluation": self.evaluation or {}}
        resume = {"config": config.model_dump(mode="json"), "best": self.best, "next_evaluation": self.next_evaluation}
        resume |= {"seconds": self.seconds, "learning_rate": learner.learning_rate, "processes": self.team.size}
        resume |= {"recent": list(self._recent), **self._own_state()}
        layout = {"observation": self.layout.model_dump(mode="json"), "action": self.action_layout.model_dump(mode="json")}
        content = {"network_config": network.config.to_dict(), "state_dict": _on_cpu(network.state_dict()), "training": training}
        content |= {"layout": layout, "optimizer": learner.optimizer.state_dict(), "resume": resume}
        return dict(to_plain(content))

    def start_from(self, path: Path) -> None:
        """Begin a new run with the weights of another one; its optimiser, decisions and evaluations are not taken over.

        Raises CheckpointError when its network has another form.
        """
        content = load_checkpoint(path)
        if NetworkConfig.from_dict(content["network_config"]) != self.network.config:
            raise CheckpointError(f"{path}: its network differs from this run's; give the preset it was trained with")
        self.network.load_state_dict(content["state_dict"])
        before = content["training"]
        self.ancestry = [*before.get("started_from", []), {key: before[key] for key in ("config_hash", "seed", "steps")}]

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of a run with the same configuration and as many processes."""
        content = load_checkpoint(path, resume=True)
        saved = content["resume"]
        if (processes := saved.get("processes", 1)) != self.team.size:
            raise CheckpointError(f"{path}: was trained by {processes} processes; torchrun that many to go on with it")
        self.network.load_state_dict(content["state_dict"])
        self.learner.optimizer.load_state_dict(content["optimizer"])
        self.learner.learning_rate = saved["learning_rate"]
        self.decisions, self.update_count = content["training"]["steps"], content["training"]["updates"]
        self.evaluation = content["training"]["evaluation"] or None
        self.ancestry = content["training"].get("started_from", [])
        self.best, self.next_evaluation, self.seconds = saved["best"], saved["next_evaluation"], saved["seconds"]
        self._recent.extend(saved["recent"])
        own = saved if self.team.leads else load_plain(path.parent / self._part().name)
        self.generator.set_state(own["generator"])
        self.collector.restore(own["collector"])
        self.env.restore(own["environment"])


def _on_cpu(weights: dict[str, Any]) -> dict[str, Any]:
    return {name: tensor.cpu() for name, tensor in weights.items()}
