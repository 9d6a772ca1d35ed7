"""The corridor of the task, drawn at random from a seed: walls, pillars, optionally pillars that move, start and goal.

What every corridor guarantees (each is tested):

* same seed and configuration, same world, bit for bit (PCG64, only its plain uniform draws are used);
* pillars are at least `clearance_m` apart edge to edge, and beside each one there is that much room on one side or more;
* no pillar is nearer than `end_clearance_m` to start or goal;
* among the static pillars a way for a disc of `vehicle_radius_m` + `path_margin_m` exists: proven by a search, else redrawn;
* movers keep `clearance_m` along x from every static pillar and from one another, and never come within `end_clearance_m`
  of start or goal. So at every instant a free lane across the corridor lies before and behind each mover and one side of
  it is open: a way exists in every frozen moment. A vehicle that stays in a mover's lane can still be hit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim_gateway.paths import path_exists
from sim_gateway.scene import Mover, Point, World

MAX_PILLARS = 32
MAX_MOVERS = 8
WALL_THICKNESS_M = 0.2
_PLACING_TRIES = 200
_REDRAWS = 100

Interval = tuple[float, float]


class CorridorError(ValueError):
    """The configuration leaves no room for a corridor; the message says what to relax."""


class CorridorConfig(BaseModel):
    """Sizes and limits of the random corridor, SI units. Pairs are (lowest, highest); x along the corridor, y left."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    length_m: float = Field(default=35.0, gt=10.0, le=1000.0, description="from x = 0 to the far end")
    width_m: float = Field(default=8.0, ge=3.0, le=100.0, description="inner width, walls at y = -width/2 and +width/2")
    height_m: float = Field(default=10.0, ge=3.0, le=100.0, description="of walls and pillars; no ceiling")
    end_walls: bool = Field(default=True, description="close both ends, `end_margin_m` outside x = 0 and x = length")
    end_margin_m: float = Field(default=0.5, ge=0.0, le=10.0)
    pillars: tuple[int, int] = (4, 12)
    pillar_width_m: Interval = (0.4, 1.0)
    pillar_x_m: Interval = (4.0, 34.0)
    clearance_m: float = Field(default=1.0, ge=0.0, le=10.0, description="least free distance between two pillars")
    end_clearance_m: float = Field(default=1.5, ge=0.0, le=10.0, description="least free distance from start and goal")
    movers: tuple[int, int] = (0, 0)
    mover_speed_m_s: Interval = (0.2, 0.5)
    mover_travel_m: Interval = (2.0, 6.0)
    vehicle_radius_m: float = Field(default=0.35, gt=0.0, le=2.0)
    path_margin_m: float = Field(default=0.1, ge=0.0, le=2.0)
    start_x_m: Interval = (3.0, 5.0)
    start_y_m: Interval = (-2.0, 2.0)
    start_yaw_rad: Interval = (0.0, 0.0)
    goal_x_m: Interval = (30.0, 34.0)
    goal_y_m: Interval = (-2.0, 2.0)
    goal_z_m: Interval = (1.5, 3.0)

    @model_validator(mode="after")
    def _check(self) -> CorridorConfig:
        for name, value in self:
            if isinstance(value, tuple) and value[0] > value[1]:
                raise ValueError(f"{name}: the lower limit {value[0]} is above the upper one {value[1]}; swap them")
        if self.pillars[0] < 0 or self.pillars[1] > MAX_PILLARS:
            raise ValueError(f"pillars: must lie within 0..{MAX_PILLARS}")
        if self.movers[0] < 0 or self.movers[1] > MAX_MOVERS:
            raise ValueError(f"movers: must lie within 0..{MAX_MOVERS}")
        if min(self.pillar_width_m[0], self.mover_speed_m_s[0], self.mover_travel_m[0]) <= 0.0:
            raise ValueError("pillar_width_m, mover_speed_m_s and mover_travel_m: must be above 0")
        if self.width_m < self.pillar_width_m[1] + 2.0 * max(self.clearance_m, self.vehicle_radius_m + self.path_margin_m):
            raise ValueError("width_m: too narrow for a passage beside the widest pillar; widen it or narrow pillar_width_m")
        self._check_ends()
        return self

    def _check_ends(self) -> None:
        room = self.vehicle_radius_m + self.path_margin_m
        for name, (low, high) in (("start_x_m", self.start_x_m), ("goal_x_m", self.goal_x_m)):
            if low < room or high > self.length_m - room:
                raise ValueError(f"{name}: must stay {room:g} m inside 0..{self.length_m:g}")
        for name, (low, high) in (("start_y_m", self.start_y_m), ("goal_y_m", self.goal_y_m)):
            if max(-low, high) > 0.5 * self.width_m - room:
                raise ValueError(f"{name}: must stay {room:g} m off the walls at +-{0.5 * self.width_m:g}")
        if self.goal_z_m[0] < room or self.goal_z_m[1] > self.height_m:
            raise ValueError(f"goal_z_m: must lie within {room:g}..{self.height_m:g}")


