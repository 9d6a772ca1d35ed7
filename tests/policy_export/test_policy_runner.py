"""The runner: equal to the network it came from, strict about rate and layout, and safe when a number goes bad."""

from __future__ import annotations

import copy
import gc
import math
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper
from policy_samples import damaged

from policy_export.contract import ActionLayout, default_layout, paper_layout
from policy_export.errors import PolicyFileError, PolicyInputError, PolicyOutputError, PolicyRateError
from policy_export.network import PolicyNetwork
from policy_export.onnx_reader import read_model, weights_sha256
from policy_export.runner import PolicyRunner
from policy_export.verify import random_trace


@pytest.fixture
def runner(policy_path: Path) -> PolicyRunner:
    return PolicyRunner.load(policy_path)


def some_observation(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 4.0, 190).astype(np.float32)


def test_thousand_steps_equal_the_network_in_float64(runner: PolicyRunner, network: PolicyNetwork) -> None:
    reference = copy.deepcopy(network).double()
    trace = random_trace(runner.metadata.observation, 1000, batch=1, seed=7)
    h, c = reference.initial_state(1)
    seen = set()
    with torch.no_grad():
        for observation, reset in zip(trace.observations[:, 0], trace.resets[:, 0], strict=True):
            if reset:
                runner.reset("goal_change")
                h, c = reference.initial_state(1)
            mean, value, h, c = reference.step(torch.from_numpy(observation.astype(np.float64))[None], h, c)
            action = runner.step(observation)
            np.testing.assert_allclose(action, reference.action(mean)[0].numpy(), rtol=0, atol=1e-5)
            assert runner.value == pytest.approx(float(value), abs=1e-5)
            assert runner.hidden_norm == pytest.approx(float(h.norm()), abs=1e-4)
            seen.add(round(float(action[0]), 2))
    assert len(seen) > 10  # the test moved the policy


def test_reset_forgets_and_counts(runner: PolicyRunner) -> None:
    first = runner.step(some_observation()).copy()
    second = runner.step(some_observation()).copy()
    assert not np.array_equal(first, second)  # memory matters
    assert runner.step_count == 2
    runner.reset("goal_change")
    assert (runner.step_count, runner.hidden_norm, runner.last_reset) == (0, 0.0, "goal_change")
    np.testing.assert_array_equal(runner.step(some_observation()), first)


def test_same_inputs_give_the_same_bytes(policy_path: Path) -> None:
    runs = []
    for _ in range(2):
        runner = PolicyRunner.load(policy_path)
        runs.append(b"".join(runner.step(some_observation(k)).tobytes() for k in range(50)))
    assert runs[0] == runs[1]


def test_gap_rule_with_a_clock(runner: PolicyRunner) -> None:
    for tick in range(5):
        runner.step(some_observation(), now_s=0.05 * tick)
    assert runner.step_count == 5
    runner.step(some_observation(), now_s=0.2 + runner.metadata.reset.max_gap_s + 0.01)
    assert (runner.step_count, runner.last_reset) == (1, "gap")
    runner.step(some_observation(), now_s=0.0)  # a clock that jumps back is a gap too
    assert runner.step_count == 1


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38])
def test_a_bad_observation_is_refused_and_changes_nothing(runner: PolicyRunner, bad: float) -> None:
    runner.step(some_observation())
    before = runner.hidden_state
    observation = some_observation(1)
    observation[17] = bad
    with pytest.raises(PolicyInputError):
        runner.step(observation)
    np.testing.assert_array_equal(np.stack(runner.hidden_state), np.stack(before))
    assert runner.step_count == 1


@pytest.mark.parametrize("observation", [np.zeros(189, np.float32), np.zeros((1, 190), np.float32), np.zeros(190)])
def test_wrong_shape_or_type_is_refused(runner: PolicyRunner, observation: np.ndarray) -> None:
    with pytest.raises(PolicyInputError, match="must be float32"):
        runner.step(observation)


