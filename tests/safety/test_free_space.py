"""What counts as seen free: beams, tilt, lost beams, own place, age, scrolling; and that every error is on the careful side."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import cast, config, scan, state

from safety.free_space import CARVE_M, CELL_M, SIDE_CELLS, TAKE_OFF_M, FreeSpace
from safety.lidar import BeamTable, see
from safety.unseen_cells import SURFACE_CELLS

C = config()
NOTHING = np.empty((2, 0))
BEHIND = 1.5  # metres: beyond the take-off disc, inside what a scan shows


def looked(free=None, pose=None, ranges=None, time_s=0.0, c=C, **kinds):
    """A map that has taken in one scan more."""
    free = free or FreeSpace(c)
    free.update(see(scan(ranges, time_s=time_s, **kinds), pose or state(time_s=time_s), BeamTable(), c))
    return free


def seen_at(free, x, y, now_s=0.0, near=NOTHING, wide=False):
    return int(free.unseen(np.array([[x], [y]]), near, now_s, wide)[0]) == 0


def seen_cells(free) -> np.ndarray:
    """Centres [n, 2] of the cells ever seen."""
    i, j = np.nonzero(np.isfinite(free._seen_s))
    return (np.stack((i + free._corner[0], j + free._corner[1]), axis=1) + 0.5) * CELL_M


def test_before_the_first_scan_nothing_is_seen():
    assert not seen_at(FreeSpace(C), 5.0, 0.0)
    free = looked()
    assert seen_at(free, 5.0, 0.0)
    free.clear()
    assert not seen_at(free, 5.0, 0.0)


@pytest.mark.parametrize(("dx", "dy", "is_seen"), [(1.5, 0.0, True), (1.0, 1.0, True), (0, BEHIND, False), (-BEHIND, 0, False)])
def test_ahead_is_seen_beside_and_behind_is_not(dx, dy, is_seen):
    assert seen_at(looked(), 5.0 + dx, dy) == is_seen


def test_all_round_scan_sees_behind():
    free = looked(beams=360, fov=2 * math.pi)
    for turn in range(12):
        assert seen_at(free, 5.0 + BEHIND * math.cos(turn), BEHIND * math.sin(turn))


def test_view_turns_with_the_vehicle():
    for turns in (-2, 0, 3):
        yaw = math.pi + 2 * math.pi * turns
        free = looked(pose=state(yaw=yaw))
        assert seen_at(free, 5.0 - BEHIND, 0.0)
        assert not seen_at(free, 5.0 + BEHIND, 0.0)


def test_edges_of_the_view_count_as_unseen():
    """fov_margin_rad: the more of the edges is unseen, the less is carved."""
    counts = [len(seen_cells(looked(c=config(fov_margin_rad=margin)))) for margin in (0.0, 0.1, 0.3)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[2]


def test_just_engaged_only_its_own_place_is_free():
    free = looked(ranges=np.zeros(180))
    far = np.hypot(*(seen_cells(free) - (5.05, 0.05)).T)
    assert far.max() <= TAKE_OFF_M + 1e-9
    assert seen_at(free, 5.05, 0.05, wide=True)
    assert not seen_at(free, 5.05 + TAKE_OFF_M, 0.05)


@pytest.mark.parametrize(("pitch", "is_seen"), [(0.0, True), (0.1, True), (-0.1, True), (-0.35, False), (0.35, False)])
def test_tilted_beams_show_free_space_only_near_the_height_of_the_vehicle(pitch, is_seen):
    assert seen_at(looked(pose=state(z=3.0, pitch=pitch)), 5.0 + BEHIND, 0.0) == is_seen


def test_single_lost_beam_is_bridged_but_a_sector_is_not():
    ranges = np.full(180, np.inf)
    ranges[[0, 90, 179]] = np.nan
    assert seen_at(looked(ranges=ranges), 5.0 + BEHIND, 0.0)
    ranges[80:100] = np.nan
    assert not seen_at(looked(ranges=ranges), 5.0 + BEHIND, 0.0)
    assert seen_at(looked(ranges=ranges), 5.0 + 1.05, -1.4)


def test_a_sector_that_loses_every_third_beam_is_not_seen():
    """Each lost beam has good neighbours, but too many are lost around there: what the good ones show does not count."""
    ranges = np.full(180, np.inf)
    ranges[75:105:3] = np.nan
    assert not seen_at(looked(ranges=ranges), 5.0 + BEHIND, 0.0)
    assert seen_at(looked(ranges=ranges), 5.0 + 1.05, -1.4)


def test_all_lost_shows_nothing():
    assert len(seen_cells(looked(ranges=np.full(180, np.nan)))) == len(seen_cells(looked(ranges=np.zeros(180))))


def test_age_runs_out_but_not_where_the_vehicle_stands():
    """Looked ahead, turned away: what is ahead is free until memory_s; the place itself stays free."""
    free = looked()
    for k in range(1, int(C.memory_s) + 2):
        looked(free, state(yaw=math.pi, time_s=float(k)), time_s=float(k))
    assert seen_at(free, 6.5, 0.0, C.memory_s - 0.01)
    assert not seen_at(free, 6.5, 0.0, C.memory_s + 0.01)
    assert seen_at(free, 5.0, 0.0, C.memory_s + 1.0)


def test_age_is_counted_between_scans_too():
    free = looked()
    assert seen_at(free, 6.5, 0.0, C.memory_s)
    assert not seen_at(free, 6.5, 0.0, C.memory_s + 0.01)


def test_surroundings_of_a_return_belong_to_it():
    """A wall is known as returns: what lies a little behind its face is not unseen, more of it is."""
    ranges = np.full(180, 1.0)
    free = looked(ranges=ranges)
    bearings = scan().angle_min_rad + scan().angle_increment_rad * np.arange(180)
    near = np.stack((5.0 + np.cos(bearings), np.sin(bearings)))
    place = 5.0 + 1.0 - 0.35 - 0.1
    assert not seen_at(free, place, 0.0)
    assert seen_at(free, place, 0.0, near=near)
    assert not seen_at(free, place + SURFACE_CELLS * CELL_M + 0.15, 0.0, near=near)


def test_map_follows_the_vehicle_and_forgets_what_is_left_behind():
    free = looked()
    for k in range(1, 60):
        looked(free, state(x=5.0 + 0.1 * k, time_s=0.05 * k), time_s=0.05 * k)
    assert seen_at(free, 8.0, 0.0, 3.0)
    assert seen_at(free, 12.0, 0.0, 3.0)
    assert not seen_at(free, 4.0, 0.0, 3.0)  # on the map no more
    cells = seen_cells(free)
    assert (np.abs(cells - (10.9, 0.0)).max(axis=0) <= (SIDE_CELLS / 2 + 8) * CELL_M).all()


@pytest.mark.parametrize(("x", "y"), [(5.0, 90.0), (90.0, 0.0), (-90.0, 0.0), (5.0, -90.0)])
def test_jump_of_the_estimate_leaves_an_empty_map(x, y):
    free = looked(looked(), state(x=x, y=y, time_s=0.05), time_s=0.05, ranges=np.zeros(180))
    assert np.hypot(*(seen_cells(free) - (x, y)).T).max() <= C.vehicle_radius_m + 2 * CELL_M
    assert not seen_at(free, 5.0, 0.0)


@pytest.mark.parametrize(("x", "y"), [(90.0, 0.0), (5.0, -90.0)])
def test_off_the_map_is_unseen(x, y):
    free = looked()
    assert not seen_at(free, x, y)
    assert free.gap_m(np.array([[x], [y]]), NOTHING, 0.0)[0] == 0.0


boxes = st.lists(st.tuples(*[st.floats(-2.5, 2.5)] * 2, *[st.floats(0.1, 1.0)] * 2), min_size=0, max_size=4)


@given(boxes, st.floats(0.0, 0.09), st.floats(0.0, 0.09), st.floats(-4.0, 4.0), st.sampled_from([90, 180, 181, 720]))
@settings(max_examples=60, deadline=None)
def test_a_cell_is_free_only_when_all_of_it_was_in_sight(found, dx, dy, yaw, beams):
    """Oracle: every corner of a carved cell is nearer than what the beam into its direction measured, and inside the view."""
    x, y = 5.0 + dx, dy
    placed = np.array([(x + a, y + b, x + a + c, y + b + d) for a, b, c, d in found]).reshape(-1, 4)
    blank = scan(beams=beams)
    bearings = blank.angle_min_rad + blank.angle_increment_rad * np.arange(beams)
    free = looked(pose=state(x=x, y=y, yaw=yaw), ranges=cast(placed, x, y, bearings + yaw), beams=beams)
    cells = seen_cells(free)
    cells = cells[np.hypot(*(cells - (math.floor(x / CELL_M) * CELL_M + 0.05, 0.05)).T) > TAKE_OFF_M + 1e-6]
    measured = cast(placed, x, y, bearings + yaw)
    for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        across = cells + 0.5 * CELL_M * np.array(corner) - (x, y)
        reach = np.hypot(*across.T)
        ahead = np.remainder(np.arctan2(across[:, 1], across[:, 0]) - yaw + math.pi, 2 * math.pi) - math.pi
        assert (np.abs(ahead) <= math.pi / 2 - C.fov_margin_rad + 1e-9).all()
        beam = np.rint((ahead - blank.angle_min_rad) / blank.angle_increment_rad).astype(int)
        assert (measured[beam] >= reach - 1e-5).all()
        assert (reach <= CARVE_M + 1e-6).all()


@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.booleans())
@settings(max_examples=60, deadline=None)
def test_counting_agrees_with_looking_at_every_cell(dx, dy, wide):
    """Oracle: zero unseen cells exactly when no unseen cell is within the radius of any point of the middle cell."""
    free = looked(ranges=np.full(180, 1.3))
    x, y = 5.5 + dx, dy
    reach = C.vehicle_radius_m + C.position_error_m + C.velocity_error_m_s * C.delay_s + 0.0146
    i, j = math.floor(x / CELL_M) - free._corner[0], math.floor(y / CELL_M) - free._corner[1]
    rows, columns = np.nonzero(~np.isfinite(free._seen_s))
    apart = CELL_M * np.hypot(np.maximum(np.abs(rows - i) - 1, 0), np.maximum(np.abs(columns - j) - 1, 0))
    touched = bool((apart <= reach + (CELL_M if wide else 0.0)).any())
    assert seen_at(free, x, y, wide=wide) == (not touched)


def test_gap_is_the_distance_to_the_nearest_unseen_cell():
    free = looked(ranges=np.zeros(180))
    places = np.array(((5.05, 5.15, 5.45), (0.05, 0.05, 0.05)))
    cells = (np.stack(np.nonzero(~np.isfinite(free._seen_s)), axis=1) + free._corner + 0.5) * CELL_M
    for x, y, gap in zip(*places, free.gap_m(places, NOTHING, 0.0), strict=True):
        across = np.maximum(np.abs(cells - (x, y)) - 0.5 * CELL_M, 0.0)
        assert gap == pytest.approx(min(float(np.hypot(*across.T).min()), 0.6), abs=1e-6)


def test_with_moving_obstacles_the_unseen_grows_into_the_seen():
    """V_o: one cell per cell that an obstacle may have moved; the vehicle's own place stays."""
    c = config(obstacle_speed_m_s=0.5)
    free, before = looked(c=c), None
    for k in range(1, 21):
        looked(free, state(time_s=0.1 * k), np.zeros(180), 0.1 * k, c=c)
        count = len(seen_cells(free))
        assert before is None or count <= before
        before = count
    assert not seen_at(free, 6.5, 0.0, 2.0)
    assert seen_at(free, 5.0, 0.0, 2.0)
    still = looked()
    for k in range(1, 21):
        looked(still, state(time_s=0.1 * k), np.zeros(180), 0.1 * k)
    assert seen_at(still, 6.5, 0.0, 2.0)


