"""Steps an exported graph beside the network it came from. Needs torch only where a network takes part.

The network runs in float64, the graph in onnxruntime's float32; each side carries its own hidden state, so that errors may
build up as they would in flight, and both are reset at the same random steps. That is the test of the actions. The hidden
state itself is compared one step after a common state: carried on its own it drifts, in a direction that no action depends
on, as far as in PyTorch's own float32, and that says nothing about the graph.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
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
    from policy_export.checkpoint import TrainedNetwork

STEPS = 1000
BATCH = 8
TOLERANCE = 1e-5
RESET_PROBABILITY = 1.0 / 100.0

Array = NDArray[np.float32]
Spread = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Trace:
    """Inputs for one verification: observations [T, B, N] and the steps [T, B] before which the state is zeroed."""

    observations: Array
    resets: NDArray[np.bool_]


def random_trace(
    layout: ObservationLayout, steps: int = STEPS, batch: int = BATCH, seed: int = 0, spread: Spread | None = None
) -> Trace:
    """Slowly moving, partly saturated observations in the layout's units; every channel reaches its extremes.

    `spread`: mean and deviation [size] of the observations in training. Every other vehicle, the first one included, then
    moves within these instead of the layout's own widths, so that a normalisation is tried where it is not saturated.
    """
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
    if spread is not None:
        observations[:, ::2] = spread[0] + 1.5 * spread[1] * walk[:, ::2]
    if (lidar := layout.channel("lidar")) is not None:
        columns = np.arange(batch) if spread is None else np.arange(1, batch, 2)
        observations[:, columns, lidar.span] += 0.5 * layout.lidar.range_max_m
        ranges = np.clip(observations[..., lidar.span], 0.0, layout.lidar.range_max_m)
        observations[..., lidar.span] = np.where(ranges < layout.lidar.range_min_m, 0.0, ranges)
    if (yaw := layout.channel("yaw")) is not None:
        observations[..., yaw.span] = np.clip(observations[..., yaw.span], -np.pi, np.pi)
    resets = rng.random((steps, batch)) < RESET_PROBABILITY
    resets[0] = True
    return Trace(observations.astype(np.float32), resets)


def reference_outputs(network: TrainedNetwork, trace: Trace, single: bool = False) -> dict[str, NDArray[np.float64]]:
    """action [T, B, A], value [T, B] if it has one, h and c [T, layers, B, H] of the network in float64 (or its float32)."""
    import torch  # noqa: PLC0415  # a file alone can be checked without torch

    kind = torch.float32 if single else torch.float64
    network = copy.deepcopy(network).to(kind).eval()
    steps, batch, _ = trace.observations.shape
    observations = torch.from_numpy(trace.observations).to(kind)
    keep = torch.from_numpy(~trace.resets).to(kind)[:, None, :, None]
    h, c = network.initial_state(batch)
    rows: dict[str, list[torch.Tensor]] = {"action": [], "value": [], "h": [], "c": []}
    with torch.no_grad():
        for t in range(steps):
            mean, value, h, c = network.step(observations[t], h * keep[t], c * keep[t])
            for name, tensor in (("action", network.action(mean)), ("value", value), ("h", h), ("c", c)):
                if tensor is not None:
                    rows[name].append(tensor)
    return {name: torch.stack(tensors).double().numpy() for name, tensors in rows.items() if tensors}


def graph_outputs(model: bytes, layers: int, hidden_size: int, trace: Trace) -> dict[str, Array]:
    """The same of an ONNX graph, run by onnxruntime with the whole batch at once."""
    session = open_session(model)
    names = [output.name for output in session.get_outputs()]
    batch = trace.observations.shape[1]
    h: Array = np.zeros((layers, batch, hidden_size), dtype=np.float32)
    c: Array = np.zeros_like(h)
    rows: dict[str, list[Array]] = {"action": [], "value": [], "h": [], "c": []}
    for observation, reset in zip(trace.observations, trace.resets, strict=True):
        feed = {"obs": observation}
        if hidden_size:
            h[:, reset], c[:, reset] = 0.0, 0.0
            feed |= {"h_in": h, "c_in": c}
        found = dict(zip(names, session.run(names, feed), strict=True))
        h, c = found.get("h_out", h), found.get("c_out", c)
        for name, array in (("action", found["action"]), ("value", found.get("value")), ("h", h), ("c", c)):
            if array is not None:
                rows[name].append(array.copy())
    return {name: np.stack(arrays) for name, arrays in rows.items() if arrays}


def single_steps(model: bytes, trace: Trace, reference: dict[str, NDArray[np.float64]]) -> dict[str, Array]:
    """What the graph makes of every step of `trace` when it starts from the reference's state, all steps in one batch."""
    session = open_session(model)
    steps, batch, size = trace.observations.shape
    feed: dict[str, Array] = {"obs": trace.observations.reshape(steps * batch, size)}
    for name in ("h", "c"):
        state = np.zeros_like(reference[name])
        state[1:] = reference[name][:-1] * ~trace.resets[1:, None, :, None]
        if state.size:
            feed[f"{name}_in"] = np.moveaxis(state, 0, 1).reshape(state.shape[1], steps * batch, -1).astype(np.float32)
    names = [output.name for output in session.get_outputs()]
    found = dict(zip(names, session.run(names, feed), strict=True))
    rows = {name: found[name].reshape(steps, batch, *found[name].shape[1:]) for name in ("action", "value") if name in found}
    for name in ("h", "c"):
        state = found.get(f"{name}_out", np.zeros((1, steps * batch, 0), dtype=np.float32))
        rows[name] = np.moveaxis(state.reshape(state.shape[0], steps, batch, -1), 1, 0)
    return rows


