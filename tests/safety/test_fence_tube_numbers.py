"""Tubes against the fence where something is met exactly: edges, corners, reach, and two polygons at once."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safety.braking import Start, Tubes
from safety.fence import Measured, PolygonFence, Ring
from safety.fence_tube import FenceGuard, NearFence, _crossing, _normals
from safety.frames import CorridorVector

HALL: Ring = ((0.0, 0.0), (16.0, 0.0), (16.0, 16.0), (0.0, 16.0))
CORNER: Ring = ((8.0, 8.0), (24.0, 8.0), (24.0, 24.0), (8.0, 24.0))  # an exclusion over the hall's far corner
Place = tuple[float, float]


def guard(*exclusions: Ring, radius_m: float = 0.25) -> FenceGuard:
    """The hall, 4 m high, for a vehicle of 0.25 m: without slack every erosion is its radius."""
    return FenceGuard(PolygonFence(HALL, exclusions, radius_m, 0.0), 0.0, 4.0)


def start_at(place: Place) -> Start:
    return Start(np.tile((*place, 1.0), (2, 1)), np.zeros((2, 3)))


def flat(*places: Place) -> np.ndarray:
    """One place per candidate, the same for both models, 1 m high."""
    return np.tile([(*place, 1.0) for place in places], (2, 1, 1))


def tube_to(*stops: Place, turn: Place | None = None) -> Tubes:
    """Tubes of candidates that stop at places, and turn there or all at one place."""
    return Tubes(flat(*(stops if turn is None else [turn] * len(stops))), flat(*stops))


def at(place: Place) -> CorridorVector:
    return CorridorVector(*place, 1.0)


def around(place: Place, reach_m: float, *exclusions: Ring) -> NearFence:
    return guard(*exclusions).look(at(place), start_at(place), reach_m)


# ---- what is near


@pytest.mark.parametrize(("y", "count"), [(0.75, 0), (math.nextafter(0.75, 0.0), 1)])
def test_what_is_just_out_of_reach_is_not_near(y, count):
    """A reach of 0.5 m and a radius of 0.25 m."""
    assert around((8.0, y), 0.5).edges.length_m.shape == (count,)


def test_far_inside_is_measured_from_where_control_begins():
    """The vehicle is 1.2 m from the wall, its control begins 0.7 m from it, and reaches 0.75 m: the wall is near."""
    fence = guard()
    fence.here(at((8.0, 1.2)))
    near = fence.look(at((8.0, 1.2)), start_at((8.0, 0.7)), 0.5)
    assert near.edges.y_m.tolist() == [0.0]


def test_far_inside_nothing_is_near():
    fence = guard()
    fence.here(at((8.0, 8.0)))
    assert fence.look(at((8.0, 8.0)), start_at((8.0, 7.5)), 0.5).pieces.length_m.shape == (0,)


@pytest.mark.parametrize(("y", "outside"), [(0.0, False), (-1e-9, True)])
def test_who_begins_right_on_an_edge_is_not_outside(y, outside):
    assert around((8.0, y), 0.5).outside == outside


@pytest.mark.parametrize("first_y", [0.25, 0.4, 3.0])
def test_room_now_is_signed_though_the_place_before_was_inside(first_y):
    fence = guard()
    assert fence.here(at((8.0, first_y))).sideways_m == pytest.approx(first_y - 0.25)
    assert fence.here(at((8.0, -0.0625))).sideways_m == pytest.approx(-0.0625 - 0.25)
    assert fence.here(at((8.0, 0.0))).sideways_m == -0.25
    assert fence.here(at((8.0, 0.5))).sideways_m == 0.25


class Counting(PolygonFence):
    """Counts how often everything is measured, which takes a good part of a tick."""

    times = 0

    def measured(self, points: np.ndarray) -> Measured:
        self.times += 1
        return super().measured(points)


@pytest.mark.parametrize("y", [0.5, 0.9, 8.0])
def test_near_a_place_that_was_measured_nothing_is_measured_anew(y):
    fence = Counting(HALL, (), 0.25, 0.0)
    guarded = FenceGuard(fence, 0.0, 4.0)
    for x, times in ((8.0, 1), (8.25, 1), (8.0, 1), (8.5, 2), (8.25, 2)):  # half a metre away it is measured again
        guarded.here(at((x, y)))
        assert fence.times == times


def test_with_nothing_near_ways_out_cost_nothing():
    fence = Counting(HALL, (), 0.25, 0.0)
    guarded = FenceGuard(fence, 0.0, 4.0)
    near = guarded.look(at((8.0, 8.0)), start_at((8.0, 8.0)), 0.5)
    assert guarded.ways_out(tube_to((8.0, 8.0)), near).room_m.shape == (0,)
    assert fence.times == 1


def test_the_pieces_of_the_tick_before_are_kept_as_they_are():
    fence = guard()
    first, same, other = (fence.look(at((x, 1.0)), start_at((x, 1.0)), 1.0) for x in (8.0, 8.1, 15.5))
    assert all(getattr(same, name) is getattr(first, name) for name in ("edges", "vertices", "pieces"))
    assert other.edges.x_m.tolist() == [0.0, 16.0]


# ---- rooms


def rooms(begin: Place, tube: Tubes, reach_m: float) -> np.ndarray:
    """Room to the edge y = 0, to the edge x = 16 and to the rest, per candidate."""
    fence = guard()
    with np.errstate(all="raise"):
        return fence.rooms_m(tube, start_at(begin), fence.look(at(begin), start_at(begin), reach_m))


def test_without_anything_near_only_floor_and_ceiling_count():
    assert rooms((8.0, 8.0), tube_to((8.0, 8.0), (8.5, 8.0)), 0.5).tolist() == [[1.0, 3.0]] * 2


def test_a_way_out_that_begins_right_on_an_edge_crosses_it():
    """A metre outside, to the edge and to everything of its polygon."""
    found = rooms((8.0, 0.0), tube_to((8.0, -1.0)), 0.5)
    assert found[0].tolist() == [-1.25, -1.25, 1.0, 3.0]


def test_a_tube_that_ends_right_on_an_edge_keeps_its_room_to_the_others():
    """While another candidate crosses the wall: the first has 0 - 0.25 at the edge it meets, 4 - 0.25 at the one to the east."""
    found = rooms((12.0, 1.0), tube_to((12.0, 0.0), (12.0, -0.5)), 6.0)
    south, east = found[:, 0], found[:, 1]
    assert south.tolist() == [-0.25, -0.75]
    assert east.tolist() == [3.75, -0.75]


def test_both_models_of_both_ends_count():
    """The nearest of four ends is the fast model's stop."""
    turn, stop = flat((8.0, 3.0)), flat((8.0, 2.0))
    stop[1, 0, 1] = 1.5
    fence, start = guard(), start_at((8.0, 3.0))
    assert fence.rooms_m(Tubes(turn, stop), start, fence.look(at((8.0, 3.0)), start, 4.0))[0, 0] == 1.25


