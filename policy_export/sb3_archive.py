"""Opens an SB3 `.zip` without running anything in it: weights by torch's restricted reader, the JSON as plain text.

`data` holds, beside cloudpickle strings (":serialized:"), the same objects' plain attributes; only these are read. The
cloudpickle bytes are looked at for one thing: a Box's limits are printed rounded, and their exact float bytes lie in there.
They are searched as bytes, never loaded.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import math
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from policy_export.errors import CheckpointError
from policy_export.weights import UNREADABLE

MAX_ARCHIVE_BYTES = 512 * 1024 * 1024
MAX_WEIGHT_BYTES = 256 * 1024 * 1024
MAX_DATA_BYTES = 64 * 1024 * 1024
_MAX_ENTRIES = 256
_MAX_BOX_VALUES = 64
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|inf|nan)")
_BROKEN = (OSError, RuntimeError, ValueError, LookupError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError)


@dataclass(frozen=True, slots=True)
class Sb3Archive:
    """What a `.zip` says: the policy's state dict, `data` as plain JSON (empty if there is none), SB3's version."""

    path: Path
    weights: dict[str, torch.Tensor]
    data: dict[str, Any]
    version: str


def is_sb3_archive(path: str | Path) -> bool:
    """Whether the file is a zip with SB3's `policy.pth` in it."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "policy.pth" in archive.namelist()
    except _BROKEN:
        return False


def open_archive(path: str | Path) -> Sb3Archive:
    """Read the archive; raises `CheckpointError` for anything damaged, too large or not SB3's."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file")
    if path.stat().st_size > MAX_ARCHIVE_BYTES:
        raise CheckpointError(f"{path}: larger than {MAX_ARCHIVE_BYTES} bytes")
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if len(names) > _MAX_ENTRIES:
                raise CheckpointError(f"{path}: holds {len(names)} entries; no SB3 archive has that many")
            weights = _entry(archive, path, "policy.pth", MAX_WEIGHT_BYTES)
            data = _entry(archive, path, "data", MAX_DATA_BYTES) if "data" in names else b"{}"
            stated = "_stable_baselines3_version"
            version = _entry(archive, path, stated, 64) if stated in names else b"unknown"
    except _BROKEN as error:
        raise CheckpointError(f"{path}: not a readable SB3 archive ({type(error).__name__}); save the model again") from None
    shown = re.sub(r"[^0-9A-Za-z.+-]", "", version.decode("ascii", "replace"))
    return Sb3Archive(path, _weights(path, weights), _data(path, data), shown)


def _entry(archive: zipfile.ZipFile, path: Path, name: str, limit: int) -> bytes:
    """One entry, never more than `limit` bytes of it in memory, whatever the archive says about its size."""
    with archive.open(name) as stream:
        content = stream.read(limit + 1)
    if len(content) > limit:
        raise CheckpointError(f"{path}: {name} unpacks to more than {limit} bytes")
    return content


def _weights(path: Path, content: bytes) -> dict[str, torch.Tensor]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as inner:
            entries = inner.infolist()
        # torch stores its tensors unpacked; packed ones could unfold to any size inside its reader.
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries) or sum(e.file_size for e in entries) > len(
            content
        ):
            raise CheckpointError(f"{path}: policy.pth is packed in a way that torch.save does not use")
        loaded = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except UNREADABLE as error:
        raise CheckpointError(f"{path}: policy.pth holds no readable weights ({type(error).__name__})") from None
    if not isinstance(loaded, dict) or not all(isinstance(k, str) and isinstance(v, torch.Tensor) for k, v in loaded.items()):
        raise CheckpointError(f"{path}: policy.pth is not a state dict of tensors")
    # A view may show one stored number a billion times.
    if sum(tensor.numel() for tensor in loaded.values()) * 4 > MAX_WEIGHT_BYTES:
        raise CheckpointError(f"{path}: policy.pth holds more than {MAX_WEIGHT_BYTES} bytes of weights")
    return _finite(path, dict(loaded))


def _finite(path: Path, weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    for name, tensor in weights.items():
        if tensor.layout is not torch.strided or not tensor.is_floating_point():
            raise CheckpointError(f"{path}: {name} is not a plain tensor of real numbers")
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{path}: {name} holds NaN or infinity; take an earlier checkpoint")
    return weights


def _data(path: Path, content: bytes) -> dict[str, Any]:
    try:
        data = json.loads(content.decode("utf-8"))
    except (ValueError, RecursionError):
        raise CheckpointError(f"{path}: data is not JSON; save the model again") from None
    if not isinstance(data, dict):
        raise CheckpointError(f"{path}: data is not a JSON object; save the model again")
    return data


def class_name(printed: object) -> str:
    """`Tanh` of "<class 'torch.nn.modules.activation.Tanh'>", or what is printed if it is no class of torch or SB3."""
    match = re.fullmatch(r"<class '(?:torch\.nn|stable_baselines3|sb3_contrib)\.[\w.]*?(\w+)'>", str(printed))
    return match[1] if match else str(printed)


def box_limits(archive: Sb3Archive, key: str) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The exact low and high [n] of a Box space in `data`, or None where the archive does not show them beyond doubt."""
    entry = archive.data.get(key)
    shape = box_shape(archive, key)
    if not isinstance(entry, dict) or shape is None or not 0 < math.prod(shape) <= _MAX_BOX_VALUES:
        return None
    kinds: dict[str, np.dtype[Any]] = {"float32": np.dtype("<f4"), "float64": np.dtype("<f8")}
    dtype = kinds.get(str(entry.get("dtype")))
    blob = _blob(entry.get(":serialized:"))
    if dtype is None or blob is None:
        return None
    limits = [_exact(str(entry.get(name, "")), math.prod(shape), dtype, blob) for name in ("low", "high")]
    low, high = limits
    return None if low is None or high is None else (low, high)


def box_shape(archive: Sb3Archive, key: str) -> tuple[int, ...] | None:
    """The shape of a Box space in `data`, or None if it is not stated."""
    entry = archive.data.get(key)
    shape = entry.get("_shape") if isinstance(entry, dict) else None
    if isinstance(shape, list) and all(type(size) is int and 0 < size <= 1_000_000 for size in shape):
        return tuple(shape)
    return None


def _blob(text: object) -> bytes | None:
    try:
        return base64.b64decode(text, validate=True) if isinstance(text, str) and len(text) < 1_000_000 else None
    except (binascii.Error, ValueError):
        return None


def _exact(printed: str, count: int, dtype: np.dtype[Any], blob: bytes) -> NDArray[np.float64] | None:
    """The array whose bytes lie in `blob` and which prints as `printed` up to numpy's rounding to 8 digits."""
    numbers = [float(number) for number in _NUMBER.findall(printed)]
    if len(numbers) != count:
        return None
    wanted, width = np.array(numbers), count * dtype.itemsize
    # The printed values themselves first: next to 0, some other bytes could pass for a rounded value.
    for test in (np.array_equal, _rounds_to):
        for start in range(len(blob) - width + 1):
            found = np.frombuffer(blob, dtype=dtype, count=count, offset=start).astype(np.float64)
            if test(found, wanted.astype(dtype).astype(np.float64)):
                return found
    return None


def _rounds_to(found: NDArray[np.float64], printed: NDArray[np.float64]) -> bool:
    return bool(np.allclose(found, printed, rtol=1e-7, atol=1e-8))
