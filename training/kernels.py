"""One compiled step over all environments: vehicle, contact, scan, estimate, observation and reward. Serial on purpose.

Every environment is one row of each array in `Arena`; the loop over rows is inside the compiled code, so a decision of 256
environments is one call. Frames: corridor (x along, y left, z up) unless a name says heading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_gateway import vehicle
from sim_gateway.collision import clearance_m
from sim_gateway.estimate import (
    ACCELERATION_SIGMA,
    ATTITUDE_ERROR,
    ERROR_SIZE,
    POSITION_BIAS,
    POSITION_ERROR,
    VELOCITY_ERROR,
    step_error,
)
from sim_gateway.raycast import cast_beams
from sim_gateway.scene import place_movers

F64 = NDArray[np.float64]

# Only the two entry points are cached, under a stamp of all sources: numba would not notice a change in another file.

SUBSTEP_S = 0.004
TICK_S = 0.05
RATE_HZ = 20.0
SUBSTEPS_PER_TWO_TICKS = 25  # 20 Hz ticks of 50 ms hold 12.5 substeps: 12 and 13 in turn
CONTACT_CHECK_SUBSTEPS = 4  # 16 ms: at 1.1 m/s the vehicle moves 18 mm between checks

# outcomes
RUNNING, GOAL, CONTACT, LEFT_BAND, TIME_OUT = range(5)
OUTCOME_NAMES = ("running", "goal", "contact", "left_band", "time_out")

# reward terms, columns of `Arena.terms`
PROGRESS, GOAL_BONUS, CONTACT_COST, TIME, PROXIMITY, SMOOTHNESS, BLIND_MOTION, PATH_DEVIATION, VELOCITY_CHANGE = range(9)
TERM_NAMES = (
    "progress", "goal", "contact", "time", "proximity", "smoothness", "blind_motion", "path_deviation", "velocity_change",
)  # fmt: skip

# columns of `Arena.episode`
DISTANCE, MIN_CLEARANCE, PATH_LENGTH, RETURN, LAST_VELOCITY = range(5)  # the last one is three columns wide
EPISODE_COLUMNS = 7


class Rules(NamedTuple):
    """What all environments share. Rates are per second; see training.config for the meaning of the reward weights."""

    beams: F64
    range_min_m: float
    range_max_m: float
    lidar_noise_m: float
    goal_radius_m: float
    vehicle_radius_m: float
    z_low_m: float
    z_high_m: float
    tick_limit: int
    heading_observation: bool
    heading_action: bool
    action_half: F64
    scale: float
    progress_per_m: float
    goal: float
    contact: float
    time_per_s: float
    proximity_per_s: float
    proximity_range_m: float
    smoothness: float
    blind_motion_per_s: float
    path_deviation_per_m_s: float
    velocity_change_per_mps: float


class Arena(NamedTuple):
    """All mutable state, one row per environment."""

    vehicle: F64
    params: F64
    wind: F64
    boxes: F64  # [N, M, 6]: fixed boxes, then movers
    box_count: NDArray[np.int64]  # [N, 2]: fixed, movers
    movers: F64  # [N, K, 9]
    start: F64
    goal: F64
    errors: F64  # estimate errors, rows of sim_gateway.estimate
    error_params: F64
    error_coefficients: F64  # [N, 2, 9] for steps of one tick
    estimate: F64  # [N, 10]: position, velocity, acceleration, yaw as the flight stack would see them
    dropout: F64
    delay: NDArray[np.int64]  # [N, 2]: command delay, scan age, in substeps
    command: F64  # [N, 4] the corridor-frame command in force
    action: F64  # [N, 4] the last action, heading frame
    ticks: NDArray[np.int64]
    episode: F64
    terms: F64  # [N, terms] of the last decision, scaled
    ranges: F64  # [N, beams]
    outcome: NDArray[np.int64]
    active: NDArray[np.bool_]


@njit(cache=True)
def _distance(a: F64, b: F64) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@njit(cache=True)
def scan_into(arena: Arena, rules: Rules, i: int, rng: np.random.Generator) -> None:
    """Cast, disturb and clip one scan as the observation wants it: no return is the maximum range, too near is 0."""
    boxes, state = arena.boxes[i], arena.vehicle[i]
    out = arena.ranges[i]
    count = arena.box_count[i, 0] + arena.box_count[i, 1]
    cast_beams(boxes, count, state[0:3], vehicle.rotation(state), rules.beams, rules.range_max_m, out)
    for k in range(out.shape[0]):
        if out[k] < rules.range_max_m:
            if arena.dropout[i] > 0.0 and rng.random() < arena.dropout[i]:
                out[k] = rules.range_max_m
                continue
            value = out[k] + rules.lidar_noise_m * rng.standard_normal()
            value = rules.range_max_m if value >= rules.range_max_m else value
            out[k] = 0.0 if value < rules.range_min_m else value


@njit(cache=True)
def estimate_into(arena: Arena, i: int, advance: bool, rng: np.random.Generator) -> None:
    """Write the estimate the flight stack would see; with `advance` its errors first move on by one tick."""
    state, error, out = arena.vehicle[i], arena.errors[i], arena.estimate[i]
    if advance:
        step_error(error, arena.error_coefficients[i], rng.standard_normal(ERROR_SIZE))
    for k in range(3):
        out[k] = state[vehicle.POS + k] + error[POSITION_ERROR + k] + error[POSITION_BIAS + k]
        out[3 + k] = state[vehicle.VEL + k] + error[VELOCITY_ERROR + k]
        out[6 + k] = state[vehicle.ACC + k] + arena.error_params[i, ACCELERATION_SIGMA + k] * rng.standard_normal()
    yaw = vehicle.yaw_rad(state) + error[ATTITUDE_ERROR + 2]
    out[9] = math.atan2(math.sin(yaw), math.cos(yaw))


@njit(cache=True)
def observe_into(arena: Arena, rules: Rules, i: int, out: NDArray[np.float32]) -> None:
    """The observation as policy_export.observation builds it."""
    estimate, n = arena.estimate[i], arena.ranges.shape[1]
    yaw = estimate[9]
    cos, sin = math.cos(yaw), math.sin(yaw)
    out[:n] = arena.ranges[i]
    for j in range(3):
        if j == 0:
            x, y, z = arena.goal[i, 0] - estimate[0], arena.goal[i, 1] - estimate[1], arena.goal[i, 2] - estimate[2]
        else:
            x, y, z = estimate[3 * j], estimate[3 * j + 1], estimate[3 * j + 2]
        turned = rules.heading_observation or j == 2
        out[n + 3 * j] = cos * x + sin * y if turned else x
        out[n + 3 * j + 1] = -sin * x + cos * y if turned else y
        out[n + 3 * j + 2] = z
    out[n + 9] = yaw


@njit(cache=True)
def _new_command(arena: Arena, rules: Rules, i: int, out: F64) -> None:
    """Turn the action by the estimated yaw, as the flight loop does once per tick."""
    action = arena.action[i]
    out[:] = action
    if rules.heading_action:
        cos, sin = math.cos(arena.estimate[i, 9]), math.sin(arena.estimate[i, 9])
        out[0] = cos * action[0] - sin * action[1]
        out[1] = sin * action[0] + cos * action[1]


@njit(cache=True)
def _judge(arena: Arena, rules: Rules, i: int) -> tuple[int, float]:
    """Outcome at this moment and the clearance (m)."""
    state = arena.vehicle[i]
    position = state[0:3]
    count = arena.box_count[i, 0] + arena.box_count[i, 1]
    clearance = clearance_m(arena.boxes[i, :count], position, rules.vehicle_radius_m)
    if clearance <= 0.0:
        return CONTACT, clearance
    if position[2] < rules.z_low_m or position[2] > rules.z_high_m:
        return LEFT_BAND, clearance
    if _distance(position, arena.goal[i]) <= rules.goal_radius_m:
        return GOAL, clearance
    return RUNNING, clearance


@njit(cache=True)
def _move_boxes(arena: Arena, i: int, time_s: float) -> None:
    movers = arena.box_count[i, 1]
    if movers > 0:
        place_movers(arena.movers[i], movers, time_s, arena.boxes[i, arena.box_count[i, 0] :])


@njit(cache=True)
def fly_tick(arena: Arena, rules: Rules, i: int, scan: bool, rng: np.random.Generator) -> tuple[int, float]:
    """One 50 ms tick of one environment: outcome and smallest clearance (m) seen. With `scan`, the LiDAR is read too."""
    state, params, wind = arena.vehicle[i], arena.params[i], arena.wind[i]
    tick = arena.ticks[i]
    first = (tick * SUBSTEPS_PER_TWO_TICKS) // 2
    substeps = ((tick + 1) * SUBSTEPS_PER_TWO_TICKS) // 2 - first
    scan_at = max(substeps - 1 - arena.delay[i, 1], 0)
    command = np.empty(4)
    _new_command(arena, rules, i, command)
    before = state[0:3].copy()
    velocity_error = arena.errors[i, VELOCITY_ERROR : VELOCITY_ERROR + 3]
    outcome, smallest = RUNNING, np.inf
    for s in range(substeps):
        if s == arena.delay[i, 0]:
            arena.command[i] = command
        in_force = arena.command[i]
        vehicle.step_velocity(state, params, in_force[0:3], in_force[3], wind, velocity_error, 1)
        if scan and s == scan_at:
            _move_boxes(arena, i, (first + s + 1) * SUBSTEP_S)
            scan_into(arena, rules, i, rng)
        if s % CONTACT_CHECK_SUBSTEPS == CONTACT_CHECK_SUBSTEPS - 1 or s == substeps - 1:
            _move_boxes(arena, i, (first + s + 1) * SUBSTEP_S)
            outcome, clearance = _judge(arena, rules, i)
            smallest = min(smallest, clearance)
            if outcome != RUNNING:
                break
    arena.command[i] = command
    arena.ticks[i] = tick + 1
    arena.episode[i, PATH_LENGTH] += _distance(before, state[0:3])
    arena.episode[i, MIN_CLEARANCE] = min(arena.episode[i, MIN_CLEARANCE], smallest)
    estimate_into(arena, i, True, rng)
    if outcome == RUNNING and arena.ticks[i] >= rules.tick_limit:
        outcome = TIME_OUT
    return outcome, smallest


@njit(cache=True)
def _tick_terms(arena: Arena, rules: Rules, i: int, clearance: float) -> None:
    """Add the terms that are paid per second for one tick."""
    terms, state, dt = arena.terms[i], arena.vehicle[i], TICK_S
    terms[TIME] += rules.time_per_s * dt
    if clearance < rules.proximity_range_m:
        near = 1.0 - max(clearance, 0.0) / rules.proximity_range_m
        terms[PROXIMITY] += rules.proximity_per_s * near * near * dt
    yaw = vehicle.yaw_rad(state)
    ahead = math.cos(yaw) * state[3] + math.sin(yaw) * state[4]
    sideways = abs(-math.sin(yaw) * state[3] + math.cos(yaw) * state[4])
    blind = max(sideways - max(ahead, 0.0), 0.0) + max(-ahead, 0.0)
    terms[BLIND_MOTION] += rules.blind_motion_per_s * blind * blind * dt
    if rules.path_deviation_per_m_s != 0.0:
        along_x, along_y = arena.goal[i, 0] - arena.start[i, 0], arena.goal[i, 1] - arena.start[i, 1]
        off = abs(along_x * (state[1] - arena.start[i, 1]) - along_y * (state[0] - arena.start[i, 0]))
        off /= max(math.hypot(along_x, along_y), 1e-6)
        terms[PATH_DEVIATION] += rules.path_deviation_per_m_s * off * dt


@njit(cache=True)
def _end_terms(arena: Arena, rules: Rules, i: int, action: F64, outcome: int) -> None:
    """Add the terms that are paid once per decision."""
    terms = arena.terms[i]
    distance = _distance(arena.vehicle[i, 0:3], arena.goal[i])
    terms[PROGRESS] += rules.progress_per_m * (arena.episode[i, DISTANCE] - distance)
    arena.episode[i, DISTANCE] = distance
    for k in range(4):
        change = (action[k] - arena.action[i, k]) / rules.action_half[k]
        terms[SMOOTHNESS] += rules.smoothness * change * change
    last_velocity, velocity = arena.episode[i, LAST_VELOCITY : LAST_VELOCITY + 3], arena.vehicle[i, 3:6]
    terms[VELOCITY_CHANGE] += rules.velocity_change_per_mps * _distance(velocity, last_velocity)
    last_velocity[:] = velocity
    if outcome == GOAL:
        terms[GOAL_BONUS] += rules.goal
    elif outcome in (CONTACT, LEFT_BAND):
        terms[CONTACT_COST] += rules.contact


@njit(cache=True)
def _decide(arena: Arena, rules: Rules, i: int, action: F64, hold: int, rng: np.random.Generator) -> int:
    """One decision of one environment; returns the outcome and leaves the unscaled terms in `arena.terms`."""
    arena.terms[i] = 0.0
    outcome = RUNNING
    previous = arena.action[i].copy()
    arena.action[i] = action
    for tick in range(hold):
        outcome, clearance = fly_tick(arena, rules, i, tick == hold - 1, rng)
        _tick_terms(arena, rules, i, clearance)
        if outcome != RUNNING:
            break
    if outcome == TIME_OUT and tick < hold - 1:
        scan_into(arena, rules, i, rng)  # the value of the state the episode is cut at needs a fresh scan
    _end_terms(arena, rules, i, previous, outcome)
    return outcome


@njit(cache=True)
def begin_episode(arena: Arena, rules: Rules, i: int, rng: np.random.Generator, observation: NDArray[np.float32]) -> None:
    """First scan, estimate and observation of an episode whose rows have been filled."""
    arena.ticks[i] = 0
    arena.outcome[i] = RUNNING
    arena.command[i] = 0.0
    arena.action[i] = 0.0
    arena.episode[i, DISTANCE] = _distance(arena.vehicle[i, 0:3], arena.goal[i])
    arena.episode[i, MIN_CLEARANCE] = np.inf
    arena.episode[i, PATH_LENGTH] = 0.0
    arena.episode[i, RETURN] = 0.0
    arena.episode[i, LAST_VELOCITY : LAST_VELOCITY + 3] = arena.vehicle[i, 3:6]
    _move_boxes(arena, i, 0.0)
    scan_into(arena, rules, i, rng)
    estimate_into(arena, i, False, rng)
    observe_into(arena, rules, i, observation)


@njit(cache=True)
def step_all(
    arena: Arena, rules: Rules, actions: F64, hold: int, rng: np.random.Generator, observations: NDArray[np.float32], rewards: F64
) -> None:
    """One decision of all active environments: fly `hold` ticks, then scan, observe [N, 190] and reward [N].

    `actions` [N, 4] are in SI units within the limits. Also writes `arena.outcome` and `arena.terms`.
    """
    for i in range(actions.shape[0]):
        if not arena.active[i]:
            continue
        arena.outcome[i] = _decide(arena, rules, i, actions[i], hold, rng)
        observe_into(arena, rules, i, observations[i])
        rewards[i] = 0.0
        for k in range(arena.terms.shape[1]):
            arena.terms[i, k] *= rules.scale
            rewards[i] += arena.terms[i, k]
        arena.episode[i, RETURN] += rewards[i]