# ---- crossings, along and across one edge of 4 m: across is positive on the allowed side


def crosses(a: Place, b: Place) -> bool:
    """Whether the way from a to b, each (along, across), crosses the edge."""
    edge = guard().look(at((1.0, 1.0)), start_at((1.0, 1.0)), 1.0).edges.taken(np.array((True, False)))
    values = [np.array([value]) for value in (*a, *b)]
    with np.errstate(all="raise"):
        found = _crossing(edge, *values)
    assert found.dtype == np.bool_
    return bool(found[0])


@pytest.mark.parametrize(
    ("a", "b", "crossed"),
    [
        ((8.0, 1.0), (8.0, -1.0), True),
        ((8.0, -1.0), (8.0, 1.0), True),
        ((8.0, 1.0), (8.0, 0.0), False),  # touches from inside
        ((8.0, 0.0), (8.0, 1.0), False),
        ((8.0, 0.0), (8.0, -1.0), True),  # the edge itself is still inside
        ((8.0, -1.0), (8.0, 0.0), True),
        ((0.0, 1.0), (0.0, -1.0), True),  # right through its first and its last point
        ((16.0, 1.0), (16.0, -1.0), True),
        ((-1e-9, 1.0), (-1e-9, -1.0), False),
        ((16.1, 1.0), (16.1, -1.0), False),
        ((-1.0, 1.0), (2.0, -2.0), True),  # a third of the way to 2: right at the begin
        ((-1.5, 1.0), (1.0, -1.0), False),
        ((15.0, 3.0), (19.0, -1.0), False),
    ],
)
def test_only_a_way_through_the_edge_itself_crosses_it(a, b, crossed):
    assert crosses(a, b) == crossed


