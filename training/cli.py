"""The ``train-policy`` command."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from training.config import TrainingConfig
    from training.recorder import Status
    from training.trainer import Trainer

_EPILOG = """
Examples:

train-policy --config configs/training/ppo_lstm.yaml

train-policy --config configs/training/ppo_lstm.yaml --out runs/night --seed 3 --decisions 5e6

train-policy --resume runs/night

train-policy --config configs/training/ppo_lstm_dynamic.yaml --start-from runs/night/best.pt

torchrun --nproc-per-node 2 -m training.cli --config configs/training/ppo_lstm.yaml
"""

app = typer.Typer(add_completion=False, rich_markup_mode="rich", pretty_exceptions_enable=False)


class _UsageError(Exception):
    """A mistake of the user's; one line that says what to change."""


@app.command(epilog=_EPILOG)
def train(
    config: Annotated[Path | None, typer.Option(help="Training preset (YAML), see configs/training/.")] = None,
    out: Annotated[Path | None, typer.Option(help="Run folder; default runs/NAME-OF-PRESET.")] = None,
    resume: Annotated[Path | None, typer.Option(help="Go on with the run in this folder, from its last.pt.")] = None,
    start_from: Annotated[Path | None, typer.Option(help="Checkpoint whose weights a new run begins with.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Replaces the preset's seed.")] = None,
    decisions: Annotated[float | None, typer.Option(min=1, max=1e12, help="Replaces the preset's number of decisions.")] = None,
    memory: Annotated[str | None, typer.Option(help="Replaces the preset's memory: lstm, gru, stack or none.")] = None,
    device: Annotated[str, typer.Option(help="Torch device of the network.")] = "cpu",
    threads: Annotated[int, typer.Option(min=1, help="Torch threads; more than 1 rarely helps at this size.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object with the result on stdout.")] = False,
) -> None:
    """Train a navigation policy with PPO-LSTM in the vectorised corridor.

    Writes last.pt, best.pt, metrics.jsonl and TensorBoard events to the run folder. Ctrl-C saves and stops; a killed run
    loses at most the updates since its last checkpoint and goes on with --resume.
    """
    from strict_yaml import ConfigError
    from training.checkpoint import CheckpointError
    from training.ppo import TrainingDivergedError

    try:
        changes = {"seed": seed, "decisions": decisions and int(decisions), "memory": memory}
        result = _run(config, out, resume, start_from, changes, device, threads)
    except (_UsageError, ConfigError, CheckpointError) as error:
        _fail(str(error), 2)
    except KeyboardInterrupt:
        _fail("stopped at once; the last checkpoint is good", 130)
    except TrainingDivergedError as error:
        _fail(f"training diverged: {error}; the last checkpoint is good", 1)
    if as_json and result.pop("leads"):
        print(json.dumps(result))


def _fail(message: str, code: int) -> None:
    print(f"train-policy: {message}", file=sys.stderr)
    raise typer.Exit(code)


def _run(
    config: Path | None,
    out: Path | None,
    resume: Path | None,
    start_from: Path | None,
    changes: dict[str, Any],
    device: str,
    threads: int,
) -> dict[str, Any]:
    if (config is None) == (resume is None):
        raise _UsageError("give either --config PRESET.yaml (a new run) or --resume RUN_FOLDER")
    if resume is not None and start_from is not None:
        raise _UsageError("--start-from belongs to a new run; a resumed one goes on with its own weights")
    import torch

    torch.set_num_threads(threads)
    settings, folder = _settings(config, out, resume, changes)
    _check_device(device)
    from training.team import join, leave
    from training.trainer import Trainer

    team, device = join(device)
    _check_shares(settings, team.size)
    try:
        trainer = Trainer(settings, folder, device, team)
        if resume is not None:
            trainer.resume(resume / "last.pt")
        elif start_from is not None:
            trainer.start_from(start_from)
        interrupted = _train(trainer)
    finally:
        leave(team)
    if team.leads:
        print(f"{'stopped' if interrupted else 'done'}: {folder}/last.pt after {trainer.decisions:,} decisions", file=sys.stderr)
    return {
        "run": str(folder), "decisions": trainer.decisions, "seconds": round(trainer.seconds, 1), "finished": not interrupted,
        "best_success": trainer.best if trainer.best >= 0.0 else None, "evaluation": trainer.evaluation, "leads": team.leads,
    }  # fmt: skip


