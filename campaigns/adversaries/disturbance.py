"""The assumptions held at their bounds: estimate errors with the worst sign, wind, gusts, vehicle, delays, lost beams and scans.

Nothing here goes beyond what docs/safety.md states; `draw_conditions` measures each drawn vehicle in its wind and takes another
when the stop distance is longer than the filter assumes, because that would test a broken assumption.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from sim_gateway.estimate import EstimateNoise
from sim_gateway.lidar import LidarConfig
from sim_gateway.scene import World
from sim_gateway.simulation import Simulation, WindConfig
from sim_gateway.vehicle_params import VehicleParams

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
MODES = ("push", "pull", "switch", "constant")
WIND_BOUND_M_S = 2.0
ATTITUDE_SIGMA_RAD = 0.004
VEHICLE_SPREAD = 0.2
DELAYS_S = (0.012, 0.024, 0.04)  # computer and link, of the 0.20 s assumed; the vehicle's own part is 0.16 s
SCAN_AGES_S = (0.004, 0.02, 0.04)
LOST_SCANS = (0.0, 0.0, 0.1)  # a lost one makes the newest 0.05 s older
DROPOUTS = (0.0, 0.0, 0.05)
_TEST_SPEEDS_M_S = (1.0, 1.2)


@dataclass(frozen=True)
class Conditions:
    """What a flight suffers. `gust_m_s`: size of the steps between which the wind jumps, every `gust_every_s` or so."""

    mode: str
    vehicle: VehicleParams
    wind_m_s: tuple[float, float]
    gust_m_s: float
    gust_every_s: float
    command_delay_s: float
    scan_age_s: float
    lost_scans: float
    lidar: LidarConfig

    def simulation(self, world: World, height_m: float, seed: int) -> Simulation:
        """The vehicle under these conditions."""
        return Simulation(
            world, self.vehicle, self.lidar, EstimateNoise.held((ATTITUDE_SIGMA_RAD,) * 3), seed=seed, hover_height_m=height_m
        )


def draw_conditions(random: np.random.Generator, config: SafetyConfig) -> Conditions:
    """Conditions inside the stated assumptions."""
    while True:
        gust = float(random.choice((0.0, 0.25, 0.5)))
        strength, angle = random.uniform(0.0, WIND_BOUND_M_S - gust), random.uniform(-math.pi, math.pi)
        drawn = Conditions(
            mode=str(random.choice(MODES)),
            vehicle=VehicleParams().randomised(random, VEHICLE_SPREAD),
            wind_m_s=(float(strength * math.cos(angle)), float(strength * math.sin(angle))),
            gust_m_s=gust,
            gust_every_s=float(random.uniform(0.3, 3.0)),
            command_delay_s=float(random.choice(DELAYS_S)),
            scan_age_s=float(random.choice(SCAN_AGES_S)),
            lost_scans=float(random.choice(LOST_SCANS)),
            lidar=LidarConfig(dropout_probability=float(random.choice(DROPOUTS))),
        )
        if stops_as_assumed(drawn, config):
            return drawn


def stops_as_assumed(drawn: Conditions, config: SafetyConfig) -> bool:
    """Whether this vehicle, flying with its strongest wind in the back, stops within the distance assumed."""
    wind = math.hypot(*drawn.wind_m_s) + drawn.gust_m_s
    for speed in _TEST_SPEEDS_M_S:
        reached, stop = measured_stop(drawn.vehicle, wind, speed, drawn.command_delay_s)
        if stop > config.stop_distance_m(reached) - reached * config.tick_s:
            return False
    return True


def measured_stop(vehicle: VehicleParams, tail_wind_m_s: float, speed_m_s: float, delay_s: float) -> tuple[float, float]:
    """Speed after 3 s of cruise, and furthest way made after a zero setpoint that arrives `delay_s` late, m/s and m."""
    world = World(
        name="open", seed=0, length_m=100.0, width_m=100.0, height_m=HOVER_M, static_boxes=np.array([[90.0, 90, 0, 91, 91, 1]]),
        movers=(), start=(0.0, 0.0, 0.0), start_yaw_rad=0.0, goal=(1.0, 0.0, HOVER_M),
    )  # fmt: skip
    wind = WindConfig((tail_wind_m_s, 0.0, 0.0))
    simulation = Simulation(world, vehicle, estimate="none", wind=wind, hover_height_m=HOVER_M)
    simulation.advance(250, (0.0, 0.0, 0.0), 0.0)
    simulation.advance(750, (speed_m_s, 0.0, 0.0), 0.0)
    speed, start = simulation.truth.velocity_m_s[0], simulation.truth.position_m[0]
    simulation.advance(round(delay_s / 0.004), (speed_m_s, 0.0, 0.0), 0.0)
    furthest = start
    for _ in range(40):
        simulation.advance(12, (0.0, 0.0, 0.0), 0.0)
        furthest = max(furthest, simulation.truth.position_m[0])
    return speed, furthest - start


HOVER_M = 5.0


class Disturbance:
    """Sets estimate errors and wind before each tick. Position errors move no faster than velocity errors let them."""

    def __init__(self, conditions: Conditions, config: SafetyConfig, random: np.random.Generator) -> None:
        self._conditions, self._random = conditions, random
        self._position_bound, self._velocity_bound = config.position_error_m, config.velocity_error_m_s
        self._slew_m = config.velocity_error_m_s * config.tick_s
        self._signs = random.choice((-1.0, 1.0), 3)
        self._velocity_signs = random.choice((-1.0, 1.0), 3)
        self._gust = np.zeros(3)
        self.position_error = self._position_bound * self._signs

    def apply(self, simulation: Simulation, threat: Array, sign: float | None = None) -> None:
        """`threat` [3]: direction to what is nearest. `sign`: -1 the estimate lags behind the threat, 1 it runs ahead."""
        self._turn_signs(threat, sign)
        wanted = self._position_bound * self._signs
        self.position_error += np.clip(wanted - self.position_error, -self._slew_m, self._slew_m)
        wind = np.array((*self._conditions.wind_m_s, 0.0)) + self._gust
        simulation.disturb(self.position_error.tolist(), (self._velocity_bound * self._velocity_signs).tolist(), wind.tolist())

    def _turn_signs(self, threat: Array, sign: float | None) -> None:
        mode, random = self._conditions.mode, self._random
        if sign is not None or mode in {"push", "pull"}:
            way = sign if sign is not None else (-1.0 if mode == "push" else 1.0)
            self._signs = self._velocity_signs = way * np.where(threat >= 0.0, 1.0, -1.0)
        elif mode == "switch" and random.random() < 0.1:
            self._signs, self._velocity_signs = random.choice((-1.0, 1.0), 3), random.choice((-1.0, 1.0), 3)
        if random.random() < 0.05 / self._conditions.gust_every_s:
            angle = random.uniform(-math.pi, math.pi)
            self._gust = self._conditions.gust_m_s * np.array((math.cos(angle), math.sin(angle), 0.0))


def calm(drawn: Conditions) -> Conditions:
    """The same without wind, lost beams and lost scans."""
    return replace(drawn, wind_m_s=(0.0, 0.0), gust_m_s=0.0, lost_scans=0.0, lidar=LidarConfig())
