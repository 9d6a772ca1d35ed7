"""What the adversaries found: pressed into a corner by drift, the vehicle must be led out, whatever lies on which side."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safety_plant import Plant, command, config

from safety.allowance import _way_out_m_s
from safety.config import Fence
from safety.fence_rules import fence_problem
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.limits import AT_REST, LastSent, limit_command, sent_after, within_limits
from safety.messages import VelocityCommand

CONFIG = config()
POCKET = np.array([(9.0, -0.85, 9.2, 0.85), (8.0, 0.65, 9.0, 0.85), (8.0, -0.85, 9.0, -0.65)])
AHEAD, LEFT, RIGHT = (-1.0, 0.0), (0.0, -1.0), (0.0, 1.0)
angles = st.floats(-math.pi, math.pi)
parts = st.floats(-3.0, 3.0)


def due(*demands: tuple[tuple[float, float], float, int]) -> tuple[np.ndarray, np.ndarray]:
    """Directions [2, h] and speeds [h] of demands (direction, speed, how many points ask for it)."""
    normals = np.array([normal for normal, _, count in demands for _ in range(count)]).T
    return normals, np.array([speed for _, speed, count in demands for _ in range(count)])


@pytest.mark.parametrize("counts", [(1, 1), (40, 1), (1, 40)])
def test_the_way_out_of_a_corner_does_not_depend_on_how_many_points_a_side_has(counts):
    normals, speeds = due((AHEAD, 0.2, counts[0]), (RIGHT, 0.15, counts[1]))
    assert _way_out_m_s(normals, speeds, CONFIG) == pytest.approx((-0.2, 0.15), abs=1e-6)


def test_an_acute_corner_is_left_no_faster_than_the_return_speed():
    slanted = (0.38, math.sqrt(1.0 - 0.38**2))
    way = _way_out_m_s(*due((AHEAD, 0.25, 9), (slanted, 0.25, 9)), CONFIG)
    assert math.hypot(*way) == pytest.approx(0.3, abs=1e-6)
    assert min(-way[0], way @ slanted) > 0.1


def test_between_opposite_sides_it_ends_in_the_middle():
    way = _way_out_m_s(*due((LEFT, 0.25, 3), (RIGHT, 0.25, 5), (AHEAD, 0.1, 1)), CONFIG)
    assert way == pytest.approx((-0.1, 0.0), abs=1e-6)


@given(angles, angles, st.floats(0.01, 0.25), st.floats(0.01, 0.25))
def test_two_demands_are_both_met_as_far_as_the_return_speed_allows(a, b, first, second):
    normals = np.array(((math.cos(a), math.cos(b)), (math.sin(a), math.sin(b))))
    way = _way_out_m_s(normals, np.array((first, second)), CONFIG)
    assert math.hypot(*way) <= CONFIG.return_speed_m_s
    if math.cos(a - b) > 0.0:
        assert (way @ normals > 0.0).all()
        if math.hypot(*way) < 0.999 * CONFIG.return_speed_m_s:
            assert (way @ normals >= 0.9 * np.array((first, second))).all()


@pytest.mark.parametrize("error", [-0.05, 0.05])
@pytest.mark.parametrize("aside", [-0.3, 0.3])
def test_drift_into_the_corner_of_a_dead_end_does_not_end_in_contact(aside, error):
    """The estimate lags behind the walls: 0.05 m/s of drift for 20 s, while the policy presses on."""
    plant = Plant(x=7.0, boxes=POCKET, noise_m=0.01, lag_s=0.6, velocity_error=(-0.05, error, 0.0))
    safety, least = SafetyFilter(CONFIG), math.inf
    for _ in range(400):
        sent, _ = safety.apply(command(1.0, aside), plant.estimate(), plant.scan(), plant.time_s)
        plant.fly(sent)
        least = min(least, plant.gap)
    assert plant.x > 8.3  # it is in there
    assert least > 0.0


def test_floor_is_held_off_from_where_nothing_passes_horizontally():
    """Pressed between two walls too near for any horizontal command, sinking by the velocity error."""
    slot = np.array([(3.0, 0.36, 12.0, 1.0), (3.0, -1.0, 12.0, -0.36), (5.6, -0.4, 5.7, 0.4)])
    plant = Plant(x=5.1, z=0.55, boxes=slot, velocity_error=(-0.05, 0.0, 0.05))
    safety = SafetyFilter(CONFIG)
    for _ in range(300):
        sent, _ = safety.apply(command(0.0, 0.0, -0.5), plant.estimate(), plant.scan(), plant.time_s)
        plant.fly(sent)
    assert plant.z > CONFIG.fence.low_m[2] + CONFIG.vehicle_half_height_m


@given(parts, parts, parts, parts, parts, parts)
def test_limits_let_pass_what_they_themselves_made(x, y, z, to_x, to_y, to_z):
    first, _ = limit_command(VelocityCommand(CorridorVector(x, y, z), 0.0), AT_REST, 0.05, 4.0, CONFIG)
    last = sent_after(AT_REST, first.velocity, 0.05)
    then, _ = limit_command(VelocityCommand(CorridorVector(to_x, to_y, to_z), 0.0), last, 0.05, 4.0, CONFIG)
    made = np.array([(then.velocity.x, then.velocity.y, then.velocity.z), (0.0, 0.0, 0.0)])
    assert within_limits(made, last, 0.05, CONFIG).all()


def test_an_evading_command_keeps_to_the_limits():
    last = LastSent(CorridorVector(1.2, 0.0, 0.0), CorridorVector(0.0, 0.0, 0.0))
    turned = np.array([(0.6, 0.6, 0.0), (0.6, 0.35, 0.0), (1.2, 0.1, 0.0), (0.0, 0.35, 0.0), (0.0, 0.0, 0.51), (-0.3, 0.0, 0.0)])
    assert within_limits(turned, last, 0.05, CONFIG).tolist() == [False, True, False, True, False, True]
    slow_start = CONFIG.model_copy(update={"max_jerk_m_s3": 100.0})
    assert within_limits(turned, last, 0.05, slow_start).tolist() == [False, False, False, False, False, False]


def test_the_fence_is_eroded_by_the_drift_of_a_velocity_error():
    one, two = CONFIG, config(velocity_error_m_s=0.1)
    assert two.keep_in_z()[0] - one.keep_in_z()[0] == pytest.approx(0.05 * one.fault_hold_s)
    assert two.eroded_fence().edges.erosion_m[0] - one.eroded_fence().edges.erosion_m[0] == pytest.approx(0.05 * one.fault_hold_s)


@given(angles)
def test_edges_apart_on_one_line_do_not_touch_whichever_way_they_are_turned(angle):
    """The narrow waist of an hourglass: rounding put the ends of the two upper edges on different sides of their common line."""
    ring = ((0, 0), (5, 0), (5, 2), (8, 2.4), (8, 0), (13, 0), (13, 6), (8, 6), (8, 4), (5, 3.8), (5, 6), (0, 6))
    c, s = math.cos(angle), math.sin(angle)
    turned = tuple((c * x - s * y, s * x + c * y) for x, y in ring)
    assert fence_problem(turned, ()) is None
    assert Fence(floor_m=0.0, ceiling_m=3.0, inclusion=turned).polygon == turned
