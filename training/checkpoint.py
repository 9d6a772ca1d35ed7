"""Checkpoints: one plain dict per file, loadable with ``weights_only=True``, written so that a kill never leaves a torn file."""

from __future__ import annotations

import fcntl
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError  # what torch.load raises on a file that is not plain data
from typing import Any

import numpy as np
import torch

EXPORT_KEYS = ("network_config", "state_dict", "training", "layout")
RESUME_KEYS = ("optimizer", "resume")


class CheckpointError(Exception):
    """A checkpoint that cannot be used; the message says which file and why."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Nobody else trains in the folder during the block. The lock ends with the process. Raises CheckpointError."""
    with (folder / "writer.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise CheckpointError(f"{folder}: another process trains there; wait for it, or give another --out") from None
        yield


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` to ``path`` by way of a temporary file and a rename, so readers see the old file or the new one."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_checkpoint(path: Path, resume: bool = False) -> dict[str, Any]:
    """Read a checkpoint; with ``resume`` also demand the optimiser and generator states. Raises CheckpointError."""
    content = load_plain(path)
    missing = [key for key in EXPORT_KEYS + (RESUME_KEYS if resume else ()) if key not in content]
    if missing:
        raise CheckpointError(f"{path}: lacks {', '.join(missing)}; it was not written by train-policy")
    return content


def load_plain(path: Path) -> dict[str, Any]:
    """Read any file that ``save_checkpoint`` wrote. Raises CheckpointError."""
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint; give a run folder that holds last.pt")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (
        OSError,
        RuntimeError,
        ValueError,
        EOFError,
        KeyError,
        zipfile.BadZipFile,
        UnpicklingError,
    ) as error:
        raise CheckpointError(f"{path}: not a readable checkpoint ({str(error).splitlines()[0]})") from None
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: not a checkpoint; it was not written by train-policy")
    return content


def to_plain(value: Any) -> Any:
    """Nested dicts with numpy arrays and scalars to what ``weights_only`` loading accepts: tensors, numbers, strings."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    return value
