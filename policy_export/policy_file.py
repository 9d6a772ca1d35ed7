"""Reads a policy file and judges it without running it: size, structure, digests, weights, metadata, inputs and outputs."""

from __future__ import annotations

import hashlib
import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from policy_export.contract import DIGEST_KEY, METADATA_KEY, PolicyMetadata, parse_metadata
from policy_export.errors import PolicyFileError
from policy_export.onnx_reader import FLOAT, Model, Port, file_sha256, read_model, weights_sha256

MAX_FILE_BYTES = 16 * 1024 * 1024
OPSET_RANGE = (17, 23)

# fmt: off
ALLOWED_OPERATORS = frozenset((
    "Abs", "Add", "Clip", "Concat", "Cos", "Div", "Elu", "Erf", "Exp", "Gemm",
    "Identity", "LSTM", "LeakyRelu", "Log", "MatMul", "Max", "Min", "Mul", "Neg",
    "Pow", "ReduceL2", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum", "Relu", "Reshape", "Selu",
    "Sigmoid", "Sin", "Slice", "Softplus", "Split", "Sqrt", "Squeeze", "Sub", "Tanh",
    "Transpose", "Unsqueeze",
))
# fmt: on
"""Plain arithmetic and one recurrent cell: nothing that loops, branches, reads files or draws random numbers."""


@dataclass(frozen=True, slots=True)
class PolicyFile:
    """A file that passed every check that needs no runtime. `sha256` is that of the file's bytes, as `sha256sum` gives it."""

    path: Path
    data: bytes
    sha256: str
    metadata: PolicyMetadata
    model: Model


def read_policy_file(path: str | Path) -> PolicyFile:
    """Read and judge a file; every refusal is a `PolicyFileError` that names the field."""
    path = Path(path)
    return check_policy_bytes(_read_bounded(path), path)


def check_policy_bytes(data: bytes, path: Path = Path("<memory>")) -> PolicyFile:
    """The checks of `read_policy_file` on bytes already in memory."""
    if len(data) > MAX_FILE_BYTES:
        raise PolicyFileError("file", f"is larger than {MAX_FILE_BYTES} bytes")
    model = read_model(data)
    metadata = _metadata(model)
    _check_digest(data, model)
    _check_graph(model)
    _check_ports(model, metadata)
    _check_weights(model, metadata)
    return PolicyFile(path, data, hashlib.sha256(data).hexdigest(), metadata, model)


def expected_ports(metadata: PolicyMetadata) -> tuple[dict[str, tuple[int | None, ...]], dict[str, tuple[int | None, ...]]]:
    """Names and shapes that the graph must have; None is the batch axis."""
    inputs: dict[str, tuple[int | None, ...]] = {"obs": (None, metadata.observation.size)}
    outputs: dict[str, tuple[int | None, ...]] = {"action": (None, metadata.action.size)}
    if metadata.memory != "none":
        state = (metadata.layers, None, metadata.hidden_size)
        inputs |= {"h_in": state, "c_in": state}
        outputs |= {"h_out": state, "c_out": state}
    return inputs, outputs


def _read_bounded(path: Path) -> bytes:
    try:
        info = path.stat()
        if not stat.S_ISREG(info.st_mode):
            raise PolicyFileError("file", f"{path} is not a regular file")
        if info.st_size > MAX_FILE_BYTES:
            raise PolicyFileError("file", f"{path} has {info.st_size} bytes, more than {MAX_FILE_BYTES}")
        with path.open("rb") as stream:
            return stream.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise PolicyFileError("file", f"cannot read {path} ({error.strerror})") from None


def _metadata(model: Model) -> PolicyMetadata:
    text = model.metadata.get(METADATA_KEY)
    if text is None:
        raise PolicyFileError("metadata", f"there is no {METADATA_KEY!r} entry; write the file with export-policy")
    return parse_metadata(text)


def _check_digest(data: bytes, model: Model) -> None:
    stated = model.metadata.get(DIGEST_KEY)
    if stated is None:
        raise PolicyFileError(DIGEST_KEY, "is missing; write the file with export-policy")
    if stated != file_sha256(data, model.spans[DIGEST_KEY]):
        raise PolicyFileError(DIGEST_KEY, "does not match: the file was changed or damaged after export; copy or export it again")


def _check_graph(model: Model) -> None:
    if not OPSET_RANGE[0] <= model.opset <= OPSET_RANGE[1]:
        raise PolicyFileError("opset_import", f"version {model.opset} is not in {OPSET_RANGE[0]}..{OPSET_RANGE[1]}")
    foreign = sorted(set(model.operators) - ALLOWED_OPERATORS)
    if foreign:
        raise PolicyFileError("graph.node", f"operators not allowed: {', '.join(foreign)}")


def _check_ports(model: Model, metadata: PolicyMetadata) -> None:
    inputs, outputs = expected_ports(metadata)
    _match_ports("input", model.inputs, inputs, optional={})
    _match_ports("output", model.outputs, outputs, optional={"value": (None,)})


def _match_ports(
    kind: str,
    ports: tuple[Port, ...],
    required: dict[str, tuple[int | None, ...]],
    optional: dict[str, tuple[int | None, ...]],
) -> None:
    found = {port.name: port for port in ports}
    names = set(found)
    if not set(required) <= names <= set(required) | set(optional) or len(found) != len(ports):
        raise PolicyFileError(kind, f"names must be {', '.join(required)}; the file has {', '.join(sorted(found)) or 'none'}")
    for name, port in found.items():
        shape = required[name] if name in required else optional[name]
        if port.elem_type != FLOAT:
            raise PolicyFileError(f"{kind}.{name}", "must be float32")
        if len(port.dims) != len(shape):
            raise PolicyFileError(f"{kind}.{name}", f"must have {len(shape)} axes, not {len(port.dims)}")
        for axis, (size, wanted) in enumerate(zip(port.dims, shape, strict=True)):
            if size != wanted if wanted is not None else isinstance(size, int):
                raise PolicyFileError(f"{kind}.{name}", f"axis {axis} must be {wanted or 'dynamic (the batch)'}, not {size}")


def _check_weights(model: Model, metadata: PolicyMetadata) -> None:
    for tensor in model.tensors:
        if tensor.elem_type == FLOAT and not np.isfinite(tensor.array()).all():
            raise PolicyFileError(f"weights.{tensor.name}", "holds NaN or infinity")
    if weights_sha256(model.tensors) != metadata.weights_sha256:
        raise PolicyFileError("metadata.weights_sha256", "does not match the weights in the file; export it again")
