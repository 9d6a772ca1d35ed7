"""Unseen cells on tubes, against asking the map at every single place; and which tubes that permits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from safety_plant import config

from safety.braking import Tubes
from safety.frames import CorridorVector
from safety.free_space import SIDE_CELLS, FreeSpace
from safety.sight import Hidden, Sight, View

C = config()
NOTHING = np.empty((2, 0))
NOW_S, AHEAD_S = 20.0, 1.7  # 2 (0.2 + 0.05 + 0.6): until less is left than what stays known around a vehicle


def random_view(chance: np.random.Generator, unseen: float) -> View:
    """A map around the origin: some cells never seen, some 20 s ago or a little later: forgotten at 20 s, or at 21.7 s."""
    free = FreeSpace(C)
    free._began_s, free._corner = 0.0, (-64, -64)
    shape, middle = (SIDE_CELLS, SIDE_CELLS), slice(44, 84)
    free._seen_s[:] = 15.0
    odd = chance.random(shape) < unseen
    free._seen_s[odd] = chance.choice((-np.inf, 1.0, 1.8), int(np.count_nonzero(odd)))
    near = chance.uniform(-3.0, 3.0, (2, int(chance.integers(0, 6))))
    assert np.isfinite(free._seen_s[middle, middle]).any()
    return View(free, near, NOW_S)


def random_tubes(chance: np.random.Generator, count: int) -> Tubes:
    """High up: a height that is taken for a place sideways is noticed."""
    turn = chance.uniform(-1.5, 1.5, (2, count, 3)) + np.array((0.0, 0.0, 40.0))
    return Tubes(turn, turn + chance.uniform(-1.2, 1.2, (2, count, 3)))


def on_the_way(tube: Tubes, which: int) -> list[np.ndarray]:
    """Thirteen places [2, 1] on each model's leg: at 2.4 m/s it is 2.4 m long, which are twelve steps of 0.2 m."""
    legs = zip(tube.turn_m[:, which, :2], tube.stop_m[:, which, :2], strict=True)
    return [(turn + share * (stop - turn))[:, None] for turn, stop in legs for share in np.arange(13) / 12.0]


def most(view: View, places: list[np.ndarray], wide: bool, ahead_s: float, spared: np.ndarray = NOTHING) -> int:
    return max(int(view.free.unseen(place, view.near_m, NOW_S + ahead_s, wide, spared)[0]) for place in places)


@pytest.mark.parametrize("seed", range(30))
def test_counts_are_those_of_the_worst_place_of_each_tube(seed):
    """The last tube is braking's: it alone says which cells are spared, and whether anything but `soon` matters."""
    chance = np.random.default_rng(seed)
    count = 2 + seed % 3
    view, tube = random_view(chance, float(chance.choice((0.0, 0.001, 0.01)))), random_tubes(chance, count)
    found = Sight(C).hidden(tube, view)
    ways = [on_the_way(tube, which) for which in range(count)]
    soon = [most(view, way, True, AHEAD_S) for way in ways]
    assert found.soon.tolist() == soon
    if soon[-1] == 0:
        assert (found.wide.tolist(), found.exact.tolist(), found.more.tolist()) == (soon, soon, soon)
        assert (found.gap_m.tolist(), found.brake_m.shape) == ([0.0] * count, (2, 0))
        return
    spared = np.concatenate(ways[-1], axis=1)
    assert found.brake_m == pytest.approx(spared, abs=1e-12)
    assert found.wide.tolist() == [most(view, way, True, 0.0) for way in ways]
    assert found.exact.tolist() == [most(view, way, False, 0.0) for way in ways]
    assert found.more.tolist() == [most(view, way, False, AHEAD_S, spared) for way in ways]
    gaps = [
        min(float(view.free.gap_m(tube.stop_m[k, which, :2, None], view.near_m, NOW_S)[0]) for k in (0, 1))
        for which in range(count)
    ]
    assert found.gap_m == pytest.approx(gaps, abs=1e-12)


