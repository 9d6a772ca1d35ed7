"""Where the adversaries fly: fences, pillars, corridors, gaps and dead ends, drawn from a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from campaigns.adversaries.geometry import FenceShape, Place, Ring
from safety.config import Fence, SafetyConfig
from sim_gateway.collision import clearance_m
from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.scene import Mover, World

Array = NDArray[np.float64]
HIGH_M = 10.0
LENGTH_M, HALF_WIDTH_M = 14.0, 5.0
START_CLEARANCE_M = 0.3  # hull to the fence: the invariant holds at the start
START_TO_BOXES_M = 0.5  # at engaging nothing stands unseen within 0.8 m of the vehicle's centre (docs/safety.md)
_FAR = [900.0, 900.0, 0.0, 901.0, 901.0, 1.0]
_TRIES = 2000


@dataclass(frozen=True)
class Scene:
    """A world, its fence, and where the flight starts. `safety` holds the same fence as the filter is told it."""

    name: str
    world: World
    fence: FenceShape
    safety: SafetyConfig
    height_m: float

    @property
    def boxes(self) -> Array:
        """Static boxes [n, 6]."""
        return self.world.static_boxes


CONCAVE: tuple[Ring, ...] = (
    ((0.0, 0.0), (9.0, 0.0), (9.0, 3.0), (3.0, 3.0), (3.0, 8.0), (0.0, 8.0)),
    ((0.0, 0.0), (9.0, 0.0), (9.0, 7.0), (6.0, 7.0), (6.0, 2.5), (3.5, 2.5), (3.5, 7.0), (0.0, 7.0)),
    ((6.0, 0.0), (2.2, 1.6), (1.5, 5.5), (-1.0, 2.5), (-5.0, 3.5), (-2.5, 0.0), (-5.0, -3.5), (-1.0, -2.5), (1.5, -5.5),
     (2.2, -1.6)),
    ((0.0, 0.0), (5.0, 0.0), (5.0, 2.0), (8.0, 2.4), (8.0, 0.0), (13.0, 0.0), (13.0, 6.0), (8.0, 6.0), (8.0, 4.0), (5.0, 3.8),
     (5.0, 6.0), (0.0, 6.0)),
)  # fmt: skip
CUT_OUT: tuple[Ring, ...] = (
    ((1.2, 0.0), (-0.6, 1.0), (-0.6, -1.0)),
    ((1.0, 0.0), (0.0, 1.5), (-1.0, 0.0), (0.0, -1.5)),
    ((1.6, 0.1), (-1.6, 0.1), (-1.6, -0.1), (1.6, -0.1)),
)


class _Builder:
    """Boxes and fence of one scene, drawn from one generator."""

    def __init__(self, random: np.random.Generator, mover_speed_m_s: float) -> None:
        self.random, self.mover_speed_m_s = random, mover_speed_m_s
        self.boxes: list[list[float]] = []
        self.movers: tuple[Mover, ...] = ()
        self.fence = FenceShape.box((0.0, -HALF_WIDTH_M, 0.4), (LENGTH_M, HALF_WIDTH_M, 3.5))

    def pillar(self, x: float, y: float, width: float) -> None:
        half = 0.5 * width
        self.boxes.append([x - half, y - half, 0.0, x + half, y + half, HIGH_M])

    def wall(self, x0: float, y0: float, x1: float, y1: float) -> None:
        self.boxes.append([min(x0, x1), min(y0, y1), 0.0, max(x0, x1), max(y0, y1), HIGH_M])

    def scatter(self, count: int, widths: tuple[float, float], apart_m: float = 0.9) -> None:
        """Pillars at random places of the fence's bounding box, at least `apart_m` from one another."""
        low, high = self.fence.corners.min(axis=0), self.fence.corners.max(axis=0)
        placed: list[tuple[float, float, float]] = []
        for _ in range(20 * count):
            (x, y), width = self.random.uniform(low, high), self.random.uniform(*widths)
            near = any(max(abs(x - a), abs(y - b)) < 0.5 * (width + w) + apart_m for a, b, w in placed)
            if not near:
                placed.append((float(x), float(y), float(width)))
            if len(placed) == count:
                break
        for x, y, width in placed:
            self.pillar(x, y, width)


def _box(build: _Builder) -> None:
    """Nothing but the fence."""


def _pillars(build: _Builder) -> None:
    build.scatter(int(build.random.integers(8, 15)), (0.3, 1.0))


def _poles(build: _Builder) -> None:
    """Thin ones: a beam apart at the sensor's range."""
    build.scatter(int(build.random.integers(10, 20)), (0.1, 0.15))


def _dead_ends(build: _Builder) -> None:
    """Pockets 0.5 to 4 m deep, open to the left or to the right."""
    random = build.random
    for x in (3.0, 8.5):
        deep, wide, thick = random.uniform(0.5, 4.0), random.uniform(1.1, 2.5), 0.2
        y, sign = random.uniform(-2.5, 2.5), random.choice((-1.0, 1.0))
        back, mouth = (x, x + deep) if sign > 0 else (x + deep, x)
        build.wall(back, y - 0.5 * wide - thick, back - sign * thick, y + 0.5 * wide + thick)
        for side in (-1.0, 1.0):
            edge = y + side * 0.5 * wide
            build.wall(back, edge, mouth, edge + side * thick)


def _gaps(build: _Builder) -> None:
    """Walls across with openings of 1.0 to 1.3 m."""
    for x in (3.5, 7.0, 10.5):
        gap, y, thick = build.random.uniform(1.0, 1.3), build.random.uniform(-3.5, 3.5), build.random.uniform(0.1, 0.7)
        build.wall(x, -HALF_WIDTH_M - 1.0, x + thick, y - 0.5 * gap)
        build.wall(x, y + 0.5 * gap, x + thick, HALF_WIDTH_M + 1.0)


