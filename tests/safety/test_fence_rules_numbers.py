"""Which polygons make a fence, a millimetre to either side of the limits, against distances searched for the slow way."""

from __future__ import annotations

import math
import random

import pytest

from safety.fence_rules import _parts, fence_problem, ring_problem, segments_touch

GAP_M = 1e-3
Place = tuple[float, float]
Segment = tuple[Place, Place]


def to_segment(p: Place, segment: Segment) -> float:
    """Distance of a place from a segment, by halving the segment until nothing is left of it."""
    (ax, ay), (bx, by) = segment
    low, high = 0.0, 1.0
    for _ in range(80):
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        near, far = (math.dist(p, (ax + t * (bx - ax), ay + t * (by - ay))) for t in (a, b))
        low, high = (low, b) if near < far else (a, high)
    middle = 0.5 * (low + high)
    return math.dist(p, (ax + middle * (bx - ax), ay + middle * (by - ay)))


def slow_distance(first: Segment, second: Segment) -> float:
    """Least distance of two segments: that of a place on the first from the second has one valley along it."""
    (ax, ay), (bx, by) = first
    low, high = 0.0, 1.0
    for _ in range(60):
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        near, far = (to_segment((ax + t * (bx - ax), ay + t * (by - ay)), second) for t in (a, b))
        low, high = (low, b) if near < far else (a, high)
    middle = 0.5 * (low + high)
    return to_segment((ax + middle * (bx - ax), ay + middle * (by - ay)), second)


def pair(seed: int) -> tuple[Segment, Segment]:
    """Two segments that cross, or meet at an end, or leave a gap of about a millimetre."""
    chance = random.Random(seed)
    turn, offset = chance.uniform(-math.pi, math.pi), (chance.uniform(-9.0, 9.0), chance.uniform(-9.0, 9.0))
    long_m, slant = chance.choice((0.01, 1.0, 7.0)), chance.uniform(0.3, math.pi - 0.3)
    begin_m = chance.choice((-0.5, -0.0008, 0.0, 0.0003, 0.0008, 0.0012, 0.01)) * (1.0 if seed % 2 else -1.0)
    at_m = chance.choice((0.0, 0.5, 1.0)) * long_m + chance.choice((-0.0011, -0.0005, 0.0, 0.0005, 0.0011))
    way = (math.cos(slant), math.sin(slant))
    other = [(at_m + s * way[0], s * way[1]) for s in (begin_m, begin_m + chance.choice((0.4, 3.0)))]
    c, s = math.cos(turn), math.sin(turn)
    places = [(offset[0] + c * x - s * y, offset[1] + s * x + c * y) for x, y in [(0.0, 0.0), (long_m, 0.0), *other]]
    chance.shuffle(two := [(places[0], places[1]), (places[3], places[2])])
    return two[0], two[1]


@pytest.mark.parametrize("seed", range(60))
def test_segments_touch_where_a_search_finds_less_than_a_millimetre(seed):
    first, second = pair(seed)
    assert segments_touch(first, second) == (slow_distance(first, second) < GAP_M)


@pytest.mark.parametrize(("gap_m", "touch"), [(GAP_M, False), (math.nextafter(GAP_M, 0.0), True), (0.0, True)])
def test_a_gap_of_a_millimetre_is_none_too_narrow(gap_m, touch):
    """End above the middle of a segment, beside it in line, and side by side."""
    wall = ((-4.0, 0.0), (0.0, 0.0))
    assert segments_touch(wall, ((-2.0, gap_m), (-2.0, 3.0))) == touch
    assert segments_touch(((-2.0, 3.0), (-2.0, gap_m)), wall) == touch
    assert segments_touch(wall, ((gap_m, 0.0), (3.0, 0.0))) == touch
    assert segments_touch(wall, ((-9.0, gap_m), (9.0, gap_m))) == touch


@pytest.mark.parametrize(("offset_m", "sure"), [(3e-4, False), (5e-4, False), (7e-4, True)])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_what_lies_within_half_a_millimetre_of_a_line_is_on_no_side_of_it(offset_m, sure, sense):
    """Half of `LEAST_GAP_M`: there rounding could decide, and the gap must."""
    a, b = (0.0, 0.0), (1.0, 0.0)
    assert _parts(a, b, (0.5, sense * offset_m), (0.5, -sense)) == sure
    assert _parts(a, b, (0.5, sense), (0.5, -sense * offset_m)) == sure


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_a_shallow_way_that_ends_just_before_a_line_does_not_cross_it(mirror):
    """It would meet the line 1 mm before its end, but ends 0.3 mm above it and 5 mm beyond: the gap is 5 mm."""
    slope = math.tan(0.05)
    end = (0.0003 / slope - 0.001, 0.0003)
    wall, way = ((-4.0, 0.0), (0.0, 0.0)), ((end[0], mirror * end[1]), (end[0] + 2.0, mirror * (end[1] + 2.0 * slope)))
    for first in (wall, wall[::-1]):
        for second in (way, way[::-1]):
            assert not segments_touch(first, second)
            assert not segments_touch(second, first)


