"""What the quick judgement lets pass, the exact one lets pass too; and it does see the usual case."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from safety_plant import Plant, command, config, scan, state

from safety.braking import Start, slow_after_s, stop_gain_s, tubes
from safety.config import Fence
from safety.fence_tube import Room
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.lidar import BeamTable, see
from safety.open_space import TubeBox, climb_room_m, kept_to_points_m
from safety.shield import Shield, Surroundings
from safety.sight import View

ROOM = Fence(floor_m=0.4, ceiling_m=3.2, inclusion=((12.0, -3.0), (18.5, -2.6), (18.0, 2.8), (15.0, 3.4), (11.5, 2.5)))
HERE = (15.05, 0.05)


class Exact(Shield):
    """Without the quick judgement."""

    def _in_the_open(self, wanted, around, room):
        return False


def vector(chance: random.Random, across: float, up: float) -> CorridorVector:
    return CorridorVector(chance.uniform(-across, across), chance.uniform(-across, across), chance.uniform(-up, up))


def surroundings(chance: random.Random, c, blind: bool) -> tuple[CorridorVector, Surroundings]:
    """A wanted velocity at some place of the room, all or half of it seen, returns at all distances."""
    x, y, z = HERE[0] + chance.uniform(-2.2, 2.2), HERE[1] + chance.uniform(-1.6, 1.6), chance.uniform(0.7, 2.9)
    free = FreeSpace(c)
    kinds = {} if blind else {"beams": 360, "fov": 2.0 * math.pi}
    free.update(see(scan(**kinds), state(x=x, y=y), BeamTable(), c))
    count = chance.choice((0, 1, 5))
    bearings, distances = np.array([(chance.uniform(-3.1, 3.1), chance.uniform(0.4, 2.2)) for _ in range(count)]).reshape(-1, 2).T
    points = np.array((x + distances * np.cos(bearings), y + distances * np.sin(bearings)))
    first = vector(chance, 0.1, 0.02)
    begins = np.array([(x + first.x, y + first.y, z + first.z), (x + 1.2 * first.x, y + 1.2 * first.y, z + first.z)])
    speeds = np.array([[v.x, v.y, v.z] for v in (vector(chance, 0.9, 0.3), vector(chance, 0.9, 0.3))])
    extra = np.array([chance.uniform(0.0, 0.1) for _ in range(count)])
    around = Surroundings(*points, extra, View(free, points, 0.0), CorridorVector(x, y, z), Start(begins, speeds))
    return vector(chance, 0.8, 0.45), around


@pytest.mark.parametrize("changes", [{}, {"obstacle_speed_m_s": 0.4}, {"braking_m_s2": 1.2}, {"margin_m": 0.0}])
def test_the_exact_way_lets_pass_the_same(changes):
    c = config(fence=ROOM, **changes)
    quick, exact, chance = Shield(c), Exact(c), random.Random(7)
    in_the_open = 0
    for k in range(100):
        wanted, around = surroundings(chance, c, blind=k % 4 == 0)
        anything = lambda few: np.ones(len(few), dtype=bool)  # noqa: E731
        decided = quick.choose(wanted, around, anything)
        assert decided == exact.choose(wanted, around, anything)
        in_the_open += quick._in_the_open(wanted, around, quick._guard.here(around.position))
    assert 5 <= in_the_open < 95


def test_a_flight_is_the_same_with_and_without():
    c, boxes = config(), np.array([(6.3, -0.4, 6.7, 0.2), (6.0, 2.1, 6.4, 2.5)])
    quick, slow, plant = SafetyFilter(c), SafetyFilter(c), Plant(boxes=boxes, x=0.0)
    slow._shield = Exact(c)
    for _ in range(160):
        seen = plant.estimate(), plant.scan(), plant.time_s
        sent, verdict = quick.apply(command(0.8, 0.1), *seen)
        assert (sent, verdict) == slow.apply(command(0.8, 0.1), *seen)
        plant.fly(sent)


@pytest.mark.parametrize("seed", range(100))
def test_the_box_holds_vehicle_and_tubes(seed):
    chance = random.Random(seed)
    c = config(braking_m_s2=chance.choice((1.0, 2.0)))
    _, around = surroundings(chance, c, blind=False)
    wanted = vector(chance, 1.2, 0.5)
    box = TubeBox.around(around.position, around.start, wanted, c)
    both = tubes(around.start, np.array([(wanted.x, wanted.y, wanted.z), (0.0, 0.0, 0.0)]), c)
    p = around.position
    places = np.concatenate((both.turn_m.reshape(-1, 3), both.stop_m.reshape(-1, 3), around.start.position_m, [(p.x, p.y, p.z)]))
    assert (places >= box.low_m).all()
    assert (places <= box.high_m).all()


@pytest.mark.parametrize("speed", [-0.9, 0.9, 1.6])
def test_in_steady_flight_the_box_ends_with_the_tube(speed):
    start, c = Start(np.array([(5.0, 1.0, 2.0)] * 2), np.array([(speed, 0.0, 0.0)] * 2)), config()
    stop = tubes(start, np.array([(speed, 0.0, 0.0)]), c).stop_m[0, 0]
    box = TubeBox.around(CorridorVector(5.0, 1.0, 2.0), start, CorridorVector(speed, 0.0, 0.0), c)
    assert box.low_m == pytest.approx((min(5.0, stop[0]) - 1e-6, 1.0 - 1e-6, 2.0 - 1e-6), abs=1e-12)
    assert box.high_m == pytest.approx((max(5.0, stop[0]) + 1e-6, 1.0 + 1e-6, 2.0 + 1e-6), abs=1e-12)


def resting(x: float = 0.0) -> TubeBox:
    """Two metres long, one wide and one high around the place (x, 0, 1)."""
    return TubeBox((x - 1.0, -0.5, 0.5), (x + 1.0, 0.5, 1.5))


@pytest.mark.parametrize(
    ("place", "gap"), [((1.4, 0.0), 0.4), ((-1.3, 0.1), 0.3), ((0.2, 0.9), 0.4), ((0.0, -0.8), 0.3), ((1.3, 0.9), 0.5)]
)
def test_points_are_apart_by_their_distance_from_the_box(place, gap):
    x, y = np.array([place[0], 50.0]), np.array([place[1], 50.0])
    assert resting().apart_from(x, y, np.array([gap - 1e-9, 1.0]))
    assert not resting().apart_from(x, y, np.array([gap + 1e-9, 1.0]))
    assert not resting().apart_from(np.zeros(1), np.zeros(1), np.zeros(1))


def test_the_box_is_inside_by_its_furthest_corner_and_its_heights():
    here, corner = CorridorVector(0.2, 0.1, 1.1), math.hypot(1.2, 0.6)
    assert resting().inside(here, Room(corner + 1e-9, 0.71, 0.51), 0.1)
    assert not resting().inside(here, Room(corner, 0.71, 0.51), 0.1)
    assert not resting().inside(here, Room(corner + 1e-9, 0.7 - 1e-9, 0.51), 0.1)
    assert not resting().inside(here, Room(corner + 1e-9, 0.71, 0.5 - 1e-9), 0.1)
    assert resting().inside(CorridorVector(-0.2, -0.1, 1.1), Room(corner + 1e-9, 0.71, 0.51), 0.1)


def test_what_is_kept_is_hull_margin_and_all_errors():
    c, moving = config(), config(obstacle_speed_m_s=0.5)
    still_m = c.keep_out_m + 0.05 * (0.2 + 0.05 + 0.6)
    assert kept_to_points_m(resting(), c) == pytest.approx(still_m + 1e-6, abs=1e-12)
    slow_s = float(slow_after_s(math.sqrt(4.0 + 1.0 + 1.0), moving))
    assert kept_to_points_m(resting(), moving) == pytest.approx(still_m + 0.5 * (0.25 + slow_s) + 1e-6, abs=1e-12)
    for up in (-0.3, 0.3):
        assert climb_room_m(CorridorVector(1.0, 1.0, up), c) == pytest.approx(0.3 * stop_gain_s(c) + 1e-6, abs=1e-12)


def test_a_place_that_is_not_a_number_is_not_apart():
    box = TubeBox((0.0, 0.0, 1.0), (1.0, 1.0, 2.0))
    far, kept_m = np.array([9.0, 9.0]), np.array([1.0, 1.0])
    assert box.apart_from(far, far, kept_m)
    assert not box.apart_from(np.array([9.0, np.nan]), far, kept_m)
    assert not box.apart_from(far, far, np.array([1.0, np.nan]))
