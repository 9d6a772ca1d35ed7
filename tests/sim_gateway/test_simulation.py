import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.lidar import LidarConfig
from sim_gateway.raycast import cast_rays_numpy
from sim_gateway.scene import Mover, World
from sim_gateway.simulation import Simulation, WindConfig, step_at
from sim_gateway.vehicle import rotation

AHEAD = (0.8, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)
GUSTY = WindConfig(mean_m_s=(0.5, -0.5, 0.0), gust_sigma_m_s=0.5)


def plain_world(boxes=(), movers=()):
    rows = np.array(boxes, dtype=float).reshape(-1, 6)
    return World("test", 0, 35.0, 8.0, 10.0, rows, tuple(movers), (4.0, 0.0, 0.0), 0.0, (30.0, 0.0, 2.0))


def corridor(seed=0):
    return generate_corridor(seed, CorridorConfig(movers=(1, 2)))


def hovering(world=None, **options):
    return Simulation(world or plain_world(), hover_height_m=2.0, **{"estimate": "none", **options})


def digest(simulation):
    motion, scan = simulation.estimate(), simulation.scan()
    log = (simulation.contacts, simulation.min_clearance_m, simulation.flown_m, simulation.wind_m_s)
    return simulation.state_row.tobytes(), repr(motion), scan.ranges_m.tobytes(), log


def fly(simulation, ticks=40):
    for tick in range(1, ticks + 1):
        yaw_rate = 0.2 * math.sin(0.3 * tick)
        simulation.advance(step_at(0.05 * tick) - simulation.steps, AHEAD, yaw_rate)
        yield digest(simulation)


def test_the_same_seed_gives_the_same_flight_bit_for_bit():
    options = {"estimate": "px4_sih", "wind": GUSTY, "seed": 5, "lidar": LidarConfig(dropout_probability=0.02)}
    first, second = (list(fly(hovering(corridor(3), **options))) for _ in range(2))
    assert first == second


def test_another_seed_gives_another_flight():
    first, second = (list(fly(hovering(corridor(3), estimate="nominal", seed=seed), 5)) for seed in (1, 2))
    assert first[-1] != second[-1]


@settings(max_examples=20, deadline=None)
@given(parts=st.lists(st.integers(0, 40), min_size=1, max_size=8))
def test_how_steps_are_split_over_calls_changes_nothing(parts):
    options = {"estimate": "px4_sih", "wind": GUSTY, "seed": 9}
    whole, split = hovering(corridor(4), **options), hovering(corridor(4), **options)
    whole.advance(sum(parts), AHEAD, 0.1)
    for part in parts:
        split.advance(part, AHEAD, 0.1)
        split.scan()
        split.estimate()
    assert digest(whole) == digest(split)


def test_reading_twice_at_one_time_gives_the_same_and_later_another():
    simulation = hovering(corridor(1), estimate="nominal")
    first = digest(simulation)
    assert digest(simulation) == first
    simulation.advance(12, STILL, 0.0)
    assert not np.array_equal(simulation.scan().ranges_m, np.frombuffer(first[2], np.float32))


def test_time_counts_in_steps_of_four_milliseconds():
    simulation = hovering()
    simulation.advance(12, STILL, 0.0)
    simulation.advance(13, STILL, 0.0)
    assert simulation.time_s == pytest.approx(0.1)
    assert [step_at(0.05 * k) for k in range(5)] == [0, 13, 25, 38, 50]


def test_ticks_at_20_hz_never_drift_from_vehicle_time():
    assert all(abs(step_at(0.05 * k) * 0.004 - 0.05 * k) <= 0.002 + 1e-9 for k in range(20_000))


# motion and estimate


def test_it_flies_where_it_is_told():
    simulation = hovering()
    simulation.advance(2500, AHEAD, 0.0)
    truth = simulation.truth
    assert truth.velocity_m_s[0] == pytest.approx(0.8, abs=0.03)
    assert truth.position_m[0] == pytest.approx(4.0 + simulation.flown_m, abs=0.02)
    assert abs(truth.position_m[1]) < 0.01


def test_on_the_ground_it_waits_and_then_takes_off():
    simulation = Simulation(plain_world(), estimate="none")
    simulation.advance_motors_off(500)
    assert simulation.landed
    assert simulation.truth.position_m == (4.0, 0.0, 0.0)
    simulation.advance(1000, (0.0, 0.0, 0.5), 0.0)
    assert not simulation.landed
    assert simulation.truth.position_m[2] > 1.0


def test_motors_off_in_the_air_falls_to_the_ground():
    simulation = hovering()
    simulation.advance_motors_off(500)
    assert simulation.landed
    assert simulation.truth.position_m[2] == pytest.approx(0.0, abs=1e-9)


def test_without_errors_the_estimate_is_the_truth():
    simulation = hovering(corridor(2), wind=GUSTY)
    simulation.advance(300, AHEAD, 0.3)
    assert simulation.estimate() == simulation.truth


def test_with_errors_the_estimate_is_off_by_about_their_size():
    offsets = []
    for seed in range(60):
        simulation = hovering(estimate="px4_sih", seed=seed)
        simulation.advance(25, STILL, 0.0)
        offsets.append(np.subtract(simulation.estimate().position_m, simulation.truth.position_m))
    # each axis: error and bias together
    np.testing.assert_allclose(np.std(offsets, axis=0), np.hypot([0.127, 0.223, 0.533], [0.17, 0.066, 0.44]), rtol=0.35)