@pytest.mark.parametrize("seed", range(8))
def test_other_tubes_are_counted_with_the_ways_of_braking_spared(seed):
    chance = np.random.default_rng(seed)
    view, tube, sight = random_view(chance, 0.02), random_tubes(chance, 3), Sight(C)
    together = sight.hidden(tube, view)
    assert together.soon[-1] > 0
    brake = together.rows(slice(2, 3))
    alone = sight.hidden(tube.rows(slice(0, 2)), view, brake)
    for name in ("soon", "wide", "exact", "more", "gap_m"):
        assert getattr(alone, name).tolist() == getattr(together, name)[:2].tolist()
    assert alone.brake_m is brake.brake_m


def test_when_braking_touches_nothing_other_tubes_are_counted_once():
    chance = np.random.default_rng(3)
    view, tube, zero = random_view(chance, 0.02), random_tubes(chance, 2), np.zeros(1, dtype=int)
    brake = Hidden(zero, zero, zero, zero, np.zeros(1), NOTHING)
    found = Sight(C).hidden(tube, view, brake)
    assert found.soon.min() > 0
    assert found.exact is found.wide is found.more is found.soon


@pytest.mark.parametrize(("speed", "shares"), [(1.2, 13), (1.25, 14), (0.3, 4), (0.31, 4), (4.0, 93)])
def test_places_on_a_leg_are_a_hull_step_apart_at_most(speed, shares):
    """From twice the speed: at 0.3 m/s 0.6 (0.25 + 0.6) = 0.51 m, at 4 m/s (64 - 1.44) / 4 + 2.72 = 18.36 m."""
    sight = Sight(config(max_horizontal_speed_m_s=speed, hold_off_speed_m_s=0.1, return_speed_m_s=0.3))
    way_m = 2.0 * speed * 0.25 + (1.2 * speed if speed <= 0.6 else ((2.0 * speed) ** 2 - 1.44) / 4.0 + 0.72)
    assert shares == math.ceil(way_m / 0.2 - 1e-9) + 1
    assert sight._shares == pytest.approx(np.arange(shares) / (shares - 1))


@pytest.mark.parametrize(("memory_s", "delay_s", "ahead_s"), [(20.0, 0.85, 1.7), (2.0, 0.85, 1.0), (20.0, 0.45, 0.9)])
def test_what_is_forgotten_soon_looks_two_blind_times_ahead_but_half_the_memory_at_most(memory_s, delay_s, ahead_s):
    sight = Sight(config(memory_s=memory_s, lag_s=delay_s - 0.25, lag_min_s=0.2))
    assert sight._ahead_s == pytest.approx(ahead_s)


def counted(soon=0, wide=0, exact=0, more=0, gap_m=0.0) -> Hidden:
    return Hidden(*(np.array([count]) for count in (soon, wide, exact, more)), np.array([gap_m]), NOTHING)


BRAKE = counted(5, 4, 3, 9, 0.2)


@pytest.mark.parametrize(
    ("parts", "permitted"),
    [
        ({}, True), ({"wide": 5}, False), ({"exact": 4}, False), ({"more": 1}, False), ({"gap_m": 0.2 - 1e-9}, True),
        ({"gap_m": 0.2 - 2e-9}, False), ({"wide": 3, "exact": 2, "gap_m": 0.6}, True), ({"soon": 1}, True), ({"soon": 99}, True),
        ({"soon": 0, "wide": 9, "exact": 9, "more": 9, "gap_m": 0.0}, True), ({"more": -1}, False),
        ({"soon": -1, "more": 1}, False),
    ],
)  # fmt: skip
def test_a_tube_may_touch_nothing_soon_or_no_more_than_braking(parts, permitted):
    other = counted(**({"soon": 5, "wide": 4, "exact": 3, "more": 0, "gap_m": 0.2} | parts))
    assert BRAKE.permits(other).tolist() == [permitted]


