"""The plain gymnasium environment: gymnasium's own checker, the vector environment's flights, another project's trainer."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from training.config import EVALUATION_SEED_START, EnvironmentConfig
from training.environment import CorridorVectorEnv
from training.single import ENVIRONMENT_ID, CorridorEnv
from training.worlds import FixedWorlds, FreshWorlds

NAME = f"training.single:{ENVIRONMENT_ID}"
SHORT = {"time_limit_s": 3.0}


@pytest.mark.filterwarnings("ignore:.*infinity")  # distances and speeds have no natural bound
@pytest.mark.parametrize("layout", ["default", "paper"])
def test_gymnasiums_checker_passes(layout):
    check_env(gymnasium.make(NAME, config=SHORT, layout=layout).unwrapped, skip_render_check=True)


def test_one_corridor_flies_as_in_the_vector_environment():
    config = EnvironmentConfig(**SHORT)
    single = CorridorEnv(config)
    first, _ = single.reset(seed=7)
    world = FreshWorlds(config).next_world(0, np.random.Generator(np.random.PCG64(7)))
    vector = CorridorVectorEnv(1, config, worlds=FixedWorlds([world]))
    vector.rng = np.random.Generator(np.random.PCG64(7))
    vector.rng.integers(0, EVALUATION_SEED_START)  # what choosing the corridor took
    assert np.array_equal(first, vector.reset()[0][0])
    action = np.array([0.5, 0.1, 0.0, 0.2], np.float32)
    for _ in range(20):
        observation, reward, terminated, truncated, _ = single.step(action)
        expected = vector.step(action[None])
        assert np.array_equal(observation, expected[0][0])
        assert (reward, terminated, truncated) == (expected[1][0], expected[2][0], expected[3][0])


def test_the_time_limit_truncates_and_says_so():
    env = gymnasium.make(NAME, config={"time_limit_s": 1.0, "spread_start_share": 0.0})
    env.reset(seed=0)
    for k in range(20):
        _, _, terminated, truncated, info = env.step(np.zeros(4, np.float32))
        assert (terminated, truncated) == (False, k == 19)
    assert info["outcome"] == "time_out"
    assert set(info["reward_terms"]) >= {"progress", "contact"}


def test_every_episode_has_its_own_corridor_from_the_training_seeds():
    env, goals = CorridorEnv(SHORT), set()
    env.reset(seed=3)
    for _ in range(5):
        env.reset()
        goals.add(tuple(env.corridors.arena.goal[0]))
    assert len(goals) == 5


def test_recurrent_ppo_of_sb3_trains_on_it_unchanged():
    from sb3_contrib import RecurrentPPO

    env = gymnasium.make(NAME, config=SHORT)
    model = RecurrentPPO("MlpLstmPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = model.policy.action_net.weight.detach().clone()
    model.learn(64)
    assert model.num_timesteps == 64
    assert not before.equal(model.policy.action_net.weight)
