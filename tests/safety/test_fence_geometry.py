"""Tubes against the fence, piece by piece, recomputed the slow way: one point, one segment, one polygon at a time."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from safety.braking import Start, Tubes
from safety.fence import PolygonFence
from safety.fence_tube import FenceGuard
from safety.frames import CorridorVector

RADIUS_M, SLACK_M, LOW_M, HIGH_M = 0.3, 0.07, 0.5, 3.0
ROOM = ((0.0, 0.0), (6.0, -0.5), (6.5, 3.0), (3.4, 2.2), (3.0, 5.0), (-0.5, 4.0))
HOLES = (((1.5, 1.0), (2.6, 1.2), (2.0, 2.1)), ((4.6, 0.7), (5.3, 0.9), (4.9, 1.6), (4.4, 1.4)))


def rings():
    """Allowed side on the left: the room counter-clockwise, the holes clockwise."""
    return [ROOM, *(hole[::-1] for hole in HOLES)]


def pieces(ring):
    return list(zip(ring, (*ring[1:], ring[0]), strict=True))


def to_segment(p, a, b):
    """Nearest place of a segment, and the distance to it."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    share = ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / max(dx * dx + dy * dy, 1e-300)
    share = min(max(share, 0.0), 1.0)
    place = (a[0] + share * dx, a[1] + share * dy)
    return place, math.dist(p, place)


def enclosed(p, ring):
    inside = False
    for (ax, ay), (bx, by) in pieces(ring):
        if (ay > p[1]) != (by > p[1]) and p[0] < ax + (bx - ax) * (p[1] - ay) / (by - ay):
            inside = not inside
    return inside


def margin(p, number):
    """Signed distance to one ring, negative on its forbidden side."""
    ring = rings()[number]
    distance = min(to_segment(p, a, b)[1] for a, b in pieces(ring))
    return distance if enclosed(p, ring) == (number == 0) else -distance


def cross(a, b, c, d):
    """Whether the segments properly cross (random places are never exactly on a line)."""

    def side(p, q, r):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]) > 0.0

    return side(a, b, c) != side(a, b, d) and side(c, d, a) != side(c, d, b)


def erosion(a, b):
    length = math.dist(a, b)
    return RADIUS_M + SLACK_M * (abs(b[0] - a[0]) + abs(b[1] - a[1])) / length


CORNER_M = RADIUS_M + SLACK_M * math.sqrt(2.0)
FENCE = PolygonFence(ROOM, HOLES, RADIUS_M, SLACK_M)
GUARD = FenceGuard(FENCE, LOW_M, HIGH_M)


def scene(seed):
    """Start, three candidates and their legs: in the room, at its edges, across edges, outside."""
    chance = random.Random(seed)
    base = np.array((chance.uniform(-1.0, 7.0), chance.uniform(-1.0, 5.5), chance.uniform(0.3, 3.2)))
    size = chance.choice((0.05, 0.4, 1.2))

    def near(count):
        return base + np.array([[[chance.uniform(-size, size) for _ in range(3)] for _ in range(count)] for _ in range(2)])

    start, turn = near(1)[:, 0], near(3)
    return Start(start, np.zeros((2, 3))), Tubes(turn, turn + (near(3) - base)), chance.uniform(0.2, 2.0)


def listed(start, reach):
    """(ring, a, b) of the pieces that are near, and whether control begins outside."""
    begins = [tuple(p[:2]) for p in start.position_m]
    breached = [min(margin(p, k) for p in begins) < 0.0 for k in range(3)]
    near = [
        (k, a, b)
        for k, ring in enumerate(rings())
        for a, b in pieces(ring)
        if breached[k] or min(to_segment(p, a, b)[1] for p in begins) < reach + CORNER_M
    ]
    return near, any(breached)


def slow_rooms(start, tube, near, outside):
    """Rooms per candidate: edges, vertices, floor, ceiling."""
    rows, any_crossed = [], False
    for c in range(tube.turn_m.shape[1]):
        ways = [[tuple(p[m, c, :2]) for p in (tube.turn_m, tube.stop_m)] for m in range(2)]
        edges, corners = [], []
        for _, a, b in near:
            crossed = any(cross(start.position_m[m, :2], ways[m][0], a, b) or cross(*ways[m], a, b) for m in range(2))
            any_crossed |= crossed
            distance = 0.0 if crossed else min(to_segment(p, a, b)[1] for way in ways for p in way)
            edges.append(distance - erosion(a, b))
            corners.append(min(to_segment(a, *way)[1] for way in ways) - CORNER_M)
        z = [p[m, c, 2] for p in (tube.turn_m, tube.stop_m) for m in range(2)]
        rows.append((edges + corners, [min(z) - LOW_M, HIGH_M - max(z)], ways))
    if outside or any_crossed:
        for row, _, ways in rows:
            depths = [min(margin(p, k) for way in ways for p in way) for k in range(3)]
            for at, (k, a, b) in enumerate(near):
                if depths[k] < 0.0:
                    row[at], row[at + len(near)] = depths[k] - erosion(a, b), depths[k] - CORNER_M
    return [row + heights for row, heights, _ in rows]


