"""Steps an exported graph beside the network it came from. Needs torch only where a network takes part.

The network runs in float64, the graph in onnxruntime's float32; each side carries its own hidden state, so that errors may
build up as they would in flight, and both are reset at the same random steps.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from policy_export.contract import ObservationLayout, PolicyMetadata, VerificationRecord
from policy_export.errors import VerificationError
from policy_export.policy_file import read_policy_file
from policy_export.runner import PolicyRunner, open_session

if TYPE_CHECKING:
    from policy_export.network import PolicyNetwork

STEPS = 1000
BATCH = 8
TOLERANCE = 1e-5
RESET_PROBABILITY = 1.0 / 100.0

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Trace:
    """Inputs for one verification: observations [T, B, N] and the steps [T, B] before which the state is zeroed."""

    observations: Array
    resets: NDArray[np.bool_]


def random_trace(layout: ObservationLayout, steps: int = STEPS, batch: int = BATCH, seed: int = 0) -> Trace:
    """Slowly moving, partly saturated observations in the layout's units; every channel reaches its extremes."""
    rng = np.random.default_rng(seed)
    widths = {"lidar": 0.6 * layout.lidar.range_max_m, "goal_offset": 15.0, "position": 15.0, "velocity": 0.8}
    scale = np.empty(layout.size)
    for channel in layout.channels:
        scale[channel.span] = widths.get(channel.name, 2.0)
    walk = np.empty((steps, batch, layout.size))
    walk[0] = rng.normal(size=walk[0].shape)
    for t in range(1, steps):
        walk[t] = 0.9 * walk[t - 1] + 0.436 * rng.normal(size=walk[0].shape)
    observations = walk * scale
    if (lidar := layout.channel("lidar")) is not None:
        ranges = np.clip(observations[..., lidar.span] + 0.5 * layout.lidar.range_max_m, 0.0, layout.lidar.range_max_m)
        observations[..., lidar.span] = np.where(ranges < layout.lidar.range_min_m, 0.0, ranges)
    if (yaw := layout.channel("yaw")) is not None:
        observations[..., yaw.span] = np.clip(observations[..., yaw.span], -np.pi, np.pi)
    resets = rng.random((steps, batch)) < RESET_PROBABILITY
    resets[0] = True
    return Trace(observations.astype(np.float32), resets)


def reference_outputs(network: PolicyNetwork, trace: Trace) -> dict[str, NDArray[np.float64]]:
    """action [T, B, 4], value [T, B], h and c [T, B, H] of the network in float64."""
    import torch  # noqa: PLC0415  # a file alone can be checked without torch

    network = copy.deepcopy(network).double().eval()
    steps, batch, _ = trace.observations.shape
    observations = torch.from_numpy(trace.observations.astype(np.float64))
    keep = torch.from_numpy(1.0 - trace.resets.astype(np.float64))[:, None, :, None]
    h, c = network.initial_state(batch)
    rows: dict[str, list[torch.Tensor]] = {"action": [], "value": [], "h": [], "c": []}
    with torch.no_grad():
        for t in range(steps):
            mean, value, h, c = network.step(observations[t], h * keep[t], c * keep[t])
            for name, tensor in (("action", network.action(mean)), ("value", value), ("h", h[0]), ("c", c[0])):
                rows[name].append(tensor)
    return {name: torch.stack(tensors).numpy() for name, tensors in rows.items()}


def graph_outputs(model: bytes, hidden_size: int, trace: Trace) -> dict[str, Array]:
    """The same of an ONNX graph, run by onnxruntime with the whole batch at once."""
    session = open_session(model)
    names = [output.name for output in session.get_outputs()]
    batch = trace.observations.shape[1]
    h = np.zeros((1, batch, hidden_size), dtype=np.float32)
    c = np.zeros_like(h)
    rows: dict[str, list[Array]] = {"action": [], "value": [], "h": [], "c": []}
    for observation, reset in zip(trace.observations, trace.resets, strict=True):
        feed = {"obs": observation}
        if hidden_size:
            h[:, reset], c[:, reset] = 0.0, 0.0
            feed |= {"h_in": h, "c_in": c}
        found = dict(zip(names, session.run(names, feed), strict=True))
        h, c = found.get("h_out", h), found.get("c_out", c)
        for name, array in (("action", found["action"]), ("value", found.get("value")), ("h", h[0]), ("c", c[0])):
            if array is not None:
                rows[name].append(array.copy())
    return {name: np.stack(arrays) for name, arrays in rows.items() if arrays}


