"""What the shield chooses, against judging one candidate after the other by itself."""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import pytest
from safety_plant import config, scan, state

from safety.allowance import Allowance, allowance, held_in
from safety.braking import Start, tubes
from safety.config import Fence
from safety.fence_tube import NearFence, WaysOut
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.lidar import BeamTable, see
from safety.shield import Shield, Surroundings
from safety.sight import Hidden, View

FENCE = Fence(floor_m=0.4, ceiling_m=3.2, inclusion=((12.0, -3.0), (18.5, -2.6), (18.0, 2.8), (15.0, 3.4), (11.5, 2.5)))
C = config(fence=FENCE)


def vector(chance: random.Random, across: float, up: float) -> CorridorVector:
    return CorridorVector(chance.uniform(-across, across), chance.uniform(-across, across), chance.uniform(-up, up))


def surroundings(chance: random.Random, crowded: bool) -> tuple[CorridorVector, Surroundings]:
    """A place in or near the fence, in a map of which half, or only the take-off disc, is seen; points at all distances."""
    x, y, z = 15.0 + chance.uniform(-3.2, 3.2), chance.uniform(-2.6, 2.6), chance.uniform(0.6, 3.0)
    free, fov = FreeSpace(C), chance.choice((math.pi, 2.0 * math.pi))
    reach = np.full(180, chance.choice((np.inf, np.inf, 1.2)), dtype=np.float32)
    free.update(see(scan(reach, fov=fov), state(x=x, y=y, yaw=chance.uniform(-3.0, 3.0)), BeamTable(), C))
    count = chance.choice((1, 4, 9)) if crowded else chance.choice((0, 1))
    away = [(chance.uniform(-3.1, 3.1), chance.uniform(0.36, 1.6)) for _ in range(count)]
    points = np.array([(x + far * math.cos(turn), y + far * math.sin(turn)) for turn, far in away]).reshape(-1, 2).T
    first, speeds = vector(chance, 0.06, 0.02), [vector(chance, 0.5, 0.3) for _ in "sf"]
    begins = np.array([(x + share * first.x, y + share * first.y, z + first.z) for share in (1.0, 1.2)])
    start = Start(begins, np.array([(v.x, v.y, v.z) for v in speeds]))
    extra = np.array([chance.uniform(0.0, 0.1) for _ in range(count)])
    return vector(chance, 0.8, 0.45), Surroundings(*points, extra, View(free, points, 0.0), CorridorVector(x, y, z), start)


@dataclass
class Slow:
    """The shield's judgement, one candidate at a time."""

    shield: Shield
    around: Surroundings
    near: NearFence = field(init=False)
    allowed: Allowance = field(init=False)
    hidden: Hidden = field(init=False)
    ways: WaysOut | None = field(init=False)

    def __post_init__(self) -> None:
        """What braking sets."""
        shield, around = self.shield, self.around
        reach = shield._reach_m(around.start)
        self.near = shield._guard.look(around.position, around.start, reach)
        self.around = around = shield._within_reach(around, reach)
        brake = tubes(around.start, np.zeros((1, 3)), C)
        clear, rooms = shield._tube_clearances(brake, around)[0], shield._guard.rooms_m(brake, around.start, self.near)[0]
        pressed = min(clear.min(initial=1.0), rooms[:-2].min(initial=1.0)) < 0.0
        self.ways = shield._guard.ways_out(brake, self.near)
        points, place = np.array((around.x_m, around.y_m)), np.array((around.position.x, around.position.y))
        self.allowed = allowance(brake, clear, rooms, points, place, self.ways if pressed else None, C)
        self.hidden = shield._sight.hidden(brake, around.view)

    def passes(self, candidate: np.ndarray) -> bool:
        """Whether it keeps to everything."""
        one, shield = candidate[None], self.shield
        tube = tubes(self.around.start, one, C)
        clear, rooms = shield._tube_clearances(tube, self.around), shield._guard.rooms_m(tube, self.around.start, self.near)
        if not self.allowed.permits(one, clear, rooms)[0]:
            return False
        return bool(self.hidden.permits(shield._sight.hidden(tube, self.around.view, self.hidden))[0])

    def limit_m_s(self) -> float:
        """Speed allowed from here."""
        here, shield = self.around.position, self.shield
        apart = [math.dist(p, (here.x, here.y)) for p in self.around.view.near_m.T.tolist()]
        slow = min(apart, default=9.0) - 0.35 < 0.05 or shield._guard.here(here).least_m < 0.0
        return 0.3 if slow or shield._sight.lost(here, self.around.view) else math.inf

    def candidates(self, first: np.ndarray, limit: float) -> list[np.ndarray]:
        """Those that are tried, nearest first."""
        assert self.ways is not None
        plain = self.shield._candidates(first, self.around, self.allowed)
        found = held_in(plain, self.ways, self.allowed.push_m_s, C)
        rows = [capped(row, limit) for row in found]
        for row in rows:
            row[2] = min(max(row[2], self.allowed.sink_m_s), self.allowed.climb_m_s)
        return sorted(rows, key=lambda row: float(((row - first) ** 2).sum()))

    def way_out(self, may_be_sent) -> np.ndarray:
        """As much as may be sent of what leads out of a margin, else of standing still."""
        rest = np.array((0.0, 0.0, min(max(0.0, self.allowed.sink_m_s), self.allowed.climb_m_s)))
        way = np.array((*self.allowed.push_m_s, rest[2]))
        tube = tubes(self.around.start, way[None], C)
        clear = self.shield._tube_clearances(tube, self.around)
        rooms = self.shield._guard.rooms_m(tube, self.around.start, self.near)
        chosen = way if self.allowed.for_the_way_out(C).permits(way[None], clear, rooms)[0] else rest
        return next(share * chosen for share in (1.0, 0.75, 0.5, 0.25, 0.0) if may_be_sent(share * chosen))


