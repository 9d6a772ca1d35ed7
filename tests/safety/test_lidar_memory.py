"""What counts as free, as obstacle and as unknown; what is remembered and for how long."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from safety_plant import command, config, scan, state

from safety.filter import SafetyFilter
from safety.lidar import BeamTable, _unseen, clean_ranges, scan_offset, scan_problem, see
from safety.memory import CAPACITY, LEAST_DEPTH_M, SAME_PLACE_M, ObstacleMemory, _edges
from safety.messages import LidarScan

C = config()


def seen(ranges=None, pose=None, time_s=0.0, **kinds):
    return see(scan(ranges, time_s=time_s, **kinds), pose or state(time_s=time_s), BeamTable(), C)


def one_return(beam: int, range_m: float, beams: int = 180) -> np.ndarray:
    ranges = np.full(beams, np.inf)
    ranges[beam] = range_m
    return ranges


@pytest.mark.parametrize("value", [0.0, -0.0, -1.0, -np.inf, 0.05, 0.0999])
def test_too_near_is_an_obstacle_at_the_vehicle(value):
    """Edge 23: the closest beams are never dropped."""
    assert clean_ranges(scan(one_return(90, value)))[90] == pytest.approx(0.05)


@pytest.mark.parametrize(("value", "kept"), [(65.535, False), (4.2, False), (4.05, True), (0.1, True), (4.0, True)])
def test_beyond_the_sensor_is_unknown_never_free(value, kept):
    cleaned = clean_ranges(scan(one_return(90, value)))[90]
    assert cleaned == pytest.approx(value) if kept else math.isnan(cleaned)


def test_infinity_is_free_and_nan_unknown():
    found = seen(one_return(90, np.nan))
    assert math.isnan(found.range_m[90])
    assert np.isinf(found.range_m[89])
    assert found.x_m.shape == (0,)


@pytest.mark.parametrize(
    "bad",
    [
        lambda s: LidarScan(0.0, s.ranges_m.reshape(2, 90), *rest(s)),
        lambda s: LidarScan(0.0, s.ranges_m[:1], *rest(s)),
        lambda s: LidarScan(0.0, np.ones(5000, dtype=np.float32), *rest(s)),
        lambda s: LidarScan(0.0, s.ranges_m.astype(np.int32, casting="unsafe"), *rest(s)),
        lambda s: LidarScan(0.0, list(s.ranges_m), *rest(s)),
        lambda s: LidarScan(0.0, s.ranges_m, s.angle_min_rad, 0.0, 0.1, 4.0),
        lambda s: LidarScan(0.0, s.ranges_m, s.angle_min_rad, -s.angle_increment_rad, 0.1, 4.0),
        lambda s: LidarScan(0.0, s.ranges_m, s.angle_min_rad, 0.1, 0.1, 4.0),
        lambda s: LidarScan(0.0, s.ranges_m, s.angle_min_rad, s.angle_increment_rad, 4.0, 4.0),
        lambda s: LidarScan(0.0, s.ranges_m, s.angle_min_rad, s.angle_increment_rad, -0.1, 4.0),
        lambda s: LidarScan(0.0, s.ranges_m, math.nan, s.angle_increment_rad, 0.1, 4.0),
        lambda s: LidarScan(0.0, s.ranges_m, s.angle_min_rad, s.angle_increment_rad, 0.1, math.inf),
    ],
)
def test_malformed_scans_are_named(bad):
    with np.errstate(invalid="ignore"):
        assert str(scan_problem(bad(scan()))).startswith("scan_")


@pytest.mark.parametrize(
    ("beams", "parts", "problem"),
    [
        (2, {}, None), (1, {}, "scan_shape"), (4096, {}, None), (4097, {}, "scan_shape"),
        (2, {"angle_increment_rad": math.pi + 0.5e-3}, None), (2, {"angle_increment_rad": math.pi + 0.51e-3}, "scan_geometry"),
        (9, {"angle_increment_rad": 0.0}, "scan_geometry"), (9, {"angle_increment_rad": -1e-9}, "scan_geometry"),
        (9, {"range_min_m": 0.0}, None), (9, {"range_min_m": -1e-9}, "scan_geometry"), (9, {"range_min_m": 4.0}, "scan_geometry"),
        (9, {"time_s": math.nan}, "scan_not_finite"), (9, {"angle_min_rad": math.inf}, "scan_not_finite"),
        (9, {"angle_increment_rad": math.nan}, "scan_not_finite"), (9, {"range_min_m": -math.inf}, "scan_not_finite"),
        (9, {"range_max_m": math.inf}, "scan_not_finite"), (9, {"ranges_m": np.ones(9, dtype=np.int32)}, "scan_shape"),
        (9, {"ranges_m": [1.0] * 9}, "scan_shape"), (9, {"ranges_m": np.ones((3, 3))}, "scan_shape"),
        (9, {"ranges_m": np.array(1.0)}, "scan_shape"), (9, {"ranges_m": np.ones(9, dtype=bool)}, "scan_shape"),
        (9, {"range_min_m": 5.0}, "scan_geometry"),
        (9, {"ranges_m": np.ones(9, dtype=np.float64)}, None),
    ],
)  # fmt: skip
def test_what_a_scan_may_be_is_exact(beams, parts, problem):
    one = LidarScan(0.0, np.ones(beams, dtype=np.float32), -1.0, 0.0015, 0.1, 4.0)
    assert scan_problem(dataclasses.replace(one, **parts)) == problem


def test_ranges_are_cleaned_exactly_at_both_ends():
    least, most = 0.1, 4.0 + 0.1
    ranges = np.array([math.nextafter(least, 0.0), least, most, math.nextafter(most, 9.0), -math.inf, math.inf])
    cleaned = clean_ranges(LidarScan(0.0, ranges, -1.0, 0.1, least, 4.0))
    assert cleaned.tolist() == pytest.approx([0.05, least, most, math.nan, 0.05, math.inf], nan_ok=True)


@pytest.mark.parametrize("parts", [{}, {"angle_min_rad": -1.2}, {"angle_increment_rad": 0.02}, {"ranges_m": np.ones(30)}])
def test_bearings_are_those_of_the_newest_geometry(parts):
    table, first = BeamTable(), LidarScan(0.0, np.ones(40), -1.0, 0.03, 0.1, 4.0)
    table.prepare(first)
    then = dataclasses.replace(first, **parts)
    table.prepare(then)
    bearings = [then.angle_min_rad + k * then.angle_increment_rad for k in range(then.ranges_m.shape[0])]
    assert table.cos == pytest.approx(np.cos(bearings))
    assert table.sin == pytest.approx(np.sin(bearings))


@given(st.floats(-20.0, 20.0), st.floats(-4.0, 4.0), st.sampled_from([0.01, 0.3]))
@example(-0.16, 0.0, 0.3)
def test_offset_from_the_first_beam_is_within_one_turn_from_half_a_beam_before_it(bearing_rad, first_rad, step_rad):
    found = see(LidarScan(0.0, np.ones(9), first_rad, step_rad, 0.1, 4.0), state(), BeamTable(), C)
    offset = float(scan_offset(found, np.array([bearing_rad]))[0])
    assert -0.5 * step_rad - 1e-12 <= offset <= 2.0 * math.pi - 0.5 * step_rad + 1e-12
    assert math.remainder(offset - (bearing_rad - first_rad), 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


def rest(s):
    return s.angle_min_rad, s.angle_increment_rad, s.range_min_m, s.range_max_m


def test_good_scan_has_no_problem():
    assert scan_problem(scan()) is None
    assert scan_problem(scan(beams=360, fov=2 * math.pi)) is None


@pytest.mark.parametrize(("beam", "side"), [(0, -1), (179, 1)])
def test_first_beam_is_right_last_is_left(beam, side):
    """Edge 25: the order of the beams decides left and right."""
    found = seen(one_return(beam, 2.0))
    assert found.y_m[0] * side == pytest.approx(2.0, abs=0.01)


@given(st.floats(-math.pi, math.pi), st.integers(0, 179), st.floats(0.2, 3.9))
def test_point_lies_where_the_beam_points(yaw, beam, range_m):
    found = seen(one_return(beam, range_m), state(x=3.0, y=-1.0, yaw=yaw))
    bearing = yaw - math.pi / 2 + math.pi / 180 * (beam + 0.5)
    assert found.x_m[0] == pytest.approx(3.0 + range_m * math.cos(bearing), abs=1e-5)
    assert found.y_m[0] == pytest.approx(-1.0 + range_m * math.sin(bearing), abs=1e-5)


@given(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(-1.0, 1.0), st.floats(0.0, 0.2))
def test_own_motion_between_scan_and_estimate_is_taken_out(vx, vy, rate, age):
    """A wall point ahead of the pose at scan time, seen from a state `age` later."""
    pose = state(x=5 + vx * age, y=vy * age, v=(vx, vy, 0.0), yaw=rate * age, yaw_rate=rate, time_s=age)
    found = see(scan(one_return(89, 2.0), time_s=0.0), pose, BeamTable(), C)
    assert (found.x_m[0], found.y_m[0]) == pytest.approx((5 + 2.0, 2.0 * math.sin(-math.pi / 360)), abs=1e-3)


@pytest.mark.parametrize(
    ("roll", "pitch", "beam", "low"), [(0, -0.3, 90, True), (0, 0.3, 90, False), (0.3, 0, 0, True), (0.3, 0, 179, False)]
)
def test_tilted_beam_that_meets_the_ground_is_unknown(roll, pitch, beam, low):
    """Nose down looks at the ground ahead; right side down looks at it on the right."""
    found = seen(one_return(beam, 3.0), state(z=1.0, roll=roll, pitch=pitch))
    assert math.isnan(found.range_m[beam]) == low
    assert found.x_m.shape[0] == (0 if low else 1)


@given(st.lists(st.booleans(), min_size=1, max_size=60), st.sampled_from([0.3, 0.1, 0.052, 0.05, 0.01, math.pi / 180]))
def test_a_bearing_is_unseen_where_more_than_a_fifth_of_the_beams_around_it_are_unknown(lost, increment_rad):
    """Within 0.26 rad on either side, one beam at least; at the edges of the view only what there is counts."""
    half = max(1, math.floor(0.26 / increment_rad))
    around = [lost[max(i - half, 0) : i + half + 1] for i in range(len(lost))]
    wanted = [5 * sum(window) > len(window) for window in around]
    found = _unseen(np.where(lost, np.nan, 1.0), increment_rad)
    assert (found.tolist() if found is not None else [False] * len(lost)) == wanted


def test_beams_at_the_very_edge_of_the_window_count():
    """At 0.01 rad 26 beams on either side are within 0.26 rad: eleven of 53 lost ones are more than a fifth."""
    lost = np.zeros(60, dtype=bool)
    lost[[0, *range(30, 40)]] = True
    assert _unseen(np.where(lost, np.nan, 1.0), 0.01)[26]
    assert not _unseen(np.where(lost, np.nan, 1.0), 0.0101)[26]


@pytest.mark.parametrize(("beams", "increment_rad"), [(3, math.pi / 2), (7, math.pi / 4), (180, math.pi / 180)])
def test_a_view_that_lacks_a_whole_beam_has_edges(beams, increment_rad):
    def all_round(step_rad):
        pose = state()
        return see(LidarScan(0.0, np.full(beams, 2.0), -1.0, step_rad, 0.1, 4.0), pose, BeamTable(), C).all_round

    assert not all_round(increment_rad)
    assert all_round(2.0 * math.pi / beams)
    assert all_round(2.0 * math.pi / (beams + 0.9))


def turn_about(axis, angle_rad):
    """Right-handed rotation about x (0), y (1) or z (2)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = math.cos(angle_rad)
    matrix[i, j], matrix[j, i] = -math.sin(angle_rad), math.sin(angle_rad)
    return matrix


