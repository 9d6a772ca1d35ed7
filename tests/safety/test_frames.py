"""Signs, handedness and round trips of the frame conversions."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safety.frames import (
    CorridorFrame,
    CorridorVector,
    HeadingVector,
    NedVector,
    corridor_to_heading,
    heading_to_corridor,
    wrap_angle_rad,
)

metres = st.floats(-1000.0, 1000.0)
angles = st.floats(-10.0, 10.0)
NORTH_UP = CorridorFrame(NedVector(0.0, 0.0, 0.0), 0.0)


def close(a: object, b: object) -> bool:
    return all(math.isclose(getattr(a, axis), getattr(b, axis), rel_tol=1e-9, abs_tol=1e-9) for axis in ("x", "y", "z"))


def test_left_is_west_and_up_is_minus_down_when_the_corridor_runs_north() -> None:
    assert close(NORTH_UP.vector_to_ned(CorridorVector(1.0, 2.0, 3.0)), NedVector(1.0, -2.0, -3.0))


def test_left_is_north_when_the_corridor_runs_east() -> None:
    east = CorridorFrame(NedVector(0.0, 0.0, 0.0), math.pi / 2)
    assert close(east.vector_to_ned(CorridorVector(1.0, 0.0, 0.0)), NedVector(0.0, 1.0, 0.0))
    assert close(east.vector_to_ned(CorridorVector(0.0, 1.0, 0.0)), NedVector(1.0, 0.0, 0.0))


def test_turning_left_is_counter_clockwise_here_and_negative_in_ned() -> None:
    assert NORTH_UP.yaw_to_ned(0.3) == pytest.approx(-0.3)
    assert NORTH_UP.yaw_to_corridor(0.3) == pytest.approx(-0.3)
    assert CorridorFrame.yaw_rate_to_ned(0.5) == -0.5
    ahead = heading_to_corridor(HeadingVector(1.0, 0.0, 0.0), math.pi / 2)
    assert close(ahead, CorridorVector(0.0, 1.0, 0.0))


def test_yaw_and_vectors_agree() -> None:
    frame = CorridorFrame(NedVector(3.0, -2.0, 1.0), 0.7)
    yaw = 0.4
    nose = frame.vector_to_ned(heading_to_corridor(HeadingVector(1.0, 0.0, 0.0), yaw))
    assert math.atan2(nose.y, nose.x) == pytest.approx(frame.yaw_to_ned(yaw))


@given(metres, metres, metres, angles)
def test_points_and_vectors_come_back(x: float, y: float, z: float, heading: float) -> None:
    frame = CorridorFrame(NedVector(12.0, -7.0, -488.0), heading)
    point = CorridorVector(x, y, z)
    assert close(frame.point_to_corridor(frame.point_to_ned(point)), point)
    assert close(frame.vector_to_corridor(frame.vector_to_ned(point)), point)
    assert close(heading_to_corridor(corridor_to_heading(point, heading), heading), point)


@given(metres, metres, metres, angles)
def test_the_anchor_has_the_coordinates_it_was_given(x: float, y: float, z: float, heading: float) -> None:
    stands, has = NedVector(4.0, 5.0, -6.0), CorridorVector(x, y, z)
    assert close(CorridorFrame.anchored(stands, has, heading).point_to_corridor(stands), has)


@given(angles, angles)
def test_yaw_comes_back_wrapped(heading: float, yaw: float) -> None:
    frame = CorridorFrame(NedVector(0.0, 0.0, 0.0), heading)
    back = frame.yaw_to_corridor(frame.yaw_to_ned(yaw))
    assert math.cos(back - yaw) == pytest.approx(1.0)
    assert -math.pi <= wrap_angle_rad(yaw) <= math.pi


@given(metres, metres, st.floats(0.0, 1.0), angles)
def test_lengths_do_not_change(x: float, y: float, z: float, heading: float) -> None:
    frame = CorridorFrame(NedVector(0.0, 0.0, 0.0), heading)
    v = frame.vector_to_ned(CorridorVector(x, y, z))
    assert math.hypot(v.x, v.y, v.z) == pytest.approx(math.hypot(x, y, z))
