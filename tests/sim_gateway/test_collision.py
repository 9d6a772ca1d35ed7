"""Sphere-to-box distance against a brute-force nearest point."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_gateway.collision import clearance_m

UNIT = np.array([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0]])
coordinates = st.tuples(*[st.floats(-5, 5)] * 3).map(np.array)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((2.0, 0.5, 0.5), 1.0),  # face
        ((2.0, 2.0, 0.5), math.sqrt(2.0)),  # edge
        ((2.0, 2.0, 2.0), math.sqrt(3.0)),  # corner
        ((1.0, 0.5, 0.5), 0.0),  # on the surface
        ((0.5, 0.5, 0.9), -0.1),  # inside, by depth to the nearest face
    ],
)
def test_known_distances(position, expected):
    assert clearance_m(UNIT, np.array(position), 0.0) == pytest.approx(expected)
    assert clearance_m(UNIT, np.array(position), 0.35) == pytest.approx(expected - 0.35)


def test_nearest_box_counts_and_no_box_is_infinitely_far():
    boxes = np.vstack([UNIT + 10.0, UNIT])
    assert clearance_m(boxes, np.array([2.0, 0.5, 0.5]), 0.0) == pytest.approx(1.0)
    assert clearance_m(np.empty((0, 6)), np.zeros(3), 0.3) == math.inf


@given(position=coordinates, low=coordinates, size=st.tuples(*[st.floats(0.05, 3)] * 3).map(np.array))
def test_agrees_with_the_nearest_point_of_the_box(position, low, size):
    box = np.concatenate([low, low + size])[None, :]
    outside = np.linalg.norm(position - np.clip(position, low, low + size))
    got = clearance_m(box, position, 0.0)
    if outside > 1e-9:
        assert got == pytest.approx(outside, abs=1e-9)
    else:
        assert got == pytest.approx(-min(np.min(position - low), np.min(low + size - position)), abs=1e-9)


@given(position=coordinates, step=coordinates)
def test_changes_no_faster_than_the_centre_moves(position, step):
    boxes = np.vstack([UNIT, UNIT - 3.0])
    moved = clearance_m(boxes, position + 0.1 * step, 0.35)
    assert abs(moved - clearance_m(boxes, position, 0.35)) <= 0.1 * np.linalg.norm(step) + 1e-9