def runner_outputs(runner: PolicyRunner, trace: Trace, column: int = 0) -> dict[str, Array]:
    """The same of the runner that flies, for one column of the batch; arrays keep a batch axis of 1."""
    has_value = not np.isnan(runner.value)  # it has stepped while it warmed up
    actions, values, states = [], [], []
    for observation, reset in zip(trace.observations[:, column], trace.resets[:, column], strict=True):
        if reset:
            runner.reset("verification")
        actions.append(runner.step(observation).copy())
        values.append(np.float32(runner.value))
        states.append(runner.hidden_state)
    h, c = (np.stack([state[k] for state in states])[:, :, None] for k in range(2))
    value = {"value": np.array(values)[:, None]} if has_value else {}
    return {"action": np.stack(actions)[:, None], "h": h, "c": c} | value


@dataclass(frozen=True, slots=True)
class Difference:
    """How far two runs are apart. `action` in m/s or rad/s; `others` over h, c and value."""

    action: float
    others: float


def difference_between(found: Mapping[str, Array | NDArray[np.float64]], reference: dict[str, NDArray[np.float64]]) -> Difference:
    """Largest differences over all steps: absolute for action and h, which are bounded.

    c and value have no bound (c counts up while a forget gate stays open), so float32 itself is only relative there. Theirs is
    divided by their size once that exceeds 1.
    """
    if found.keys() != reference.keys():
        raise VerificationError(f"outputs are {', '.join(sorted(found))}, the network gives {', '.join(sorted(reference))}")
    worst = {name: _difference(name, array, reference[name]) for name, array in found.items()}
    return Difference(worst.pop("action"), max(worst.values()))


def _difference(name: str, found: Array | NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    if found.shape != reference.shape:
        raise VerificationError(f"{name} has shape {found.shape}, the network gives {reference.shape}")
    if not found.size:
        return 0.0
    difference = np.abs(found - reference)
    if name in {"value", "c"}:
        difference /= np.maximum(1.0, np.abs(reference))
    return float(difference.max()) if np.isfinite(difference).all() else np.inf


def verify_model(
    model: bytes, network: TrainedNetwork, layout: ObservationLayout, steps: int = STEPS, seed: int = 0
) -> VerificationRecord:
    """Compare over `steps` recurrent steps of `BATCH` vehicles; raises `VerificationError` beyond `TOLERANCE`."""
    trace = random_trace(layout, steps, seed=seed, spread=network.observation_spread())
    reference = reference_outputs(network, trace)
    run = difference_between(graph_outputs(model, network.config.layers, network.config.state_size, trace), reference)
    step = difference_between(single_steps(model, trace, reference), reference)
    worst = max(run.action, step.action, step.others)
    if not worst <= TOLERANCE:
        own = difference_between(reference_outputs(network, trace, single=True), reference)
        message = (
            f"largest difference {worst:.3g} exceeds {TOLERANCE:g} (PyTorch's own float32 differs by {own.action:.2g} in the"
        )
        raise VerificationError(f"{message} actions; if that is as much, train on normalised observations)")
    return _record(run.action, worst, run.others, trace, seed)


def verify_file(path: str | Path, network: TrainedNetwork, seed: int = 1, steps: int = STEPS) -> VerificationRecord:
    """Compare a finished file, stepped by `PolicyRunner`, with `network`."""
    file = read_policy_file(path)
    runner = PolicyRunner(file)
    _check_same_shape(runner.metadata, network)
    trace = random_trace(runner.metadata.observation, steps, batch=1, seed=seed, spread=network.observation_spread())
    reference = reference_outputs(network, trace)
    run = difference_between(runner_outputs(runner, trace), reference)
    step = difference_between(single_steps(file.data, trace, reference), reference)
    return _record(run.action, max(run.action, step.action, step.others), run.others, trace, seed)


def verify_consistency(path: str | Path, seed: int = 1, steps: int = STEPS) -> float:
    """Largest difference between `PolicyRunner` and the same graph run in a batch: what can be checked without a checkpoint."""
    file = read_policy_file(path)
    metadata: PolicyMetadata = file.metadata
    trace = random_trace(metadata.observation, steps, seed=seed)
    batch = graph_outputs(file.data, metadata.layers, metadata.hidden_size, trace)
    single = runner_outputs(PolicyRunner(file), trace)
    reference = {name: array[..., :1, :] if name != "value" else array[:, :1] for name, array in batch.items()}
    difference = difference_between(single, {name: array.astype(np.float64) for name, array in reference.items()})
    return max(difference.action, difference.others)


def _check_same_shape(metadata: PolicyMetadata, network: TrainedNetwork) -> None:
    config = network.config
    shape = (metadata.observation.size, metadata.memory, metadata.layers, metadata.hidden_size, metadata.action.size)
    if shape != (config.observation_size, config.memory, config.layers, config.state_size, config.action_size):
        names = "observation size, memory, layers, hidden size and action size"
        raise VerificationError(f"the file is of another network: its {names} are {shape}")


def _record(action: float, largest: float, drift: float, trace: Trace, seed: int) -> VerificationRecord:
    if not (largest <= TOLERANCE and np.isfinite(drift)):
        raise VerificationError(f"largest difference {largest:.3g} exceeds {TOLERANCE:g}")
    steps, batch, _ = trace.observations.shape
    return VerificationRecord(
        steps=steps,
        resets=int(trace.resets[1:].sum()),
        batch=batch,
        seed=seed,
        reference=f"torch {version('torch')} float64",
        runtime=f"onnxruntime {ort.__version__}",
        tolerance=TOLERANCE,
        max_action_difference=action,
        max_abs_difference=largest,
        max_state_drift=drift,
    )