def slowly_seen(one, pose, c):
    """Per beam: horizontal range, horizontal free distance, place of its return; by rotating one beam at a time."""
    back_s = pose.time_s - one.time_s
    origin = [getattr(pose.position, k) - getattr(pose.velocity, k) * back_s for k in "xyz"]
    yaw = pose.yaw_rad - pose.yaw_rate_rad_s * back_s
    attitude = turn_about(2, yaw) @ turn_about(1, -pose.pitch_rad) @ turn_about(0, pose.roll_rad)
    ranges, free, places = [], [], []
    for k, measured in enumerate(one.ranges_m.astype(float)):
        bearing = one.angle_min_rad + k * one.angle_increment_rad
        way = attitude @ (math.cos(bearing), math.sin(bearing), 0.0)
        r = 0.5 * one.range_min_m if measured < one.range_min_m else measured
        r = math.nan if math.isfinite(r) and r > one.range_max_m + 0.1 else r
        level = math.hypot(way[0], way[1])
        free.append(min(r, one.range_max_m, 0.3 / max(abs(way[2]), 1e-6)) * level if not math.isnan(r) else math.nan)
        on_ground = math.isfinite(r) and origin[2] + r * way[2] < c.ground_z_m + c.ground_band_m
        ranges.append(math.nan if on_ground else r * level)
        if math.isfinite(ranges[-1]):
            places.append((origin[0] + r * way[0], origin[1] + r * way[1], 0.5 * r * one.angle_increment_rad))
    return np.array(ranges), np.array(free), np.array(places).reshape(-1, 3).T


