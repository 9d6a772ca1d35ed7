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
from safety.shield import WAY_SHARES, Shield, Surroundings, _reasons
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

    def reasons(self, first: np.ndarray) -> list[tuple[str, float, float]]:
        """Why a command does not pass; known returns and fence come before the unseen."""
        one, shield = first[None], self.shield
        tube = tubes(self.around.start, one, C)
        clear, rooms = shield._tube_clearances(tube, self.around), shield._guard.rooms_m(tube, self.around.start, self.near)
        found = [(why.rule, why.value, why.limit) for why in _reasons(self.allowed, first, clear[0], rooms[0])]
        hidden = shield._sight.hidden(tube, self.around.view, self.hidden)
        if not found and not self.hidden.permits(hidden)[0]:
            found.append(("unseen", float(hidden.soon[0]), float(self.hidden.soon[0])))
        return found

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
    told = [(why.rule, why.value, why.limit) for why in decision.interventions]
    slow = Slow(shield, around)
    speed, limit = math.hypot(wanted.x, wanted.y), slow.limit_m_s()
    slowed = [("return_speed", speed, limit)] if speed > limit else []
    reasons = slowed + slow.reasons(capped(np.array((wanted.x, wanted.y, wanted.z)), limit))
    assert [rule for rule, *_ in told] == [rule for rule, *_ in reasons]
    for mine, theirs in zip(told, reasons, strict=True):
        assert mine[1:] == pytest.approx(theirs[1:], abs=1e-9)
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
    assert WAY_SHARES.tolist() == [[1.0], [0.75], [0.5], [0.25], [0.0]]
    assert min(met[how] for how in ("wanted", "slower", "other", "way out")) >= 2, met


def judged(around: Surroundings, wanted=(0.1, 0.0, 0.0), c=C):
    """The bounds of a tick, and clearances and rooms of braking."""
    shield = Shield(c)
    near = shield._guard.look(around.position, around.start, 9.0)
    bounds = shield._judge(np.array((wanted, (0.0, 0.0, 0.0))), around, near, [])[1]
    clear = shield._tube_clearances(bounds.brake, around)[0]
    return bounds, clear, shield._guard.rooms_m(bounds.brake, around.start, near)[0]


@pytest.mark.parametrize("seed", range(60))
def test_ways_out_are_looked_for_where_braking_presses_points_or_fence(seed):
    """Floor and ceiling, the last two rooms, have no way out sideways."""
    chance = random.Random(seed)
    wanted, around = surroundings(chance, crowded=seed % 2 == 0)
    bounds, clear, rooms = judged(around, (wanted.x, wanted.y, wanted.z))
    assert (bounds.ways is not None) == bool((clear < 0.0).any() or (rooms[:-2] < 0.0).any())
    assert bounds.brake.stop_m.shape == (2, 1, 3)


def standing(x: float, y: float, z: float = 1.8, points=(), extra=()) -> Surroundings:
    """A vehicle that stands, with its points."""
    _, around = surroundings(random.Random(1), crowded=False)
    found = np.array(points, dtype=float).reshape(-1, 2).T
    start = Start(np.array([(x, y, z)] * 2), np.zeros((2, 3)))
    return Surroundings(*found, np.array(extra, dtype=float), View(around.view.free, found, 0.0), CorridorVector(x, y, z), start)


@pytest.mark.parametrize(
    ("around", "pressed"),
    [
        (standing(15.0, 0.0), False), (standing(15.0, 0.0, 0.5), False), (standing(15.0, 0.0, 3.15), False),
        (standing(18.2, 0.0), True), (standing(12.05, 0.0), True), (standing(15.0, -2.7), True), (standing(13.0, 2.8), True),
        (standing(15.0, 0.0, 1.8, [(15.3, 0.0), (15.0, 0.35)], [0.0, 0.0]), True),
        (standing(15.0, 0.0, 1.8, [(15.9, 0.0), (15.0, 0.9)], [0.0, 0.0]), False),
        (standing(18.2, 0.0, 1.8, [(18.5, 0.0)], [0.0]), True), (standing(18.2, 0.0, 1.8, [(16.5, 0.0)], [0.0]), True),
    ],
)  # fmt: skip
def test_what_presses_a_vehicle_that_stands(around, pressed):
    bounds, _, _ = judged(around)
    assert (bounds.ways is not None) == pressed


