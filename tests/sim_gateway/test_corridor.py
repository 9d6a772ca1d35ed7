import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from sim_gateway.corridor import CorridorConfig, CorridorError, generate_corridor, wall_boxes
from sim_gateway.paths import path_exists, shortest_path_length

seeds = st.integers(0, 2**40)
MOVING = CorridorConfig(movers=(1, 4))
WALLS = len(wall_boxes(CorridorConfig()))


def edge_gap(a, b):
    """Horizontal distance between two boxes."""
    gap = np.maximum(np.maximum(a[:2] - b[3:5], b[:2] - a[3:5]), 0.0)
    return math.hypot(*gap)


def point_gap(box, point):
    return edge_gap(box, np.array([*point[:2], 0, *point[:2], 0], dtype=float))


@settings(max_examples=150, deadline=None)
@given(seed=seeds)
def test_pillars_keep_their_distances(seed):
    config = CorridorConfig()
    world = generate_corridor(seed, config)
    pillars = world.static_boxes[WALLS:]
    assert config.pillars[0] <= len(pillars) <= config.pillars[1]
    for i, a in enumerate(pillars):
        assert all(edge_gap(a, b) >= 1.0 - 1e-9 for b in pillars[i + 1 :])
        assert min(point_gap(a, world.start), point_gap(a, world.goal)) >= 1.5 - 1e-9
        width, depth = a[3] - a[0], a[4] - a[1]
        assert width == pytest.approx(depth)
        assert 0.4 <= width <= 1.0 + 1e-9
        assert (a[2], a[5]) == (0.0, 10.0)
        assert -4.0 - 1e-9 <= a[1] <= a[4] <= 4.0 + 1e-9


@settings(max_examples=150, deadline=None)
@given(seed=seeds)
def test_beside_each_pillar_one_side_is_open(seed):
    pillars = generate_corridor(seed).static_boxes[WALLS:]
    for pillar in pillars:
        level = [b for b in pillars if b is not pillar and b[0] < pillar[3] and b[3] > pillar[0]]
        left = min([4.0] + [b[1] for b in level if b[1] >= pillar[4]]) - pillar[4]
        right = pillar[1] - max([-4.0] + [b[4] for b in level if b[4] <= pillar[1]])
        assert max(left, right) >= 1.0 - 1e-9


@settings(max_examples=100, deadline=None)
@given(seed=seeds)
def test_start_and_goal_lie_where_they_should_and_a_way_exists(seed):
    world = generate_corridor(seed)
    assert 3.0 <= world.start[0] <= 5.0
    assert abs(world.start[1]) <= 2.0
    assert world.start[2] == 0.0
    assert 30.0 <= world.goal[0] <= 34.0
    assert 1.5 <= world.goal[2] <= 3.0
    above = (*world.start[:2], world.goal[2])
    assert path_exists(world.static_boxes, above, world.goal, 0.45)
    straight = math.dist(above, world.goal)
    assert straight - 1e-9 <= shortest_path_length(world.static_boxes, above, world.goal, 0.35) < 1.2 * straight


def test_the_same_seed_gives_the_same_bytes():
    for seed in (0, 1, 2**63):
        first, second = generate_corridor(seed, MOVING), generate_corridor(seed, MOVING)
        assert first.static_boxes.tobytes() == second.static_boxes.tobytes()
        assert (first.movers, first.start, first.goal) == (second.movers, second.start, second.goal)
    assert generate_corridor(1).static_boxes.tobytes() != generate_corridor(2).static_boxes.tobytes()


def test_a_known_seed_keeps_its_corridor():
    """Guards recorded results: a change of the drawing order would silently change every split."""
    world = generate_corridor(1)
    assert world.start == pytest.approx((4.023643249400513, 1.8018547853037412, 0.0), abs=1e-12)
    assert world.goal == pytest.approx((30.576638450878534, 1.7945977885489754, 1.967747178015728), abs=1e-12)
    assert len(world.static_boxes) == WALLS + 7


@settings(max_examples=60, deadline=None)
@given(seed=seeds, time_s=st.floats(0.0, 300.0))
def test_movers_keep_their_lanes_and_leave_a_way_at_every_moment(seed, time_s):
    world = generate_corridor(seed, MOVING)
    boxes = world.boxes_at(time_s)
    pillars, moving = boxes[WALLS : len(world.static_boxes)], boxes[len(world.static_boxes) :]
    for i, box in enumerate(moving):
        assert -4.0 - 1e-9 <= box[1] <= box[4] <= 4.0 + 1e-9
        for other in (*pillars, *moving[i + 1 :]):
            assert max(box[0] - other[3], other[0] - box[3]) >= 1.0 - 1e-9
        for end in (world.start, world.goal):
            assert max(box[0] - end[0], end[0] - box[3]) >= 1.5 - 1e-9
    assert path_exists(boxes, (*world.start[:2], world.goal[2]), world.goal, 0.35)


@settings(max_examples=40, deadline=None)
@given(seed=seeds)
def test_mover_speeds_are_within_the_configuration(seed):
    movers = generate_corridor(seed, MOVING).movers
    assert 1 <= len(movers) <= 4
    assert all(0.2 <= mover.speed_m_s <= 0.5 for mover in movers)


