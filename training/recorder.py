"""What happened in each update, kept for people: ``metrics.jsonl`` and TensorBoard."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(slots=True)
class Status:
    """One update. ``success`` and ``contacts`` are shares of the last episodes; ``outcomes`` counts those that ended in it."""

    decisions: int
    total: int
    decisions_per_s: float
    hold: int
    success: float
    contacts: float
    evaluation: dict[str, Any] | None
    metrics: dict[str, float]
    outcomes: dict[str, int]


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


class Recorder:
    """Metrics of every update to ``metrics.jsonl`` and TensorBoard."""

    def __init__(self, out: Path, decisions: int) -> None:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  # slow import

        path = out / "metrics.jsonl"
        _forget_after(path, decisions)
        self._file = path.open("a", encoding="utf-8")
        self._board = SummaryWriter(str(out / "tensorboard"), purge_step=decisions + 1)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._board.close()

    def write(self, update: int, seconds: float, status: Status) -> None:
        """One line, one TensorBoard step; ``seconds`` of training so far."""
        row: dict[str, Any] = {
            "decisions": status.decisions,
            "update": update,
            "seconds": round(seconds, 2),
        }
        row |= {"hold": status.hold, "decisions_per_s": round(status.decisions_per_s, 1)}
        row |= {"success": status.success, "contacts": status.contacts} | status.metrics
        for name, value in row.items():
            self._board.add_scalar(name, value, status.decisions)
        row["outcomes"] = status.outcomes
        if status.evaluation is not None:
            row["evaluation"] = status.evaluation
            self._board.add_scalar("evaluation/success", status.evaluation["success"], status.decisions)
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()