ATTITUDES = list(itertools.product((0.0, 0.03, -0.06, 0.3, -0.001), repeat=2))
HEIGHTS_M = (0.25, 0.45, 0.75, 0.85, 4.0)


@pytest.mark.parametrize("seed", range(len(ATTITUDES) * len(HEIGHTS_M)))
def test_a_scan_is_placed_as_each_beam_by_itself_would_be(seed):
    """Any attitude, height, ground and age of the scan; also tilts so small that nothing meets the ground or leaves the band."""
    random = np.random.default_rng(seed)
    beams, reach = int(random.choice([12, 60])), float(random.choice([4.0, 8.0]))
    c = config(ground_z_m=float(random.choice([0.0, 0.5, -1.0])), ground_band_m=float(random.choice([0.2, 0.05])))
    ranges = random.uniform(0.0, reach + 0.3, beams)
    ranges[random.random(beams) < 0.2] = np.inf
    ranges[random.random(beams) < 0.1] = np.nan
    one = LidarScan(8.0, ranges, -1.3, float(random.choice([0.02, 0.05])), 0.1, reach)
    (roll, pitch), height = ATTITUDES[seed % len(ATTITUDES)], HEIGHTS_M[seed // len(ATTITUDES)]
    pose = state(
        x=random.uniform(-3, 3), y=random.uniform(-3, 3), z=c.ground_z_m + height, v=tuple(random.uniform(-1, 1, 3)),
        time_s=8.0 + float(random.choice([0.0, 0.1])), yaw=random.uniform(-4, 4), yaw_rate=random.uniform(-1, 1),
        roll=roll, pitch=pitch,
    )  # fmt: skip
    found = see(one, pose, BeamTable(), c)
    range_m, free_m, places = slowly_seen(one, pose, c)
    assert found.range_m == pytest.approx(range_m, nan_ok=True)
    assert found.free_m == pytest.approx(free_m, nan_ok=True)
    assert np.array([found.x_m, found.y_m, found.spread_m]) == pytest.approx(places)


@pytest.mark.parametrize(("z", "pitch"), [(4.0, 0.076), (4.0, -0.076), (0.45, -0.07), (0.45, 0.07)])
def test_the_least_tilt_that_changes_anything_is_not_overlooked(z, pitch):
    """The band of 0.3 m is left 5 cm before the range ends; a return at 3.9 m is 0.02 m too low to be an obstacle."""
    one, pose = scan(np.where(np.arange(180) % 2, 3.9, np.inf), 0.0), state(z=z, pitch=pitch)
    found = see(one, pose, BeamTable(), C)
    range_m, free_m, _ = slowly_seen(one, pose, C)
    assert found.range_m == pytest.approx(range_m, nan_ok=True)
    assert found.free_m == pytest.approx(free_m, nan_ok=True)


def test_tilt_shortens_the_horizontal_distance():
    found = seen(one_return(90, 2.0), state(z=3.0, pitch=-0.3))
    assert found.x_m[0] - 5.0 == pytest.approx(2.0 * math.cos(0.3), abs=1e-3)


WITH_FAR_SIDE = 2  # points that a single return leaves


def fed(memory, ranges, time_s, pose=None):
    memory.update(seen(ranges, pose, time_s), 5.0, C)
    return memory.points(time_s, C)


def test_the_far_side_of_an_edge_is_kept_along_its_beam():
    """A wall 2 m ahead that ends on the left, where a box begins 1 m behind it: a far side of the wall's end alone."""
    ranges = np.full(180, 2.0)
    ranges[120:] = 3.0
    found, memory = seen(ranges), ObstacleMemory()
    x, y, _ = fed(memory, ranges, 0.0)
    assert x.shape[0] == 180 + 1
    behind = np.hypot(x[0] - 5.0, y[0]), math.atan2(y[0], x[0] - 5.0)
    assert behind == pytest.approx((2.0 + LEAST_DEPTH_M, math.atan2(found.y_m[119], found.x_m[119] - 5.0)))


@given(st.lists(st.sampled_from([1.0, 1.1, 1.5, 3.0, math.inf, math.nan]), min_size=2, max_size=12))
@example([0.4, 0.2, 0.4])  # exactly as much further as the same thing may be
def test_a_return_is_at_an_edge_when_a_beam_beside_it_saw_clearly_further(values):
    def further(i, j):
        return 0 <= j < len(values) and values[j] - values[i] > SAME_PLACE_M

    wanted = [further(i, i - 1) or further(i, i + 1) for i, value in enumerate(values) if math.isfinite(value)]
    assert _edges(np.array(values)).tolist() == wanted


def test_new_return_replaces_the_old_one():
    memory = ObstacleMemory()
    for k, range_m in enumerate((2.0, 1.96, 1.92)):
        x, _, _ = fed(memory, one_return(90, range_m), 0.05 * k)
    assert x == pytest.approx([6.92 + LEAST_DEPTH_M, 6.92], abs=0.01)


def test_drop_out_is_bridged_but_a_gone_obstacle_is_forgotten():
    """L13, L14: one scan that looks past a return does not remove it; three do."""
    memory = ObstacleMemory()
    fed(memory, one_return(90, 2.0), 0.0)
    assert fed(memory, None, 0.05)[0].shape == (WITH_FAR_SIDE,)
    assert fed(memory, None, 0.10)[0].shape == (WITH_FAR_SIDE,)
    assert fed(memory, None, 0.15)[0].shape == (0,)


def test_what_leaves_the_view_is_remembered_for_its_time():
    memory = ObstacleMemory()
    fed(memory, one_return(90, 2.0), 0.0)
    away = state(yaw=math.pi)
    assert fed(memory, None, 1.0, away)[0].shape == (WITH_FAR_SIDE,)
    assert fed(memory, None, C.memory_s - 0.1, away)[0].shape == (WITH_FAR_SIDE,)
    assert fed(memory, None, C.memory_s + 0.1, away)[0].shape == (0,)


def test_hidden_behind_something_nearer_stays():
    memory = ObstacleMemory()
    fed(memory, one_return(90, 3.0), 0.0)
    x, _, _ = fed(memory, one_return(90, 1.0), 1.0)
    assert sorted(x - 5.0) == pytest.approx([1.0, 1.0 + LEAST_DEPTH_M, 3.0, 3.0 + LEAST_DEPTH_M], abs=0.01)


def test_unknown_beam_forgets_nothing():
    memory = ObstacleMemory()
    fed(memory, one_return(90, 2.0), 0.0)
    assert fed(memory, one_return(90, np.nan), 1.0)[0].shape == (WITH_FAR_SIDE,)


def test_far_points_are_dropped():
    memory = ObstacleMemory()
    fed(memory, one_return(90, 3.0), 0.0)
    memory.update(seen(None, state(x=-5.0), 0.05), 5.0, C)
    assert memory.count == 0


@pytest.mark.parametrize(("range_m", "points"), [(4.29, WITH_FAR_SIDE), (4.31, 0)])
def test_the_filter_remembers_what_a_stop_from_twice_the_speed_limit_could_reach_and_a_little_more(range_m, points):
    """From 2.4 m/s it takes 0.6 m in the dead time and 1.8 m to brake; then 0.4 m of keep-out and 1.5 m: 4.3 m in all."""
    safety = SafetyFilter(C)
    safety.apply(command(), state(), scan(one_return(90, range_m), range_max=8.0), 0.0)
    assert safety._memory.count == points


def test_age_widens_a_point_up_to_its_bounds():
    memory = ObstacleMemory()
    fed(memory, one_return(90, 2.0), 0.0)
    spread = 2.0 * 0.5 * math.pi / 180
    assert memory.points(0.0, C)[2][0] == pytest.approx(spread)
    assert memory.points(0.5, C)[2][0] == pytest.approx(spread + 0.5 * C.velocity_error_m_s)
    assert memory.points(10.0, C)[2][0] == pytest.approx(spread + 2.0 * C.position_error_m)
    assert memory.points(1.0, config(obstacle_speed_m_s=0.5))[2][0] == pytest.approx(spread + 0.05 + 0.5)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4), st.floats(0.0, 20.0))
