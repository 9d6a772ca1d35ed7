"""The shield's parts, one by one: reach, clearances of tubes, candidates and their order, against plain sums by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config

from safety.allowance import Allowance
from safety.braking import Start, Tubes
from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.shield import Shield, Surroundings, _capped, _leg_clearances, _reasons
from safety.sight import View

C = config()
Floats = np.ndarray


def seen_everywhere(c: SafetyConfig = C) -> FreeSpace:
    """A map of 12.8 m around the origin, all of it seen just now."""
    free = FreeSpace(c)
    free._began_s, free._corner = 0.0, (-64, -64)
    free._seen_s.fill(0.0)
    return free


def start_at(
    x: float = 0.0, y: float = 0.0, v: tuple[float, float] = (0.0, 0.0), fast: tuple[float, float] | None = None
) -> Start:
    """Control begins at a height of two metres; the fast model at the same place unless its velocity is given."""
    return Start(np.array([(x, y, 2.0)] * 2), np.array([(*v, 0.0), (*(fast or v), 0.0)]))


def surroundings(points, extra, start: Start | None = None, c: SafetyConfig = C) -> Surroundings:
    """Known points [k, 2] and what is added to them; the vehicle at the origin."""
    x, y = np.array(points, dtype=float).reshape(-1, 2).T
    view = View(seen_everywhere(c), np.array((x, y)), 0.0)
    return Surroundings(x, y, np.array(extra, dtype=float), view, CorridorVector(0.0, 0.0, 2.0), start or start_at())


# reach and clearance


def test_the_clearance_now_is_from_the_hull_to_the_nearest_point():
    shield, around = Shield(C), surroundings([(3.0, 4.0), (-1.2, 0.5), (0.0, -2.0)], [0.0, 0.5, 0.0])
    assert shield._clearance_now(around) == pytest.approx(1.3 - 0.35)
    moved = Surroundings(around.x_m, around.y_m, around.extra_m, around.view, CorridorVector(3.0, 3.0, 9.0), around.start)
    assert shield._clearance_now(moved) == pytest.approx(1.0 - 0.35)
    assert shield._clearance_now(surroundings([], [])) == math.inf


SPEED_M_S = 0.5 + 1.2 * 0.05 / 0.35  # at the end of the tick of the fast model, bound: half a metre per second at its begin


def test_the_reach_is_a_stop_from_the_fastest_tube_and_all_that_is_kept():
    """Dead time and tick 0.25 s; up to b tau = 1.2 m/s a stop takes v tau; 0.4 m of keep-out and 0.05 m/s for 0.85 s."""
    shield, begin = Shield(C), start_at(v=(0.3, -0.4), fast=(0.1, 0.2))
    stop_m = (SPEED_M_S + 0.06) * (0.25 + 0.6)
    assert shield._reach_m(begin) == pytest.approx(0.4 + 0.0425 + stop_m)
    turned = start_at(v=(0.1, 0.2), fast=(0.3, -0.4))
    assert shield._reach_m(turned) == pytest.approx(0.4 + 0.0425 + stop_m)
    apart = Start(np.array([(0.0, 0.0, 2.0), (0.3, -0.4, 9.0)]), begin.velocity_m_s)
    assert shield._reach_m(apart) == pytest.approx(0.4 + 0.0425 + stop_m + 0.5)


def test_the_reach_grows_with_what_obstacles_move_meanwhile():
    """Until the vehicle is slower than 0.1 m/s: 0.6 s (1 + ln(v / 0.1)) after 0.25 s."""
    shield, begin = Shield(config(obstacle_speed_m_s=0.4)), start_at(v=(0.3, -0.4))
    moved_m = 0.4 * (0.25 + 0.6 * (1.0 + math.log(SPEED_M_S / 0.1)))
    assert shield._reach_m(begin) == pytest.approx(0.4 + 0.0425 + (SPEED_M_S + 0.06) * 0.85 + moved_m)


def test_points_within_reach_are_kept_with_all_that_belongs_to_them():
    """Three metres of reach from (1, 0), where the slow model begins: a point's extra counts, and exactly that far is too far."""
    begin = Start(np.array([(1.0, 0.0, 2.0), (9.0, 9.0, 2.0)]), np.zeros((2, 3)))
    around = surroundings([(4.0, 0.0), (3.9, 0.0), (1.0, -3.2), (1.0, 3.2), (-1.9, 0.9)], [0.0, 0.1, 0.25, 0.1, 0.1], begin)
    near = Shield(C)._within_reach(around, 3.0)
    assert near.x_m.tolist() == [3.9, 1.0, -1.9]
    assert near.y_m.tolist() == [0.0, -3.2, 0.9]
    assert near.extra_m.tolist() == [0.1, 0.25, 0.1]
    assert near.view is around.view
    assert near.position is around.position
    assert near.start is begin


