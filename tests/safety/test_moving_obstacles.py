"""Moving obstacles up to `obstacle_speed_m_s`: the vehicle never runs into one that it could see.

Guaranteed is passive safety: whenever something within view touches the hull, the vehicle moves no faster towards it than the
speed that counts as standing, plus the error of its velocity estimate. A mover may still run into a standing vehicle.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safety_plant import Plant, cast, command, config, gap_m
from safety_vehicle import FENCE, scan_of, state_of

from safety.braking import STANDSTILL_M_S, Start, Tubes, slow_after_s
from safety.config import SafetyConfig
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.shield import Shield, Surroundings
from safety.sight import View
from sim_gateway.estimate import EstimateNoise
from sim_gateway.scene import Mover, World
from sim_gateway.simulation import Simulation, step_at

SLOW_M_S = STANDSTILL_M_S + 0.05


class Charging:
    """Boxes of 0.5 m that head for the vehicle from all over what it sees, at a given speed, straight on until they passed."""

    def __init__(self, speed_m_s: float, seed: int):
        self.speed, self.random, self.boxes, self.ways = speed_m_s, np.random.default_rng(seed), np.empty((0, 4)), []

    def step(self, plant: Plant, tick_s: float = 0.05) -> None:
        self.ways = [(p + w * tick_s, w) for p, w in self.ways if np.hypot(*(p - (plant.x, plant.y))) < 6.0]
        while len(self.ways) < 2:
            bearing = plant.yaw + self.random.uniform(-1.0, 1.0)
            place = np.array((plant.x, plant.y)) + 3.9 * np.array((math.cos(bearing), math.sin(bearing)))
            towards = math.atan2(plant.y - place[1], plant.x - place[0]) + self.random.uniform(-0.4, 0.4)
            self.ways.append((place, self.speed * np.array((math.cos(towards), math.sin(towards)))))
        self.boxes = np.array([(p[0] - 0.25, p[1] - 0.25, p[0] + 0.25, p[1] + 0.25) for p, _ in self.ways])


def towards_box(box, x: float, y: float) -> np.ndarray:
    """Unit vector from the vehicle to the nearest point of a box."""
    across = np.array((np.clip(x, box[0], box[2]) - x, np.clip(y, box[1], box[3]) - y))
    return across / max(float(np.hypot(*across)), 1e-9)


def worst_ram_m_s(plant: Plant, boxes) -> float:
    """Speed of the vehicle towards what touches it now, -inf when nothing does."""
    hits = [towards_box(box, plant.x, plant.y) for box in boxes if gap_m(np.array([box]), plant.x, plant.y) <= 0.0]
    return max((float(plant.v[:2] @ unit) for unit in hits), default=-math.inf)


def fly_among(speed_m_s: float, seed: int, assumed_m_s: float, ticks: int = 500) -> tuple[float, float, int]:
    """Worst ramming speed, distance flown and ticks in contact, straight ahead among charging boxes."""
    plant, movers = Plant(x=5.0, lag_s=0.6, noise_m=0.01, seed=seed), Charging(speed_m_s, seed)
    safety = SafetyFilter(config(obstacle_speed_m_s=assumed_m_s))
    worst, flown, contacts = -math.inf, 0.0, 0
    for _ in range(ticks):
        movers.step(plant)
        plant.boxes = movers.boxes
        turn = max(-1.0, min(1.0, -2.0 * math.remainder(plant.yaw, 2 * math.pi)))
        away = 0.0 if 4.0 < plant.x < 33.0 else math.pi
        sent, _ = safety.apply(command(math.cos(away), 0.0, 0.0, turn), plant.estimate(), plant.scan(), plant.time_s)
        x = plant.x
        plant.fly(sent)
        flown += abs(plant.x - x)
        ram = worst_ram_m_s(plant, movers.boxes)
        worst, contacts = max(worst, ram), contacts + (ram > -math.inf)
    return worst, flown, contacts


@pytest.mark.parametrize("speed", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_it_never_runs_into_movers_up_to_the_stated_speed(speed, seed):
    worst, flown, _ = fly_among(speed, seed, speed)
    assert worst <= SLOW_M_S
    assert flown > 1.0  # and it does fly


def test_without_the_stated_speed_it_does_run_into_them():
    """The test can fail."""
    assert max(fly_among(1.0, seed, 0.0)[0] for seed in range(4)) > SLOW_M_S


def crossing(speed_m_s: float, seed: int) -> World:
    """A corridor with boxes that go from wall to wall across the way."""
    random = np.random.default_rng(seed)
    walls = np.array([[-1.0, 4.0, 0.0, 36.0, 4.2, 10.0], [-1.0, -4.2, 0.0, 36.0, -4.0, 10.0]])
    movers = tuple(
        Mover(
            size_m=(0.5, 0.5, 4.0), x_m=float(x), z_m=2.0, y_low_m=-3.5, y_high_m=3.5, speed_m_s=speed_m_s,
            phase_m=float(random.uniform(0.0, 14.0)),
        )
        for x in (8.0, 13.0, 18.0)
    )  # fmt: skip
    return World(
        name="crossing", seed=seed, length_m=35.0, width_m=8.0, height_m=10.0, static_boxes=walls, movers=movers,
        start=(4.0, 0.0, 0.0), start_yaw_rad=0.0, goal=(33.0, 0.0, 2.0),
    )  # fmt: skip


@pytest.mark.parametrize("speed", [0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_vehicle_never_runs_into_crossing_movers(speed, seed):
    noise = EstimateNoise(position_m=(0.0167,) * 3, velocity_m_s=(0.0167,) * 3, attitude_rad=(0.005,) * 3)
    sim = Simulation(crossing(speed, seed), estimate=noise, seed=seed, hover_height_m=2.0)
    safety = SafetyFilter(SafetyConfig(fence=FENCE, obstacle_speed_m_s=speed))
    worst, run_over = -math.inf, False  # a mover may pass through the standing vehicle: then its LiDAR sees nothing but that
    for k in range(600):
        now = sim.time_s
        sent, verdict = safety.apply(command(1.0), state_of(sim.estimate()), scan_of(sim.scan()), now)
        assert verdict.fault is None or (verdict.fault == "scan_touching" and run_over)
        run_over = False
        sim.advance(step_at((k + 1) * 0.05) - sim.steps, (sent.velocity.x, sent.velocity.y, sent.velocity.z), sent.yaw_rate_rad_s)
        x, y, _ = sim.truth.position_m
        for b in sim.boxes():
            flat = (b[0], b[1], b[3], b[4])
            if gap_m(np.array([flat]), x, y) <= 0.0:
                worst = max(worst, float(np.array(sim.truth.velocity_m_s[:2]) @ towards_box(flat, x, y)))
                run_over = True
    assert worst <= SLOW_M_S
    assert sim.truth.position_m[0] > 6.0


@given(st.floats(0.01, 1.0), st.floats(0.5, 3.0), st.floats(0.01, 0.2))
def test_a_standing_vehicle_counts_what_a_mover_covers_before_it_can_act(speed, away, beam_m):
    """A command takes dead time and a tick until it acts; and the return may be anywhere within the width of its beam."""
    c = config(obstacle_speed_m_s=speed)
    place = np.array([[[5.0, 0.0, 2.0]], [[5.0, 0.0, 2.0]]])
    view = View(FreeSpace(c), np.array([[5.0 + away], [0.0]]), 0.0)
    around = Surroundings(
        *view.near_m, np.array([beam_m]), view, CorridorVector(5.0, 0.0, 2.0), Start(place[:, 0], np.zeros((2, 3)))
    )
    clear = Shield(c)._tube_clearances(Tubes(place, place), around)
    blind_m = (c.velocity_error_m_s + speed) * (c.dead_time_s + c.tick_s)
    assert clear == pytest.approx(away - beam_m - c.keep_out_m - blind_m)


@given(st.floats(0.11, 1.2), st.floats(0.2, 1.0))
def test_the_time_until_slow_is_never_behind_the_way(speed, lag):
    """Independent: fly the first-order lag; at every moment the bound's share of the way is at least the share of the time."""
    c = config(lag_s=lag, lag_min_s=0.1, braking_m_s2=20.0)
    bound = float(slow_after_s(speed * lag, c))
    for t in np.linspace(0.0, lag * math.log(speed / STANDSTILL_M_S), 50):
        assert bound * (1.0 - math.exp(-t / lag)) >= t - 1e-9


def test_cast_knows_the_boxes_of_the_charge():
    """The harness itself: a box straight ahead is seen at its face."""
    assert cast(np.array([(7.0, -0.5, 8.0, 0.5)]), 5.0, 0.0, np.array([0.0]))[0] == pytest.approx(2.0)