def _convex(build: _Builder) -> None:
    """A convex fence of four to seven sides, acute corners among them, and a few pillars."""
    angles = np.sort(build.random.uniform(0.0, 2.0 * math.pi, int(build.random.integers(4, 8))))
    while np.diff(angles, append=angles[0] + 2.0 * math.pi).max() > 2.4 or np.diff(angles).min() < 0.3:
        angles = np.sort(build.random.uniform(0.0, 2.0 * math.pi, len(angles)))
    ring = tuple((7.0 + 7.0 * math.cos(angle), 5.0 * math.sin(angle)) for angle in angles)
    build.fence = FenceShape(ring, 0.4, 3.5)
    build.scatter(int(build.random.integers(0, 5)), (0.3, 0.8))


def _concave(build: _Builder) -> None:
    """An L, a U, a star or a slot, turned, with a few pillars."""
    ring = CONCAVE[int(build.random.integers(len(CONCAVE)))]
    turn = float(build.random.uniform(-math.pi, math.pi))
    build.fence = FenceShape(_turned(ring, turn), 0.4, 3.5)
    build.scatter(int(build.random.integers(0, 4)), (0.3, 0.8))


def _exclusions(build: _Builder) -> None:
    """A box with a triangle, a diamond and a bar cut out, turned at random, and a few pillars."""
    holes = []
    for x, shape in zip((2.5, 7.0, 11.5), CUT_OUT, strict=True):
        turned = _turned(shape, float(build.random.uniform(-math.pi, math.pi)), float(build.random.uniform(0.6, 1.3)))
        y = float(build.random.uniform(-2.0, 2.0))
        holes.append(tuple((x + a, y + b) for a, b in turned))
    build.fence = FenceShape(build.fence.outer, 0.4, 3.5, tuple(holes))
    build.scatter(int(build.random.integers(0, 4)), (0.3, 0.6))


def _turned(ring: Ring, angle: float, scale: float = 1.0) -> Ring:
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    return tuple((c * x - s * y, s * x + c * y) for x, y in ring)


def _movers(build: _Builder) -> None:
    """Pillars that go back and forth at the speed that the filter is told."""
    random, movers = build.random, []
    for x in (3.0, 6.0, 9.0, 12.0):
        low = random.uniform(-HALF_WIDTH_M, -1.0)
        high, phase = low + random.uniform(2.0, 6.0), random.uniform(0.0, 4.0)
        movers.append(Mover((0.6, 0.6, HIGH_M), x, 0.5 * HIGH_M, low, high, build.mover_speed_m_s, phase))
    build.movers = tuple(movers)


_LAYOUTS: dict[str, Callable[[_Builder], None]] = {
    "box": _box,
    "pillars": _pillars,
    "poles": _poles,
    "dead ends": _dead_ends,
    "gaps": _gaps,
    "convex": _convex,
    "concave": _concave,
    "exclusions": _exclusions,
    "movers": _movers,
}
SCENES = ("box", "convex", "concave", "exclusions", "pillars", "poles", "dead ends", "gaps", "corridor")
CORRIDOR = CorridorConfig(pillars=(8, 14))


def make_scene(name: str, random: np.random.Generator, **safety: float) -> Scene:
    """The scene of that name. `safety`: changes of the filter's configuration. Raises `KeyError` for an unknown name."""
    build = _Builder(random, safety.get("obstacle_speed_m_s", 0.0))
    if name == "corridor":
        world = generate_corridor(int(random.integers(5_000_000, 6_000_000)), CORRIDOR)
        build.boxes = world.static_boxes.tolist()
        build.fence = FenceShape.box((-0.5, -4.0, 0.4), (35.5, 4.0, 3.5))
    else:
        _LAYOUTS[name](build)
    boxes = np.array([*build.boxes, _FAR])
    x, y, z = _start(boxes, build.fence, random)
    world = World(
        name=name, seed=0, length_m=100.0, width_m=100.0, height_m=HIGH_M, static_boxes=boxes, movers=build.movers,
        start=(x, y, 0.0), start_yaw_rad=float(random.uniform(-math.pi, math.pi)), goal=(x, y, 2.0),
    )  # fmt: skip
    return Scene(name, world, build.fence, SafetyConfig(fence=told(build.fence), **safety), z)


def told(shape: FenceShape) -> Fence:
    """The fence in the filter's own words."""
    return Fence(floor_m=shape.z_low_m, ceiling_m=shape.z_high_m, inclusion=shape.outer, exclusion=shape.holes)


def _start(boxes: Array, fence: FenceShape, random: np.random.Generator) -> Place:
    """A place clear of everything, half of the time close to something."""
    low, high = fence.corners.min(axis=0), fence.corners.max(axis=0)
    furthest = 0.8 if random.random() < 0.5 else math.inf
    for _ in range(_TRIES):
        (x, y), z = random.uniform(low, high), random.uniform(fence.z_low_m + 0.4, fence.z_high_m - 0.4)
        place = (float(x), float(y), float(z))
        to_boxes, to_fence = clearance_m(boxes, np.array(place), 0.35), fence.margin_m(place, 0.35, 0.1)
        if to_boxes >= START_TO_BOXES_M and to_fence >= START_CLEARANCE_M and min(to_boxes, to_fence) <= furthest:
            return place
    raise ValueError(f"no start found {START_CLEARANCE_M} m clear of everything")