def _check_shares(settings: TrainingConfig, processes: int) -> None:
    parts = processes * settings.ppo.minibatches
    if settings.ppo.environments % parts:
        raise _UsageError(
            f"ppo.environments ({settings.ppo.environments}) must be a multiple of processes x minibatches ({parts})"
        )


def _settings(config: Path | None, out: Path | None, resume: Path | None, changes: dict[str, Any]) -> tuple[TrainingConfig, Path]:
    """The configuration with the command line's changes, and the run folder."""
    from pydantic import ValidationError

    from strict_yaml import load_config
    from training.checkpoint import load_checkpoint
    from training.config import TrainingConfig

    if config is not None:
        base, folder = load_config(config, TrainingConfig), out or Path("runs") / config.stem
        if folder.exists() and not folder.is_dir():
            raise _UsageError(f"{folder} is a file; give --out a folder")
        if (folder / "last.pt").exists():
            raise _UsageError(f"{folder} already holds a run: go on with --resume {folder}, or give another --out")
    else:
        assert resume is not None
        for name in ("seed", "memory"):
            if changes[name] is not None:
                raise _UsageError(f"--{name} belongs to a new run; a resumed one keeps its own")
        base, folder = _stored_config(load_checkpoint(resume / "last.pt", resume=True), resume), out or resume
    try:
        merged = base.model_dump() | {key: value for key, value in changes.items() if value is not None}
        return TrainingConfig.model_validate(merged), folder
    except ValidationError as error:
        first = error.errors()[0]
        raise _UsageError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _stored_config(content: dict[str, Any], folder: Path) -> TrainingConfig:
    from pydantic import ValidationError

    from training.config import TrainingConfig

    try:
        return TrainingConfig.model_validate(content["resume"]["config"])
    except (ValidationError, KeyError, TypeError):
        raise _UsageError(f"{folder}/last.pt was written by another version of the trainer; start anew with --config") from None


def _check_device(device: str) -> None:
    import torch

    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise _UsageError(f"--device {device} cannot be used on this machine; use cpu") from None


def _train(trainer: Trainer) -> bool:
    """Run to the end with a progress display; True if stopped before (the state is saved)."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), TextColumn("ETA"), TimeRemainingColumn())
    stop = _StopRequest()
    quiet = not (console.is_terminal and trainer.team.leads)
    with Progress(*columns, console=console, disable=quiet, speed_estimate_period=120.0) as progress, stop:
        task = progress.add_task("starting", total=trainer.config.decisions, completed=trainer.decisions)
        for status in trainer.updates():
            progress.update(task, completed=status.decisions, description=_describe(status))
            if trainer.team.leads:
                _log(console, trainer, status)
            if trainer.team.mean(stop.requested) > 0.0:  # all processes end at the same update
                trainer.save()
                break
    return trainer.decisions < trainer.config.decisions


class _StopRequest:
    """Ctrl-C or SIGTERM asks for a stop after the update in progress, so that what is saved is whole; a second one insists."""

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _StopRequest:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._ask)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, _frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print("train-policy: stopping after this update (again to stop at once)", file=sys.stderr)


def _describe(status: Status) -> str:
    best = f", held-out {status.evaluation['success']:.1%}" if status.evaluation else ""
    return (
        f"{status.decisions / 1e6:.2f} M decisions, {status.decisions_per_s:,.0f}/s, hold {status.hold}, "
        f"success {status.success:.1%}, collisions {status.contacts:.1%}{best}"
    )


def _log(console: Any, trainer: Trainer, status: Status) -> None:
    """A line per evaluation, and one every 10 updates when there is no terminal to show a bar on."""
    if status.evaluation:
        result = status.evaluation
        console.print(
            f"held-out corridors after {status.decisions / 1e6:.2f} M decisions: {result['success']:.1%} "
            f"[{result['low']:.1%}, {result['high']:.1%}] of {result['episodes']}, failures {result['failures']}",
            soft_wrap=True, highlight=False, markup=False,
        )  # fmt: skip
    elif not console.is_terminal and trainer.update_count % 10 == 0:
        left = (status.total - status.decisions) / max(status.decisions_per_s, 1.0)
        console.print(f"{_describe(status)}, ETA {left / 60.0:.0f} min", soft_wrap=True, highlight=False, markup=False)


def main() -> None:
    """Entry point."""
    app()


if __name__ == "__main__":
    main()
