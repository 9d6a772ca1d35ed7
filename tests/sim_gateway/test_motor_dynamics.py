"""The airframe under motor commands: PX4's order and signs, the ground, what the inertial sensor feels."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_gateway.motor_dynamics import LEG_M, NONE_IRIS, MotorDynamics, standing_height_m
from sim_gateway.simulation import Simulation
from sim_gateway.vehicle import POS, QUAT
from tests.sim_gateway.mavlink_bench import EMPTY

HOVER, HEIGHT_M = 0.5, 10.0


def _vehicle(height_m: float = HEIGHT_M) -> tuple[Simulation, MotorDynamics]:
    dynamics = MotorDynamics()
    simulation = Simulation(EMPTY, NONE_IRIS, estimate="none", dynamics=dynamics)
    simulation.carry((0.0, 0.0, height_m), 0.0)
    return simulation, dynamics


def _pass(simulation: Simulation, seconds: float) -> None:
    for _ in range(round(seconds / 0.004)):
        simulation.advance(1, (0.0, 0.0, 0.0), 0.0)


def test_hovers_at_half_throttle_and_feels_its_weight() -> None:
    simulation, dynamics = _vehicle()
    dynamics.commands[:] = HOVER
    _pass(simulation, 0.5)
    climb = simulation.truth.velocity_m_s[2]
    _pass(simulation, 1.0)
    assert simulation.truth.velocity_m_s[2] == pytest.approx(climb, abs=0.1), "only the motors' start was missing"
    assert dynamics.specific_force_m_s2 == pytest.approx((0.0, 0.0, 9.81), abs=0.1)


def test_falls_weightless() -> None:
    simulation, dynamics = _vehicle()
    _pass(simulation, 0.5)
    assert simulation.truth.velocity_m_s[2] == pytest.approx(-9.81 * 0.5, abs=0.3)
    assert abs(dynamics.specific_force_m_s2[2]) < 1.2, "air alone"


@pytest.mark.parametrize(
    ("stronger", "roll", "pitch", "yaw"),
    [((0,), -1, 1, -1), ((1,), 1, -1, -1), ((2,), 1, 1, 1), ((3,), -1, -1, 1), ((1, 2), 1, 0, 0), ((0, 2), 0, 1, 0)],
)
def test_px4s_motor_order(stronger: tuple[int, ...], roll: int, pitch: int, yaw: int) -> None:
    """Front right, rear left, front left, rear right; the first two turn counter-clockwise, which turns the body clockwise."""
    simulation, dynamics = _vehicle()
    dynamics.commands[:] = HOVER
    dynamics.commands[list(stronger)] += 0.02
    _pass(simulation, 0.1)
    rates = simulation.truth.angular_rate_rad_s  # ahead, left, up
    for rate, sign in zip((rates[0], -rates[1], rates[2]), (roll, pitch, yaw), strict=True):
        assert (rate > 1e-3) - (rate < -1e-3) == sign


def test_stands_still_and_is_not_pushed_off_by_wind() -> None:
    simulation, dynamics = _vehicle(standing_height_m(NONE_IRIS))
    simulation.disturb((0.0,) * 3, (0.0,) * 3, (6.0, 0.0, 0.0))
    _pass(simulation, 10.0)
    x, _, z = simulation.truth_position_m
    assert simulation.landed
    assert (x, z) == (pytest.approx(0.0, abs=0.5), pytest.approx(LEG_M, abs=0.01))
    assert dynamics.rate_rad_s == pytest.approx((0.0,) * 3, abs=1e-3)


def test_lands_softly_on_its_feet() -> None:
    simulation, dynamics = _vehicle(0.3)
    simulation.carry((0.0, 0.0, 0.3), 0.0, (0.2, 0.0, -0.7))
    dynamics.commands[:] = 0.3
    _pass(simulation, 3.0)
    assert simulation.landed
    assert math.hypot(*simulation.truth.velocity_m_s) < 1e-3
    assert abs(simulation.truth.pitch_rad) < 1e-3


@settings(deadline=None, max_examples=25)
@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4), st.tuples(*[st.floats(0.0, 1.0)] * 4), st.floats(0.05, 3.0))
def test_whatever_falls_to_the_ground_comes_to_rest_on_it(
    turn: tuple[float, float, float, float], commands: tuple[float, float, float, float], height_m: float
) -> None:
    simulation, dynamics = _vehicle(height_m)
    size = math.sqrt(sum(value * value for value in turn))
    if size > 0.1:
        simulation._state[QUAT : QUAT + 4] = np.array(turn) / size
    dynamics.commands[:] = commands
    _pass(simulation, 0.3)
    dynamics.commands[:] = 0.0
    _pass(simulation, 8.0)
    assert simulation.landed
    assert -0.05 < simulation.state_row[POS + 2] < 0.4
    assert math.hypot(*simulation.truth.velocity_m_s) < 0.05
