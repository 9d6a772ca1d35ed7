"""Reads VecNormalize's statistics from .npz or .json, as docs/export_sb3.md says how to write them. Never a pickle. No torch."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policy_export.errors import CheckpointError

MAX_STATISTICS_BYTES = 4 * 1024 * 1024
_NAMES = ("mean", "var", "clip_obs", "epsilon")
_UNREADABLE = (
    OSError,
    ValueError,
    LookupError,
    RuntimeError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    MemoryError,
    RecursionError,
)


def read_statistics(path: str | Path, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Mean [size], variance [size], clip_obs and epsilon; raises `CheckpointError` saying what is wrong and what to do."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"--normalize {path}: no such file")
    if path.stat().st_size > MAX_STATISTICS_BYTES:
        raise CheckpointError(f"--normalize {path}: larger than {MAX_STATISTICS_BYTES} bytes; it should hold only mean, var, ...")
    try:
        content = _json(path) if path.suffix == ".json" else _npz(path)
    except _UNREADABLE as error:
        hint = "give the .npz or .json that docs/export_sb3.md shows how to write (a VecNormalize pickle is never opened)"
        raise CheckpointError(f"--normalize {path}: cannot read it ({' '.join(str(error).split())[:120]}); {hint}") from None
    return _checked(path, content, size)


def _npz(path: Path) -> dict[str, Any]:
    """The arrays by name. What an entry unpacks to is checked before numpy reads it: a small archive may claim gigabytes."""
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > MAX_STATISTICS_BYTES:
            raise ValueError(f"unpacks to more than {MAX_STATISTICS_BYTES} bytes")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files[:16]}


def _json(path: Path) -> dict[str, Any]:
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("must hold one JSON object")
    return content


def _checked(path: Path, content: dict[str, Any], size: int) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    missing = [name for name in _NAMES if name not in content]
    if missing:
        raise CheckpointError(f"--normalize {path}: lacks {', '.join(missing)} (docs/export_sb3.md)")
    try:
        mean, variance = (np.asarray(content[name], dtype=np.float64).reshape(-1) for name in ("mean", "var"))
        clip, epsilon = (float(np.asarray(content[name], dtype=np.float64)) for name in ("clip_obs", "epsilon"))
    except (ValueError, TypeError, OverflowError):
        raise CheckpointError(f"--normalize {path}: mean and var must be number lists, clip_obs and epsilon numbers") from None
    if mean.size != size or variance.size != size:
        problem = f"mean and var hold {mean.size} and {variance.size} values, the policy takes {size}"
        raise CheckpointError(f"--normalize {path}: {problem}; give the statistics saved with this checkpoint")
    usable = np.isfinite(mean).all() and np.isfinite(variance).all() and (variance >= 0.0).all()
    if not (usable and math.isfinite(clip) and math.isfinite(epsilon) and clip > 0.0 and epsilon >= 0.0):
        raise CheckpointError(f"--normalize {path}: needs finite mean, var >= 0, clip_obs > 0 and epsilon >= 0")
    if (variance + epsilon <= 1e-30).any():
        raise CheckpointError(f"--normalize {path}: var + epsilon is 0 for some value; observations would be divided by 0")
    return mean, variance, clip, epsilon
