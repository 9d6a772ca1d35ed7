"""What braking allows, recomputed the slow way for each point and piece, and its limits met exactly."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from safety_plant import config

from safety.allowance import Allowance, _fence_due_m_s, _outward, _strongest_per_sector, _way_out_m_s, allowance, held_in
from safety.braking import Start, Tubes, stop_gain_s
from safety.fence_tube import WaysOut
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.shield import Shield, Surroundings
from safety.sight import View

MARGIN, KEEP_OUT, HOLD_OFF, SLIDE, POINT_BAND, FENCE_BAND = 0.08, 0.43, 0.25, 0.02, 0.05, 0.5
C = config(margin_m=MARGIN, vehicle_radius_m=KEEP_OUT - MARGIN, hold_off_speed_m_s=HOLD_OFF)
GAIN = stop_gain_s(C)


def scene(seed):
    """A brake tube, points around it at all depths, clearances to them, rooms to the fence."""
    chance = random.Random(seed)
    position = np.array((chance.uniform(-3, 3), chance.uniform(-3, 3)))
    length = chance.choice((0.0, 0.2, 0.6))
    turn = np.array([[[*position, 1.0]], [[*position, 1.1]]]) + 0.02
    bearing = chance.uniform(-math.pi, math.pi)
    stop = turn + np.array((length * math.cos(bearing), length * math.sin(bearing), 0.1))
    count = chance.choice((0, 1, 6))
    points = np.array([(position[0] + chance.uniform(-0.7, 0.7), position[1] + chance.uniform(-0.7, 0.7)) for _ in range(count)])
    points = points.reshape(-1, 2).T
    legs = (turn[0, -1, :2], stop[0, -1, :2])
    clear = np.array([to_leg(p, *legs)[1] - KEEP_OUT + chance.uniform(-0.05, 0.05) for p in points.T])
    fence = np.array(
        [chance.uniform(-0.2, 0.3) for _ in range(4)] + [chance.choice((-0.7, -0.1, -0.03, -0.01, 0.0, 0.2)) for _ in "zz"]
    )
    return position, Tubes(turn, stop), points, clear, fence, chance


def to_leg(p, begin, stop):
    """Nearest place of a leg, and the distance."""
    d = stop - begin
    share = min(max(float((p - begin) @ d) / max(float(d @ d), 1e-12), 0.0), 1.0)
    place = begin + share * d
    return place, float(np.hypot(*(p - place)))


def hold_off(depth):
    return min(10.0 * depth, HOLD_OFF)


def fence_hold_off(depth):
    return hold_off(depth) if depth <= FENCE_BAND else 0.0


def test_too_near_one_piece_of_the_fence_the_others_keep_their_room():
    rest = Tubes(np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    fence = np.array((-0.15, 0.3, -0.02, 0.0, 0.5, 0.5))
    found = allowance(rest, np.empty(0), fence, np.empty((2, 0)), np.zeros(2), None, C)
    assert found.fence_m.tolist() == [-0.15, 0.0, -0.02, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("seed", range(120))
def test_directions_and_speeds_due_are_those_of_the_slow_way(seed):
    position, tube, points, clear, fence, _ = scene(seed)
    normals, speeds = _outward(tube, clear, points, position, False, C)
    depths = [max(-c - SLIDE, KEEP_OUT - SLIDE - math.dist(p, position)) for p, c in zip(points.T, clear, strict=True)]
    wanted = []
    for p, c, depth in zip(points.T, clear, depths, strict=True):
        if max(depths) <= 0.0 or depth <= -0.05:
            continue
        near_now = KEEP_OUT - SLIDE - math.dist(p, position) >= -c - SLIDE
        place = position if near_now or depth > MARGIN else to_leg(p, tube.turn_m[0, -1, :2], tube.stop_m[0, -1, :2])[0]
        away = (place - p) / max(math.dist(place, p), 1e-6)
        due = hold_off(depth) if depth <= MARGIN + POINT_BAND else 0.0
        wanted.append((*away, due if depth > 0.0 else depth / GAIN))
    assert speeds.shape == (len(wanted),)
    for at, (x, y, speed) in enumerate(wanted):
        assert (normals[0, at], normals[1, at], speeds[at]) == pytest.approx((x, y, speed), abs=1e-9)
    found = allowance(tube, clear, fence, points, position, None, C)
    worst = min([0.0, *clear, *fence[:-2]])
    assert found.clearance_m == pytest.approx(np.array([min(c, max(worst, -SLIDE)) for c in clear]))
    assert found.fence_m == pytest.approx(np.minimum(fence, 0.0))
    assert (found.brake_stop_m == tube.stop_m[:, -1]).all()
    push = _way_out_m_s(normals, speeds, C)
    assert found.push_m_s == pytest.approx(push)
    asked = [(n, d) for n, d in zip(normals.T, speeds, strict=True) if d >= 0.0]
    assert found.normals == pytest.approx(np.array([n for n, _ in asked]).reshape(-1, 2).T)
    assert found.outward_m_s == pytest.approx(np.array([min(d, push @ n) if d > 0.0 else d for n, d in asked]))


@pytest.mark.parametrize("deeper_m", [0.0, 1e-9])
def test_a_point_as_deep_in_the_hull_as_drift_can_bring_it_is_still_held_off(deeper_m):
    """Margin and 5 cm: a quarter and 0.05 m; less than a billionth more is no drift any more, and the way is only not nearer."""
    wide = config(margin_m=0.25, vehicle_radius_m=0.35)
    clear_m = -(0.25 + POINT_BAND) - 0.25 * 0.25
    assert -clear_m - 0.25 * 0.25 == 0.25 + POINT_BAND  # met exactly, in floating point too
    rest = Tubes(np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    points = np.array([[5.0], [0.0]])
    _, due = _outward(rest, np.array([clear_m - deeper_m]), points, np.zeros(2), False, wide)
    assert due.tolist() == [0.0 if deeper_m else wide.hold_off_speed_m_s]


@pytest.mark.parametrize("room", [-0.9, -0.52, -0.5201, -0.5199, -0.3, -0.045, -0.03, -0.02, -0.0201, -0.01, 0.0, 0.004, 0.3])
def test_vertical_bounds_reach_floor_and_ceiling_and_lead_back(room):
    position, tube, points, clear, fence, _ = scene(0)
    depth = -room - SLIDE
    inward = fence_hold_off(depth) if depth > 0.0 else 0.0
    bound = -inward if inward > 0.0 else max(room, 0.0) / GAIN
    fence[-2:] = room, 0.1
    low = allowance(tube, clear, fence, points, position, None, C)
    assert (low.sink_m_s, low.climb_m_s) == pytest.approx((-bound, 0.1 / GAIN))
    fence[-2:] = 0.1, room
    high = allowance(tube, clear, fence, points, position, None, C)
    assert (high.sink_m_s, high.climb_m_s) == pytest.approx((-0.1 / GAIN, bound))


def test_a_point_beside_the_way_counts_with_the_errors_up_to_there():
    """Half way along a leg of 2 m: half of what the velocity error adds along it, and all of what it added before."""
    tube = Tubes(np.zeros((2, 1, 3)), np.broadcast_to((2.0, 0.0, 0.0), (2, 1, 3)))
    x, y, extra = np.array([1.0]), np.array([0.6]), np.array([0.01])
    empty = View(FreeSpace(C), np.array((x, y)), 0.0)
    at_rest = Start(np.zeros((2, 3)), np.zeros((2, 3)))
    around = Surroundings(x, y, extra, empty, CorridorVector(0.0, 0.0, 0.0), at_rest)
    errors_m = C.velocity_error_m_s * (C.dead_time_s + C.tick_s + 0.5 * C.lag_s)
    assert Shield(C)._tube_clearances(tube, around)[0, 0] == pytest.approx(0.6 - 0.01 - errors_m - KEEP_OUT)


def ways(chance, count):
    bearings = [chance.uniform(-math.pi, math.pi) for _ in range(count)]
    normals = np.array([(math.cos(b), math.sin(b)) for b in bearings]).reshape(-1, 2).T
    return WaysOut(normals, np.array([chance.choice((-0.7, -0.52, -0.3, -0.03, -0.02, -0.01, 0.0, 0.01, 0.2)) for _ in bearings]))


def fence_due(room):
    depth = -room - SLIDE - C.velocity_error_m_s * (C.fault_hold_s - C.delay_s)
    return fence_hold_off(depth) if depth > 0.0 else -max(room, 0.0) / GAIN


@pytest.mark.parametrize("seed", range(60))
def test_ways_out_of_the_fence_are_added(seed):
    position, tube, points, clear, fence, chance = scene(seed)
    out = ways(chance, 4)
    assert _fence_due_m_s(out, C) == pytest.approx([fence_due(room) for room in out.room_m])
    normals, speeds = _outward(tube, clear, points, position, True, C)
    normals = np.concatenate((normals, out.normals), axis=1)
    speeds = np.concatenate((speeds, [fence_due(room) for room in out.room_m]))
    found = allowance(tube, clear, fence, points, position, out, C)
    push = _way_out_m_s(normals, speeds, C)
    assert found.push_m_s == pytest.approx(push)
    assert found.normals == pytest.approx(normals[:, speeds >= 0.0])
    held = [min(d, push @ n) if d > 0.0 else d for n, d in zip(normals.T, speeds, strict=True) if d >= 0.0]
    assert found.outward_m_s == pytest.approx(np.array(held))


@pytest.mark.parametrize("seed", range(60))
def test_held_in_takes_off_what_breaks_the_worst_bound_three_times(seed):
    chance = random.Random(seed)
    out = ways(chance, chance.choice((0, 1, 3)))
    push = np.array((chance.uniform(-0.3, 0.3), chance.uniform(-0.3, 0.3)))
    candidates = np.array([[chance.uniform(-1, 1) for _ in range(3)] for _ in range(4)])
    before = candidates.copy()
    found = held_in(candidates, out, push, C)
    assert (candidates == before).all()
    for row, wanted in zip(found, before, strict=True):
        velocity = list(wanted)
        for _ in range(3 if out.room_m.shape[0] else 0):
            lacking = []
            for (nx, ny), room in zip(out.normals.T, out.room_m, strict=True):
                due = fence_due(room)
                due = min(due, push[0] * nx + push[1] * ny) if due > 0.0 else due
                lacking.append((due - velocity[0] * nx - velocity[1] * ny, nx, ny))
            worst, nx, ny = max(lacking)
            velocity[0] += max(worst, 0.0) * nx
            velocity[1] += max(worst, 0.0) * ny
        assert row == pytest.approx(velocity, abs=1e-9)


def test_of_each_sixteenth_of_a_turn_the_strongest_demand_counts():
    bearings = [(k + 0.5) * math.pi / 8 for k in range(16)]
    normals = np.array([(math.cos(b), math.sin(b)) for b in bearings for _ in range(3)]).T
    due = np.array([value for k in range(16) for value in (0.1, 0.3 + 0.01 * k, -0.2)])
    assert sorted(_strongest_per_sector(normals, due).tolist()) == [3 * k + 1 for k in range(16)]
    assert _strongest_per_sector(np.empty((2, 0)), np.empty(0)).shape == (0,)


def demand(*pairs):
    return np.array([n for n, _ in pairs]).T, np.array([d for _, d in pairs])


EAST, NORTH, WEST = (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)


@pytest.mark.parametrize(
    ("demands", "way"),
    [
        ([(EAST, 0.2)], (0.2, 0.0)),
        ([(EAST, 0.2), (NORTH, 0.1)], (0.2, 0.1)),
        ([(EAST, 0.2), (WEST, 0.2)], (0.0, 0.0)),  # contradiction: half way
        ([(EAST, 0.2), (WEST, 0.1)], (0.05, 0.0)),
        ([(EAST, 0.2), (WEST, -0.15)], (0.15, 0.0)),  # a bound weighs more than a demand
        ([(EAST, 0.2), (WEST, 0.0)], (0.0, 0.0)),
        ([(EAST, 0.25), (NORTH, 0.25)], (0.3 / math.sqrt(2), 0.3 / math.sqrt(2))),  # no longer than the return speed
        ([(EAST, -0.1)], (0.0, 0.0)),
        ([(EAST, 0.0)], (0.0, 0.0)),
    ],
)
def test_the_way_out_does_all_that_is_due_or_half_of_what_contradicts(demands, way):
    assert _way_out_m_s(*demand(*demands), C) == pytest.approx(way, abs=1e-4)


def plain(**parts):
    """An allowance that permits everything but what `parts` forbid."""
    free = {"clearance_m": np.array([0.0]), "fence_m": np.array([0.0, 0.0, 0.0]), "normals": np.empty((2, 0))}
    free |= {
        "outward_m_s": np.empty(0),
        "push_m_s": np.zeros(2),
        "sink_m_s": -1.0,
        "climb_m_s": 1.0,
        "brake_stop_m": np.zeros((2, 3)),
    }
    return Allowance(**(free | parts))


SLACK = 1e-9
INSIDE, BEYOND = 0.999 * SLACK, 1.001 * SLACK


@pytest.mark.parametrize(("less", "passes"), [(0.0, True), (INSIDE, True), (BEYOND, False), (0.5, False)])
def test_each_bound_alone_decides_to_the_billionth(less, passes):
    """One candidate that misses one bound by a little: clearance, fence, sinking, climbing, outward speed."""
    up, level, down = (np.array([[0.0, 0.0, z]]) for z in (1.0 + less, 0.0, -1.0 - less))
    fine, rooms = np.array([[0.0]]), np.zeros((1, 3))
    short = rooms.copy()
    short[0, 1] -= less
    held = plain(normals=np.array([[1.0], [0.0]]), outward_m_s=np.array([0.25]))
    cases = [
        plain().permits(level, fine - less, rooms),
        plain().permits(level, fine, short),
        plain().permits(up, fine, rooms),
        plain().permits(down, fine, rooms),
        held.permits(np.array([[0.25 - less, 0.0, 0.0]]), fine, rooms),
    ]
    assert [bool(case[0]) for case in cases] == [passes] * 5


def test_bounds_met_exactly_are_kept():
    """Numbers that are exact in binary: the slack itself is still accepted."""
    exact = plain(clearance_m=np.array([SLACK]), fence_m=np.array([SLACK, SLACK, SLACK]))
    assert exact.permits(np.zeros((1, 3)), np.array([[0.0]]), np.zeros((1, 3)))[0]
    level = plain(sink_m_s=SLACK, climb_m_s=-SLACK)
    assert level.permits(np.zeros((1, 3)), np.array([[0.0]]), np.zeros((1, 3)))[0]
    held = plain(normals=np.array([[1.0], [0.0]]), outward_m_s=np.array([SLACK]))
    assert held.permits(np.zeros((1, 3)), np.array([[0.0]]), np.zeros((1, 3)))[0]


def test_candidates_are_judged_one_by_one_at_their_worst_place():
    free = plain(clearance_m=np.array([0.0, -0.1]), normals=np.array([[1.0, 0.0], [0.0, 1.0]]), outward_m_s=np.array([0.1, 0.2]))
    candidates = np.array([[0.1, 0.2, 0.0], [0.1, 0.1, 0.0], [0.3, 0.3, 0.0], [0.3, 0.3, 0.0]])
    clear = np.array([[0.0, -0.1], [0.0, 0.0], [0.0, -0.2], [0.5, 0.5]])
    assert free.shortfall_m_s(candidates) == pytest.approx([0.0, 0.1, -0.1, -0.1])
    assert free.permits(candidates, clear, np.zeros((4, 3))).tolist() == [True, False, False, True]
    assert (plain().shortfall_m_s(candidates) == -math.inf).all()


@pytest.mark.parametrize(("sink", "climb", "hover"), [(-1.0, 1.0, 0.0), (0.2, 1.0, 0.2), (-1.0, -0.1, -0.1), (0.0, 0.0, 0.0)])
def test_hovering_leads_back_from_floor_and_ceiling(sink, climb, hover):
    assert plain(sink_m_s=sink, climb_m_s=climb).hover_m_s.tolist() == [0.0, 0.0, hover]