def runner_outputs(runner: PolicyRunner, trace: Trace, column: int = 0) -> dict[str, Array]:
    """The same of the runner that flies, for one column of the batch; arrays keep a batch axis of 1."""
    actions, values, states = [], [], []
    for observation, reset in zip(trace.observations[:, column], trace.resets[:, column], strict=True):
        if reset:
            runner.reset("verification")
        actions.append(runner.step(observation).copy())
        values.append(np.float32(runner.value))
        states.append(runner.hidden_state)
    h, c = (np.stack([state[k] for state in states])[:, None] for k in range(2))
    return {"action": np.stack(actions)[:, None], "value": np.array(values)[:, None], "h": h, "c": c}


@dataclass(frozen=True, slots=True)
class Difference:
    """How far two runs are apart. `action` in m/s or rad/s; `largest` over action, h, c and value."""

    action: float
    largest: float


def difference_between(found: dict[str, Array], reference: dict[str, NDArray[np.float64]]) -> Difference:
    """Largest differences over all steps: absolute for action and h, which are bounded.

    c and value have no bound (c counts up while a forget gate stays open), so float32 itself is only relative there: PyTorch's
    own float32 network differs from its float64 twin by as much. Theirs is divided by their size once that exceeds 1.
    """
    worst = {name: _difference(name, array, reference[name]) for name, array in found.items()}
    return Difference(worst["action"], max(worst.values()))


def _difference(name: str, found: Array, reference: NDArray[np.float64]) -> float:
    if found.shape != reference.shape:
        raise VerificationError(f"{name} has shape {found.shape}, the network gives {reference.shape}")
    if not found.size:
        return 0.0
    difference = np.abs(found - reference)
    if name in {"value", "c"}:
        difference /= np.maximum(1.0, np.abs(reference))
    return float(difference.max()) if np.isfinite(difference).all() else np.inf


def verify_model(
    model: bytes, network: PolicyNetwork, layout: ObservationLayout, steps: int = STEPS, seed: int = 0
) -> VerificationRecord:
    """Compare over `steps` recurrent steps of `BATCH` vehicles; raises `VerificationError` beyond `TOLERANCE`."""
    trace = random_trace(layout, steps, seed=seed)
    found = graph_outputs(model, network.config.state_size, trace)
    return _record(difference_between(found, reference_outputs(network, trace)), trace, seed)


def verify_file(path: str | Path, network: PolicyNetwork, seed: int = 1, steps: int = STEPS) -> VerificationRecord:
    """Compare a finished file, stepped by `PolicyRunner`, with `network`."""
    runner = PolicyRunner(read_policy_file(path))
    _check_same_shape(runner.metadata, network)
    trace = random_trace(runner.metadata.observation, steps, batch=1, seed=seed)
    return _record(difference_between(runner_outputs(runner, trace), reference_outputs(network, trace)), trace, seed)


def verify_consistency(path: str | Path, seed: int = 1, steps: int = STEPS) -> float:
    """Largest difference between `PolicyRunner` and the same graph run in a batch: what can be checked without a checkpoint."""
    file = read_policy_file(path)
    metadata: PolicyMetadata = file.metadata
    trace = random_trace(metadata.observation, steps, seed=seed)
    batch = graph_outputs(file.data, metadata.hidden_size, trace)
    single = runner_outputs(PolicyRunner(file), trace)
    reference = {name: array[:, :1].astype(np.float64) for name, array in batch.items()}
    return difference_between({name: single[name] for name in batch}, reference).largest


def _check_same_shape(metadata: PolicyMetadata, network: PolicyNetwork) -> None:
    config = network.config
    shape = (metadata.observation.size, metadata.memory, metadata.hidden_size)
    if shape != (config.observation_size, config.memory, config.state_size):
        raise VerificationError(f"the file is of another network: observation size, memory, hidden size are {shape}")


def _record(difference: Difference, trace: Trace, seed: int) -> VerificationRecord:
    if not difference.largest <= TOLERANCE:
        raise VerificationError(f"largest difference {difference.largest:.3g} exceeds {TOLERANCE:g}")
    steps, batch, _ = trace.observations.shape
    return VerificationRecord(
        steps=steps,
        resets=int(trace.resets[1:].sum()),
        batch=batch,
        seed=seed,
        reference=f"torch {version('torch')} float64",
        runtime=f"onnxruntime {ort.__version__}",
        tolerance=TOLERANCE,
        max_action_difference=difference.action,
        max_abs_difference=difference.largest,
    )
