"""The other half of safety: a vehicle that wants to leave must get out. Dead ends, phantoms, narrow gaps, bad starts, timed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from campaigns.adversaries.disturbance import draw_conditions
from campaigns.adversaries.flight import Duel
from campaigns.adversaries.geometry import FenceShape
from campaigns.adversaries.policies import FAST_M_S, View, command, towards
from campaigns.adversaries.pool import spread
from campaigns.adversaries.scenes import HIGH_M, Scene, told
from campaigns.lockstep import TICK_S
from safety.config import SafetyConfig
from safety.filter import SafetyFilter
from safety.messages import LidarScan, VelocityCommand
from sim_gateway.scene import World

SEEDS = 6
AREA = FenceShape.box((0.0, -5.0, 0.4), (14.0, 5.0, 3.5))
BACK_X_M, POCKET_WIDTH_M = 9.0, 1.3
LEAVING_M_S = 0.5  # backwards, as the policy's own limit
SLOW_M_S = 0.25  # bounds are distance at this speed, and a few seconds to begin with
PATIENCE_S = 6.0
PHANTOM_NOISE_M = 0.005  # the same to the last bit from scan to scan, in motion, would be a frozen scan (L2), rightly refused
Boxes = list[tuple[float, float, float, float]]


@dataclass(frozen=True)
class Escape:
    """A place to get out of. `enter_s`: flown in first, not timed. `out`: whether it has left; `way_m`: how far that is."""

    name: str
    boxes: Boxes
    start: tuple[float, float]
    yaw_rad: float
    leave: Callable[[View], VelocityCommand]
    out: Callable[[View], bool]
    way_m: float
    enter_s: float = 0.0
    alter: Callable[[LidarScan, float], LidarScan] | None = None

    @property
    def bound_s(self) -> float:
        """In time means within this."""
        return PATIENCE_S + self.way_m / SLOW_M_S

    def scene(self) -> Scene:
        """The place as a scene."""
        rows = [(x0, y0, 0.0, x1, y1, HIGH_M) for x0, y0, x1, y1 in self.boxes] or [(900.0, 900.0, 0.0, 901.0, 901.0, 1.0)]
        world = World(
            name=self.name, seed=0, length_m=100.0, width_m=100.0, height_m=HIGH_M, static_boxes=np.array(rows), movers=(),
            start=(*self.start, 0.0), start_yaw_rad=self.yaw_rad, goal=(1.0, 1.0, 2.0),
        )  # fmt: skip
        return Scene(self.name, world, AREA, SafetyConfig(fence=told(AREA)), 2.0)

    def fly(self, seed: int, safety: type[SafetyFilter] = SafetyFilter) -> tuple[float | None, bool]:
        """Seconds until it was out, None if never; and whether nothing was touched on the way."""
        random, scene = np.random.default_rng(seed), self.scene()
        conditions = draw_conditions(random, scene.safety)
        duel = Duel(scene, conditions, seed, safety=safety(scene.safety))
        duel.alter = self.alter
        left: list[float] = []
        entered = round(self.enter_s / TICK_S)

        def policy(view: View) -> VelocityCommand:
            if view.tick < entered:
                return command(FAST_M_S, max(-1.0, min(1.0, -view.place[1])), 0.0, 0.0)
            if not left and self.out(view):
                left.append((view.tick - entered) * TICK_S)
            return self.leave(view)

        outcome = duel.fly(policy, entered + round(self.bound_s / TICK_S))
        return (left[0] if left else None), outcome.clearance_m > 0.0


def _backwards(view: View) -> VelocityCommand:
    return command(-LEAVING_M_S, 0.0, 0.0, 0.0)


def _forwards(view: View) -> VelocityCommand:
    return command(1.0, 0.0, 0.0, 0.0)


def _turn_and_go(view: View) -> VelocityCommand:
    """Turn on the spot, then out forwards, steering back to the middle."""
    off = math.remainder(math.pi - view.yaw_rad, 2.0 * math.pi)
    speed = 1.0 if abs(off) < 0.3 else 0.0
    return command(-speed, 0.5 * max(-1.0, min(1.0, -view.place[1])) * speed, 0.0, max(-1.0, min(1.0, 2.0 * off)))


def _through(view: View) -> VelocityCommand:
    """To the middle of the gap, then on."""
    x, y, _ = view.place
    ahead = 1.0 if abs(y) < 0.1 or x < BACK_X_M - 2.5 else 0.1
    return command(ahead, max(-0.5, min(0.5, -y)), 0.0, 0.0)


def _home(view: View) -> VelocityCommand:
    return towards(view, np.array((7.0, 0.0)) - view.place[:2], speed=1.0)


def _dead_end(deep_m: float, leave: Callable[[View], VelocityCommand], how: str, wide_m: float = POCKET_WIDTH_M) -> Escape:
    mouth, half = BACK_X_M - deep_m, 0.5 * wide_m
    walls = [
        (BACK_X_M, -half - 0.2, BACK_X_M + 0.2, half + 0.2),
        (mouth, half, BACK_X_M, half + 0.2),
        (mouth, -half - 0.2, BACK_X_M, -half),
    ]
    start, wanted = mouth - 1.0, mouth - 0.5
    size = f"{deep_m:g} m deep" if wide_m == POCKET_WIDTH_M else f"{deep_m:g} m deep and {wide_m:g} m wide"
    return Escape(
        f"dead end {size}, left {how}", walls, (start, 0.0), 0.0, leave, lambda view: view.place[0] < wanted,
        way_m=deep_m + 0.5, enter_s=(deep_m + 1.0) / 0.8 + 2.0,
    )  # fmt: skip


def _phantom(
    name: str, range_m: float, until_s: float, leave: Callable[[View], VelocityCommand], out: Callable[[View], bool]
) -> Escape:
    """Returns ahead that nothing causes, in 12 degrees: too few for the sudden emptiness afterwards to be a fault."""

    def alter(scan: LidarScan, now_s: float) -> LidarScan:
        if now_s >= until_s:
            return scan
        ranges = scan.ranges_m.copy()
        ranges[84:96] = range_m + PHANTOM_NOISE_M * np.random.default_rng(scan.sequence).standard_normal(12)
        return replace(scan, ranges_m=ranges)

    return Escape(f"phantom {name}", [], (7.0, 0.0), 0.0, leave, out, way_m=1.0, alter=alter)


def _escapes() -> list[Escape]:
    deep = (0.5, 1.0, 2.0, 3.0)
    ends = [_dead_end(d, leave, how) for d in deep for leave, how in ((_backwards, "backwards"), (_turn_and_go, "turned"))]
    wall = [(BACK_X_M, -4.0, BACK_X_M + 0.3, 4.0)]
    gap = [(BACK_X_M, -5.0, BACK_X_M + 0.3, -0.5), (BACK_X_M, 0.5, BACK_X_M + 0.3, 5.0)]
    beside = BACK_X_M - 0.35
    return [
        *ends,
        _dead_end(2.0, _turn_and_go, "turned", wide_m=1.0),  # backwards that is too narrow: docs/safety.md, residual risks
        _phantom("at the hull that stays, backwards", 0.36, 99.0, _backwards, _past(-1.0)),
        _phantom("at the hull for 0.2 s, forwards", 0.36, 0.2, _forwards, _past(1.0)),
        _phantom("inside the hull for 0.2 s, forwards", 0.2, 0.2, _forwards, _past(1.0)),
        Escape("gap of 1.0 m", gap, (5.0, 0.4), 0.0, _through, lambda view: view.place[0] > BACK_X_M + 1.0, 5.0),
        Escape("start 1 cm from a wall ahead, turned", wall, (beside - 0.01, 0.0), 0.0, _turn_and_go, _past(-0.5, beside), 0.5),
        Escape(
            "start 1 cm from a wall at the side, turned", wall, (beside - 0.01, 0.0), 1.57, _turn_and_go, _past(-0.5, beside), 0.5
        ),
        Escape("start 1 cm from a wall behind", wall, (beside - 0.01, 0.0), math.pi, _backwards, _past(-0.5, beside), 0.5),
        Escape("start 0.2 m outside the fence", [], (7.0, 4.85), -1.57, _home, lambda view: view.place[1] < 4.2, 0.7),
    ]


def _past(way_m: float, begin_m: float = 7.0) -> Callable[[View], bool]:
    """Whether x has come `way_m` from its begin."""
    return lambda view: (view.place[0] - begin_m) * math.copysign(1.0, way_m) > abs(way_m)


ESCAPES = {escape.name: escape for escape in _escapes()}


def fly_escape(item: tuple[str, int]) -> tuple[str, float | None, bool]:
    """One escape by name and seed: its name, its time, whether nothing was touched."""
    name, seed = item
    return name, *ESCAPES[name].fly(seed)


def run_liveness(seed: int, jobs: int) -> list[dict[str, Any]]:
    """Every escape with `SEEDS` seeds: the slowest time, and whether all were in time."""
    flown = list(spread(fly_escape, [(name, seed + i) for name in ESCAPES for i in range(SEEDS)], jobs))
    rows = []
    for name, escape in ESCAPES.items():
        mine = [(time_s, clear) for its, time_s, clear in flown if its == name]
        times = [time_s for time_s, _ in mine if time_s is not None]
        rows.append({
            "name": name,
            "flights": SEEDS,
            "left": len(times),
            "untouched": sum(clear for _, clear in mine),
            "slowest_s": round(max(times), 2) if len(times) == SEEDS else None,
            "bound_s": escape.bound_s,
            "passed": len(times) == SEEDS and all(clear for _, clear in mine),
        })  # fmt: skip
    return rows