@example((1.0, 1.0, -1.0, -1.0), 20.0)
def test_a_point_covers_where_it_seems_to_be_now_whatever_the_estimate_errs_then_and_now(signs, age):
    """Position errors stay inside their bound on each axis and change no faster than velocity errors let them.

    Along both axes at once they may add up to a little more, which the margin is for.
    """
    then, now = np.array(signs[:2]) * C.position_error_m, np.array(signs[2:]) * C.position_error_m
    now = then + np.clip(now - then, -age * C.velocity_error_m_s, age * C.velocity_error_m_s)
    memory = ObstacleMemory()
    fed(memory, one_return(90, 2.0), 0.0, state(x=5.0 + then[0], y=then[1]))
    x, y, extra = memory.points(age, C)
    truth = seen(one_return(90, 2.0), state(x=5.0, y=0.0))
    assert math.hypot(x[-1] - (truth.x_m[0] + now[0]), y[-1] - (truth.y_m[0] + now[1])) <= extra[-1] + C.margin_m


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_memory_never_grows_and_the_newest_scan_is_always_in(seed):
    random, memory = np.random.default_rng(seed), ObstacleMemory()
    for k in range(60):
        ranges = random.uniform(0.2, 4.5, 180)
        pose = state(x=random.uniform(4, 6), yaw=random.uniform(-3, 3), time_s=0.05 * k)
        now = seen(ranges, pose, 0.05 * k)
        memory.update(now, 5.0, C)
        assert memory.count <= CAPACITY
        x, y, _ = memory.points(0.05 * k, C)
        assert np.array_equal(x[-now.x_m.shape[0] :], now.x_m)
        assert np.array_equal(y[-now.y_m.shape[0] :], now.y_m)


def test_full_memory_lets_the_oldest_go():
    """Rings, each hidden behind the next nearer one, so that none is looked at again: the first seen go first."""
    memory, rings = ObstacleMemory(), [3.8 - 0.3 * k for k in range(8)]
    for k, radius in enumerate(rings):
        memory.update(seen(np.full(360, radius), None, 0.05 * k, fov=2 * math.pi), 50.0, C)
        assert memory.count <= CAPACITY
    x, y, _ = memory.points(0.4, C)
    counts = [int(np.count_nonzero(np.abs(np.hypot(x - 5.0, y) - radius) < 1e-6)) for radius in rings]
    assert counts == [0, 0, CAPACITY - 5 * 360, 360, 360, 360, 360, 360]
    memory.clear()
    assert memory.count == 0
