"""The training benchmark's arithmetic, and that SB3's adapter shows what the environment gave."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks._sb3_corridors import Sb3Corridors
from benchmarks.training import figures, flop_per_decision
from training.config import EnvironmentConfig
from training.environment import CorridorVectorEnv


def test_flop_per_decision_is_that_of_the_matrix_products():
    weights_in, weights_hidden, heads = 190 * 512, 128 * 512, 2 * 128 * 64 + 64 * 5
    forward = 2 * (weights_in + weights_hidden + heads)
    backward = 2 * forward - 2 * weights_in  # gradients of weights and of what enters them, but for the observations
    assert flop_per_decision() == forward + 4 * (forward + backward)


def test_ratios_and_targets():
    found = {"own": 12_000.0, "peer": 2_000.0, "peer wall": 1_500.0, "peer wall, two threads": 1_800.0, "shared": 4_000.0}
    found |= {"authors": 100.0, "flops": 128e9, "own, two cores": 17_000.0}
    one, two, shared, ceiling, share, authors, volume = figures(found)
    assert (one["ratio"], one["ok"]) == (6.0, True)
    assert (two["ratio"], two["ok"]) == (pytest.approx(9.44, abs=0.01), False)
    assert (shared["ratio"], shared["ok"]) == (3.0, None)
    assert ceiling["ratio"] == pytest.approx(128e9 / flop_per_decision() / 4_000.0)
    assert share["ratio"] == pytest.approx(0.365, abs=0.001)
    assert "NOT like for like" in authors["name"]
    assert volume["ok"] is True


def test_the_adapter_passes_on_what_the_corridors_say():
    config = EnvironmentConfig(world_pool=4, time_limit_s=0.2)
    adapter = Sb3Corridors(CorridorVectorEnv(3, config, 5))
    twin = CorridorVectorEnv(3, config, 5)
    assert np.array_equal(adapter.reset(), twin.reset()[0])
    action = np.full((3, 4), 0.2, np.float32)
    for k in range(4):
        observations, rewards, dones, infos = adapter.step(action)
        expected = twin.step(action)
        assert np.array_equal(observations, expected[0])
        np.testing.assert_allclose(rewards, expected[1], rtol=1e-6)
        assert dones.all() == (k == 3)
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert np.array_equal(infos[1]["terminal_observation"], expected[4]["final_obs"][1])