class _Dice:
    """Uniform draws from one PCG64 stream."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.Generator(np.random.PCG64(seed))

    def within(self, limits: Interval) -> float:
        return limits[0] + (limits[1] - limits[0]) * float(self._generator.random())

    def count(self, limits: tuple[int, int]) -> int:
        return min(limits[0] + int((limits[1] - limits[0] + 1) * float(self._generator.random())), limits[1])


_Square = tuple[float, float, float]  # centre x, centre y, half width


def generate_corridor(seed: int, config: CorridorConfig | None = None) -> World:
    """The corridor of this `seed` (>= 0). Raises `CorridorError` if the configuration leaves too little room.

    Takes well under a millisecond on average once compiled.
    """
    config = config or CorridorConfig()
    dice = _Dice(seed)
    walls = wall_boxes(config)
    for _ in range(_REDRAWS):
        start: Point = (dice.within(config.start_x_m), dice.within(config.start_y_m), 0.0)
        goal: Point = (dice.within(config.goal_x_m), dice.within(config.goal_y_m), dice.within(config.goal_z_m))
        yaw = dice.within(config.start_yaw_rad)
        movers = _draw_movers(dice, config, start, goal)
        pillars = None if movers is None else _draw_pillars(dice, config, start, goal, movers)
        if movers is None or pillars is None:
            continue
        boxes = np.concatenate([walls, _pillar_boxes(pillars, config.height_m)])
        if path_exists(boxes, (*start[:2], goal[2]), goal, config.vehicle_radius_m + config.path_margin_m):
            size = (config.length_m, config.width_m, config.height_m)
            return World(f"corridor-{seed}", seed, *size, boxes, movers, start, yaw, goal)
    raise CorridorError(
        f"seed {seed}: no corridor found in {_REDRAWS} draws; ask for fewer or narrower pillars or movers, or less clearance"
    )


def wall_boxes(config: CorridorConfig) -> NDArray[np.float64]:
    """The walls [2 or 4, 6]: right, left and, if wanted, the two ends."""
    half, thick, high, margin = 0.5 * config.width_m, WALL_THICKNESS_M, config.height_m, config.end_margin_m
    x0, x1 = -margin, config.length_m + margin
    sides = [[x0, -half - thick, 0.0, x1, -half, high], [x0, half, 0.0, x1, half + thick, high]]
    ends = [
        [x0 - thick, -half - thick, 0.0, x0, half + thick, high],
        [x1, -half - thick, 0.0, x1 + thick, half + thick, high],
    ]
    return np.array(sides + ends if config.end_walls else sides)


def _pillar_boxes(pillars: list[_Square], height_m: float) -> NDArray[np.float64]:
    rows = [[x - half, y - half, 0.0, x + half, y + half, height_m] for x, y, half in pillars]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def _draw_movers(dice: _Dice, config: CorridorConfig, start: Point, goal: Point) -> tuple[Mover, ...] | None:
    """Movers whose lanes keep clear of one another and of both ends; None if they do not fit."""
    movers: list[Mover] = []
    for _ in range(dice.count(config.movers)):
        for _ in range(_PLACING_TRIES):
            half = 0.5 * dice.within(config.pillar_width_m)
            x = dice.within(config.pillar_x_m)
            ends_free = all(abs(x - end[0]) >= half + config.end_clearance_m for end in (start, goal))
            if ends_free and _lane_free(x, half, movers, config.clearance_m):
                movers.append(_draw_motion(dice, config, x, half))
                break
        else:
            return None
    return tuple(movers)


def _lane_free(x: float, half: float, movers: list[Mover] | tuple[Mover, ...], clearance_m: float) -> bool:
    return all(abs(x - mover.x_m) >= half + 0.5 * mover.size_m[0] + clearance_m for mover in movers)


def _draw_motion(dice: _Dice, config: CorridorConfig, x: float, half: float) -> Mover:
    reach = 0.5 * config.width_m - half  # the centre may come this near to either wall
    travel = min(dice.within(config.mover_travel_m), 2.0 * reach)
    low = dice.within((-reach, reach - travel))
    speed, phase = dice.within(config.mover_speed_m_s), dice.within((0.0, 2.0 * travel))
    size = (2.0 * half, 2.0 * half, config.height_m)
    return Mover(size, x, 0.5 * config.height_m, low, low + travel, speed, phase)


def _draw_pillars(
    dice: _Dice, config: CorridorConfig, start: Point, goal: Point, movers: tuple[Mover, ...]
) -> list[_Square] | None:
    pillars: list[_Square] = []
    for _ in range(dice.count(config.pillars)):
        for _ in range(_PLACING_TRIES):
            half = 0.5 * dice.within(config.pillar_width_m)
            y_limit = 0.5 * config.width_m - half
            square = (dice.within(config.pillar_x_m), dice.within((-y_limit, y_limit)), half)
            if _pillar_fits(square, config, start, goal, movers, pillars):
                pillars.append(square)
                break
        else:
            return None
    return pillars


def _pillar_fits(
    square: _Square, config: CorridorConfig, start: Point, goal: Point, movers: tuple[Mover, ...], pillars: list[_Square]
) -> bool:
    x, _, half = square
    ends_free = all(_gap(square, (end[0], end[1], 0.0)) >= config.end_clearance_m for end in (start, goal))
    if not ends_free or not _lane_free(x, half, movers, config.clearance_m):
        return False
    return all(_gap(square, other) >= config.clearance_m for other in pillars)


def _gap(a: _Square, b: _Square) -> float:
    """Distance between the edges of two squares, 0 if they overlap."""
    reach = a[2] + b[2]
    return math.hypot(max(abs(a[0] - b[0]) - reach, 0.0), max(abs(a[1] - b[1]) - reach, 0.0))
