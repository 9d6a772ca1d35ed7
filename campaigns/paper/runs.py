"""The training runs of a study, each in its folder: finished ones are kept, broken-off ones go on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from campaigns.workers import over_processes
from training.config import TrainingConfig


@dataclass(frozen=True, slots=True)
class Run:
    """One algorithm from one seed."""

    algorithm: str
    config: TrainingConfig
    folder: Path

    @property
    def policy(self) -> Path:
        """Its policy file."""
        return self.folder / "policy.onnx"


def study_runs(algorithms: dict[str, TrainingConfig], seeds: int, decisions: int, folder: Path) -> list[Run]:
    """Every algorithm from seeds 1 to ``seeds``; each for so many ``decisions``."""
    runs = []
    for seed in range(1, seeds + 1):
        for name, preset in algorithms.items():
            config = preset.model_copy(update={"seed": seed, "decisions": decisions})
            runs.append(Run(name, config, folder / f"{name.lower()}-{seed}"))
    return runs


def train_all(runs: list[Run], workers: int | None) -> None:
    """Train what is not finished yet, one run per process."""
    console = Console(stderr=True)
    for index, line in over_processes(partial(train_one, runs), len(runs), workers):
        console.print(f"{index + 1} of {len(runs)}: {line}", highlight=False, markup=False, soft_wrap=True)


def train_one(runs: list[Run], index: int) -> str:
    """Train one run to its end and export its policy; says what was done."""
    import torch  # noqa: PLC0415  # not in the process that only waits

    from policy_export.export import export_checkpoint  # noqa: PLC0415
    from training.trainer import Trainer  # noqa: PLC0415

    run, torch_threads = runs[index], 1
    torch.set_num_threads(torch_threads)
    done = finished_decisions(run)
    trainer = Trainer(run.config, run.folder)
    if done:
        trainer.resume(run.folder / "last.pt")
    for _ in trainer.updates() if done < run.config.decisions else ():
        pass
    if done < run.config.decisions or not run.policy.exists():
        export_checkpoint(run.folder / "last.pt", run.policy, name=run.folder.name)
    verb = "kept" if done >= run.config.decisions else "resumed" if done else "trained"
    return f"{run.folder.name} {verb}: {trainer.decisions:,} decisions in {trainer.seconds / 60.0:.1f} min"


def finished_decisions(run: Run) -> int:
    """Decisions behind the checkpoint in the run's folder, 0 without one. A run of another configuration is an error."""
    from training.checkpoint import CheckpointError, load_checkpoint  # noqa: PLC0415

    path = run.folder / "last.pt"
    if not path.exists():
        return 0
    content = load_checkpoint(path, resume=True)
    saved = TrainingConfig.model_validate(content["resume"]["config"])
    if saved.model_copy(update={"decisions": run.config.decisions}) != run.config:
        raise CheckpointError(f"{run.folder}: holds a run of another configuration; give another --runs folder")
    return int(content["training"]["steps"])
