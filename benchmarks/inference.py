"""One step of a policy at batch 1: the runner that flies beside bare onnxruntime, PyTorch and SB3, taking turns in one run."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from policy_export.bench import bare_step, interleaved_us, runner_step

STEPS = 4000
RUNNER_TARGET, EAGER_TARGET = 1.3, 8.0


def _eager_step(network: Any, fused: bool) -> Callable[[], object]:
    """A step of the torch network as a flight program would call it: numpy in, numpy out."""
    import torch

    inputs = np.random.default_rng(0).uniform(0.0, 4.0, size=(64, 1, 190)).astype(np.float32)
    state = [*network.initial_state(1)]
    count = iter(range(10**9))

    def step() -> object:
        observation = torch.from_numpy(inputs[next(count) % 64])
        with torch.inference_mode():
            if fused:
                features = network.features(observation)
                output, (state[0], state[1]) = network.lstm(features.unsqueeze(0), (state[0], state[1]))
                mean, _ = network.heads(output[0], features)
            else:
                mean, _, state[0], state[1] = network.step(observation, state[0], state[1])
            return network.action(mean).numpy()

    return step


def _files() -> tuple[Any, dict[str, Any]]:
    """A network with fixed weights and its policy file with the LSTM written in both ways."""
    import tempfile
    from pathlib import Path

    import torch

    from policy_export.checkpoint import Checkpoint, PolicyLayout
    from policy_export.contract import ActionLayout, TrainingRecord, default_layout
    from policy_export.export import export_policy
    from policy_export.network import NetworkConfig, PolicyNetwork
    from policy_export.policy_file import read_policy_file

    torch.manual_seed(0)
    network = PolicyNetwork(NetworkConfig()).eval()
    layout = PolicyLayout(observation=default_layout(), action=ActionLayout())
    files = {}
    with tempfile.TemporaryDirectory() as folder:
        for form in ("fused", "gates"):
            path = Path(folder) / f"{form}.onnx"
            export_policy(Checkpoint(network, layout, TrainingRecord()), path, memory_form=form)
            files[form] = read_policy_file(path)
    return network, files


def _sb3() -> tuple[Any, Callable[[], object]]:
    """A RecurrentPPO of sb3-contrib of the same sizes as its policy file, and a step of its own `predict`."""
    import tempfile
    from pathlib import Path

    import gymnasium
    from gymnasium import spaces
    from sb3_contrib import RecurrentPPO

    from policy_export.export import export_checkpoint
    from policy_export.policy_file import read_policy_file

    class Spaces(gymnasium.Env[Any, Any]):
        observation_space = spaces.Box(-np.inf, np.inf, (190,), np.float32)
        action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)

    model = RecurrentPPO("MlpLstmPolicy", Spaces(), policy_kwargs={"lstm_hidden_size": 128}, device="cpu", seed=0)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "model.zip")
        export_checkpoint(Path(folder) / "model.zip", Path(folder) / "policy.onnx")
        file = read_policy_file(Path(folder) / "policy.onnx")
    inputs = np.random.default_rng(0).uniform(0.0, 4.0, size=(64, 190)).astype(np.float32)
    state: list[Any] = [None]
    count = iter(range(10**9))

    def step() -> object:
        action, state[0] = model.predict(inputs[next(count) % 64], state=state[0], deterministic=True)
        return action

    return file, step


def run(json: bool) -> list[dict[str, Any]]:
    """Medians and 99th percentiles per step, microseconds; ratios within this run."""
    import torch

    from policy_export.graph_writer import DEFAULT_MEMORY_FORM

    torch.set_num_threads(1)
    network, files = _files()
    sb3_file, sb3_predict = _sb3()
    shipped = files[DEFAULT_MEMORY_FORM]
    candidates = {
        "runner": runner_step(shipped),
        "bare onnxruntime": bare_step(shipped.data, shipped),
        "fused LSTM node": bare_step(files["fused"].data, files["fused"]),
        "written-out gates": bare_step(files["gates"].data, files["gates"]),
        "torch eager, nn.LSTM": _eager_step(network, fused=True),
        "torch eager, gates": _eager_step(network, fused=False),
        "runner of the exported SB3 policy": runner_step(sb3_file),
        "SB3 predict": sb3_predict,
    }
    if not json:
        print(f"   timing {STEPS} steps of {len(candidates)} candidates in turns", file=sys.stderr, flush=True)
    times = interleaved_us(candidates, STEPS)
    return _figures(
        {name: (float(np.median(us)), float(np.percentile(us, 99))) for name, us in times.items()}, DEFAULT_MEMORY_FORM
    )


def _figures(times: dict[str, tuple[float, float]], form: str) -> list[dict[str, Any]]:
    figures = []
    for rank, label in enumerate(("median", "p99")):
        value, bare = times["runner"][rank], times["bare onnxruntime"][rank]
        name = f"runner, {label}, to bare onnxruntime with I/O binding"
        figures.append(_figure(name, value, bare, value / bare, f"<= {RUNNER_TARGET}" if rank == 0 else None, RUNNER_TARGET))
        for peer in ("torch eager, nn.LSTM", "torch eager, gates"):
            eager = times[peer][rank]
            target = f">= {EAGER_TARGET}" if rank == 0 and peer.endswith("nn.LSTM") else None
            figures.append(_figure(f"{peer}, {label}, to runner", value, eager, eager / value, target, EAGER_TARGET))
        own, predict = times["runner of the exported SB3 policy"][rank], times["SB3 predict"][rank]
        target = f">= {EAGER_TARGET}" if rank == 0 else None
        figures.append(
            _figure(f"SB3 predict, {label}, to runner of its export", own, predict, predict / own, target, EAGER_TARGET)
        )
        fused, gates = times["fused LSTM node"][rank], times["written-out gates"][rank]
        chosen, other = (fused, gates) if form == "fused" else (gates, fused)
        figures.append(
            _figure(f"{form} (exported) to the other form of the LSTM, {label}", chosen, other, chosen / other, None, 0.0)
        )
    return figures


def _figure(name: str, value: float, peer: float, ratio: float, target: str | None, bound: float) -> dict[str, Any]:
    ok = None if target is None else (ratio <= bound if target.startswith("<=") else ratio >= bound)
    return {"name": name, "value": value, "unit": "us", "peer": peer, "ratio": ratio, "target": target, "ok": ok}
