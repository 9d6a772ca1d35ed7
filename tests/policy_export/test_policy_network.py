"""The network: the fast sequence form is the step form, in values and gradients; resets cut every path through time."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from policy_samples import make_network
from pydantic import ValidationError

from policy_export.network import NetworkConfig, PolicyNetwork

CASES = [{"memory": m, "preprocessing": p} for m in ("lstm", "gru", "none") for p in ("shaped", "channels")]
CASES += [{"memory": "stack"}]


def by_steps(network: PolicyNetwork, obs: torch.Tensor, h: torch.Tensor, c: torch.Tensor, reset: torch.Tensor) -> tuple:
    means, values = [], []
    for t in range(obs.shape[0]):
        keep = (~reset[t]).to(obs.dtype)[None, :, None]
        mean, value, h, c = network.step(obs[t], h * keep, c * keep)
        means.append(mean)
        values.append(value)
    return torch.stack(means), torch.stack(values), (h, c)


def loss(mean: torch.Tensor, value: torch.Tensor, state: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    return mean.sin().sum() + value.square().sum() + state[0].sum() + state[1].square().sum()


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(case.values()))
def test_sequence_equals_steps(case: dict[str, str]) -> None:
    network = make_network(spread=0.01, **case).double()
    obs = 4.0 * torch.rand(23, 5, 190, dtype=torch.float64)
    reset = torch.rand(23, 5) < 0.2
    h, c = network.initial_state(5)
    h, c = h + 0.3, c + (0.3 if case["memory"] == "lstm" else 0.0)  # nothing else reads c
    wanted = [*network.parameters(), *((h.requires_grad_(), c.requires_grad_()) if network.config.state_size else ())]
    fast, slow = network.sequence(obs, h, c, reset), by_steps(network, obs, h, c, reset)
    torch.testing.assert_close(fast, slow, rtol=1e-12, atol=1e-12)
    gradients = [torch.autograd.grad(loss(*result), wanted, allow_unused=True) for result in (fast, slow)]
    used = 0
    for left, right in zip(*gradients, strict=True):
        if right is not None:
            used += 1
            torch.testing.assert_close(left, right, rtol=1e-9, atol=1e-11)
    assert used >= len(wanted) - 1  # all but log_std


@pytest.mark.parametrize("memory", ["lstm", "gru", "stack"])
@settings(max_examples=15, deadline=None)
@given(cut=st.integers(1, 9), seed=st.integers(0, 1000))
def test_nothing_crosses_a_reset(memory: str, cut: int, seed: int) -> None:
    network = make_network(seed, memory=memory, hidden_size=16, stack_frames=6).double()
    generator = torch.Generator().manual_seed(seed)
    obs = 4.0 * torch.rand(10, 2, 190, dtype=torch.float64, generator=generator)
    reset = torch.zeros(10, 2, dtype=torch.bool)
    reset[cut] = True
    other = obs.clone()
    other[:cut] = 4.0 * torch.rand(cut, 2, 190, dtype=torch.float64, generator=generator)
    one, _, _ = network.sequence(obs, *network.initial_state(2), reset)
    two, _, _ = network.sequence(other, *network.initial_state(2), reset)
    torch.testing.assert_close(one[cut:], two[cut:], rtol=0, atol=0)
    assert not torch.equal(one[:cut], two[:cut])


def test_step_is_torchs_lstm() -> None:
    network = make_network().double()
    obs = 4.0 * torch.rand(3, 190, dtype=torch.float64)
    h, c = (0.2 * torch.randn(1, 3, 128, dtype=torch.float64) for _ in range(2))
    _, _, h1, c1 = network.step(obs, h, c)
    _, (h2, c2) = network.lstm(network.features(obs).unsqueeze(0), (h, c))
    torch.testing.assert_close((h1, c1), (h2, c2))


def test_step_is_torchs_gru() -> None:
    network = make_network(memory="gru").double()
    obs = 4.0 * torch.rand(3, 190, dtype=torch.float64)
    h = 0.2 * torch.randn(1, 3, 128, dtype=torch.float64)
    _, _, h1, _ = network.step(obs, h, torch.zeros_like(h))
    _, h2 = network.gru(network.features(obs).unsqueeze(0), h)
    torch.testing.assert_close(h1, h2)


def test_a_stack_sees_its_last_frames_and_no_more() -> None:
    network = make_network(memory="stack", stack_frames=4).double()
    obs = 4.0 * torch.rand(9, 1, 190, dtype=torch.float64)
    reset, state = torch.zeros(9, 1, dtype=torch.bool), network.initial_state(1)
    means, _, _ = network.sequence(obs, *state, reset)
    for frame, last_changed in ((4, 7), (5, 8)):
        other = obs.clone()
        other[frame] += 0.5
        changed = (network.sequence(other, *state, reset)[0] != means).any(-1)[:, 0].nonzero()[:, 0]
        assert changed.tolist() == list(range(frame, last_changed + 1))


@settings(max_examples=30, deadline=None)
@given(means=st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4))
def test_actions_stay_within_the_limits(means: list[float]) -> None:
    network = make_network()
    action = network.action(torch.tensor(means))
    assert (action >= network.action_low - 1e-6).all()
    assert (action <= network.action_high + 1e-6).all()


@pytest.mark.parametrize("preprocessing", ["shaped", "channels"])
def test_features_are_of_order_one_for_extreme_inputs(preprocessing: str) -> None:
    network = make_network(preprocessing=preprocessing)
    extreme = torch.full((2, 190), 1e3)
    extreme[1] = -1e3
    extreme[:, 180:183] = 40.0
    extreme[:, 189] = 3.0
    features = network.features(extreme)
    assert features.shape == (2, network.config.feature_size)
    assert features.abs().max() <= 5.0


def test_config_round_trip_and_refusals() -> None:
    config = NetworkConfig(memory="none", action_high=(2.0, 1.0, 1.0, 2.0))
    assert NetworkConfig.from_dict(config.to_dict()) == config
    for bad in ({"beam_group": 7}, {"memory": "gru9"}, {"action_low": (1.0, -0.5, -0.5, -1.0)}, {"unknown": 1}):
        with pytest.raises(ValidationError):
            NetworkConfig.from_dict(bad)
