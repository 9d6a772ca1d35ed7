"""A spinning 2D scanner in the simulated world: every beam is measured from where the vehicle is when that beam fires.

The head turns clockwise at a constant rate and fires at a constant rate; nothing is a snapshot, so a vehicle that moves or turns
smears the scan as a real one does. Firing times are exact to the physics step (4 ms), in which the pose is taken as constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_gateway.lidar import LidarConfig, measure
from sim_gateway.raycast import beam_table, cast_beams
from sim_gateway.simulation import Simulation
from sim_gateway.vehicle import POS, rotation

Array = NDArray[np.float64]
_MAX_CATCH_UP_S = 0.1


@dataclass(frozen=True, slots=True)
class SpinConfig:
    """`turns_per_s`: of the head. `points_per_s`: measurements. Ranges in m."""

    turns_per_s: float = 10.0
    points_per_s: float = 4500.0
    range_min_m: float = 0.02
    range_max_m: float = 12.0
    noise_sigma_m: float = 0.01
    dropout_probability: float = 0.0

    def __post_init__(self) -> None:
        if not (0.1 <= self.turns_per_s <= 50.0 and 100.0 <= self.points_per_s <= 100_000.0):
            raise ValueError(f"a head with {self.turns_per_s} turns and {self.points_per_s} points a second cannot be simulated")


@dataclass(frozen=True, slots=True)
class Shots:
    """Consecutive measurements [k]: firing time (vehicle, s), clockwise angle (deg, 0 ahead), range (m; inf none, 0 too near)."""

    time_s: Array
    clockwise_deg: Array
    range_m: Array


class SpinningScanner:
    """The head. Angle and firing instants follow from the vehicle's time alone, so a pause of the reader changes nothing."""

    def __init__(self, config: SpinConfig, seed: int = 0) -> None:
        self.config = config
        self._fired = 0
        self._generator = np.random.Generator(np.random.PCG64([seed, 77]))
        self._sensor = LidarConfig(
            range_min_m=config.range_min_m,
            range_max_m=config.range_max_m,
            noise_sigma_m=config.noise_sigma_m,
            dropout_probability=config.dropout_probability,
        )

    def fire(self, simulation: Simulation) -> Shots:
        """The beams due up to the vehicle's present time, cast from its present pose."""
        rate, now_s = self.config.points_per_s, simulation.time_s
        due = math.floor(now_s * rate + 1e-6)
        first = max(self._fired, due - int(_MAX_CATCH_UP_S * rate))
        index = np.arange(first, due, dtype=np.float64)
        self._fired = due
        time_s = index / rate
        clockwise_deg = np.remainder(360.0 * self.config.turns_per_s * time_s, 360.0)
        return Shots(time_s, clockwise_deg, self._ranges(simulation, clockwise_deg))

    def _ranges(self, simulation: Simulation, clockwise_deg: Array) -> Array:
        true_ranges = np.empty(clockwise_deg.size)
        if not clockwise_deg.size:
            return true_ranges
        boxes, state = simulation.boxes(), simulation.state_row
        beams = beam_table(-np.radians(clockwise_deg))
        cast_beams(boxes, len(boxes), state[POS : POS + 3], rotation(state), beams, self._sensor.range_max_m, true_ranges)
        return measure(self._sensor, true_ranges, self._generator)


def millimetres(range_m: Array) -> NDArray[np.int64]:
    """Ranges as such devices send them: whole millimetres, 0 for no return of any kind."""
    usable = np.isfinite(range_m) & (range_m > 0.0)
    return np.where(usable, np.rint(1000.0 * np.where(usable, range_m, 0.0)), 0.0).astype(np.int64)