@pytest.mark.parametrize("seed", range(150))
def test_rooms_are_those_of_the_slow_way(seed):
    start, tube, reach = scene(seed)
    position = CorridorVector(*start.position_m[0])
    found = GUARD.look(position, start, reach)
    near, outside = listed(start, reach)
    assert found.outside == outside
    assert found.edges.length_m.tolist() == pytest.approx([math.dist(a, b) for _, a, b in near])
    assert found.edges.ring.tolist() == found.vertices.ring.tolist() == [k for k, _, _ in near]
    assert GUARD.rooms_m(tube, start, found) == pytest.approx(np.array(slow_rooms(start, tube, near, outside)), abs=1e-9)


@pytest.mark.parametrize("seed", range(60))
def test_room_now_counts_edges_vertices_floor_and_ceiling(seed):
    start, _, _ = scene(seed)
    x, y, z = start.position_m[0]
    worst = min(margin((x, y), k) for k in range(3))
    all_pieces = [piece for ring in rings() for piece in pieces(ring)]
    edges = min(to_segment((x, y), a, b)[1] - erosion(a, b) for a, b in all_pieces)
    corners = min(math.dist((x, y), a) - CORNER_M for a, _ in all_pieces)
    least = min(erosion(a, b) for a, b in all_pieces)
    sideways = min(edges, corners) if worst >= 0.0 else worst - least
    assert FENCE.room_m(np.array((x, y))) == pytest.approx(sideways, abs=1e-9)
    assert FENCE.signed_margin_m(np.array((x, y))) == pytest.approx(worst, abs=1e-9)
    assert GUARD.here(CorridorVector(x, y, z)).least_m == pytest.approx(min(sideways, z - LOW_M, HIGH_M - z), abs=1e-9)


def slow_ways(tube, near):
    """(normal, room) per piece where the last candidate is nearest to it; of a breached ring its nearest piece only."""
    points = [tuple(p[m, -1, :2]) for p in (tube.turn_m, tube.stop_m) for m in range(2)]
    shapes = [(k, a, b, erosion(a, b)) for k, a, b in near] + [(k, a, a, CORNER_M) for k, a, _ in near]
    result = []
    for at, (k, a, b, keep) in enumerate(shapes):
        best = None
        for p in points:
            place, distance = to_segment(p, a, b)
            sign = 1.0
            if margin(p, k) < 0.0:
                own = [(to_segment(p, c, d)[1], i) for i, (n, c, d, _) in enumerate(shapes) if n == k]
                if min(own)[1] != at:
                    continue
                sign = -1.0
            if best is None or sign * distance < best[0]:
                best = (sign * distance, sign * (p[0] - place[0]) / distance, sign * (p[1] - place[1]) / distance)
        if best is not None:
            result.append((best[1], best[2], best[0] - keep))
    return result


def clear_cut(seed):
    """No two pieces are equally near to a point beyond them, so that rounding decides nothing."""
    start, tube, reach = scene(seed)
    points = [tuple(p[m, -1, :2]) for p in (tube.turn_m, tube.stop_m) for m in range(2)]
    near, _ = listed(start, reach)
    for p in points:
        for k in {k for k, _, _ in near if margin(p, k) < 0.0}:
            shapes = [(a, b) for n, a, b in near if n == k] + [(a, a) for n, a, _ in near if n == k]
            nearest = sorted(to_segment(p, *shape)[1] for shape in shapes)
            if nearest[1] - nearest[0] < 1e-9:
                return False
    return True


@pytest.mark.parametrize("seed", [seed for seed in range(150) if clear_cut(seed)])
def test_ways_out_are_those_of_the_slow_way(seed):
    start, tube, reach = scene(seed)
    near, _ = listed(start, reach)
    found = GUARD.ways_out(tube, GUARD.look(CorridorVector(*start.position_m[0]), start, reach))
    wanted = slow_ways(tube, near)
    assert found.room_m.shape == (len(wanted),)
    for at, (x, y, room) in enumerate(wanted):
        assert (found.normals[0, at], found.normals[1, at], found.room_m[at]) == pytest.approx((x, y, room), abs=1e-9)


SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))


@pytest.mark.parametrize("ring", [SQUARE, (SQUARE[0], *SQUARE[:0:-1])])
@pytest.mark.parametrize(("x", "y", "inwards"), [(2, 0, (0, 1)), (4, 2, (-1, 0)), (2, 4, (0, -1)), (0, 2, (1, 0))])
def test_right_on_an_edge_the_way_out_is_to_its_allowed_side(ring, x, y, inwards):
    fence = FenceGuard(PolygonFence(ring, ()), 0.0, 3.0)
    place = np.array((x, y, 1.0))
    start = Start(np.array((place, place)), np.zeros((2, 3)))
    tube = Tubes(np.tile(place, (2, 1, 1)), np.tile(place, (2, 1, 1)))
    ways = fence.ways_out(tube, fence.look(CorridorVector(*place), start, 0.5))
    nearest = int(np.argmin(ways.room_m))
    assert ways.normals[:, nearest] == pytest.approx(inwards)
    assert ways.room_m[nearest] == 0.0


@pytest.mark.parametrize(
    ("ring", "holes", "radius", "slack", "place"),
    [
        (((0, 0), (4, 0), (4, 2), (0, 2)), (), 0.3, 0.1, (1.0, 1.0)),
        (((0, 0), (4, 0), (4, 2), (0, 2)), (((0.2, 0.2), (3.0, 0.2), (3.0, 1.8), (0.2, 1.8)),), 0.3, 0.05, (3.5, 0.5)),
        (((0, 0), (9, 0), (9, 0.9), (0, 0.9)), (), 0.4, 0.02, (0.45, 0.45)),
        (((0, 0), (3, 0), (0, 3)), (), 0.8, 0.02, (0.84375, 0.84375)),
        (((0, 0), (3, 0), (0, 3)), (), 0.88, 0.02, None),
        (((0, 0), (1, 0), (1, 1), (0, 1)), (), 0.495, 0.0, (0.5, 0.5)),
        (((0, 0), (1, 0), (1, 1), (0, 1)), (), 0.505, 0.0, None),
    ],
)
def test_the_search_for_room_looks_where_it_always_looked(ring, holes, radius, slack, place):
    """Coarse cells first, halves only where room may hide: the same place every time."""
    found = PolygonFence(ring, holes, radius, slack).roomiest()
    assert found == (pytest.approx(place) if place else None)


def test_a_tube_that_leads_away_from_an_edge_counts_where_it_begins():
    guard = FenceGuard(PolygonFence(((0.0, 0.0), (6.0, 0.0), (6.0, 6.0), (0.0, 6.0)), (), 0.3, 0.0), 0.0, 3.0)
    start = Start(np.array(((3.0, 0.4, 1.0), (3.0, 0.4, 1.0))), np.zeros((2, 3)))
    tube = Tubes(np.array([[[3.0, 0.4, 1.0]], [[3.0, 0.5, 1.0]]]), np.array([[[3.0, 1.4, 1.0]], [[3.0, 1.5, 1.0]]]))
    rooms = guard.rooms_m(tube, start, guard.look(CorridorVector(3.0, 0.4, 1.0), start, 0.5))
    assert rooms[0] == pytest.approx([0.1, math.hypot(3.0, 0.4) - 0.3, 1.0, 2.0])


def test_a_tube_past_the_corner_of_a_hole_counts_the_corner():
    """Both ends are far from every edge; the way between them passes the corner at 0.4 m."""
    hole = ((3.0, 1.4), (3.2, 3.0), (2.8, 3.0))
    guard = FenceGuard(PolygonFence(((0.0, -3.0), (6.0, -3.0), (6.0, 6.0), (0.0, 6.0)), (hole,), 0.3, 0.0), 0.0, 3.0)
    start = Start(np.array(((1.5, 1.0, 1.0), (1.5, 1.0, 1.0))), np.zeros((2, 3)))
    tube = Tubes(np.tile((1.5, 1.0, 1.0), (2, 1, 1)), np.tile((4.5, 1.0, 1.0), (2, 1, 1)))
    rooms = guard.rooms_m(tube, start, guard.look(CorridorVector(1.5, 1.0, 1.0), start, 4.0))
    assert rooms[0, :-2].min() == pytest.approx(0.1)