def slow_crossing(ring: tuple[Place, ...]) -> tuple[int, int] | None:
    """The first two edges, counted from 1, that are no neighbours and touch."""
    edges = list(zip(ring, (*ring[1:], ring[0]), strict=True))
    for a in range(len(edges)):
        for b in range(a + 2, len(edges)):
            if (a, b) != (0, len(edges) - 1) and slow_distance(edges[a], edges[b]) < GAP_M:
                return a + 1, b + 1
    return None


@pytest.mark.parametrize("seed", range(12))
def test_the_first_two_edges_that_cross_are_named(seed):
    chance = random.Random(seed)
    ring = tuple((chance.uniform(0.0, 9.0), chance.uniform(0.0, 9.0)) for _ in range(chance.choice((4, 5, 6))))
    found, wanted = ring_problem(ring), slow_crossing(ring)
    if wanted is None:
        assert found is None
    else:
        first, second = ((k, *ring[k - 1]) for k in wanted)
        assert found == (
            f"the edge from vertex {first[0]} ({first[1]:g}, {first[2]:g}) crosses or touches"
            f" the edge from vertex {second[0]} ({second[1]:g}, {second[2]:g})"
        )


def test_on_one_line_the_last_vertex_is_named():
    for count in (3, 4, 5):
        ring = tuple((float(k), 2.0 * k) for k in range(count))
        assert (
            ring_problem(ring)
            == f"all vertices, up to vertex {count} ({count - 1}, {2 * count - 2}), lie on one line; it encloses nothing"
        )


def slim(width_m: float) -> tuple[Place, ...]:
    """A slit between two parallel edges."""
    return ((0.0, 0.0), (4.0, 0.0), (4.0, width_m), (0.0, width_m))


def test_vertices_a_millimetre_apart_are_two():
    assert ring_problem(slim(GAP_M)) is None
    assert ring_problem(slim(math.nextafter(GAP_M, 0.0))) == "vertex 4 (0, 0.001) repeats vertex 1; remove it"


@pytest.mark.parametrize("sense", [1, -1])
def test_a_square_millimetre_encloses_something(sense):
    """Base 4 m, height 0.5 um, or 0.25 um: a spike in any case, but the second one is on a line."""
    for height_m, words in ((0.5e-6, "is a spike"), (0.25e-6, "lie on one line")):
        problem = ring_problem(((0.0, 0.0), (4.0, 0.0), (2.0, height_m))[::sense])
        assert problem is not None
        assert words in problem


def test_a_spike_is_as_narrow_as_a_millimetre():
    """The tip at (4, 0) has its edges a millimetre apart where the shorter one ends, or just less."""
    wide, narrow = (((0.0, 0.0), (4.0, 0.0), (2.0, gap), (2.0, 3.0), (0.0, 3.0)) for gap in (GAP_M, math.nextafter(GAP_M, 0.0)))
    assert ring_problem(wide) is None
    assert ring_problem(narrow) == "vertex 2 (4, 0) is a spike: the edge doubles back; remove it"


@pytest.mark.parametrize("count", [3, 4, 64])
def test_up_to_sixty_four_vertices_make_a_fence(count):
    ring = tuple((9.0 * math.cos(k * math.tau / count), 9.0 * math.sin(k * math.tau / count)) for k in range(count))
    assert fence_problem(ring, []) is None
    assert ring_problem(ring[:2]) == "2 vertices; a polygon has three or more"


HALL = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
OUTSIDE = "lies outside the inclusion polygon and forbids nothing; move or remove it"


@pytest.mark.parametrize(
    ("exclusion", "problem"),
    [
        (((1.0, 1.0), (2.0, 1.0), (2.0, 2.0)), None),  # inside: its first vertex tells
        (((-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)), None),  # all around
        (((5.0, 1.0), (6.0, 1.0), (6.0, 2.0)), OUTSIDE),
        (((4.0005, 1.0), (6.0, 1.0), (6.0, 2.0)), None),  # touches
        (((4.001, 1.0), (6.0, 1.0), (6.0, 2.0)), OUTSIDE),  # just not
        (((-2.0, 1.0), (1.0, 1.5), (-2.0, 2.0)), None),  # across the edge that closes the hall
        (((-0.5, -0.5), (-3.0, -0.5), (-3.0, -3.0)), OUTSIDE),  # 0.7 m from its first corner
        (((-0.5, -0.5), (4.5, -0.5), (4.5, 4.5), (-0.5, 4.5)), None),  # closely around
        (((7.0, 2.0), (9.0, 9.0), (-1.0, 9.0), (3.9, 4.2)), OUTSIDE),  # bends around a corner
        (((6.0, 2.0), (3.5, 6.0), (6.0, 6.0)), OUTSIDE),
        (((6.0, 2.0), (2.5, 5.0), (6.0, 5.0)), None),  # only a corner of the hall is inside
    ],
)
def test_an_exclusion_must_take_something_away(exclusion, problem):
    assert fence_problem(HALL, [exclusion]) == (None if problem is None else f"exclusion 1: {problem}")
    inside = ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0))
    assert fence_problem(HALL, [inside, exclusion]) == (None if problem is None else f"exclusion 2: {problem}")


@pytest.mark.parametrize("vertex", range(3))
@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.inf), (-math.inf, math.nan)])
def test_each_number_must_be_finite(vertex, bad):
    ring = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0)]
    ring[vertex] = bad
    assert ring_problem(tuple(ring)) == f"vertex {vertex + 1} ({bad[0]:g}, {bad[1]:g}) is not finite"