def capped(row: np.ndarray, limit: float) -> np.ndarray:
    speed = math.hypot(row[0], row[1])
    share = limit / speed if speed > limit else 1.0
    return np.array((row[0] * share, row[1] * share, row[2]))


def slowly_chosen(slow: Slow, wanted: CorridorVector, may_be_sent) -> tuple[str, np.ndarray]:
    """How it was decided, and the velocity."""
    asked, limit = np.array((wanted.x, wanted.y, wanted.z)), slow.limit_m_s()
    first = capped(asked, limit)
    if slow.passes(first) and math.hypot(wanted.x, wanted.y) <= limit:
        return "wanted", asked
    if slow.passes(first) and may_be_sent(first):
        return "slower", first
    for row in slow.candidates(first, limit):
        if may_be_sent(row) and slow.passes(row):
            return "other", row
    return "way out", slow.way_out(may_be_sent)


@pytest.mark.parametrize("seed", range(90))
def test_the_choice_is_that_of_judging_one_after_the_other(seed):
    chance, shield = random.Random(seed), Shield(C)
    wanted, around = surroundings(chance, crowded=seed % 3 > 0)
    bound, turn = chance.choice((9.0, 0.3, 0.1)), chance.uniform(-3.0, 3.0)
    side = np.array((math.cos(turn), math.sin(turn), 0.0))
    decision = shield.choose(wanted, around, lambda rows: rows @ side <= bound)
    how, expected = slowly_chosen(Slow(shield, around), wanted, lambda row: row @ side <= bound)
    sent = decision.velocity
    assert (sent.x, sent.y, sent.z) == pytest.approx(expected, abs=1e-9), how
    assert (sent is wanted) == (how == "wanted")
    rules = [why.rule for why in decision.interventions]
    assert (rules == []) == (how == "wanted")
    assert decision.fence_margin_m == shield._guard.here(around.position).least_m
    assert decision.clearance_m == shield._clearance_now(around)


def test_choices_of_every_kind_are_met():
    met: Counter[str] = Counter()
    for seed in range(90):
        chance = random.Random(seed)
        wanted, around = surroundings(chance, crowded=seed % 3 > 0)
        bound, turn = chance.choice((9.0, 0.3, 0.1)), chance.uniform(-3.0, 3.0)
        side = np.array((math.cos(turn), math.sin(turn), 0.0))
        met[slowly_chosen(Slow(Shield(C), around), wanted, lambda row, s=side, b=bound: row @ s <= b)[0]] += 1
    assert min(met[how] for how in ("wanted", "slower", "other", "way out")) >= 2, met