def test_the_controller_flies_on_the_estimated_velocity():
    simulation = hovering(estimate="px4_sih", seed=1)
    still = hovering(seed=1)
    for each in (simulation, still):
        each.advance(1000, STILL, 0.0)
    assert math.dist(still.truth.position_m, (4.0, 0.0, 2.0)) < 1e-6
    assert math.dist(simulation.truth.position_m, (4.0, 0.0, 2.0)) > 0.05


def test_wind_pushes_and_gusts_differ_from_calm():
    calm, windy = hovering(), hovering(wind=WindConfig(mean_m_s=(0.0, 3.0, 0.0)))
    for each in (calm, windy):
        each.advance(250, STILL, 0.0)
    assert windy.truth.position_m[1] > calm.truth.position_m[1] + 0.02
    assert windy.wind_m_s == (0.0, 3.0, 0.0)


# surroundings


def test_the_scan_is_cast_from_the_true_place_and_tilt():
    world = corridor(6)
    simulation = hovering(world, lidar=LidarConfig(noise_sigma_m=0.0), estimate="px4_sih")
    simulation.advance(60, (1.0, 0.5, 0.0), 0.5)  # leaning into the acceleration
    assert abs(simulation.truth.pitch_rad) > 0.02
    state = simulation.state_row
    expected = cast_rays_numpy(simulation.boxes(), state[:3], rotation(state), simulation.lidar_config.bearings_rad, 4.0)
    seen = simulation.scan().ranges_m
    np.testing.assert_allclose(np.where(np.isinf(seen), 4.0, seen), expected, atol=1e-5)
    assert np.isfinite(seen).any()


def test_the_device_scan_has_361_beams_and_says_how_they_lie():
    scan = hovering(corridor(), lidar=LidarConfig.device()).scan()
    assert scan.ranges_m.shape == (361,)
    assert scan.ranges_m.dtype == np.float32
    assert (scan.angle_min_rad, scan.angle_increment_rad) == pytest.approx((-math.pi / 2, math.pi / 360))


def test_a_moving_pillar_is_seen_where_it_is_now():
    mover = Mover((0.5, 0.5, 10.0), 6.0, 5.0, 0.0, 4.0, 0.5)
    simulation = hovering(plain_world(movers=[mover]), lidar=LidarConfig(noise_sigma_m=0.0))
    assert simulation.scan().ranges_m[90] == pytest.approx(1.75, abs=0.01)
    simulation.advance(500, STILL, 0.0)
    assert np.isinf(simulation.scan().ranges_m[90])
    np.testing.assert_allclose(simulation.boxes()[0], mover.box_at(2.0), atol=1e-9)


def test_clearance_is_measured_from_the_sphere():
    simulation = hovering(plain_world([[6.0, -1.0, 0.0, 7.0, 1.0, 10.0]]))
    assert simulation.clearance_m == pytest.approx(2.0 - 0.35)
    assert hovering().clearance_m == math.inf


def test_each_entry_into_a_box_is_one_contact():
    boxes = [[6.0, -1.0, 0.0, 6.5, 1.0, 10.0], [9.0, -1.0, 0.0, 9.5, 1.0, 10.0]]
    simulation = hovering(plain_world(boxes))
    seen = []
    for _ in range(200):
        simulation.advance(12, AHEAD, 0.0)
        seen.append(simulation.contacts)
    assert simulation.truth.position_m[0] > 10.5
    assert sorted(set(seen)) == [0, 1, 2]
    assert simulation.min_clearance_m < -0.35
    assert simulation.clearance_m > 0.0


def test_passing_by_at_a_distance_is_no_contact():
    simulation = hovering(plain_world([[6.0, 0.4, 0.0, 6.5, 1.0, 10.0]]))
    simulation.advance(1500, AHEAD, 0.0)
    assert simulation.contacts == 0
    assert simulation.min_clearance_m == pytest.approx(0.05, abs=0.01)


def test_a_moving_pillar_that_sweeps_a_waiting_vehicle_is_a_contact_each_time():
    mover = Mover((0.5, 0.5, 10.0), 4.0, 5.0, -2.0, 2.0, 1.0)
    simulation = hovering(plain_world(movers=[mover]))
    simulation.advance(2000, STILL, 0.0)  # 8 s: past it twice
    assert simulation.contacts == 2


def test_a_start_inside_a_box_counts_at_once():
    assert hovering(plain_world([[3.0, -1.0, 0.0, 5.0, 1.0, 10.0]])).contacts == 1


# refusals


@pytest.mark.parametrize(
    ("n_steps", "setpoint", "yaw_rate"),
    [(-1, STILL, 0.0), (10**9, STILL, 0.0), (1, (math.nan, 0, 0), 0.0), (1, STILL, math.inf), (1, (0.0, 0.0), 0.0)],
)
def test_senseless_steps_and_setpoints_are_refused(n_steps, setpoint, yaw_rate):
    simulation = hovering()
    before = simulation.state_row
    with pytest.raises(ValueError, match=r"n_steps|setpoint"):
        simulation.advance(n_steps, setpoint, yaw_rate)
    assert simulation.state_row.tobytes() == before.tobytes()


@pytest.mark.parametrize("change", [{"gust_sigma_m_s": -1.0}, {"gust_time_s": 0.0}, {"mean_m_s": (math.nan, 0.0, 0.0)}])
def test_senseless_wind_is_refused(change):
    with pytest.raises(ValueError, match="wind"):
        WindConfig(**change)