@pytest.mark.parametrize(
    ("clearance_m", "fence_m", "limit"),
    [(0.05, 0.0, math.inf), (math.nextafter(0.05, 0.0), 0.0, 0.3), (0.05, math.nextafter(0.0, -1.0), 0.3), (9.0, -0.2, 0.3)],
)
def test_inside_a_margin_or_outside_the_fence_the_return_speed_holds(clearance_m, fence_m, limit):
    assert Shield(C)._speed_limit(surroundings([], []), clearance_m, fence_m) == limit


def test_in_space_never_seen_the_return_speed_holds():
    around = surroundings([], [])
    around.view.free._seen_s[64 + 4, 64] = -np.inf
    assert Shield(C)._speed_limit(around, 9.0, 9.0) == 0.3


@pytest.mark.parametrize(("away_m", "in_the_open"), [(0.75, True), (0.735, False), (0.5, False), (0.1, False)])
def test_a_point_is_as_far_from_the_open_as_its_extra_and_all_that_is_kept(away_m, in_the_open):
    """0.3 m more than 0.4 m of keep-out and 0.05 m/s for 0.85 s: 0.7425 m from a box of one millionth."""
    shield, around = Shield(C), surroundings([(-away_m, 0.0)], [0.3])
    room = shield._guard.here(around.position)
    assert shield._in_the_open(CorridorVector(0.0, 0.0, 0.0), around, room) == in_the_open


# clearances of tubes


def plain_clearance(tube: Tubes, which: int, point, extra_m: float, begin_m: float, grown_m: list[float]) -> float:
    """Of both models' legs: from the nearest place of the leg, less what grows up to there."""
    found = []
    for model in (0, 1):
        turn, stop = tube.turn_m[model, which, :2], tube.stop_m[model, which, :2]
        way = stop - turn
        share = min(max(float((point - turn) @ way) / max(float(way @ way), 1e-12), 0.0), 1.0)
        found.append(math.dist(point, turn + share * way) - extra_m - share * grown_m[model])
    return min(found) - begin_m


@pytest.mark.parametrize("speed", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(12))
def test_tubes_are_clear_of_points_by_their_legs_less_all_errors(seed, speed):
    """At a leg's begin 0.25 s of errors and obstacles' motion, 0.6 s more of errors at its end, and how long it takes."""
    chance, c = np.random.default_rng(seed), config(obstacle_speed_m_s=speed)
    turn = chance.uniform(-1.0, 1.0, (2, 3, 3))
    tube = Tubes(turn, turn + chance.uniform(-1.0, 1.0, (2, 3, 3)) * chance.choice((0.0, 0.05, 1.0), (2, 3, 1)))
    points, extra = chance.uniform(-2.0, 2.0, (4, 2)), chance.uniform(0.0, 0.3, 4)
    found = Shield(c)._tube_clearances(tube, surroundings(points, extra, c=c))
    assert found.shape == (3, 4)
    for which in range(3):
        legs_m = [math.dist(tube.turn_m[model, which, :2], tube.stop_m[model, which, :2]) for model in (0, 1)]
        slow_s = [0.6 * (1.0 + math.log(max(leg / 0.06, 1.0))) for leg in legs_m]
        grown = [0.05 * 0.6 + speed * slow for slow in slow_s]
        for k in range(4):
            clear = plain_clearance(tube, which, points[k], float(extra[k]), (0.05 + speed) * 0.25, grown)
            assert found[which, k] == pytest.approx(clear - 0.4)


def test_without_points_there_is_nothing_to_be_clear_of():
    tube = Tubes(np.zeros((2, 5, 3)), np.ones((2, 5, 3)))
    assert _leg_clearances(tube, 0.1, 0.1, surroundings([], [])).shape == (5, 0)


