"""SET_ATTITUDE_TARGET in OFFBOARD, over the wire, and that a vehicle in Hold stays on the ground."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from mavlink_bench import EMPTY, Bench
from pymavlink.dialects.v20 import development as mav

from sim_gateway.attitude_setpoints import AttitudeLaw, AttitudeSetpoint, read_attitude_target, thrust_for, yaw_of
from sim_gateway.flight_modes import FlightMode
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.simulation import Simulation
from sim_gateway.vehicle_params import GRAVITY_M_S2, IRIS

RATES_IGNORED, ATTITUDE_IGNORED = 0b111, 128
HOVER = IRIS.hover_thrust
NO_RATES = (math.nan, math.nan, math.nan)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.run(2.0)
    yield bench
    bench.close()


def _quaternion(roll_deg: float, yaw_deg: float) -> tuple[float, float, float, float]:
    r, y = math.radians(roll_deg) / 2, math.radians(yaw_deg) / 2
    return (math.cos(r) * math.cos(y), math.sin(r) * math.cos(y), math.sin(r) * math.sin(y), math.cos(r) * math.sin(y))


def _stream(bench: Bench, mask: int, seconds: float, q=(1.0, 0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), thrust=HOVER) -> None:  # type: ignore[no-untyped-def]
    for _ in range(round(seconds / 0.04)):
        bench.onboard.send(mav.MAVLink_set_attitude_target_message(0, 1, 1, mask, list(q), *rates, thrust))
        bench.run(0.04)


def _hover_offboard(bench: Bench) -> None:
    bench.pilot.arm()
    bench.pilot.takeoff()
    bench.run(10.0)
    _stream(bench, RATES_IGNORED, 0.2)
    assert bench.acks(176, 1, 6) == [0, 0]


def test_attitude_and_thrust_are_flown(bench: Bench) -> None:
    _hover_offboard(bench)
    _stream(bench, RATES_IGNORED, 1.5, _quaternion(8.0, 30.0))
    assert bench.pilot.mode is FlightMode.OFFBOARD
    now = bench.vehicle.snapshot()
    assert now.roll_pitch_yaw[0] == pytest.approx(math.radians(8.0), abs=0.02)
    assert now.roll_pitch_yaw[2] == pytest.approx(math.radians(30.0), abs=0.05)
    to_the_right = -math.sin(math.radians(30.0)) * now.velocity[0] + math.cos(math.radians(30.0)) * now.velocity[1]
    assert to_the_right > 0.8
    _stream(bench, RATES_IGNORED, 0.6, thrust=1.2 * HOVER)
    assert bench.vehicle.snapshot().velocity[2] < now.velocity[2] - 0.5


def test_body_rates_are_flown(bench: Bench) -> None:
    _hover_offboard(bench)
    _stream(bench, ATTITUDE_IGNORED, 1.0, rates=(0.0, -0.15, 0.4))
    roll, pitch, yaw = bench.vehicle.snapshot().roll_pitch_yaw
    assert yaw == pytest.approx(0.4, abs=0.15)
    assert pitch == pytest.approx(-0.15, abs=0.06)
    assert abs(roll) < 0.08


def test_velocity_setpoints_take_over_from_attitude(bench: Bench) -> None:
    _hover_offboard(bench)
    _stream(bench, RATES_IGNORED, 0.5, _quaternion(10.0, 0.0))
    for _ in range(150):
        still = mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x5C7, *(0.0,) * 11)
        bench.onboard.send(still)
        bench.run(0.04)
    assert math.dist(bench.vehicle.snapshot().velocity, (0.0, 0.0, 0.0)) < 0.1


def test_thrust_takes_off_after_spool_up_and_lands(bench: Bench) -> None:
    bench.pilot.arm()
    _stream(bench, RATES_IGNORED, 0.2, thrust=0.0)
    bench.acks(176, 1, 6)
    _stream(bench, RATES_IGNORED, 0.5, thrust=1.4 * HOVER)
    assert bench.pilot.landed, "motors are still spooling up"
    _stream(bench, RATES_IGNORED, 1.0, thrust=1.4 * HOVER)
    assert not bench.pilot.landed
    assert bench.vehicle.simulation.truth.position_m[2] > 0.1
    _stream(bench, RATES_IGNORED, 7.0, thrust=0.5 * HOVER)
    assert bench.pilot.landed


@pytest.mark.parametrize(
    ("mask", "q", "rates", "thrust"),
    [
        (RATES_IGNORED | ATTITUDE_IGNORED, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, 0.5),
        (RATES_IGNORED, (math.nan, 0.0, 0.0, 0.0), (0.0,) * 3, 0.5),
        (RATES_IGNORED, (0.0, 0.0, 0.0, 0.0), (0.0,) * 3, 0.5),
        (RATES_IGNORED, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, math.nan),
        (RATES_IGNORED | 64, (1.0, 0.0, 0.0, 0.0), (0.0,) * 3, 0.5),
        (ATTITUDE_IGNORED, (1.0, 0.0, 0.0, 0.0), NO_RATES, 0.5),
    ],
)
def test_what_cannot_be_flown_is_no_setpoint(mask: int, q: tuple[float, ...], rates: tuple[float, ...], thrust: float) -> None:
    assert read_attitude_target(mask, q, rates, thrust) is None  # type: ignore[arg-type]


def test_attitude_is_normalised_and_thrust_limited() -> None:
    given = read_attitude_target(RATES_IGNORED, (2.0, 0.0, 0.0, 2.0), (0.0,) * 3, 7.0)
    assert given is not None
    assert given.attitude is not None
    assert math.hypot(*given.attitude) == pytest.approx(1.0)
    assert yaw_of(given.attitude) == pytest.approx(math.pi / 2)
    assert given.thrust == 1.0


def test_rates_integrate_to_the_attitude_they_make() -> None:
    law = AttitudeLaw()
    for _ in range(100):
        thrust = law.update(AttitudeSetpoint(None, (0.5, 0.0, 0.0), 0.4), 0.0, 0.01)
    assert thrust.direction == pytest.approx((0.0, math.sin(0.5), -math.cos(0.5)), abs=1e-3)


def test_armed_in_hold_stays_on_the_ground_for_all_its_noise() -> None:
    vehicle = PilotedVehicle(Simulation(EMPTY, estimate="nominal", seed=5), ready_after_s=0.0)
    vehicle.advance(5)
    vehicle.autopilot.arm()
    vehicle.advance(2250)
    assert vehicle.autopilot.armed
    assert vehicle.autopilot.landed
    assert "Takeoff detected" not in [text.text for text in vehicle.autopilot.texts]


def test_an_acceleration_is_flown_by_the_thrust_that_gives_it() -> None:
    thrust = thrust_for((1.0, 0.0, 0.0), math.radians(45.0))
    assert thrust.of_hover
    assert thrust.share * thrust.direction[0] * GRAVITY_M_S2 == pytest.approx(1.0)
    assert thrust.share * thrust.direction[2] == pytest.approx(-1.0)
    steep = thrust_for((100.0, 0.0, 0.0), math.radians(45.0))
    assert steep.direction == pytest.approx((math.sqrt(0.5), 0.0, -math.sqrt(0.5)))
    assert thrust_for((0.0, 0.0, 50.0), math.radians(45.0)).direction == pytest.approx((0.0, 0.0, -1.0))  # never upside down


def test_an_acceleration_alone_is_echoed_and_ends_where_drag_meets_it(bench: Bench) -> None:
    _hover_offboard(bench)
    for _ in range(75):
        ahead = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0)
        bench.onboard.send(mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0xC3F, *ahead))
        bench.run(0.04)
    now, echo = bench.vehicle.snapshot(), bench.onboard.named("POSITION_TARGET_LOCAL_NED")[-1]
    assert now.velocity[1] == pytest.approx(3.0, abs=1.2)
    assert abs(now.velocity[2]) < 0.3
    assert (echo.type_mask, echo.afy) == (63, 1.5)