def test_a_non_finite_output_raises_and_resets(policy_bytes: bytes, tmp_path: Path) -> None:
    """A graph that divides by the first beam: fine at warm-up, infinite when something is too near."""

    def divide(model: onnx.ModelProto) -> None:
        last = next(node for node in model.graph.node if "value" in node.output)
        last.output[0] = "honest_value"
        model.graph.initializer.append(numpy_helper.from_array(np.array([0, 0], np.int64), "first"))
        model.graph.initializer.append(numpy_helper.from_array(np.array([1, 1], np.int64), "second"))
        model.graph.initializer.append(numpy_helper.from_array(np.array([0, 1], np.int64), "both_axes"))
        model.graph.initializer.append(numpy_helper.from_array(np.array([-1], np.int64), "as_row"))
        beam = helper.make_node("Slice", ["obs", "first", "second", "both_axes"], ["beam"])
        row = helper.make_node("Reshape", ["beam", "as_row"], ["beam_row"])
        model.graph.node.extend([beam, row, helper.make_node("Div", ["honest_value", "beam_row"], ["value"])])
        stated = weights_sha256(read_model(policy_bytes).tensors)
        fresh = weights_sha256(read_model(model.SerializeToString()).tensors)
        model.metadata_props[0].value = model.metadata_props[0].value.replace(stated, fresh)

    path = tmp_path / "fragile.onnx"
    path.write_bytes(damaged(policy_bytes, divide))
    runner = PolicyRunner.load(path)
    for _ in range(3):
        runner.step(some_observation())
    bad = some_observation()
    bad[0] = 0.0
    with pytest.raises(PolicyOutputError, match="hidden state was reset"):
        runner.step(bad)
    assert (runner.hidden_norm, runner.step_count, runner.last_reset) == (0.0, 0, "bad_output")
    assert np.isfinite(runner.step(some_observation())).all()


def test_rate_lock(policy_path: Path) -> None:
    with pytest.raises(PolicyRateError, match="trained at 20 Hz and would be stepped at 10 Hz"):
        PolicyRunner.load(policy_path, rate_hz=10.0)
    with pytest.raises(PolicyRateError):
        PolicyRunner.load(policy_path, rate_hz=math.nan, allow_other_rate=True)
    assert PolicyRunner.load(policy_path, rate_hz=10.0, allow_other_rate=True).metadata.rate_hz == 20.0


@pytest.mark.parametrize(
    ("wish", "field"),
    [
        ({"expected_sha256": "0" * 64}, "sha256"),
        ({"expected_observation": paper_layout()}, "metadata.observation.channels"),
        ({"allowed_action": ActionLayout(frame="corridor")}, "metadata.action.frame"),
        ({"allowed_action": ActionLayout(high=(0.9, 0.5, 0.5, 1.0))}, "metadata.action.high"),
        ({"allowed_action": ActionLayout(low=(-0.4, -0.5, -0.5, -1.0))}, "metadata.action.low"),
    ],
)
def test_what_cannot_be_honoured_is_refused_by_name(policy_path: Path, wish: dict, field: str) -> None:
    with pytest.raises(PolicyFileError) as caught:
        PolicyRunner.load(policy_path, **wish)
    assert caught.value.field == field


def test_what_can_be_honoured_is_accepted(policy_path: Path) -> None:
    wide = ActionLayout(low=(-2.0, -1.0, -1.0, -2.0), high=(2.0, 1.0, 1.0, 2.0))
    sha256 = PolicyRunner.load(policy_path).sha256
    runner = PolicyRunner.load(
        policy_path, expected_sha256=sha256.upper(), expected_observation=default_layout(), allowed_action=wide
    )
    assert runner.sha256 == sha256
    assert np.isfinite(runner.step(some_observation())).all()


def test_feed_forward_policy_has_no_state(feed_forward_path: Path) -> None:
    runner = PolicyRunner.load(feed_forward_path)
    first = runner.step(some_observation()).copy()
    runner.step(some_observation(1))
    np.testing.assert_array_equal(runner.step(some_observation()), first)
    assert runner.hidden_norm == 0.0
    assert runner.metadata.hidden_size == 0


def test_the_action_cannot_be_written_to(runner: PolicyRunner) -> None:
    with pytest.raises(ValueError, match="read-only"):
        runner.step(some_observation())[0] = 1.0


def test_steps_do_not_allocate(runner: PolicyRunner) -> None:
    observation = some_observation()
    gc.collect()
    tracemalloc.start()
    for _ in range(500):  # the interpreter and onnxruntime fill their own caches here
        runner.step(observation)
    before, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    for _ in range(2000):
        runner.step(observation)
    after, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 1000  # bytes, after 2,000 steps
    assert peak - before < 5000


def test_runtime_import_is_quick_small_and_without_torch() -> None:
    code = (
        "import time; c = time.process_time()\n"
        "import policy_export.runner, policy_export.observation\n"
        "import sys, pathlib\n"
        "peak = pathlib.Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0]\n"
        "print(time.process_time() - c, int(peak) / 1024,"
        " sorted({'torch', 'onnx', 'onnxscript', 'numba'} & set(sys.modules)))"
    )
    best = None
    for _ in range(4):  # a shared machine: the best of a few, in processor time
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
        seconds, megabytes, heavy = done.stdout.split(maxsplit=2)
        best = min(best or math.inf, float(seconds))
    assert heavy.strip() == "[]"
    assert best is not None
    assert best < 0.5
    assert float(megabytes) < 80.0
