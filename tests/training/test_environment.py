"""The vector environment: gymnasium's API, determinism, observation and action semantics, how episodes end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from policy_export.contract import ActionLayout, default_layout, paper_layout
from policy_export.observation import ObservationBuilder
from sim_gateway import vehicle
from sim_gateway.scene import Mover, World
from training import kernels
from training.config import EVALUATION_SEED_START, EnvironmentConfig, EstimateRandomisation, RewardConfig, VehicleRandomisation
from training.environment import CorridorVectorEnv
from training.worlds import FixedWorlds, WorldPool, world_for_seed

SMALL = EnvironmentConfig(world_pool=8)
CALM = EnvironmentConfig(
    world_pool=1,
    spread_start_share=0.0,
    start_yaw_rad=0.0,
    start_altitude_m=(2.0, 2.0),
    dropout=(0.0, 0.0),
    lidar_noise_m=0.0,
    vehicle=VehicleRandomisation(relative=0.0, command_delay_steps=(0, 0), scan_age_steps=(0, 0), wind_mps=(0.0, 0.0)),
    estimate=EstimateRandomisation(harsh_share=0.0, nominal="none"),
)


def open_world(goal=(30.0, 0.0, 2.0), boxes=(), movers=(), yaw=0.0):
    rows = np.array([[-1.0, -5.0, 0.0, 36.0, -4.0, 10.0], [-1.0, 4.0, 0.0, 36.0, 5.0, 10.0], *boxes], dtype=np.float64)
    return World("test", 0, 35.0, 8.0, 10.0, rows, tuple(movers), (4.0, 0.0, 0.0), yaw, goal)


def calm_env(world, config=CALM, **kwargs):
    env = CorridorVectorEnv(1, config, 0, worlds=FixedWorlds([world]), **kwargs)
    env.reset()
    return env


def fly(env, action, ticks, hold=1):
    for _ in range(ticks):
        result = env.step_held(np.array([action], np.float32), hold)
        if result[2].any() or result[3].any():
            break
    return result


def test_spaces_shapes_and_types():
    env = CorridorVectorEnv(3, SMALL, 0)
    observation, info = env.reset(seed=5)
    assert observation.shape == env.observation_space.shape == (3, 190)
    assert env.observation_space.contains(observation)
    assert info == {}
    env.action_space.seed(0)
    for _ in range(30):
        observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert reward.shape == terminated.shape == truncated.shape == (3,)
        assert terminated.dtype == truncated.dtype == np.bool_
        assert np.isfinite(observation).all()
    assert set(info["reward_terms"]) == set(kernels.TERM_NAMES)


def test_same_seed_same_flights_and_another_seed_others():
    def run(seed):
        env = CorridorVectorEnv(4, SMALL, seed)
        rows = [env.reset()[0]]
        for k in range(60):
            rows.append(env.step(np.full((4, 4), 0.3 * math.sin(k), np.float32))[0])
        return np.stack(rows)

    assert np.array_equal(run(1), run(1))
    assert not np.array_equal(run(1), run(2))


def test_reset_with_a_seed_starts_over():
    env = CorridorVectorEnv(2, SMALL, 0)
    first, _ = env.reset(seed=9)
    env.step(np.zeros((2, 4), np.float32))
    again, _ = env.reset(seed=9)
    assert np.array_equal(first, again)


@pytest.mark.parametrize("layout", [default_layout(), paper_layout()], ids=["default", "paper"])
def test_observation_is_what_the_flight_builder_makes(layout):
    env = CorridorVectorEnv(6, EnvironmentConfig(world_pool=8, dropout=(0.1, 0.2)), 3, layout=layout)
    env.reset()
    builder = ObservationBuilder(layout)
    for _ in range(25):
        observation, *_ = env.step(np.tile(np.array([0.6, 0.1, 0.0, 0.4], np.float32), (6, 1)))
        for i in range(6):
            estimate = env.arena.estimate[i]
            ranges = np.where(env.arena.ranges[i] >= 4.0, np.inf, env.arena.ranges[i])
            expected = builder.build(ranges, estimate[0:3], estimate[3:6], estimate[6:9], estimate[9], env.arena.goal[i])
            np.testing.assert_allclose(observation[i], expected, atol=2e-6)


def test_forward_action_follows_the_heading():
    env = calm_env(open_world(yaw=math.pi / 2))
    fly(env, [0.5, 0.0, 0.0, 0.0], 40)
    x, y, z = env.arena.vehicle[0, 0:3]
    assert abs(x - 4.0) < 0.05
    assert 0.5 < y < 1.2
    assert abs(z - 2.0) < 0.1


def test_corridor_frame_actions_ignore_the_heading():
    env = calm_env(open_world(yaw=math.pi / 2), action=ActionLayout(frame="corridor"))
    fly(env, [0.5, 0.0, 0.0, 0.0], 40)
    x, y, _ = env.arena.vehicle[0, 0:3]
    assert x > 4.5
    assert abs(y) < 0.05


def test_positive_yaw_rate_turns_left():
    env = calm_env(open_world())
    observation, *_ = fly(env, [0.0, 0.0, 0.0, 0.5], 40)
    assert 0.6 < vehicle.yaw_rad(env.arena.vehicle[0]) < 1.1
    assert observation[0, 189] == pytest.approx(vehicle.yaw_rad(env.arena.vehicle[0]), abs=1e-6)


def test_a_held_action_flies_like_the_same_action_repeated():
    one, four = calm_env(open_world()), calm_env(open_world())
    for _ in range(5):
        fly(one, [0.4, 0.2, 0.1, 0.3], 4, hold=1)
        fly(four, [0.4, 0.2, 0.1, 0.3], 1, hold=4)
    np.testing.assert_allclose(one.arena.vehicle, four.arena.vehicle, atol=1e-12)
    assert one.arena.ticks[0] == four.arena.ticks[0] == 20


def test_ticks_hold_twelve_and_thirteen_substeps_in_turn():
    env, state = calm_env(open_world()), vehicle.initial_state((4.0, 0.0, 2.0), 0.0, True)
    params, still = env.arena.params[0], np.zeros(3)
    fly(env, [0.5, 0.0, 0.0, 0.0], 2)
    vehicle.step_velocity(state, params, np.array([0.5, 0.0, 0.0]), 0.0, still, still, 25)
    np.testing.assert_allclose(env.arena.vehicle[0], state, atol=1e-12)


def test_a_delayed_command_takes_effect_late():
    late = CALM.model_copy(update={"vehicle": CALM.vehicle.model_copy(update={"command_delay_steps": (12, 12)})})
    prompt, delayed = calm_env(open_world()), calm_env(open_world(), late)
    fly(prompt, [1.0, 0.0, 0.0, 0.0], 4)
    fly(delayed, [1.0, 0.0, 0.0, 0.0], 4)
    assert delayed.arena.vehicle[0, 3] < prompt.arena.vehicle[0, 3] - 0.02


def test_reaching_the_goal_terminates_with_its_bonus():
    env = calm_env(open_world(goal=(5.0, 0.0, 2.0)))
    _, reward, terminated, truncated, info = fly(env, [0.5, 0.0, 0.0, 0.0], 200)
    assert terminated[0]
    assert not truncated[0]
    assert info["outcomes"] == ["goal"]
    assert info["reward_terms"]["goal"] == pytest.approx(2.0)
    assert reward[0] == pytest.approx(sum(info["reward_terms"].values()))


def test_contact_terminates_with_its_cost_and_the_next_episode_begins():
    env = calm_env(open_world(boxes=[[6.0, -0.5, 0.0, 7.0, 0.5, 10.0]]))
    paid = 0.0
    while not (result := env.step(np.array([[1.0, 0.0, 0.0, 0.0]], np.float32)))[2][0]:
        paid += result[1][0]
    observation, reward, _, _, info = result
    paid += reward[0]
    assert info["outcomes"] == ["contact"]
    assert info["min_clearance_m"][0] <= 0.0
    assert info["reward_terms"]["contact"] == pytest.approx(-2.0)
    assert info["episode_return"][0] == pytest.approx(paid)
    assert info["final_obs"][0, 180] < 25.0  # the old episode's last goal offset
    assert observation[0, 180] == pytest.approx(26.0, abs=1e-3)  # the new one's first
    assert env.arena.ticks[0] == 0


def test_leaving_the_altitude_band_terminates():
    env = calm_env(open_world())
    *_, info = fly(env, [0.0, 0.0, 0.5, 0.0], 400)
    assert info["outcomes"] == ["left_band"]


def test_the_time_limit_truncates():
    env = calm_env(open_world(), CALM.model_copy(update={"time_limit_s": 1.0}))
    _, _, terminated, truncated, info = fly(env, [0.0, 0.0, 0.0, 0.0], 200, hold=3)
    assert truncated[0]
    assert not terminated[0]
    assert info["episode_ticks"] == [20]
    assert np.isfinite(info["final_obs"]).all()


def test_progress_adds_up_to_the_distance_gained():
    env = calm_env(open_world())
    total = 0.0
    for _ in range(50):
        *_, info = fly(env, [1.0, 0.3, 0.0, 0.0], 1)
        total += info["reward_terms"]["progress"]
    distance = np.linalg.norm(env.arena.vehicle[0, 0:3] - env.arena.goal[0])
    assert total == pytest.approx(0.2 * 0.5 * (26.0 - distance), rel=1e-6)


def test_article_terms_are_paid():
    reward = RewardConfig(scale=1.0, path_deviation_per_m_s=-1.0, velocity_change_per_mps=-0.5)
    env = calm_env(open_world(), CALM.model_copy(update={"reward": reward}))
    fly(env, [0.5, 0.5, 0.0, 0.0], 40)
    *_, info = fly(env, [-0.5, -0.5, 0.0, 0.0], 3)
    y = env.arena.vehicle[0, 1]
    assert info["reward_terms"]["path_deviation"] == pytest.approx(-0.05 * y, rel=0.1)
    assert info["reward_terms"]["velocity_change"] < -0.01


def test_moving_pillars_are_seen_and_hit():
    mover = Mover((1.0, 1.0, 10.0), 6.0, 5.0, -3.0, 3.0, 0.5, 0.0)
    env = calm_env(open_world(movers=[mover]))
    fly(env, [0.0, 0.0, 0.0, 0.0], 80)
    first = env.arena.boxes[0, 2].copy()
    np.testing.assert_allclose(first, mover.box_at(4.0), atol=1e-9)
    assert env.arena.ranges[0].min() < 2.5
    fly(env, [0.2, 0.0, 0.0, 0.0], 2)
    assert not np.array_equal(first, env.arena.boxes[0, 2])


def test_inactive_environments_stand_still():
    env = CorridorVectorEnv(2, SMALL, 0)
    env.reset()
    env.arena.active[0] = False
    before = env.arena.vehicle[0].copy()
    env.step(np.ones((2, 4), np.float32))
    assert np.array_equal(before, env.arena.vehicle[0])
    assert env.arena.ticks.tolist() == [0, 1]


def test_training_corridors_never_come_from_evaluation_seeds():
    pool = WorldPool(EnvironmentConfig(world_pool=64), np.random.default_rng(0))
    rng = np.random.default_rng(1)
    for _ in range(200):
        assert pool.next_world(0, rng).seed < EVALUATION_SEED_START
    assert (pool.seeds < EVALUATION_SEED_START).all()


def test_the_pool_is_renewed():
    rng = np.random.default_rng(0)
    pool = WorldPool(EnvironmentConfig(world_pool=4, world_renewal_episodes=3), rng)
    before = pool.seeds.tolist()
    for _ in range(11):
        pool.next_world(0, rng)
    assert pool.seeds.tolist()[3] == before[3]
    assert not set(before[:3]) & set(pool.seeds.tolist())
    pool.next_world(0, rng)
    assert not set(before) & set(pool.seeds.tolist())


def test_moving_share_gives_moving_corridors():
    config = EnvironmentConfig(moving_share=0.5)
    assert len(world_for_seed(499, config).movers) >= 2
    assert world_for_seed(500, config).movers == ()


def test_spread_starts_are_free_and_before_the_goal():
    env = CorridorVectorEnv(64, EnvironmentConfig(world_pool=32, spread_start_share=1.0), 0)
    env.reset()
    assert (env.arena.start[:, 0] <= env.arena.goal[:, 0] - 2.9).all()
    assert env.arena.start[:, 0].max() > 15.0
    assert (env.arena.ranges.min(axis=1) > 0.3).all()


def test_nan_actions_are_refused():
    env = CorridorVectorEnv(1, SMALL, 0)
    env.reset()
    with pytest.raises(ValueError, match="NaN"):
        env.step(np.array([[0.0, np.nan, 0.0, 0.0]], np.float32))


def test_state_and_restore_go_on_identically():
    env = CorridorVectorEnv(3, SMALL, 4)
    env.reset()
    action = np.tile(np.array([0.8, 0.2, 0.0, 0.2], np.float32), (3, 1))
    for _ in range(40):
        env.step(action)
    saved = env.state()
    rows = [env.step(action)[0] for _ in range(200)]
    twin = CorridorVectorEnv(3, SMALL, 99)
    twin.restore(saved)
    for row in rows:
        assert np.array_equal(row, twin.step(action)[0])