def test_each_tube_is_permitted_by_itself():
    rows = [counted(0, 9, 9, 9, 0.0), counted(5, 4, 3, 0, 0.2), counted(5, 4, 3, 1, 0.2), counted(5, 5, 3, 0, 0.2)]
    names = ("soon", "wide", "exact", "more", "gap_m")
    others = Hidden(*(np.concatenate([getattr(row, name) for row in rows]) for name in names), NOTHING)
    permitted = BRAKE.permits(others)
    assert permitted.tolist() == [True, True, False, False]
    assert permitted.dtype == np.bool_
    middle = others.rows(slice(1, 3))
    assert [getattr(middle, name).tolist() for name in names] == [[5, 5], [4, 4], [3, 3], [0, 1], [0.2, 0.2]]
    assert middle.brake_m is NOTHING


def seen_but(i: int, j: int, at_s: float = -math.inf) -> View:
    """All seen at 15 s but for one cell."""
    free = FreeSpace(C)
    free._began_s, free._corner = 0.0, (-64, -64)
    free._seen_s.fill(15.0)
    free._seen_s[64 + i, 64 + j] = at_s
    return View(free, NOTHING, NOW_S)


@pytest.mark.parametrize(("i", "lost"), [(0, True), (5, True), (6, False), (-5, True), (-6, False), (8, False)])
def test_a_vehicle_is_lost_when_its_hull_touches_the_unseen(i, lost):
    """0.457 m: five cells on, the next column begins 0.4 m from the middle one, the sixth 0.5 m."""
    here, sight = CorridorVector(0.05, 0.05, 2.0), Sight(C)
    assert sight.lost(here, seen_but(i, 0)) == lost
    assert sight.lost(here, seen_but(0, i)) == lost
    known = np.array([[0.1 * i + 0.05], [0.05]])
    assert not sight.lost(here, replace(seen_but(i, 0), near_m=known))


def test_lost_is_judged_now_and_clear_when_the_vehicle_will_stand():
    """Seen at 1 s it is known until 21 s: not lost at 20 s, but not clear any more 1.7 s later; seen at 1.75 s it is."""
    here, sight = CorridorVector(0.05, 0.05, 2.0), Sight(C)
    for at_s, clear in ((1.0, False), (1.65, False), (1.75, True)):
        view = seen_but(3, 0, at_s)
        assert not sight.lost(here, view)
        assert sight.all_clear((0.05, 0.05, 1.0), (0.05, 0.05, 1.0), view) == clear
        assert view.all_seen(np.array([0.05, 0.05, 1.0]), np.array([0.05, 0.05, 1.0]), 0.0)
        assert view.all_seen(np.array([0.05, 0.05, 1.0]), np.array([0.05, 0.05, 1.0]), AHEAD_S) == clear
        assert view.unseen(np.array([[0.05], [0.05]]), wide=True)[0] == 0
        assert (view.unseen(np.array([[0.05], [0.05]]), True, AHEAD_S)[0] == 0) == clear


def test_without_a_time_ahead_cells_are_counted_now():
    """Twenty seconds of memory: seen at 0 s a cell is known at 20 s for the last time."""
    here = np.array([[0.05], [0.05]])
    assert seen_but(3, 0, 0.0).unseen(here, wide=True)[0] == 0
    assert seen_but(3, 0, -0.5).unseen(here, wide=True)[0] > 0


def test_a_box_is_clear_where_known_returns_explain_the_unseen():
    view, sight = seen_but(3, 0), Sight(C)
    corners = (0.05, 0.05, 1.0), (0.25, 0.15, 1.0)
    assert not sight.all_clear(*corners, view)
    assert sight.all_clear(*corners, replace(view, near_m=np.array([[0.35], [0.05]])))


@pytest.mark.parametrize(
    ("i", "j", "seen"), [(26, 0, False), (27, 0, True), (-16, 0, False), (-17, 0, True), (0, 16, False), (0, 17, True)]
)
def test_all_is_seen_around_legs_as_far_as_the_hull_and_a_cell(i, j, seen):
    """Legs from -1 to 2 m along x and 0 to 1 m along y: six cells beyond their ends count."""
    begin, end = np.array([[[0.05, 0.05, 0.0], [2.05, 0.95, 0.0]]]), np.array([[[-0.95, 0.05, 9.0], [0.05, 1.05, -9.0]]])
    assert seen_but(i, j).all_seen(begin, end, 0.0) == seen
    assert seen_but(i, j).all_seen(end, begin, 0.0) == seen
