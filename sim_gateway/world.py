"""World files (YAML): a seeded random corridor, the paper's fixed world, or boxes written out.

`load_world` is the way in; `World` and `Mover` themselves live in `scene`.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim_gateway.collision import clearance_m
from sim_gateway.corridor import CorridorConfig, CorridorError, Interval, generate_corridor
from sim_gateway.scene import Mover, Point, World, box_row
from strict_yaml import ConfigError, load_config

__all__ = ["BoxSpec", "BoxesConfig", "Mover", "MoverSpec", "PaperConfig", "World", "WorldFile", "load_world", "paper_world"]

PAPER_HEIGHT_M = 10.0
_PAPER_HALF_WIDTH_M = 6.0 - 0.075  # to the inner face of the walls
_PAPER_LENGTH_M = 40.5

Coordinate = Annotated[float, Field(ge=-10_000.0, le=10_000.0)]
Size = Annotated[float, Field(gt=0.0, le=10_000.0)]
Place = tuple[Coordinate, Coordinate, Coordinate]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class BoxSpec(_Strict):
    """A box by centre and size (x, y, z), metres, corridor frame."""

    center: Place
    size: tuple[Size, Size, Size]


class MoverSpec(_Strict):
    """A box that goes back and forth along y: its centre between `y_m[0]` and `y_m[1]`, starting `phase_m` along the way."""

    size: tuple[Size, Size, Size]
    x_m: Coordinate
    z_m: Coordinate
    y_m: Interval
    speed_m_s: float = Field(ge=0.0, le=20.0)
    phase_m: float = Field(default=0.0, ge=0.0)

    @model_validator(mode="after")
    def _check(self) -> MoverSpec:
        if self.y_m[0] > self.y_m[1]:
            raise ValueError("y_m: give the lower turning point first")
        return self


class BoxesConfig(_Strict):
    """A world written out box by box. Walls are ordinary boxes."""

    length_m: float = Field(default=35.0, gt=0.0, le=1000.0)
    width_m: float = Field(default=8.0, gt=0.0, le=100.0)
    height_m: float = Field(default=10.0, gt=0.0, le=100.0)
    boxes: tuple[BoxSpec, ...] = Field(default=(), max_length=1000)
    movers: tuple[MoverSpec, ...] = Field(default=(), max_length=100)
    start: Place
    start_yaw_rad: float = 0.0
    goal: Place


class PaperConfig(_Strict):
    """Choices the authors left open about their fixed world (their speeds are not published).

    `raise_movers`: let the moving pillars span the whole height; as published they end 2 to 5 m up, below the flight height.
    `mover_speed_m_s`: (lowest, highest), drawn per pillar from the seed. `mover_travel_m`: how far each goes to either side.
    """

    moving: bool = True
    raise_movers: bool = True
    mover_speed_m_s: Interval = (0.2, 0.5)
    mover_travel_m: float = Field(default=2.0, gt=0.0, le=6.0)
    start: Place = (4.0, 0.0, 0.0)
    goal: Place = (30.0, 2.0, 7.0)

    @model_validator(mode="after")
    def _check(self) -> PaperConfig:
        if not 0.0 <= self.mover_speed_m_s[0] <= self.mover_speed_m_s[1] <= 20.0:
            raise ValueError("mover_speed_m_s: give two speeds within 0..20, the lower first")
        return self


class WorldFile(_Strict):
    """The world file: `kind` says which one of the sections applies; `seed` draws what is random in it."""

    kind: Literal["corridor", "paper", "boxes"]
    seed: int = Field(default=0, ge=0, lt=2**63)
    corridor: CorridorConfig | None = None
    paper: PaperConfig | None = None
    boxes: BoxesConfig | None = None

    @model_validator(mode="after")
    def _one_section(self) -> WorldFile:
        for name in ("corridor", "paper", "boxes"):
            if name != self.kind and getattr(self, name) is not None:
                raise ValueError(f"{name}: this section needs kind: {name}; the kind is {self.kind}")
        if self.kind == "boxes" and self.boxes is None:
            raise ValueError("boxes: required with kind: boxes; add start, goal and the boxes")
        return self


def load_world(path: str | Path, seed: int | None = None) -> World:
    """The world of a YAML file; `seed`, if given, replaces the file's. Raises `ConfigError` with a one-line message.

    Refused too: a start or goal that lies inside a box.
    """
    config = load_config(path, WorldFile)
    drawn = config.seed if seed is None else seed
    if drawn < 0:
        raise ConfigError(f"{path}: seed {drawn} is negative; give a whole number from 0 up")
    try:
        world = _build(config, drawn)
    except CorridorError as error:
        raise ConfigError(f"{path}: corridor: {error}") from None
    for name, point in (("start", world.start), ("goal", world.goal)):
        if clearance_m(world.boxes_at(0.0), np.array(point), 0.0) <= 0.0:
            raise ConfigError(f"{path}: {name}: {point} lies inside a box; move it or the box")
    return world


def _build(config: WorldFile, seed: int) -> World:
    if config.kind == "corridor":
        return generate_corridor(seed, config.corridor)
    if config.kind == "paper":
        return paper_world(seed, config.paper)
    assert config.boxes is not None  # checked by WorldFile
    return _explicit_world(seed, config.boxes)


def _explicit_world(seed: int, config: BoxesConfig) -> World:
    boxes = np.array([box_row(b.center, b.size) for b in config.boxes]).reshape(-1, 6)
    movers = tuple(Mover(m.size, m.x_m, m.z_m, m.y_m[0], m.y_m[1], m.speed_m_s, m.phase_m) for m in config.movers)
    size = (config.length_m, config.width_m, config.height_m)
    return World("boxes", seed, *size, boxes, movers, config.start, config.start_yaw_rad, config.goal)


class _PaperData(_Strict):
    walls: tuple[BoxSpec, ...]
    static_boxes: tuple[BoxSpec, ...]
    moving_boxes: tuple[BoxSpec, ...]


def paper_world(seed: int = 0, config: PaperConfig | None = None) -> World:
    """The fixed world of the paper's authors; the seed draws speed and phase of its four moving pillars."""
    config = config or PaperConfig()
    data = _PaperData.model_validate_json(files("sim_gateway").joinpath("paper_world.json").read_bytes())
    fixed = [*data.walls, *data.static_boxes]
    if not config.moving:
        fixed += [_raised(box) if config.raise_movers else box for box in data.moving_boxes]
    boxes = np.array([box_row(box.center, box.size) for box in fixed])
    generator = np.random.Generator(np.random.PCG64(seed))
    movers = tuple(_paper_mover(box, config, generator) for box in data.moving_boxes) if config.moving else ()
    size = (_PAPER_LENGTH_M, 2.0 * _PAPER_HALF_WIDTH_M, PAPER_HEIGHT_M)
    return World("paper", seed, *size, boxes, movers, config.start, 0.0, config.goal)


def _raised(box: BoxSpec) -> BoxSpec:
    x, y, _ = box.center
    return BoxSpec(center=(x, y, 0.5 * PAPER_HEIGHT_M), size=(*box.size[:2], PAPER_HEIGHT_M))


def _paper_mover(box: BoxSpec, config: PaperConfig, generator: np.random.Generator) -> Mover:
    box = _raised(box) if config.raise_movers else box
    (x, y, z), reach = box.center, _PAPER_HALF_WIDTH_M - 0.5 * box.size[1]
    low, high = max(y - config.mover_travel_m, -reach), min(y + config.mover_travel_m, reach)
    slow, fast = config.mover_speed_m_s
    speed = slow + (fast - slow) * float(generator.random())
    size: Point = box.size
    return Mover(size, x, z, low, high, speed, 2.0 * (high - low) * float(generator.random()))