def test_shrinking_takes_one_cell_from_all_sides():
    c = config(obstacle_speed_m_s=1.0)
    free = looked(c=c)
    free._seen_s.fill(-np.inf)
    free._seen_s[20:31, 40:51] = 0.0
    free._shrink(0.25)
    expected = np.zeros((SIDE_CELLS, SIDE_CELLS), dtype=bool)
    expected[22:29, 42:49] = True
    assert np.array_equal(np.isfinite(free._seen_s), expected)
    free._shrink(0.29)
    assert np.array_equal(np.isfinite(free._seen_s), expected)
    free._shrink(0.301)
    assert np.isfinite(free._seen_s).sum() == 25


@given(st.lists(st.floats(0.0, 4.5), min_size=180, max_size=180), st.integers(0, 179), st.floats(0.0, 1.0))
@settings(max_examples=40, deadline=None)
def test_nearer_never_shows_more(ranges, beam, nearer):
    free = looked(ranges=np.array(ranges))
    ranges[beam] *= nearer
    fewer = looked(ranges=np.array(ranges))
    assert not (np.isfinite(fewer._seen_s) & ~np.isfinite(free._seen_s)).any()


@given(st.lists(st.floats(0.5, 4.0), min_size=180, max_size=180))
@settings(max_examples=20, deadline=None)
def test_mirrored_view_is_the_mirrored_map(ranges):
    left = looked(pose=state(x=5.05, y=0.05), ranges=np.array(ranges))
    right = looked(pose=state(x=5.05, y=0.05), ranges=np.array(ranges[::-1]))
    middle = SIDE_CELLS // 2
    a, b = np.isfinite(left._seen_s)[:, 1:], np.isfinite(right._seen_s)[:, 1:][:, ::-1]
    assert a[:, middle - 26 : middle + 25].sum() > 100
    assert (a != b).mean() < 2e-3  # bearings that fall between two beams may go either way


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_same_scans_give_the_same_map_in_the_same_space(seed):
    random = np.random.default_rng(seed)
    flights = [(random.uniform(4, 6), random.uniform(-1, 1), random.uniform(0.2, 4.5, 180)) for _ in range(12)]
    maps = []
    for _ in range(2):
        free = FreeSpace(C)
        for k, (x, y, ranges) in enumerate(flights):
            looked(free, state(x=x, y=y, time_s=0.05 * k), ranges, 0.05 * k)
        assert free._seen_s.shape == free._spare.shape == (SIDE_CELLS, SIDE_CELLS)
        maps.append(free._seen_s)
    assert np.array_equal(*maps)


def test_quick_look_around_claims_nothing_it_cannot_know():
    """Before the first scan, and at the rim of the map, what is around must be counted."""
    assert not FreeSpace(C).all_seen_around(5.0, 0.0, 0.0)
    free = looked(ranges=np.full(360, np.inf), beams=360, fov=2.0 * math.pi)
    assert free.all_seen_around(5.05, 0.05, 0.0)
    assert not free.all_seen_around(5.0 + 6.3, 0.05, 0.0)
