"""The observation builder: frames, LiDAR conventions, and refusal of anything that is not a number."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy_export.contract import ChannelSpec, LidarSpec, ObservationLayout, default_layout, paper_layout
from policy_export.observation import ObservationBuilder, beam_bearings_rad

coordinate = st.floats(-100.0, 100.0)
vector = st.tuples(coordinate, coordinate, coordinate)
SCAN = np.full(180, 2.0)
ZERO = (0.0, 0.0, 0.0)


def turned(v: tuple[float, float, float], yaw: float) -> np.ndarray:
    """Corridor to heading frame as a complex product: an independent way to write the turn."""
    flat = complex(v[0], v[1]) * complex(math.cos(yaw), -math.sin(yaw))
    return np.array([flat.real, flat.imag, v[2]])


@given(position=vector, velocity=vector, acceleration=vector, goal=vector, yaw=st.floats(-math.pi, math.pi))
def test_heading_layout(position: tuple, velocity: tuple, acceleration: tuple, goal: tuple, yaw: float) -> None:
    observation = ObservationBuilder(default_layout()).build(SCAN, position, velocity, acceleration, yaw, goal)
    offset = tuple(np.subtract(goal, position))
    expected = np.concatenate([turned(offset, yaw), turned(velocity, yaw), turned(acceleration, yaw), [yaw]])
    np.testing.assert_allclose(observation[180:], expected, rtol=1e-5, atol=1e-4)
    assert observation.dtype == np.float32


@given(position=vector, velocity=vector, acceleration=vector, goal=vector, yaw=st.floats(-math.pi, math.pi))
def test_paper_layout_keeps_corridor_axes(position: tuple, velocity: tuple, acceleration: tuple, goal: tuple, yaw: float) -> None:
    observation = ObservationBuilder(paper_layout()).build(SCAN, position, velocity, acceleration, yaw, goal)
    expected = np.concatenate([np.subtract(goal, position), velocity, turned(acceleration, yaw), [yaw]])
    np.testing.assert_allclose(observation[180:], expected, rtol=1e-5, atol=1e-4)


def test_goal_to_the_left_is_positive_y_and_turning_left_moves_it_right() -> None:
    builder = ObservationBuilder(default_layout())
    assert builder.build(SCAN, ZERO, ZERO, ZERO, 0.0, (0.0, 5.0, 0.0))[181] == pytest.approx(5.0)
    ahead = builder.build(SCAN, ZERO, ZERO, ZERO, math.pi / 2, (0.0, 5.0, 0.0))
    assert ahead[180] == pytest.approx(5.0)
    assert ahead[181] == pytest.approx(0.0, abs=1e-6)


def test_lidar_conventions() -> None:
    ranges = SCAN.copy()
    ranges[:6] = [math.inf, 0.0, 0.05, 0.1, 4.0, 17.0]
    observation = ObservationBuilder(default_layout()).build(ranges, ZERO, ZERO, ZERO, 0.0, ZERO)
    np.testing.assert_allclose(observation[:6], [4.0, 0.0, 0.0, 0.1, 4.0, 4.0])


@given(yaw=st.floats(-50.0, 50.0))
def test_yaw_is_wrapped(yaw: float) -> None:
    found = float(ObservationBuilder(default_layout()).build(SCAN, ZERO, ZERO, ZERO, yaw, ZERO)[189])
    assert abs(found) <= math.pi + 1e-6
    assert math.cos(found) == pytest.approx(math.cos(yaw), abs=1e-5)
    assert math.sin(found) == pytest.approx(math.sin(yaw), abs=1e-5)


@given(
    which=st.sampled_from(["position", "velocity", "acceleration", "goal"]),
    axis=st.integers(0, 2),
    bad=st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_a_vector_that_is_not_finite_is_refused_by_name(which: str, axis: int, bad: float) -> None:
    values = {name: [0.0, 0.0, 0.0] for name in ("position", "velocity", "acceleration", "goal")}
    values[which][axis] = bad
    with pytest.raises(ValueError, match=f"{which} is not finite"):
        ObservationBuilder(default_layout()).build(
            SCAN, values["position"], values["velocity"], values["acceleration"], 0.0, values["goal"]
        )


@given(beam=st.integers(0, 179))
def test_nan_in_the_scan_is_refused(beam: int) -> None:
    ranges = SCAN.copy()
    ranges[beam] = math.nan
    with pytest.raises(ValueError, match="ranges hold NaN"):
        ObservationBuilder(default_layout()).build(ranges, ZERO, ZERO, ZERO, 0.0, ZERO)


def test_yaw_and_shapes_are_checked() -> None:
    builder = ObservationBuilder(default_layout())
    with pytest.raises(ValueError, match="yaw"):
        builder.build(SCAN, ZERO, ZERO, ZERO, math.nan, ZERO)
    with pytest.raises(ValueError, match="shape"):
        builder.build(SCAN[:179], ZERO, ZERO, ZERO, 0.0, ZERO)
    with pytest.raises(ValueError, match="3 components"):
        builder.build(SCAN, (0.0, 0.0), ZERO, ZERO, 0.0, ZERO)


def test_a_layout_in_another_order_is_honoured() -> None:
    layout = ObservationLayout(
        size=12,
        lidar=LidarSpec(beams=5),
        channels=(
            ChannelSpec(name="yaw", unit="rad", frame="corridor", start=0, stop=1),
            ChannelSpec(name="position", unit="m", frame="corridor", start=1, stop=4),
            ChannelSpec(name="lidar", unit="m", frame="sensor", start=4, stop=9),
            ChannelSpec(name="velocity", unit="m/s", frame="corridor", start=9, stop=12),
        ),
    )
    found = ObservationBuilder(layout).build(np.arange(5.0), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), ZERO, 0.5, ZERO)
    np.testing.assert_allclose(found, [0.5, 1, 2, 3, 0, 1, 2, 3, 4, 4, 5, 6])


def test_bearings_are_symmetric_and_grow_to_the_left() -> None:
    bearings = beam_bearings_rad(LidarSpec())
    assert bearings[0] == pytest.approx(-math.pi / 2 + math.pi / 360)
    np.testing.assert_allclose(bearings, -bearings[::-1], atol=1e-12)
    assert (np.diff(bearings) > 0).all()