def test_met_exactly_a_margin_does_not_press():
    """A point whose extra uses up all there is, and next to nothing more."""
    place, lacking = (15.75, 0.0), float(judged(standing(15.0, 0.0, 1.8, [(15.75, 0.0)], [0.0]))[1][0])
    extra = next(e for e in near_to(lacking) if judged(standing(15.0, 0.0, 1.8, [place], [e]))[1][0] == 0.0)
    assert judged(standing(15.0, 0.0, 1.8, [place], [extra]))[0].ways is None
    assert judged(standing(15.0, 0.0, 1.8, [place], [extra + 1e-12]))[0].ways is not None


def test_as_far_from_the_fence_as_is_kept_to_it_does_not_press():
    """Beside a straight wall at y = 0: a place as far from it as is kept, to the last bit, and a billionth nearer."""
    box = config(fence=Fence(min_m=(11.0, 0.0, 0.4), max_m=(19.0, 6.0, 3.2)))
    y = 0.6 - float(judged(standing(15.0, 0.6), c=box)[2][:-2].min())
    exact = next(one for one in near_to(y) if judged(standing(15.0, one), c=box)[2][:-2].min() == 0.0)
    assert judged(standing(15.0, exact), c=box)[0].ways is None
    assert judged(standing(15.0, exact - 1e-9), c=box)[0].ways is not None


@pytest.mark.parametrize(("y", "speed", "pressed"), [(0.56, -0.8, False), (0.545, 0.8, True), (0.56, 0.8, False)])
def test_braking_presses_not_what_is_wanted(y, speed, pressed):
    """Standing 1 cm outside of what is kept to a wall at y = 0, or 5 mm inside; wanted is to or from it."""
    box = config(fence=Fence(min_m=(11.0, 0.0, 0.4), max_m=(19.0, 6.0, 3.2)))
    assert (judged(standing(15.0, y), (0.0, speed, 0.0), c=box)[0].ways is not None) == pressed


SPIKE = ((15.0, 0.0), (14.8, -1.5), (15.2, -1.5))


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_a_lone_vertex_beside_the_way_of_braking_presses(turn):
    """Past the tip of a spike, 0.6 m beside it: a corner keeps 0.35 + 0.2 sqrt(2) = 0.633 m, its edges 0.574 m."""
    ring = SPIKE[turn:] + SPIKE[:turn]
    spiked = config(
        fence=Fence(floor_m=0.4, ceiling_m=3.2, inclusion=((9.0, -4.0), (21.0, -4.0), (21.0, 4.0), (9.0, 4.0)), exclusion=(ring,))
    )
    around = standing(15.0, 0.6)
    flying = Start(np.array([(14.85, 0.6, 1.8)] * 2), np.array([(0.5, 0.0, 0.0)] * 2))
    passing = Surroundings(around.x_m, around.y_m, around.extra_m, around.view, around.position, flying)
    bounds, _, rooms = judged(passing, (0.5, 0.0, 0.0), c=spiked)
    assert np.count_nonzero(rooms < 0.0) == 1
    assert bounds.ways is not None


def near_to(value: float) -> list[float]:
    """The next few numbers on either side."""
    return [value + k * math.ulp(value) for k in range(-40, 41)]


def test_the_return_speed_itself_is_not_told_as_too_fast():
    """A little inside a point's margin, on the way out at 0.3 m/s: nothing to change; faster it is cut to that."""
    around = standing(15.0, 0.0, 1.8, [(14.62, 0.0)], [0.0])
    wanted, shield = CorridorVector(0.3, 0.0, 0.0), Shield(C)
    decision = shield.choose(wanted, around, lambda rows: np.ones(len(rows), dtype=bool))
    assert (decision.velocity is wanted, decision.interventions) == (True, ())
    faster = shield.choose(CorridorVector(0.4, 0.0, 0.0), around, lambda rows: np.ones(len(rows), dtype=bool))
    assert faster.velocity == CorridorVector(pytest.approx(0.3), 0.0, 0.0)
    assert [(why.rule, why.value, why.limit) for why in faster.interventions] == [("return_speed", 0.4, 0.3)]