def test_a_leg_of_no_length_is_a_place():
    tube = Tubes(np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
    assert _leg_clearances(tube, 0.1, 7.0, surroundings([(3.0, 4.0)], [0.5])).tolist() == [[pytest.approx(5.0 - 0.5 - 0.1)]]


def test_a_very_short_leg_counts_to_its_end():
    """A hundredth of a millimetre: the square of its length is well above what counts as none."""
    tube = Tubes(np.zeros((2, 1, 3)), np.array([[[1e-5, 0.0, 0.0]]] * 2))
    assert _leg_clearances(tube, 0.0, 2.0, surroundings([(5.0, 0.0)], [0.0]))[0, 0] == pytest.approx(5.0 - 1e-5 - 2.0, abs=1e-9)


# speed and candidates


def test_what_is_faster_than_a_limit_is_shortened_to_it():
    fast = np.array([(0.6, -0.8, 0.3), (0.3, 0.4, -0.2), (0.0, 0.0, 0.5), (0.0, 2.0, 0.0)])
    assert _capped(fast, 0.5) == pytest.approx(np.array([(0.3, -0.4, 0.3), (0.3, 0.4, -0.2), (0.0, 0.0, 0.5), (0.0, 0.5, 0.0)]))
    assert fast[0, 0] == 0.6
    assert _capped(fast, math.inf) is fast
    assert _capped(fast, 2.0) is fast
    assert _capped(fast[1:3], 0.5) is not fast
    one = np.array([(0.3, 0.4, 1.0)])
    assert _capped(one, math.hypot(0.3, 0.4)) is one


def test_scaled_and_turned_candidates():
    """Six shorter ones, then pairs to the left and right, shortened by the cosine so that none is faster towards the goal."""
    expected = [(scale, 0.0) for scale in (0.8, 0.6, 0.4, 0.2, 0.1, 0.05)]
    for degrees in (15, 30, 45, 60, 75, 85):
        turn = math.radians(degrees)
        expected += [
            (math.cos(turn) ** 2, math.cos(turn) * math.sin(turn)),
            (math.cos(turn) ** 2, -math.cos(turn) * math.sin(turn)),
        ]
    assert Shield(C)._scaled == pytest.approx(np.array(expected))


NO_DIRECTIONS = np.empty((2, 0))


def allowed(
    push=(0.0, 0.0), stops=((0.0, 0.0, 2.0), (0.0, 0.0, 2.0)), clear=(), fence=(0.0, 0.0), sink=-0.5, climb=0.5
) -> Allowance:
    """An allowance with no directions due."""
    return Allowance(
        np.array(clear), np.array(fence), NO_DIRECTIONS, np.empty(0), np.array(push), sink, climb, np.array(stops, dtype=float)
    )


def turned(wanted, share: float, angle_rad: float) -> list[float]:
    x, y, z = wanted
    cos, sin = share * math.cos(angle_rad), share * math.sin(angle_rad)
    return [cos * x - sin * y, sin * x + cos * y, z]


def plain_candidates(wanted) -> list[list[float]]:
    """Without points and pushes: shorter, turned, wanted, level hover, standstill."""
    found = [turned(wanted, scale, 0.0) for scale in (0.8, 0.6, 0.4, 0.2, 0.1, 0.05)]
    for degrees in (15, 30, 45, 60, 75, 85):
        turn = math.radians(degrees)
        found += [turned(wanted, math.cos(turn), turn), turned(wanted, math.cos(turn), -turn)]
    return [*found, list(wanted), [0.0, 0.0, wanted[2]], [0.0, 0.0, 0.0]]


WANTED = np.array((0.5, -0.25, 0.125))


def test_candidates_without_points():
    found = Shield(C)._candidates(WANTED, surroundings([], []), allowed())
    assert found == pytest.approx(np.array(plain_candidates(WANTED.tolist())))


def slid_along(wanted: Floats, stops, points, extra) -> list[list[float]]:
    """Per model: without the part towards the point whose surface is nearest to its stop, then with a tenth of the speed away."""
    found = []
    for stop in stops:
        gaps = [math.dist(stop[:2], point) - more for point, more in zip(points, extra, strict=True)]
        nearest = points[gaps.index(min(gaps))]
        away = np.array(stop[:2]) - nearest
        away = away / max(float(np.hypot(*away)), 1e-9)
        inward = min(0.0, float(wanted[:2] @ away))
        for share in (0.0, 0.1):
            x, y = wanted[:2] - (inward - share * math.hypot(*wanted[:2])) * away
            found.append([float(x), float(y), float(wanted[2])])
    return found


@pytest.mark.parametrize("seed", range(10))
def test_slid_candidates_lose_their_part_towards_the_nearest_point(seed):
    chance = np.random.default_rng(seed)
    stops = [(*chance.uniform(-1.0, 1.0, 2).tolist(), 2.0) for _ in range(2)]
    points, extra = chance.uniform(-2.0, 2.0, (5, 2)), chance.uniform(0.0, 1.0, 5)
    wanted = chance.uniform(-1.0, 1.0, 3)
    found = Shield(C)._candidates(wanted, surroundings(points, extra), allowed(stops=stops))
    assert found == pytest.approx(np.array(plain_candidates(wanted.tolist()) + slid_along(wanted, stops, points, extra)))


def test_a_point_at_the_very_stop_has_no_side():
    stops = ((1.0, 1.0, 2.0), (1.0, 1.0, 2.0))
    found = Shield(C)._slid(WANTED, surroundings([(1.0, 1.0)], [0.0]), np.array(stops))
    assert found == pytest.approx(np.array([WANTED] * 4))


@pytest.mark.parametrize("push", [(0.1, -0.2), (0.0, 0.05), (-0.1, 0.0)])
def test_pushed_candidates_follow_with_the_push_once_and_half_as_much_again(push):
    shield, around = Shield(C), surroundings([(1.0, 0.5)], [0.1])
    plain = shield._candidates(WANTED, around, allowed())
    found = shield._candidates(WANTED, around, allowed(push))
    moved = np.array((*push, 0.0))
    assert found == pytest.approx(np.concatenate((plain, plain + moved, plain + 1.5 * moved)))


def test_there_are_as_many_candidates_as_scales_and_shares_say(monkeypatch):
    """An odd number of shorter ones; three shares of sliding for each model."""
    monkeypatch.setattr("safety.shield.OUTWARD", (0.0, 0.1, 0.2))
    shield, around = Shield(C), surroundings([(1.0, 0.5)], [0.1])
    shield._scaled = shield._scaled[:5]
    found = shield._candidates(WANTED, around, allowed())
    assert found.shape == (5 + 3 + 6, 3)
    assert found[4:8] == pytest.approx(np.array([0.1 * WANTED * (1, 1, 10), WANTED, (0.0, 0.0, 0.125), (0.0, 0.0, 0.0)]))


# reasons


def reasons(allowance: Allowance, wanted=(0.1, 0.2, 0.0), clear=(), fence=(0.0, 0.0)) -> list[tuple[str, float, float]]:
    found = _reasons(allowance, np.array(wanted), np.array(clear), np.array(fence))
    return [(why.rule, why.value, why.limit) for why in found]


LEAST = 1e-9


def test_each_rule_is_told_at_its_worst_place():
    assert reasons(allowed(clear=(0.0, 0.1, 0.2)), clear=(0.3, 0.05, 0.1)) == [("obstacle", 0.1, 0.2)]
    assert reasons(allowed(fence=(0.0, -0.1, -0.3)), fence=(0.2, -0.2, -0.35)) == [("fence", -0.2, -0.1)]
    assert reasons(allowed(clear=(3.0, 0.3)), clear=(2.0, 0.2)) == [("obstacle", 2.0, 3.0)]
    both = reasons(allowed(clear=(0.0,), fence=(0.0, 0.0)), clear=(-0.5,), fence=(-0.1, -0.2))
    assert both == [("fence", -0.2, 0.0), ("obstacle", -0.5, 0.0)]
    assert reasons(allowed(clear=(0.0,)), clear=(0.0,)) == []


def test_a_reason_needs_more_than_rounding():
    assert reasons(allowed(clear=(0.0,)), clear=(-LEAST,)) == reasons(allowed(), fence=(0.5, -LEAST)) == []
    assert reasons(allowed(clear=(0.0,)), clear=(-1.1 * LEAST,)) == [("obstacle", -1.1 * LEAST, 0.0)]
    assert reasons(allowed(), fence=(0.5, -1.1 * LEAST)) == [("fence", -1.1 * LEAST, 0.0)]


@pytest.mark.parametrize(("climb", "told"), [(LEAST, False), (1.1 * LEAST, True), (-0.5, False), (-0.5 - 2.0 * LEAST, True)])
def test_climbing_or_sinking_further_than_allowed_is_told_as_the_fence(climb, told):
    found = reasons(allowed(sink=-0.5, climb=0.0), (0.0, 0.0, climb), fence=(0.4, 0.3))
    assert found == ([("fence", 0.3, 0.0)] if told else [])


@pytest.mark.parametrize(("due", "lacking"), [(0.3, 0.0), (LEAST, LEAST), (1.1 * LEAST, 1.1 * LEAST), (0.5, 0.5)])
def test_what_a_command_lacks_of_the_way_out_is_told(due, lacking):
    """Along x so much is asked for; along y less than the command does. More than rounding must be lacking."""
    normals, asked = np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([due, 0.0])
    held = Allowance(np.empty(0), np.zeros(2), normals, asked, np.zeros(2), -0.5, 0.5, np.zeros((2, 3)))
    found = reasons(held, (due - lacking, 0.4, 0.0))
    assert found == ([("hold_off", lacking, 0.0)] if lacking > LEAST else [])
