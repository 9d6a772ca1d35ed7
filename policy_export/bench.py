"""Times one step of a policy file: the runner beside bare onnxruntime on the same graph, taking turns in one run. No torch."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from policy_export.policy_file import PolicyFile, expected_ports, read_policy_file
from policy_export.runner import PolicyRunner, open_session

_BLOCK, _SETTLE = 100, 5


def bench_file(path: str | Path, steps: int = 5000) -> dict[str, Any]:
    """{"timings": {name: {"median_us", "p99_us"}}, "ratio"}: runner and bare onnxruntime with I/O binding."""
    file = read_policy_file(path)
    timings = interleaved_us({"runner": runner_step(file), "bare onnxruntime, I/O binding": bare_step(file.data, file)}, steps)
    summary = {name: {"median_us": float(np.median(us)), "p99_us": float(np.percentile(us, 99))} for name, us in timings.items()}
    runner, bare = summary.values()
    return {"path": str(path), "steps": steps, "timings": summary, "ratio": runner["median_us"] / bare["median_us"]}


def interleaved_us(steps_by_name: dict[str, Callable[[], object]], steps: int) -> dict[str, NDArray[np.float64]]:
    """Time of every call in microseconds; the candidates take turns in blocks, so that they share the machine's moods."""
    times: dict[str, list[int]] = {name: [] for name in steps_by_name}
    for call in steps_by_name.values():
        for _ in range(_BLOCK):
            call()
    order = list(steps_by_name.items())
    for turn in range(max(1, steps // _BLOCK)):
        # Each starts the round in its turn.
        for name, call in order[turn % len(order) :] + order[: turn % len(order)]:
            for _ in range(_SETTLE):  # whoever follows a heavy candidate finds its caches cold; that is not its own time
                call()
            for _ in range(_BLOCK):
                begin = time.perf_counter_ns()
                call()
                times[name].append(time.perf_counter_ns() - begin)
    return {name: np.asarray(values, dtype=np.float64) / 1e3 for name, values in times.items()}


def observations(file: PolicyFile, count: int = 64, seed: int = 0) -> NDArray[np.float32]:
    """Plausible observations [count, size]."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0.0, 4.0, size=(count, file.metadata.observation.size)).astype(np.float32)


def runner_step(file: PolicyFile) -> Callable[[], object]:
    """A call that makes one step of the runner that flies."""
    runner = PolicyRunner(file)
    inputs = observations(file)
    count = iter(range(10**9))
    return lambda: runner.step(inputs[next(count) % len(inputs)])


def bare_step(model: bytes, file: PolicyFile) -> Callable[[], object]:
    """A call that makes one step of onnxruntime with bound buffers and nothing else; the hidden state swaps buffers."""
    session = open_session(model)
    inputs = observations(file)
    buffer = np.zeros((1, inputs.shape[1]), dtype=np.float32)
    shapes_in, shapes_out = expected_ports(file.metadata)
    shapes = {
        name: tuple(1 if size is None else size for size in shape)
        for name, shape in (shapes_in | shapes_out | {"value": (1,)}).items()
    }
    kept: list[Any] = [buffer]
    pairs = {"h": (_zeros(shapes, "h_in"), _zeros(shapes, "h_in")), "c": (_zeros(shapes, "c_in"), _zeros(shapes, "c_in"))}
    bindings = []
    for turn in range(2):
        binding = session.io_binding()
        arrays = {"obs": buffer, "action": _zeros(shapes, "action"), "value": _zeros(shapes, "value")}
        for name, pair in pairs.items():
            arrays |= {f"{name}_in": pair[turn], f"{name}_out": pair[1 - turn]}
        for port in session.get_inputs():
            binding.bind_input(port.name, "cpu", 0, np.float32, arrays[port.name].shape, arrays[port.name].ctypes.data)
        for port in session.get_outputs():
            binding.bind_output(port.name, "cpu", 0, np.float32, arrays[port.name].shape, arrays[port.name].ctypes.data)
        bindings.append(binding)
        kept.append(arrays)
    count = iter(range(10**9))

    def step() -> list[Any]:
        k = next(count)
        buffer[0] = inputs[k % len(inputs)]
        session.run_with_iobinding(bindings[k & 1])
        return kept

    return step


def _zeros(shapes: dict[str, tuple[int, ...]], name: str) -> NDArray[np.float32]:
    return np.zeros(shapes.get(name, (1, 1, 0)), dtype=np.float32)
