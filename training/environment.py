"""The corridor task as a gymnasium VectorEnv: many corridors at once, stepped by the compiled kernels of training.kernels.

One step is one decision at 20 Hz (``step``) or an action held for several ticks (``step_held``). Episodes restart in the
step in which they end (SAME_STEP autoreset): the returned observation is then the new episode's first, and
``info["final_obs"]`` holds the last one of the old episode.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from policy_export.contract import ActionLayout, ObservationLayout, default_layout
from policy_export.observation import beam_bearings_rad
from sim_gateway import vehicle
from sim_gateway.collision import clearance_m
from sim_gateway.corridor import MAX_MOVERS, MAX_PILLARS
from sim_gateway.estimate import ERROR_SIZE, ESTIMATE_PARAM_SIZE, PROCESSES, error_coefficients, estimate_preset, initial_error
from sim_gateway.raycast import beam_table
from sim_gateway.scene import MOVER_COLUMNS, World
from sim_gateway.vehicle_params import IRIS, PARAM_SIZE
from training import kernels
from training.config import EnvironmentConfig
from training.kernels import Arena, Rules
from training.worlds import WorldPool, WorldSource

_WALLS = 4
_START_TRIES = 40
_START_CLEARANCE_M = 0.4
_SPREAD_END_MARGIN_M = 3.0  # spread starts end this far before the goal


class CorridorVectorEnv(VectorEnv):
    """``num_envs`` corridors. Observations float32 [N, 190] as ``layout`` says; actions float32 [N, 4] in SI units.

    ``worlds`` defaults to a pool of new corridors from the training seeds. Deterministic: equal seeds, equal flights.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012  # gymnasium's convention

    def __init__(
        self,
        num_envs: int,
        config: EnvironmentConfig | None = None,
        seed: int = 0,
        layout: ObservationLayout | None = None,
        action: ActionLayout | None = None,
        worlds: WorldSource | None = None,
    ) -> None:
        self.config = config or EnvironmentConfig()
        self.layout = layout or default_layout()
        self.action_layout = action or ActionLayout()
        self.num_envs = num_envs
        self.rng = np.random.default_rng(seed)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.layout.size,), np.float32)
        low, high = np.array(self.action_layout.low, np.float32), np.array(self.action_layout.high, np.float32)
        self.single_action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._nominal, self._harsh = (
            estimate_preset(name).as_array() for name in (self.config.estimate.nominal, self.config.estimate.harsh)
        )
        self.rules = make_rules(self.config, self.layout, self.action_layout)
        self.arena = empty_arena(num_envs, self.layout.lidar.beams)
        self.worlds: WorldSource = worlds or WorldPool(self.config, self.rng)
        self._observations = np.zeros((num_envs, self.layout.size), np.float32)
        self._rewards = np.zeros(num_envs)
        self._low, self._high = low.astype(np.float64), high.astype(np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a new episode everywhere. With ``seed`` the noise and the choice of corridors start over from it."""
        if seed is not None:
            self.rng = np.random.default_rng(seed)
            if isinstance(self.worlds, WorldPool):
                self.worlds = WorldPool(self.config, self.rng)
        self.arena.active[:] = True
        for i in range(self.num_envs):
            self._begin(i)
        return self.last_observations, {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One 50 ms tick of every environment."""
        return self.step_held(actions, 1)

    def step_held(
        self, actions: NDArray[np.float32], hold: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """One decision held for ``hold`` ticks (turned by the new yaw at every tick). Raises ValueError on NaN actions."""
        self.decide(actions, hold)
        outcome = np.where(self.arena.active, self.arena.outcome, kernels.RUNNING)
        truncated = outcome == kernels.TIME_OUT
        terminated = (outcome != kernels.RUNNING) & ~truncated
        info = self._episode_info(outcome)
        for i in np.flatnonzero(outcome):
            self._begin(int(i))
        return self.last_observations, self.last_rewards, terminated, truncated, info

    def decide(self, actions: NDArray[np.floating[Any]], hold: int) -> None:
        """`step_held` without its answer and without new episodes: the state is then in ``arena``. Raises ValueError on NaN."""
        clipped = np.clip(np.asarray(actions, dtype=np.float64), self._low, self._high)
        if not np.isfinite(clipped).all():
            raise ValueError("actions hold NaN")
        kernels.step_all(self.arena, self.rules, clipped, hold, self.rng, self._observations, self._rewards)

    @property
    def last_observations(self) -> NDArray[np.float32]:
        """A copy of the newest observations [N, 190]."""
        return self._observations.copy()

    @property
    def last_rewards(self) -> NDArray[np.float64]:
        """A copy of the rewards [N] of the last decision."""
        return self._rewards.copy()

    def _episode_info(self, outcome: NDArray[np.int64]) -> dict[str, Any]:
        arena, ended = self.arena, np.flatnonzero(outcome)
        sums = arena.terms[arena.active].sum(axis=0)
        info: dict[str, Any] = {
            "reward_terms": dict(zip(kernels.TERM_NAMES, sums.tolist(), strict=True)),
            "ended": ended,
            "outcomes": [kernels.OUTCOME_NAMES[outcome[i]] for i in ended],
            "episode_ticks": arena.ticks[ended].tolist(),
            "episode_return": arena.episode[ended, kernels.RETURN].tolist(),
            "path_length_m": arena.episode[ended, kernels.PATH_LENGTH].tolist(),
            "min_clearance_m": arena.episode[ended, kernels.MIN_CLEARANCE].tolist(),
        }
        if len(ended):
            info["final_obs"] = self._observations.copy()
            info["_final_obs"] = outcome != kernels.RUNNING
        return info

    def _begin(self, i: int) -> None:
        """Fill row i with a new episode."""
        arena, rng = self.arena, self.rng
        world = self.worlds.next_world(i, rng)
        fixed, movers = len(world.static_boxes), len(world.movers)
        arena.boxes[i, :fixed] = world.static_boxes
        arena.movers[i, :movers] = world.mover_rows
        arena.box_count[i] = fixed, movers
        arena.goal[i] = world.goal
        self._randomise(i)
        position = self._start_position(world)
        arena.start[i] = position
        yaw = world.start_yaw_rad + rng.uniform(-1.0, 1.0) * self.config.start_yaw_rad
        vehicle.reset_state(arena.vehicle[i], arena.params[i], *position, yaw, True)
        kernels.begin_episode(arena, self.rules, i, rng, self._observations[i])

    def _randomise(self, i: int) -> None:
        """Draw the vehicle, wind, delays and estimate errors of an episode."""
        arena, rng, config = self.arena, self.rng, self.config
        varied = config.vehicle
        arena.params[i] = IRIS.randomised(rng, varied.relative).as_array()
        speed, direction = rng.uniform(*varied.wind_mps), rng.uniform(-math.pi, math.pi)
        arena.wind[i] = speed * math.cos(direction), speed * math.sin(direction), 0.0
        arena.delay[i, 0] = rng.integers(varied.command_delay_steps[0], varied.command_delay_steps[1] + 1)
        arena.delay[i, 1] = rng.integers(varied.scan_age_steps[0], varied.scan_age_steps[1] + 1)
        arena.dropout[i] = rng.uniform(*config.dropout)
        blend = rng.uniform() if rng.uniform() < config.estimate.harsh_share else 0.0
        arena.error_params[i] = (1.0 - blend) * self._nominal + blend * self._harsh
        initial_error(arena.error_params[i], rng.standard_normal(ERROR_SIZE), arena.errors[i])
        error_coefficients(arena.error_params[i], kernels.TICK_S, arena.error_coefficients[i])

    def _start_position(self, world: World) -> tuple[float, float, float]:
        """The world's start at a random altitude, or (a share of episodes) a free point along the corridor."""
        rng, config = self.rng, self.config
        altitude = float(rng.uniform(*config.start_altitude_m))
        if rng.uniform() < config.spread_start_share:
            boxes = world.boxes_at(0.0)
            half = 0.5 * world.width_m - config.vehicle_radius_m - _START_CLEARANCE_M
            for _ in range(_START_TRIES):
                point = np.array(
                    [rng.uniform(world.start[0], world.goal[0] - _SPREAD_END_MARGIN_M), rng.uniform(-half, half), altitude]
                )
                if clearance_m(boxes, point, config.vehicle_radius_m) > _START_CLEARANCE_M:
                    return float(point[0]), float(point[1]), altitude
        return world.start[0], world.start[1], altitude

    def state(self) -> dict[str, Any]:
        """Everything needed to go on exactly here: arrays, generator and corridor pool."""
        state: dict[str, Any] = {"arena": {name: array.copy() for name, array in self.arena._asdict().items()}}
        state |= {"rng": self.rng.bit_generator.state, "observations": self._observations.copy()}
        if isinstance(self.worlds, WorldPool):
            state["pool"] = self.worlds.state()
        return state

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of ``state``; arrays may be numpy arrays or torch tensors."""
        for name, array in self.arena._asdict().items():
            array[...] = np.asarray(state["arena"][name])
        self.rng.bit_generator.state = state["rng"]
        self._observations[...] = np.asarray(state["observations"])
        if isinstance(self.worlds, WorldPool):
            self.worlds.restore(state["pool"])


def make_rules(config: EnvironmentConfig, layout: ObservationLayout, action: ActionLayout) -> Rules:
    """The constants the kernels share."""
    reward = config.reward
    low, high = np.array(action.low), np.array(action.high)
    velocity = layout.channel("velocity")
    return Rules(
        beams=beam_table(beam_bearings_rad(layout.lidar)),
        range_min_m=layout.lidar.range_min_m,
        range_max_m=layout.lidar.range_max_m,
        lidar_noise_m=config.lidar_noise_m,
        goal_radius_m=config.goal_radius_m,
        vehicle_radius_m=config.vehicle_radius_m,
        z_low_m=config.altitude_band_m[0],
        z_high_m=config.altitude_band_m[1],
        tick_limit=round(config.time_limit_s / kernels.TICK_S),
        heading_observation=velocity is not None and velocity.frame == "heading",
        heading_action=action.frame == "heading",
        action_half=0.5 * (high - low),
        scale=reward.scale,
        progress_per_m=reward.progress_per_m,
        goal=reward.goal,
        contact=reward.contact,
        time_per_s=reward.time_per_s,
        proximity_per_s=reward.proximity_per_s,
        proximity_range_m=reward.proximity_range_m,
        smoothness=reward.smoothness,
        blind_motion_per_s=reward.blind_motion_per_s,
        path_deviation_per_m_s=reward.path_deviation_per_m_s,
        velocity_change_per_mps=reward.velocity_change_per_mps,
    )


def empty_arena(count: int, beams: int) -> Arena:
    """Zeroed rows for ``count`` environments."""
    return Arena(
        vehicle=np.zeros((count, vehicle.STATE_SIZE)),
        params=np.zeros((count, PARAM_SIZE)),
        wind=np.zeros((count, 3)),
        boxes=np.zeros((count, _WALLS + MAX_PILLARS + MAX_MOVERS, 6)),
        box_count=np.zeros((count, 2), np.int64),
        movers=np.zeros((count, MAX_MOVERS, MOVER_COLUMNS)),
        start=np.zeros((count, 3)),
        goal=np.zeros((count, 3)),
        errors=np.zeros((count, ERROR_SIZE)),
        error_params=np.zeros((count, ESTIMATE_PARAM_SIZE)),
        error_coefficients=np.zeros((count, 2, PROCESSES)),
        estimate=np.zeros((count, 10)),
        dropout=np.zeros(count),
        delay=np.zeros((count, 2), np.int64),
        command=np.zeros((count, 4)),
        action=np.zeros((count, 4)),
        ticks=np.zeros(count, np.int64),
        episode=np.zeros((count, kernels.EPISODE_COLUMNS)),
        terms=np.zeros((count, len(kernels.TERM_NAMES))),
        ranges=np.zeros((count, beams)),
        outcome=np.zeros(count, np.int64),
        active=np.ones(count, np.bool_),
    )
