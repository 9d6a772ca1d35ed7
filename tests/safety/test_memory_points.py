"""Which points the memory holds, against a plain list of them, and each of its limits met exactly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from safety_plant import config, scan, state

from safety.lidar import BeamTable, SeenScan, see
from safety.memory import CAPACITY, ObstacleMemory, _edges

C = config(memory_s=1.0, memory_hold_s=0.25)
Point = tuple[float, float, float, float]  # x, y, spread, time of sight


def reach_of(seen: SeenScan, bearing_rad: float) -> float:
    """How far the beam into a direction saw; not a number where there is none."""
    turn = 2.0 * math.pi
    offset = (bearing_rad - seen.yaw_rad - seen.angle_min_rad) % turn
    beam = round(offset / seen.angle_increment_rad) if offset < turn - 0.5 * seen.angle_increment_rad else 0
    return float(seen.range_m[beam]) if beam < seen.beams else math.nan


def still_held(point: Point, seen: SeenScan, reach_m: float) -> bool:
    """Young, in reach, not seen anew, and not looked past for longer than a drop-out."""
    x, y, _, time_s = point
    away_m = math.hypot(x - seen.origin_x_m, y - seen.origin_y_m)
    saw_m = reach_of(seen, math.atan2(y - seen.origin_y_m, x - seen.origin_x_m))
    if seen.time_s - time_s > 1.0 or away_m >= reach_m or abs(saw_m - away_m) <= 0.2:
        return False
    return seen.time_s - time_s <= 0.25 or not saw_m > away_m


def added(seen: SeenScan, reach_m: float) -> list[Point]:
    """Places 0.15 m behind returns beside which a beam saw more than 0.2 m further, then all returns; those in reach."""
    far, plain, k = [], [], 0
    for beam, range_m in enumerate(seen.range_m.tolist()):
        if not math.isfinite(range_m):
            continue
        x, y, spread = float(seen.x_m[k]), float(seen.y_m[k]), float(seen.spread_m[k])
        k += 1
        dx, dy = x - seen.origin_x_m, y - seen.origin_y_m
        away_m = math.hypot(dx, dy)
        beside = [seen.range_m[other] for other in (beam - 1, beam + 1) if 0 <= other < seen.beams]
        if away_m < reach_m:
            plain.append((x, y, spread, seen.time_s))
            if any(other - range_m > 0.2 for other in beside):
                share = 1.0 + 0.15 / max(away_m, 0.15)
                far.append((seen.origin_x_m + share * dx, seen.origin_y_m + share * dy, spread, seen.time_s))
    return far + plain


def random_scan(chance: np.random.Generator, time_s: float, beams: int, fov_rad: float) -> SeenScan:
    kinds = ([np.inf, np.nan], chance.uniform(0.05, 0.2, 2), chance.uniform(0.5, 4.0, 8))
    ranges = np.concatenate(kinds)[chance.integers(0, 12, beams)]
    ranges = np.where(chance.random(beams) < 0.5, np.roll(ranges, 1), ranges)
    pose = state(*chance.uniform(-1.0, 1.0, 2), yaw=chance.uniform(-9.0, 9.0), time_s=time_s)
    return see(scan(ranges, time_s=time_s, fov=fov_rad), pose, BeamTable(), C)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("beams", "fov_rad"), [(60, math.pi), (40, 2.0 * math.pi), (25, 0.8)])
def test_the_memory_is_a_plain_list_of_points(seed, beams, fov_rad):
    chance, memory, plain, time_s = np.random.default_rng(seed), ObstacleMemory(), list[Point](), 8.0
    for _ in range(12):
        time_s += float(chance.choice((0.05, 0.125, 0.4)))
        seen, reach_m = random_scan(chance, time_s, beams, fov_rad), float(chance.choice((1.5, 3.0)))
        memory.update(seen, reach_m, C)
        plain = [point for point in plain if still_held(point, seen, reach_m)] + added(seen, reach_m)
        assert memory.count == len(plain)
        rows = np.array(plain).reshape(-1, 4).T
        held, places_m = memory._points[:, : memory.count], memory.places_m
        assert held == pytest.approx(rows, abs=1e-12)
        assert places_m == pytest.approx(rows[:2], abs=1e-12)
    assert len(plain) > 10


_MIDDLE = np.array([np.nan, 2.0, np.nan])
ALONG = SeenScan(
    0.0, 0.0, 0.0, 0.0, -0.1, 0.1, np.array([2.0]), np.array([0.0]), np.array([0.01]), _MIDDLE, _MIDDLE, None
)  # fmt: skip


def looking(saw_m: float, time_s: float, x_m: float = 0.0) -> SeenScan:
    """Three beams ahead of which the middle one saw so far; no return of its own."""
    nothing = np.empty(0)
    ranges = np.array([np.nan, saw_m, np.nan])
    return replace(
        ALONG, time_s=time_s, origin_x_m=x_m, x_m=nothing, y_m=nothing, spread_m=nothing, range_m=ranges, free_m=ranges
    )


def held_after(later: SeenScan, reach_m: float = 5.0) -> int:
    """Points left of a single return two metres ahead, seen at 0, once a later scan has nothing new to add."""
    memory = ObstacleMemory()
    memory.update(ALONG, 5.0, C)
    assert memory.count == 1
    return int(np.count_nonzero(memory._kept(later, reach_m, C)))


def test_a_point_is_young_up_to_exactly_its_time():
    assert held_after(looking(math.nan, 1.0)) == 1
    assert held_after(looking(math.nan, math.nextafter(1.0, 2.0))) == 0


def test_a_point_that_is_looked_past_is_held_up_to_exactly_a_drop_out():
    assert held_after(looking(math.inf, 0.25)) == 1
    assert held_after(looking(math.inf, math.nextafter(0.25, 1.0))) == 0
    assert held_after(looking(3.0, 0.5)) == 0
    assert held_after(looking(1.0, 0.5)) == 1


def test_a_point_at_the_end_of_reach_is_out_of_it():
    assert held_after(looking(math.nan, 0.0), 2.0) == 0
    assert held_after(looking(math.nan, 0.0), math.nextafter(2.0, 3.0)) == 1
    memory = ObstacleMemory()
    for reach_m, count in ((2.0, 0), (math.nextafter(2.0, 3.0), 1)):
        memory.update(ALONG, reach_m, C)
        assert memory.count == count
        memory.clear()


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_same_place_is_up_to_exactly_as_far(side):
    """A point a fifth of a metre away, and a beam that ends there, 0.2 m nearer or further, in floating point exactly."""
    memory = ObstacleMemory()
    away_m = 0.2 if side > 0.0 else 0.4
    memory._points[:, 0], memory._count = (away_m, 0.0, 0.0, 0.0), 1
    assert abs(away_m + side * 0.2 - away_m) == 0.2
    kept = memory._kept(looking(away_m + side * 0.2, 0.0), 5.0, C)
    assert (kept.tolist(), kept.dtype) == ([False], np.bool_)
    assert memory._kept(looking(away_m + side * 0.2000001, 0.0), 5.0, C).tolist() == [True]


@pytest.mark.parametrize(
    ("bearing_rad", "saw_m"),
    [
        (-0.149, 1.0),
        (-0.051, 1.0),
        (-0.049, 2.0),
        (0.049, 2.0),
        (0.051, 3.0),
        (0.149, 3.0),
        (0.151, None),
        (-0.151, None),
        (3.1, None),
    ],
)
def test_a_direction_belongs_to_the_nearest_beam(bearing_rad, saw_m):
    """Half a beam beyond the first and the last one nothing is seen."""
    seen = replace(ALONG, range_m=np.array([1.0, 2.0, 3.0]), yaw_rad=7.0)
    reach = ObstacleMemory._reach(seen, np.array([bearing_rad + 7.0]))
    assert reach.tolist() == pytest.approx([math.nan if saw_m is None else saw_m], nan_ok=True)


def test_a_beam_that_saw_exactly_as_much_further_as_the_same_thing_may_is_no_edge():
    assert _edges(np.array([0.4, 0.2, 0.4])).tolist() == [False] * 3
    assert _edges(np.array([0.4, math.nextafter(0.2, 0.0), 0.4])).tolist() == [False, True, False]


def test_a_near_return_has_its_far_side_no_further_than_twice_as_far():
    """At 0.05 m the place behind is another 0.05 m away: 0.15 m over at least 0.15 m is all of the way."""
    for away_m, behind_m in ((0.05, 0.1), (0.15, 0.3), (0.3, 0.45)):
        memory, ranges = ObstacleMemory(), np.array([9.0, away_m, 9.0])
        memory.update(replace(ALONG, origin_y_m=1.0, x_m=np.array([9.0, away_m, 9.0]), y_m=np.ones(3), spread_m=np.zeros(3),
                              range_m=ranges), 1.0, C)  # fmt: skip
        assert memory.places_m[0].tolist() == pytest.approx([behind_m, away_m])
        assert memory.places_m[1].tolist() == [1.0, 1.0]


def test_age_drift_and_motion_add_to_the_spread():
    """At 0.05 m/s of velocity error drift ends at twice the position error; an obstacle's own motion ends after a second."""
    memory = ObstacleMemory()
    memory.update(replace(ALONG, time_s=8.0), 5.0, C)
    quick, quicker = config(obstacle_speed_m_s=0.4), config(obstacle_speed_m_s=1.0)
    for age_s, drift_m, moved_m in ((-0.5, 0.0, 0.0), (0.5, 0.025, 0.2), (1.0, 0.05, 0.4), (1.5, 0.075, 0.4), (3.0, 0.1, 0.4)):
        x, y, extra = memory.points(8.0 + age_s, C)
        assert (x.tolist(), y.tolist()) == ([2.0], [0.0])
        assert extra.tolist() == pytest.approx([0.01 + drift_m])
        assert memory.points(8.0 + age_s, quick)[2].tolist() == pytest.approx([0.01 + drift_m + moved_m])
        assert memory.points(8.0 + age_s, quicker)[2].tolist() == pytest.approx([0.01 + drift_m + 2.5 * moved_m])


