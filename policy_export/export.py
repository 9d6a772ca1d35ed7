"""Checkpoint to policy file: build the graph, verify it against the network, write it whole or not at all. Needs torch, onnx."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from policy_export.checkpoint import Checkpoint, TrainedNetwork, load_checkpoint
from policy_export.contract import DIGEST_KEY, METADATA_KEY, PolicyMetadata, VerificationRecord, first_problem
from policy_export.errors import CheckpointError, PolicyError, PolicyFileError, VerificationError
from policy_export.graph import build_model
from policy_export.graph_writer import DEFAULT_MEMORY_FORM, MemoryForm
from policy_export.layout_file import layout_of_file, read_layout
from policy_export.onnx_reader import file_sha256, read_model, weights_sha256
from policy_export.policy_file import check_policy_bytes
from policy_export.sb3 import Sb3Options, load_sb3
from policy_export.sb3_archive import is_sb3_archive
from policy_export.sb3_graph import build_sb3_model
from policy_export.sb3_network import Sb3Network
from policy_export.verify import verify_file, verify_model

MAX_EVALUATION_BYTES = 128 * 1024


def export_checkpoint(
    checkpoint_path: str | Path,
    output_path: str | Path,
    *,
    name: str | None = None,
    evaluation: dict[str, Any] | None = None,
    memory_form: MemoryForm = DEFAULT_MEMORY_FORM,
    layout: str | Path | None = None,
    options: Sb3Options | None = None,
) -> PolicyMetadata:
    """Export a checkpoint; returns the metadata written. See `load_any` and `export_policy` for the errors."""
    checkpoint = load_any(checkpoint_path, layout, options)
    name = name or Path(output_path).stem
    return export_policy(checkpoint, output_path, name=name, evaluation=evaluation, memory_form=memory_form)


def load_any(path: str | Path, layout: str | Path | None = None, options: Sb3Options | None = None) -> Checkpoint:
    """A checkpoint of this project, or an SB3 `.zip`; which it is, its content says.

    `layout`: a YAML file or built-in name for `read_layout`; `options`: see `Sb3Options`. Both are only for SB3, whose archives
    do not say what their observations mean. Raises `CheckpointError` or `strict_yaml.ConfigError`.
    """
    if is_sb3_archive(path):
        return load_sb3(path, read_layout(layout), options)
    if layout is not None or options not in {None, Sb3Options()}:
        problem = "is no SB3 archive; this project's checkpoints carry their own layout, limits and normalisation"
        raise CheckpointError(f"{path}: {problem}, leave out --layout and the options for SB3")
    return load_checkpoint(path)


def load_for_file(path: str | Path, metadata: PolicyMetadata, options: Sb3Options | None = None) -> Checkpoint:
    """The checkpoint that a finished file is compared with; an SB3 archive takes its layout from the file."""
    if not is_sb3_archive(path):
        return load_any(path, None, options)
    layout = layout_of_file(metadata.observation, metadata.action, metadata.rate_hz, metadata.reset)
    return load_sb3(path, layout, options)


def export_policy(
    checkpoint: Checkpoint,
    output_path: str | Path,
    *,
    name: str = "policy",
    evaluation: dict[str, Any] | None = None,
    memory_form: MemoryForm = DEFAULT_MEMORY_FORM,
) -> PolicyMetadata:
    """Write the policy file, replacing any file of that name only when everything has been checked.

    The graph is verified over 1,000 recurrent steps of 8 vehicles against float64 torch; then the finished bytes are read,
    judged and stepped by the runner that flies, over another 1,000 steps. `VerificationError`: it computes something
    else. `PolicyFileError`: it would be refused on load. Either way nothing is written.
    """
    output = Path(output_path)
    if not output.parent.is_dir():
        raise PolicyError(f"{output.parent}: no such folder; create it first")
    model = _graph_of(checkpoint.network, memory_form)
    graph = model.SerializeToString()
    try:
        verification = verify_model(graph, checkpoint.network, checkpoint.layout.observation)
    except VerificationError as error:
        raise VerificationError(f"graph and network differ, nothing was written: {error}") from None
    weights = weights_sha256(read_model(graph).tensors)
    metadata = _metadata(checkpoint, name, evaluation or {}, verification, weights)
    data = finish_file(model, metadata)
    check_policy_bytes(data, output)
    _write_verified(data, output, checkpoint)
    return metadata


def _graph_of(network: TrainedNetwork, memory_form: MemoryForm) -> Any:
    return build_sb3_model(network, memory_form) if isinstance(network, Sb3Network) else build_model(network, memory_form)


def finish_file(model: Any, metadata: PolicyMetadata) -> bytes:
    """The file's bytes: `model` (an onnx.ModelProto) with its metadata and the digest over the whole file."""
    del model.metadata_props[:]
    for key, value in ((METADATA_KEY, metadata.to_json()), (DIGEST_KEY, "0" * 64)):
        model.metadata_props.add(key=key, value=value)
    data: bytes = model.SerializeToString(deterministic=True)
    start, stop = read_model(data).spans[DIGEST_KEY]
    return data[:start] + file_sha256(data, (start, stop)).encode() + data[stop:]


def read_evaluation(path: str | Path) -> dict[str, Any]:
    """Evaluation results, a JSON object as `evaluate-policy --json` prints it, to be kept in the file."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_EVALUATION_BYTES:
            raise PolicyError(f"{path}: larger than {MAX_EVALUATION_BYTES} bytes; keep the summary only")
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PolicyError(f"{path}: cannot read it ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"{path}: not a JSON document ({error})") from None
    if not isinstance(document, dict):
        raise PolicyError(f"{path}: must hold one JSON object")
    return document


def _metadata(
    checkpoint: Checkpoint, name: str, evaluation: dict[str, Any], verification: VerificationRecord, weights: str
) -> PolicyMetadata:
    config, layout = checkpoint.network.config, checkpoint.layout
    try:
        return PolicyMetadata(
            name=name,
            observation=layout.observation,
            action=layout.action,
            rate_hz=layout.rate_hz,
            memory=config.memory,
            hidden_size=config.state_size,
            layers=config.layers,
            reset=layout.reset,
            training=checkpoint.training,
            evaluation=evaluation,
            verification=verification,
            weights_sha256=weights,
        )
    except ValidationError as error:
        raise PolicyFileError(*first_problem(error)) from None


def _write_verified(data: bytes, output: Path, checkpoint: Checkpoint) -> None:
    """Write beside the target, step the written file, and only then give it its name."""
    handle, temporary_name = tempfile.mkstemp(prefix=f".{output.name}.", suffix=".part", dir=output.parent)
    temporary = Path(temporary_name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        try:
            verify_file(temporary, checkpoint.network)
        except VerificationError as error:
            raise VerificationError(f"runner and network differ, nothing was written: {error}") from None
        temporary.chmod(0o644)
        temporary.replace(output)
    finally:
        temporary.unlink(missing_ok=True)
