"""One flight of the whole stack in the training dynamics: the same pilot and safety filter, the trainer's compiled kernels.

What differs from the trainer's own held-out flights is only who steps the policy: the policy file, the observation builder and
the safety filter, as in flight. As in training, vehicle, command delay and scan age are drawn anew for every episode, and
reaching the goal or touching anything ends it. Estimate errors, wind, lost beams and field of view are those of the split.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from campaigns.lockstep import SUCCESS_RADIUS_M, TICK_S, StackConfig, Unfiltered, count_interventions, mean_jerk, what_was_hit
from campaigns.statistics import EpisodeResult
from flight.tick import Pilot
from flight.trajectory import FlightLog
from policy_export.contract import ActionLayout, default_layout
from policy_export.observation import beam_bearings_rad
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState
from sim_gateway import vehicle
from sim_gateway.paths import shortest_path_length
from sim_gateway.scene import World
from sim_gateway.simulation import WindConfig
from training import kernels
from training.config import EnvironmentConfig, EstimateRandomisation, VehicleRandomisation
from training.environment import CorridorVectorEnv
from training.worlds import FixedWorlds

# Commands leave the safety filter in the corridor frame, within limits of its own: these only have to be wider.
_ANY_COMMAND = ActionLayout(frame="corridor", low=(-5.0, -5.0, -5.0, -5.0), high=(5.0, 5.0, 5.0, 5.0))
_SCANNER = default_layout().lidar
_EDGE_RAD = 1e-6


class TrainingFlight:
    """One vehicle in one world under one policy. `run` flies it to its end; `log` then holds every tick."""

    def __init__(self, world: World, config: StackConfig, runner: PolicyRunner, seed: int | None = None) -> None:
        self.world, self.config = world, config
        drawn = world.seed if seed is None else seed
        self.env = CorridorVectorEnv(1, _environment(world, config), seed=drawn, action=_ANY_COMMAND, worlds=FixedWorlds([world]))
        self.env.reset()
        self._wind = gusts(config.wind, self.env.rng)
        bearings = beam_bearings_rad(_SCANNER)
        self._seen = np.abs(bearings) <= 0.5 * config.lidar.fov_rad + _EDGE_RAD
        self._angles = float(bearings[self._seen][0]), _SCANNER.fov_rad / _SCANNER.beams
        safety = (SafetyFilter if config.filtered else Unfiltered)(config.safety)
        self.pilot = Pilot(runner, safety, CorridorVector(*world.goal), config.arrival_radius_m)
        self.log = FlightLog(max_ticks=self.env.rules.tick_limit + 1)
        self._velocities: list[NDArray[np.float64]] = []
        self._left_fence = self._arrived = False

    def run(self) -> EpisodeResult:
        """Fly until the goal, a contact or the time limit."""
        self.pilot.reset()
        arena = self.env.arena
        while arena.outcome[0] == kernels.RUNNING:
            now_s = float(arena.ticks[0]) * TICK_S
            record = self.pilot.tick(self._scan(now_s), self._state(now_s), now_s)
            self.log.append(record, now_s)
            self._arrived = self._arrived or record.goal_reached
            self._fly(record.sent)
        return self._result()

    def _fly(self, command: SafeCommand) -> None:
        env, velocity = self.env, command.velocity
        env.arena.wind[0] = self._wind()
        env.decide(np.array([[velocity.x, velocity.y, velocity.z, command.yaw_rate_rad_s]]), 1)
        state = env.arena.vehicle[0]
        self._velocities.append(state[vehicle.VEL : vehicle.VEL + 3].copy())
        x, y, z = state[vehicle.POS : vehicle.POS + 3].tolist()
        self._left_fence = self._left_fence or self.config.safety.fence.margin_m(x, y, z) < 0.0

    def _scan(self, now_s: float) -> LidarScan:
        arena = self.env.arena
        ranges = arena.ranges[0, self._seen].astype(np.float32)
        ranges[ranges >= _SCANNER.range_max_m] = np.inf
        measured_s = now_s - float(arena.delay[0, 1]) * kernels.SUBSTEP_S if arena.ticks[0] else now_s
        return LidarScan(
            measured_s, ranges, *self._angles, _SCANNER.range_min_m, _SCANNER.range_max_m, sequence=int(arena.ticks[0])
        )

    def _state(self, now_s: float) -> VehicleState:
        row, truth = self.env.arena.estimate[0].tolist(), self.env.arena.vehicle[0]
        roll, pitch = vehicle.roll_pitch_rad(truth)
        position, velocity, acceleration = (CorridorVector(*row[k : k + 3]) for k in (0, 3, 6))
        return VehicleState(now_s, position, velocity, acceleration, roll, pitch, row[9], float(truth[vehicle.OMEGA + 2]))

    def _result(self) -> EpisodeResult:
        arena, world = self.env.arena, self.world
        outcome, radius, ticks = int(arena.outcome[0]), self.env.config.vehicle_radius_m, int(arena.ticks[0])
        start = (*world.start[:2], self.config.takeoff_height_m)
        shortest_m = shortest_path_length(world.static_boxes, start, world.goal, radius)
        return EpisodeResult(
            seed=world.seed,
            success=outcome == kernels.GOAL,
            arrived=self._arrived or outcome == kernels.GOAL,
            contacts=int(outcome == kernels.CONTACT),
            failure=self._failure(outcome, radius),
            ticks=ticks,
            duration_s=ticks * TICK_S,
            path_length_m=float(arena.episode[0, kernels.PATH_LENGTH]),
            shortest_path_m=max(0.0, shortest_m - SUCCESS_RADIUS_M),
            min_clearance_m=float(arena.episode[0, kernels.MIN_CLEARANCE]),
            mean_jerk_m_s3=mean_jerk(np.array(self._velocities)),
            interventions=count_interventions(self.log),
        )

    def _failure(self, outcome: int, radius_m: float) -> str | None:
        arena = self.env.arena
        if outcome == kernels.CONTACT:
            fixed, count = int(arena.box_count[0, 0]), int(arena.box_count[0].sum())
            x, y, z = arena.vehicle[0, vehicle.POS : vehicle.POS + 3].tolist()
            return what_was_hit(arena.boxes[0, :count], fixed, (x, y, z), radius_m)
        if self._left_fence or outcome == kernels.LEFT_BAND:
            return "fence"
        if outcome == kernels.GOAL:
            return None
        return "missed_goal" if self._arrived else "timeout"


def _environment(world: World, config: StackConfig) -> EnvironmentConfig:
    """The trainer's environment under the split's conditions, from the world's own start; wind is set tick by tick."""
    height, dropout = config.takeoff_height_m, config.lidar.dropout_probability
    return EnvironmentConfig(
        time_limit_s=config.time_limit_s,
        goal_radius_m=SUCCESS_RADIUS_M,
        altitude_band_m=(0.0, world.height_m),
        start_altitude_m=(height, height),
        start_yaw_rad=0.0,
        spread_start_share=0.0,
        dropout=(dropout, dropout),
        lidar_noise_m=config.lidar.noise_sigma_m,
        vehicle=VehicleRandomisation(wind_mps=(0.0, 0.0)),
        estimate=EstimateRandomisation(harsh_share=0.0, nominal=config.estimate),
    )


def gusts(config: WindConfig, rng: np.random.Generator) -> Callable[[], NDArray[np.float64]]:
    """Wind [3], m/s, of the next tick each time: steady plus gusts, as `Simulation` has them but held over a tick."""
    mean = np.array(config.mean_m_s)
    if config.gust_sigma_m_s == 0.0:
        return lambda: mean
    decay = math.exp(-TICK_S / config.gust_time_s)
    gain = config.gust_sigma_m_s * math.sqrt(1.0 - decay * decay)
    gust = config.gust_sigma_m_s * rng.standard_normal(3)

    def blow() -> NDArray[np.float64]:
        gust[:] = decay * gust + gain * rng.standard_normal(3)
        return np.asarray(mean + gust, dtype=np.float64)

    return blow