def ring(count: int, time_s: float, away_m: float) -> SeenScan:
    """So many returns with their numbers as y, and beams that saw nothing else."""
    numbers = np.arange(count, dtype=float)
    return replace(ALONG, time_s=time_s, x_m=np.full(count, away_m), y_m=numbers * 1e-3, spread_m=numbers,
                   range_m=np.full(count, away_m), angle_min_rad=2.0, angle_increment_rad=1e-4)  # fmt: skip


@pytest.mark.parametrize(("first", "second"), [(1000, 1048), (1000, 1049), (2000, 500), (2048, 2048), (5, 3000), (2049, 0)])
def test_the_oldest_points_make_room(first, second):
    """Of both scans together the last 2048 are held, in order."""
    memory = ObstacleMemory()
    for k, count in enumerate((first, second)):
        memory.update(ring(count, 0.01 * k, 4.0 - 2.0 * k), 9.0, C)
    expected = [(0.0, n) for n in range(first)][-CAPACITY:] + [(0.01, n) for n in range(second)]
    assert list(zip(memory._points[3, : memory.count], memory._points[2, : memory.count], strict=True)) == expected[-CAPACITY:]
    assert memory.count == min(len(expected), CAPACITY)
    memory.clear()
    assert (memory.count, memory.places_m.shape) == (0, (2, 0))
