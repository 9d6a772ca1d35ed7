"""Where the quick judgement's box ends: each side of it by itself, and limits met exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config

from safety.braking import Start
from safety.fence_tube import Room
from safety.frames import CorridorVector
from safety.open_space import TubeBox

BOX = TubeBox((-1.0, -0.5, 0.5), (1.0, 0.75, 1.5))
WIDE = Room(9.0, 9.0, 9.0)


@pytest.mark.parametrize(
    ("place", "furthest_m"),
    [
        ((0.5, 0.25), math.hypot(1.5, 0.75)), ((-0.5, 0.25), math.hypot(1.5, 0.75)), ((-0.5, -0.25), math.hypot(1.5, 1.0)),
        ((0.25, 0.5), math.hypot(1.25, 1.0)), ((3.0, 4.0), math.hypot(4.0, 4.5)), ((-3.0, -4.0), math.hypot(4.0, 4.75)),
    ],
)  # fmt: skip
def test_the_furthest_corner_decides_sideways(place, furthest_m):
    """From any place, inside or outside; as much room as that is not more than that."""
    here = CorridorVector(*place, 1.0)
    assert not BOX.inside(here, Room(furthest_m, 9.0, 9.0), 0.0)
    assert not BOX.inside(here, Room(furthest_m - 0.5, 9.0, 9.0), 0.0)
    assert BOX.inside(here, Room(math.nextafter(furthest_m, 9.0), 9.0, 9.0), 0.0)


@pytest.mark.parametrize(("z", "down_m", "up_m"), [(1.0, 0.75, 0.75), (0.75, 0.5, 1.0), (1.25, 1.0, 0.5), (3.0, 2.75, -1.25)])
def test_heights_need_more_room_than_box_and_climb(z, down_m, up_m):
    """A quarter of a metre is kept to floor and ceiling besides."""
    here = CorridorVector(0.0, 0.0, z)
    assert BOX.inside(here, WIDE, 0.25)
    for room in (Room(9.0, down_m, 9.0), Room(9.0, down_m - 0.25, 9.0), Room(9.0, 9.0, up_m), Room(9.0, 9.0, up_m - 0.25)):
        assert not BOX.inside(here, room, 0.25)
    assert BOX.inside(here, Room(9.0, math.nextafter(down_m, 9.0), math.nextafter(up_m, 9.0)), 0.25)


def test_a_box_can_be_asked_for_the_one_of_another_command():
    start, here = Start(np.zeros((2, 3)), np.zeros((2, 3))), CorridorVector(0.0, 0.0, 0.0)
    wanted = CorridorVector(0.5, 0.0, 0.0)
    assert BOX.around(here, start, wanted, config()) == TubeBox.around(here, start, wanted, config())


def test_all_points_must_be_apart():
    x, y, kept_m = np.array([2.0, 0.0, 3.0]), np.array([0.0, 1.75, 2.75]), np.array([0.5, 0.5, 0.5])
    assert BOX.apart_from(x, y, kept_m)
    assert BOX.apart_from(x[:0], y[:0], kept_m[:0])
    for k in range(3):
        near = kept_m.copy()
        near[k] = 9.0
        assert not BOX.apart_from(x, y, near)
    assert not BOX.apart_from(np.array([2.0]), np.array([0.0]), np.array([1.0]))
