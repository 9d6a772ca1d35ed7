"""The learner against slow, independent references: densities, advantages, memory over sequences, gradients."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from policy_export.network import NetworkConfig, PolicyNetwork
from training.config import PpoConfig
from training.ppo import (
    Batch,
    PpoLearner,
    TrainingDivergedError,
    advantages,
    correlated_log_prob,
    evaluate_sequences,
    gaussian_entropy,
)


def slow_advantages(rewards, values, last_value, terminated, truncated, final_values, gamma, lam):
    """One environment at a time, straight from the definition: a sum of discounted temporal differences."""
    steps, batch = rewards.shape
    result = torch.zeros_like(rewards)
    for b in range(batch):
        for t in range(steps):
            weight = 1.0
            for k in range(t, steps):
                if terminated[k, b]:
                    future = 0.0
                elif truncated[k, b]:
                    future = float(final_values[k, b])
                else:
                    future = float(last_value[b] if k == steps - 1 else values[k + 1, b])
                result[t, b] += weight * (float(rewards[k, b]) + gamma * future - float(values[k, b]))
                if terminated[k, b] or truncated[k, b]:
                    break
                weight *= gamma * lam
    return result


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), gamma=st.floats(0.5, 1.0), lam=st.floats(0.0, 1.0))
def test_advantages_equal_the_slow_sum(seed, gamma, lam):
    generator = torch.Generator().manual_seed(seed)
    draw = [torch.randn(9, 4, generator=generator, dtype=torch.float64) for _ in range(3)]
    ends = torch.rand(9, 4, generator=generator)
    terminated, truncated = ends < 0.15, (ends >= 0.15) & (ends < 0.3)
    last = torch.randn(4, generator=generator, dtype=torch.float64)
    got, target = advantages(draw[0], draw[1], last, terminated, truncated, draw[2], (gamma, lam))
    expected = slow_advantages(draw[0], draw[1], last, terminated, truncated, draw[2], gamma, lam)
    torch.testing.assert_close(got, expected)
    torch.testing.assert_close(target, expected + draw[1])


def test_white_noise_density_is_torch_normal():
    raw, mean, log_std = torch.randn(7, 4), torch.randn(7, 4), torch.randn(4) * 0.3
    expected = torch.distributions.Normal(mean, log_std.exp()).log_prob(raw).sum(-1)
    torch.testing.assert_close(correlated_log_prob(raw, mean, log_std, torch.randn(7, 4), 0.0), expected)


def test_correlated_density_is_torch_normal_around_the_shifted_mean():
    raw, mean, before, log_std = torch.randn(7, 4), torch.randn(7, 4), torch.randn(7, 4), torch.randn(4) * 0.3
    rho, std = 0.8, log_std.exp()
    expected = torch.distributions.Normal(mean + std * rho * before, std * math.sqrt(1.0 - rho**2)).log_prob(raw).sum(-1)
    torch.testing.assert_close(correlated_log_prob(raw, mean, log_std, before, rho), expected)


def test_correlated_densities_multiply_to_the_joint_gaussian():
    rho, steps = 0.7, 6
    mean, raw = torch.randn(steps, 1, dtype=torch.float64), torch.randn(steps, 1, dtype=torch.float64)
    lags = torch.arange(steps)
    covariance = rho ** (lags[:, None] - lags[None, :]).abs().double()
    joint = torch.distributions.MultivariateNormal(mean[:, 0], covariance).log_prob(raw[:, 0])
    log_std, noise = torch.zeros(1, dtype=torch.float64), raw - mean
    total = correlated_log_prob(raw[0], mean[0], log_std, torch.zeros_like(raw[0]), 0.0)
    for t in range(1, steps):
        total = total + correlated_log_prob(raw[t], mean[t], log_std, noise[t - 1], rho)
    torch.testing.assert_close(total, joint)


def squashed(mean, log_std, low, high):
    """The policy as torch builds it: a normal, a tanh, and a scaling to the limits, Jacobians included."""
    scale = torch.distributions.AffineTransform(0.5 * (low + high), 0.5 * (high - low))
    parts = [torch.distributions.TanhTransform(), scale]
    normal = torch.distributions.Normal(mean, log_std.exp())
    return torch.distributions.Independent(torch.distributions.TransformedDistribution(normal, parts), 1)


def test_ratios_of_raw_densities_are_those_of_the_squashed_actions():
    net = network().double()
    low, high = net.action_low, net.action_high
    old, new = torch.randn(7, 4, dtype=torch.float64), torch.randn(7, 4, dtype=torch.float64)
    old_std, new_std = torch.randn(4, dtype=torch.float64) * 0.3, torch.randn(4, dtype=torch.float64) * 0.3
    raw = old + old_std.exp() * torch.randn(7, 4, dtype=torch.float64)
    action = net.action(raw)
    assert ((action > low) & (action < high)).all()
    expected = squashed(new, new_std, low, high).log_prob(action) - squashed(old, old_std, low, high).log_prob(action)
    zero = torch.zeros_like(raw)
    got = correlated_log_prob(raw, new, new_std, zero, 0.0) - correlated_log_prob(raw, old, old_std, zero, 0.0)
    torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)


def test_entropy_is_torch_normal():
    log_std = torch.randn(4)
    torch.testing.assert_close(
        gaussian_entropy(log_std), torch.distributions.Normal(torch.zeros(4), log_std.exp()).entropy().sum()
    )


def network(memory="lstm"):
    torch.manual_seed(0)
    return PolicyNetwork(NetworkConfig(memory=memory, hidden_size=16, head_size=8))


def observations(steps, batch):
    generator = torch.Generator().manual_seed(1)
    return torch.rand(steps, batch, 190, generator=generator) * 4.0


@pytest.mark.parametrize("memory", ["lstm", "gru", "stack", "none"])
def test_sequences_equal_steps_with_the_state_cleared_at_episode_starts(memory):
    net, obs = network(memory), observations(12, 5)
    reset = torch.rand(12, 5, generator=torch.Generator().manual_seed(2)) < 0.25
    h, c = (torch.randn_like(state) for state in net.initial_state(5))
    means, values = evaluate_sequences(net, net.features(obs), h[0], c[0], reset)
    for t in range(12):
        keep = (~reset[t]).float().view(1, 5, 1)
        mean, value, h, c = net.step(obs[t], h * keep, c * keep)
        torch.testing.assert_close(means[t], mean, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(values[t], value, atol=1e-5, rtol=1e-5)


def test_no_gradient_crosses_an_episode_start():
    net, features = network(), network().features(observations(8, 3)).requires_grad_()
    reset = torch.zeros(8, 3, dtype=torch.bool)
    reset[4, 1] = True
    means, _ = evaluate_sequences(net, features, torch.zeros(3, 16), torch.zeros(3, 16), reset)
    (gradient,) = torch.autograd.grad(means[4:].sum(), features)
    assert gradient[:4, 1].abs().max() == 0.0
    assert gradient[:4, 0].abs().max() > 0.0


def batch_for(net, config, gain):
    generator = torch.Generator().manual_seed(3)
    features = net.features(observations(config.steps, config.environments))
    shape = (config.steps, config.environments)
    reset = torch.zeros(shape, dtype=torch.bool)
    h, c = (state[0] for state in net.initial_state(config.environments))
    with torch.no_grad():
        mean, value = evaluate_sequences(net, features, h, c, reset)
        noise = torch.randn(*shape, 4, generator=generator)
        raw = mean + net.log_std.exp() * noise
        log_prob = correlated_log_prob(raw, mean, net.log_std, torch.zeros_like(noise), 0.0)
    advantage = gain(raw)
    return Batch(features, raw, torch.zeros_like(noise), torch.zeros(shape), log_prob, advantage, value + advantage, reset, h, c)


CONFIG = PpoConfig(environments=32, steps=8, minibatches=2, epochs=4, learning_rate=3e-3, target_kl=None)


@pytest.mark.parametrize("memory", ["lstm", "gru", "stack", "none"])
def test_updates_move_the_policy_towards_what_paid(memory):
    net = network(memory)
    batch = batch_for(net, CONFIG, lambda raw: raw[..., 0])
    before = evaluate_sequences(net, batch.features, batch.h0, batch.c0, batch.reset)[0].mean(dim=(0, 1))
    metrics = PpoLearner(net, CONFIG).update(batch, torch.Generator().manual_seed(0), 0.0)
    after = evaluate_sequences(net, batch.features, batch.h0, batch.c0, batch.reset)[0].mean(dim=(0, 1))
    assert after[0] > before[0] + 0.02
    assert abs(after[1] - before[1]) < 0.5 * (after[0] - before[0])
    assert all(math.isfinite(value) for value in metrics.values())


def test_learning_rate_follows_the_kl():
    config = CONFIG.model_copy(update={"target_kl": 0.01, "learning_rate": 1e-3, "learning_rate_bounds": (1e-5, 1e-2)})
    learner = PpoLearner(network(), config)
    learner._adapt(0.03, 0.0)
    assert learner.learning_rate == pytest.approx(1e-3 / 1.5)
    learner._adapt(0.001, 0.0)
    assert learner.learning_rate == pytest.approx(1e-3)
    for _ in range(20):
        learner._adapt(0.001, 1.0)
    assert learner.learning_rate == pytest.approx(2e-3)  # a fifth of the upper bound at the end


def test_a_nan_stops_before_the_weights_are_touched():
    net = network()
    batch = batch_for(net, CONFIG, lambda raw: raw[..., 0])
    batch.target[0, 0] = float("nan")
    before = [parameter.detach().clone() for parameter in net.parameters()]
    learner = PpoLearner(net, CONFIG.model_copy(update={"minibatches": 1}))
    with pytest.raises(TrainingDivergedError, match=r"lower ppo\.learning_rate"):
        learner.update(batch, torch.Generator().manual_seed(0), 0.0)
    assert all(torch.equal(old, new) for old, new in zip(before, net.parameters(), strict=True))