def test_unchanged_sides_are_never_divided_by():
    """One way crosses, the other runs along the edge at no distance."""
    edge = guard().look(at((1.0, 1.0)), start_at((1.0, 1.0)), 1.0).edges.taken(np.array((True, False)))
    along, across = np.array([[1.0], [1.0]]), np.array([[1.0], [0.5]])
    with np.errstate(all="raise"):
        found = _crossing(edge, along, across, along, np.array([[-1.0], [0.5]]))
    assert found.tolist() == [[True], [False]]


# ---- ways out


def ways(place: Place, reach_m: float, *exclusions: Ring) -> list[tuple[float, float, float]]:
    """Normal and room of each way out for a vehicle that stands."""
    fence = guard(*exclusions)
    with np.errstate(all="raise"):
        found = fence.ways_out(tube_to(place), fence.look(at(place), start_at(place), reach_m))
    return [(*normal, room) for normal, room in zip(found.normals.T.tolist(), found.room_m.tolist(), strict=True)]


def test_there_is_no_way_out_of_nothing():
    assert ways((8.0, 8.0), 0.5) == []


def test_right_on_an_edge_the_other_pieces_count_too():
    """Half way along: four edges and four corners within reach."""
    found = ways((8.0, 0.0), 32.0)
    assert sorted(room for _, _, room in found[:4]) == [-0.25, 7.75, 7.75, 15.75]
    assert [room for _, _, room in found[4:]] == pytest.approx([7.75, 7.75, math.hypot(8, 16) - 0.25, math.hypot(8, 16) - 0.25])
    assert found[0][:2] == (0.0, 1.0)


def breached(place: Place) -> list[tuple[float, float, float]]:
    return [way for way in ways(place, 32.0, CORNER) if way[2] < -0.25]


def test_of_each_breached_polygon_its_own_nearest_edge_counts():
    """In the exclusion, 1 m from the hall's wall and 4 m from the southern edge of the exclusion: back over that."""
    assert breached((15.0, 12.0)) == [(0.0, -1.0, -4.25)]


def test_outside_the_hall_and_in_the_exclusion_each_leads_back_its_own_way():
    """2 m outside to the east, 1 m from the exclusion's southern edge: the hall still asks to go west."""
    assert sorted(breached((18.0, 9.0))) == [(-1.0, 0.0, -2.25), (0.0, -1.0, -1.25)]


def normal_at(place: Place, corner: Place) -> list[float]:
    """At a corner of the hall, as a piece of its own."""
    near = around((0.5, 0.5), 1.0).vertices
    points = np.tile(place, (near.x_m.shape[0], 1))
    along, _ = near.along_across(points[:1, 0], points[:1, 1])
    with np.errstate(all="raise"):
        found = _normals(points, along[0], near, np.zeros(near.x_m.shape, dtype=np.bool_))
    index = list(zip(near.x_m.tolist(), near.y_m.tolist(), strict=True)).index(corner)
    return [float(value) for value in found[:, index]]


@pytest.mark.parametrize(
    ("distance_m", "normal"),
    [
        (0.0, [0.0, 1.0]),  # right on it: to the left of the edge that begins there
        (1e-7, [0.0, 1.0]),
        (0.999e-6, [0.0, 1.0]),
        (1e-6, [1.0, 0.0]),  # a micrometre away it can be told
        (1.0, [1.0, 0.0]),
    ],
)
def test_within_a_micrometre_of_a_corner_the_edge_tells_the_side(distance_m, normal):
    assert normal_at((distance_m, 0.0), (0.0, 0.0)) == normal
