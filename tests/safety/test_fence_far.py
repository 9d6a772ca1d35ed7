"""Far inside the fence the few pieces that can be nearest say the very same as all of them."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from safety.braking import Start
from safety.fence import PolygonFence
from safety.fence_far import WITHIN_M, FarInside
from safety.fence_tube import FenceGuard
from safety.frames import CorridorVector

ROOM = ((0.0, 0.0), (20.0, -2.0), (21.0, 9.0), (11.0, 6.0), (10.0, 14.0), (-2.0, 12.0))
HOLES = (((5.0, 4.0), (7.0, 4.4), (6.0, 6.1)), ((15.0, 2.0), (16.0, 2.2), (15.2, 3.6)))
FENCE = PolygonFence(ROOM, HOLES, 0.3, 0.07)
REACH_M = 0.4


def inside(chance: random.Random) -> np.ndarray:
    """A place with some room to every edge."""
    while True:
        place = np.array((chance.uniform(-2.0, 21.0), chance.uniform(-2.0, 14.0)))
        if FENCE.signed_margin_m(place) > 0.2:
            return place


def far_from(place: np.ndarray) -> FarInside:
    return FarInside.at((float(place[0]), float(place[1])), FENCE.measured(place[None]), 0, FENCE)


@pytest.mark.parametrize("seed", range(200))
def test_the_few_say_what_all_say(seed):
    chance = random.Random(seed)
    place = inside(chance)
    far, turn = far_from(place), chance.uniform(-math.pi, math.pi)
    away = min(0.999 * WITHIN_M, float(FENCE.signed_margin_m(place)) - 0.01) * np.array((math.cos(turn), math.sin(turn)))
    assert far.room_m(tuple((place + away).tolist())) == FENCE.room_m(place + away)
    assert len(far.pieces) < 2 * FENCE.edges.length_m.shape[0]


def test_clear_of_claims_no_more_than_was_measured():
    place = np.array((2.0, 5.0))
    far, edge_m = far_from(place), float(FENCE.signed_margin_m(place))
    assert far.clear_of(edge_m - 1e-3, (2.0, 5.0))
    assert not far.clear_of(edge_m, (2.0, 5.0))
    assert far.clear_of(edge_m - 0.301, (2.0, 5.3))
    assert not far.clear_of(edge_m - 0.299, (2.0, 5.3))
    assert not far.clear_of(0.0, (2.0, 5.0 + WITHIN_M))


@pytest.mark.parametrize("seed", range(20))
def test_a_guard_says_the_same_wherever_it_has_been(seed):
    """Along a way through the room, one guard that remembers and one made anew at each step."""
    chance = random.Random(seed)
    guard, place, aim = FenceGuard(FENCE, 0.0, 3.0), inside(chance), inside(chance)
    for step in np.linspace(0.0, 1.0, 60):
        x, y = (place + step * (aim - place)).tolist()
        begins = np.array(((x + 0.1, y, 1.0), (x, y + 0.15, 1.2)))
        start, here = Start(begins, np.zeros((2, 3))), CorridorVector(x, y, 1.4)
        anew = FenceGuard(FENCE, 0.0, 3.0)
        assert guard.here(here) == anew.here(here)
        kept, fresh = guard.look(here, start, REACH_M), FenceGuard(FENCE, 0.0, 3.0).look(here, start, REACH_M)
        assert kept.outside == fresh.outside
        for name in ("edges", "vertices", "pieces"):
            assert getattr(kept, name).x_m.tolist() == getattr(fresh, name).x_m.tolist()
