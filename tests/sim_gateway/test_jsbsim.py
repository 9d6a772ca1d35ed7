"""JSBSim under our cascade: it flies as the internal vehicle does, in our frames, silently, and ends cleanly."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mavlink_bench import EMPTY

from campaigns.lockstep import LockstepFlight, StackConfig
from flight.mission import load_mission
from sim_gateway.corridor import generate_corridor
from sim_gateway.errors import DivergedError, DynamicsMissingError
from sim_gateway.faults import Fault
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.simulation import Simulation, WindConfig
from sim_gateway.vehicle_params import GRAVITY_M_S2, PROFILES

ROOT = Path(__file__).resolve().parents[2]
STILL = (0.0, 0.0, 0.0)


def hovering(dynamics: str = "jsbsim", vehicle: str = "iris", height_m: float = 20.0, **options) -> Simulation:
    options = {"estimate": "none", "dynamics": dynamics, **options}
    return Simulation(options.pop("world", EMPTY), PROFILES[vehicle], hover_height_m=height_m, **options)


def response(dynamics: str, vehicle: str, axis: int, size: float) -> tuple[float, float]:
    """Final value and t63 of a step along x, y, z (m/s) or of the yaw rate (axis 3, rad/s)."""
    simulation = hovering(dynamics, vehicle)
    wanted = [0.0, 0.0, 0.0, 0.0]
    wanted[axis] = size
    rows = []
    for _ in range(1500):
        simulation.advance(1, wanted[:3], wanted[3])
        truth = simulation.truth
        rows.append((*truth.velocity_m_s, truth.angular_rate_rad_s[2])[axis])
    flown = np.array(rows)
    final = float(flown[-250:].mean())
    return final, 0.004 * int(np.argmax(flown / final >= 0.632))


@pytest.mark.parametrize("vehicle", ["iris", "sih_quadx"])
@pytest.mark.parametrize(("axis", "size"), [(0, 1.0), (1, -0.5), (2, 0.5), (2, -0.5), (3, 0.5), (0, 3.0)])
def test_steps_are_those_of_the_internal_vehicle(vehicle: str, axis: int, size: float) -> None:
    (final, t63), (own_final, own_t63) = (response(dynamics, vehicle, axis, size) for dynamics in ("jsbsim", "internal"))
    assert final == pytest.approx(own_final, rel=0.03)
    assert t63 == pytest.approx(own_t63, rel=0.2)


def test_it_hovers_in_place() -> None:
    simulation = hovering()
    simulation.advance(2500, STILL, 0.0)
    truth = simulation.truth
    assert math.dist(truth.position_m, (1.0, 2.0, 20.0)) < 0.01
    assert max(map(abs, (*truth.velocity_m_s, truth.roll_rad, truth.pitch_rad, truth.yaw_rad))) < 1e-3


def test_axes_turn_the_way_ours_do() -> None:
    """Right of it is -y, up is +z, yaw grows counter-clockwise, and it leans into its way."""
    simulation = hovering(world=replace(EMPTY, start_yaw_rad=0.5 * math.pi))
    assert simulation.truth.yaw_rad == pytest.approx(0.5 * math.pi)
    simulation.advance(100, (0.0, 2.0, 0.0), 0.0)  # ahead, for this yaw
    assert simulation.truth.pitch_rad < -0.05
    assert abs(simulation.truth.roll_rad) < 0.01
    simulation.advance(500, (0.0, 2.0, 0.5), 0.4)
    truth = simulation.truth
    assert truth.position_m[1] > 2.0 + 2.0
    assert truth.position_m[2] > 20.5
    assert abs(truth.position_m[0] - 1.0) < 0.3
    assert 0.5 * math.pi + 0.5 < truth.yaw_rad < 0.5 * math.pi + 1.0
    assert truth.angular_rate_rad_s[2] == pytest.approx(0.39, abs=0.03)


def test_free_fall_with_motors_running_down() -> None:
    own, internal = hovering(), hovering("internal")
    for simulation in (own, internal):
        simulation.advance_motors_off(250)
    assert own.truth.velocity_m_s[2] == pytest.approx(internal.truth.velocity_m_s[2], rel=0.005)
    late = hovering(height_m=200.0)
    late.carry((1.0, 2.0, 200.0), 0.0, (0.0, 0.0, 0.0))
    late.advance_motors_off(150)
    assert -GRAVITY_M_S2 < late.truth.acceleration_m_s2[2] < -0.7 * GRAVITY_M_S2


def test_wind_carries_it_like_the_internal_vehicle() -> None:
    wind = WindConfig(mean_m_s=(1.0, -3.0, 0.0))
    drifts = []
    for dynamics in ("jsbsim", "internal"):
        simulation = hovering(dynamics, wind=wind)
        simulation.advance(500, STILL, 0.0)
        truth = simulation.truth
        drifts.append((truth.position_m[0] - 1.0, truth.position_m[1] - 2.0))
        assert drifts[-1][0] > 0.02
        assert drifts[-1][1] < -0.05
    assert drifts[0] == pytest.approx(drifts[1], rel=0.1)


def test_it_starts_on_the_ground_takes_off_and_lands() -> None:
    simulation = Simulation(EMPTY, estimate="none", dynamics="jsbsim")
    simulation.advance(250, STILL, 0.0)
    assert simulation.landed
    assert simulation.truth.position_m == (1.0, 2.0, 0.0)
    simulation.advance(750, (0.0, 0.0, 1.0), 0.0)
    assert not simulation.landed
    assert 1.5 < simulation.truth.position_m[2] < 3.0
    simulation.advance(1500, (0.0, 0.0, -0.7), 0.0)
    assert simulation.landed
    assert simulation.truth.position_m[2] == 0.0
    simulation.advance(500, (0.0, 0.0, 1.0), 0.0)
    assert not simulation.landed, "and takes off again"


@pytest.mark.parametrize("split", [1, 7])
def test_same_seed_same_bytes_however_steps_are_split(split: int) -> None:
    wind = WindConfig(mean_m_s=(0.5, -0.5, 0.0), gust_sigma_m_s=0.5)

    def fly(chunk: int) -> bytes:
        simulation = hovering(estimate="px4_sih", wind=wind, seed=9)
        while simulation.steps < 700:
            simulation.advance(min(chunk, 700 - simulation.steps), (0.8, 0.1, 0.0), 0.2)
        return simulation.state_row.tobytes() + simulation.scan().ranges_m.tobytes()

    assert fly(split) == fly(100)


def test_it_goes_on_from_where_a_hand_puts_it() -> None:
    simulation = hovering()
    simulation.advance(100, (1.0, 0.0, 0.0), 0.0)
    simulation.carry((-7.0, 11.0, 5.0), 2.0, (0.4, 0.0, 0.0))
    simulation.advance(1, (0.4, 0.0, 0.0), 0.0)
    truth = simulation.truth
    assert math.dist(truth.position_m, (-7.0, 11.0, 5.0)) < 0.005
    assert truth.yaw_rad == pytest.approx(2.0, abs=1e-3)
    assert truth.velocity_m_s[0] == pytest.approx(0.4, abs=0.02)


def test_faults_of_the_vehicle_reach_it() -> None:
    weak, sound = hovering(), hovering()
    weak.inject(Fault(kind="motor_weak", start_s=0.0, parameters={"share": 0.6}))
    for simulation in (weak, sound):
        simulation.advance(25, STILL, 0.0)
    assert weak.truth.velocity_m_s[2] < sound.truth.velocity_m_s[2] - 0.05


def test_under_the_autopilot_it_takes_off_by_itself() -> None:
    vehicle = PilotedVehicle(Simulation(EMPTY, estimate="nominal", seed=2, dynamics="jsbsim"), ready_after_s=0.0)
    vehicle.advance(250)
    vehicle.autopilot.arm()
    vehicle.autopilot.takeoff()
    vehicle.advance(250 * 10)
    assert vehicle.simulation.truth.position_m[2] == pytest.approx(2.5, abs=0.4)


def test_reset_takes_milliseconds() -> None:
    times = []
    for _ in range(5):
        started = time.process_time()
        hovering().advance(1, STILL, 0.0)
        times.append(time.process_time() - started)
    assert min(times) < 0.03


@pytest.mark.parametrize("dynamics", ["jsbsim", "internal"])
def test_a_state_that_is_no_number_is_named(dynamics: str) -> None:
    simulation = hovering(dynamics)
    simulation.advance(10, STILL, 0.0)
    simulation.carry((1.0, 2.0, 20.0), 0.0, (0.0, math.nan, 0.0))
    with pytest.raises(DivergedError, match=r"nan at 0\.044 s"):
        simulation.advance(5, STILL, 0.0)
    assert math.isfinite(simulation.flown_m)


@pytest.mark.parametrize("dynamics", ["jsbsim", "internal"])
def test_a_diverged_vehicle_ends_a_lockstep_flight_as_a_failure(dynamics: str) -> None:
    mission = load_mission(ROOT / "configs" / "corridor.yaml")
    config = StackConfig(mission.policy.path, mission.safety, dynamics=dynamics, time_limit_s=2.0)
    flight = LockstepFlight(generate_corridor(2_000_000), config)
    flight.simulation.disturb((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (math.inf, 0.0, 0.0))
    result = flight.run()
    assert result.failure == "diverged"
    assert not result.success
    assert math.isfinite(result.path_length_m)


def test_a_corridor_is_flown_cleanly_by_the_shipped_policy() -> None:
    mission = load_mission(ROOT / "configs" / "corridor.yaml")
    config = StackConfig(mission.policy.path, mission.safety, dynamics="jsbsim")
    result = LockstepFlight(generate_corridor(2_000_000), config).run()
    assert result.clean_success, result


def test_nothing_on_stdout() -> None:
    program = (
        "from sim_gateway.simulation import Simulation\n"
        "from sim_gateway.corridor import generate_corridor\n"
        "s = Simulation(generate_corridor(1), hover_height_m=2.0, dynamics='jsbsim')\n"
        "s.advance(100, (1.0, 0.0, 0.0), 0.1)\n"
        "s.carry((float('nan'), 0.0, 0.0), 0.0)\n"
        "try:\n    s.advance(1, (0.0, 0.0, 0.0), 0.0)\nexcept Exception as error:\n    print(type(error).__name__)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "DivergedError\n"
    assert done.stderr == ""


def test_without_jsbsim_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jsbsim", None)  # as if it were not installed
    with pytest.raises(DynamicsMissingError, match=r"lstm-pilot\[jsbsim\]"):
        hovering()


def test_unknown_dynamics_are_refused() -> None:
    with pytest.raises(ValueError, match="internal, jsbsim"):
        hovering("gazebo")
