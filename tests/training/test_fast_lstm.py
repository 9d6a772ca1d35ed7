"""The compiled LSTM of the learner against the readable one of the network: values, gradients, resets, NaN."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from policy_export.memory import LstmMemory
from training.fast_lstm import fast_lstm_sequence


def problem(steps, batch, seed, resets=0.2, width=16):
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    memory = LstmMemory(7, width)
    features = 2.0 * torch.randn(steps, batch, 7, generator=generator)
    h, c = (torch.randn(batch, width, generator=generator).requires_grad_() for _ in range(2))
    return memory, features.requires_grad_(), h, c, torch.rand(steps, batch, generator=generator) < resets


def gradients(result, wanted):
    output, h, c = result
    return torch.autograd.grad(output.sin().sum() + (c * c).sum() + h.sum(), wanted)


@settings(max_examples=25, deadline=None)
@given(steps=st.integers(1, 12), batch=st.integers(1, 9), seed=st.integers(0, 10_000), resets=st.floats(0.0, 1.0))
def test_values_and_gradients_are_those_of_the_reference(steps, batch, seed, resets):
    memory, features, h, c, reset = problem(steps, batch, seed, resets)
    fast, slow = fast_lstm_sequence(memory, features, h, c, reset), memory.sequence(features, h, c, reset)
    torch.testing.assert_close(fast, slow, rtol=2e-6, atol=2e-6)
    wanted = [*memory.parameters(), features, h, c]
    for left, right in zip(gradients(fast, wanted), gradients(slow, wanted), strict=True):
        torch.testing.assert_close(left, right, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("spread", [1.0, 30.0])
def test_gates_are_as_exact_as_float32_at_any_size(spread):
    memory, features, h, c, reset = problem(4, 64, 0)
    with torch.no_grad():
        fast = fast_lstm_sequence(memory, spread * features, h, c, reset)
        exact = memory.double().sequence(spread * features.double(), h.double(), c.double(), reset)
    for left, right in zip(fast, exact, strict=True):
        assert (left - right).abs().max() < 3e-6 * spread


def test_a_nan_is_not_swallowed():
    memory, features, h, c, reset = problem(3, 4, 1, resets=0.0)
    with torch.no_grad():
        features[0, 2, 0] = np.nan
        output, _, _ = fast_lstm_sequence(memory, features, h, c, reset)
    assert output[:, 2].isnan().all()
    assert not output[:, [0, 1, 3]].isnan().any()


def test_gradients_arriving_without_memory_order_are_read_right():
    memory, features, h, c, reset = problem(5, 3, 2)
    weights = torch.randn(3, 5, 16).transpose(0, 1)
    found = [
        torch.autograd.grad((sequence[0] * weights).sum(), features)[0]
        for sequence in (fast_lstm_sequence(memory, features, h, c, reset), memory.sequence(features, h, c, reset))
    ]
    torch.testing.assert_close(*found, rtol=2e-5, atol=2e-5)