def test_end_walls_can_be_left_out():
    closed, opened = CorridorConfig(), CorridorConfig(end_walls=False)
    assert len(wall_boxes(closed)) == 4
    assert len(wall_boxes(opened)) == 2
    ends = wall_boxes(closed)[2:]
    assert ends[0][3] == -0.5
    assert ends[1][0] == 35.5


def test_a_corridor_that_cannot_be_drawn_says_what_to_relax():
    crowded = CorridorConfig(pillars=(32, 32), pillar_x_m=(15.0, 17.0))
    with pytest.raises(CorridorError, match="fewer or narrower pillars"):
        generate_corridor(0, crowded)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"pillars": (5, 4)}, "pillars"),
        ({"pillars": (0, 99)}, "pillars"),
        ({"movers": (-1, 2)}, "movers"),
        ({"width_m": 3.0, "pillar_width_m": (0.4, 2.0)}, "width_m"),
        ({"goal_x_m": (30.0, 36.0)}, "goal_x_m"),
        ({"start_y_m": (-3.9, 0.0)}, "start_y_m"),
        ({"goal_z_m": (0.0, 2.0)}, "goal_z_m"),
        ({"mover_speed_m_s": (0.0, 0.5)}, "mover_speed_m_s"),
        ({"length_m": math.nan}, "length_m"),
        ({"lenght_m": 35.0}, "lenght_m"),
    ],
)
def test_bad_configurations_are_refused_by_name(change, field):
    with pytest.raises(ValidationError, match=field):
        CorridorConfig(**change)


# ways among boxes


def barrier(gap_m):
    """A wall across, with one gap centred on y = 1, inside a closed room."""
    low, high = 1.0 - 0.5 * gap_m, 1.0 + 0.5 * gap_m
    room = wall_boxes(CorridorConfig(length_m=11.0, goal_x_m=(8, 9), start_x_m=(1, 2)))
    return np.vstack([room, [[5.0, -4.0, 0, 5.2, low, 10], [5.0, high, 0, 5.2, 4.0, 10]]])


START, GOAL = (2.0, 1.0, 2.0), (9.0, 1.0, 2.0)


@pytest.mark.parametrize(("gap_m", "passes"), [(1.2, True), (0.9, True), (0.69, False), (0.0, False)])
def test_a_gap_is_passed_only_if_wide_enough(gap_m, passes):
    assert path_exists(barrier(gap_m), START, GOAL, 0.35, resolution_m=0.05) is passes
    assert math.isfinite(shortest_path_length(barrier(gap_m), START, GOAL, 0.35)) is passes


def test_boxes_below_the_flight_height_do_not_count():
    low = np.vstack([wall_boxes(CorridorConfig()), [[5.0, -4.0, 0.0, 5.2, 4.0, 1.0]]])
    assert path_exists(low, START, GOAL, 0.35)
    assert not path_exists(low, (2.0, 1.0, 0.5), GOAL, 0.35)


def test_a_start_inside_a_widened_box_has_no_way():
    assert not path_exists(barrier(1.2), (4.8, -1.0, 2.0), GOAL, 0.35)
    assert shortest_path_length(barrier(1.2), (4.8, -1.0, 2.0), GOAL, 0.35) == math.inf


def test_too_fine_a_grid_is_refused():
    with pytest.raises(ValueError, match="resolution_m"):
        path_exists(barrier(1.2), START, GOAL, 0.35, resolution_m=0.001)


def test_the_free_way_is_the_straight_line_in_three_dimensions():
    assert shortest_path_length(np.empty((0, 6)), (0, 0, 1), (3, 4, 13), 0.35) == pytest.approx(13.0)


@pytest.mark.parametrize("radius_m", [0.1, 0.35, 1.0])
def test_the_way_around_one_box_is_just_below_the_exact_one(radius_m):
    box = np.array([[-0.5, -0.5, 0.0, 0.5, 0.5, 10.0]])
    reach = 6.0
    # exact: tangent from (-6, 0) to the circle around corner (-0.5, 0.5), arc, along the face, and the same on the far side
    across, up = reach - 0.5, 0.5
    tangent = math.sqrt(across**2 + up**2 - radius_m**2)
    angle = math.atan2(up, across) + math.asin(radius_m / math.hypot(across, up))
    exact = 2.0 * (tangent + radius_m * angle) + 1.0
    found = shortest_path_length(box, (-reach, 0.0, 2.0), (reach, 0.0, 2.0), radius_m)
    assert found <= exact + 1e-9
    assert found > 0.99 * exact


@settings(max_examples=60, deadline=None)
@given(seed=seeds, radius_m=st.sampled_from([0.2, 0.45, 0.6]))
def test_a_proven_way_has_a_finite_length_that_grows_with_the_radius(seed, radius_m):
    world = generate_corridor(seed, CorridorConfig(pillars=(12, 12)))
    above = (*world.start[:2], world.goal[2])
    length = shortest_path_length(world.static_boxes, above, world.goal, radius_m)
    assert math.isfinite(length) or not path_exists(world.static_boxes, above, world.goal, radius_m)
    # 1 %: the chords that cut the corners differ between radii
    assert shortest_path_length(world.static_boxes, above, world.goal, 0.1) <= 1.01 * length
