"""How the vehicle's own state estimate differs from the truth: a noise model in place of an estimator.

Position, velocity and attitude errors are independent first-order Gauss-Markov processes, stepped by the exact solution
e' = e exp(-dt/tau) + sigma sqrt(1 - exp(-2 dt/tau)) n (Maybeck 1979, section 4.11), so their size does not depend on the
step. Added to that: a position bias drawn once per flight and white noise on acceleration.

Simplification: velocity errors are not the derivative of position errors, as they would be in a real filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

# error row: Gauss-Markov errors of position, velocity, (roll, pitch, yaw); then the constant position bias
POSITION_ERROR, VELOCITY_ERROR, ATTITUDE_ERROR, POSITION_BIAS = 0, 3, 6, 9
ERROR_SIZE = 12
PROCESSES = 9  # standard normals one step takes

# parameter row: sigma of the nine processes, their correlation times, sigma of the bias, sigma of acceleration
_SIGMA, _TAU, _BIAS_SIGMA, ACCELERATION_SIGMA = 0, 9, 18, 21
ESTIMATE_PARAM_SIZE = 24


class UnknownPresetError(ValueError):
    """No estimate preset of that name."""


@dataclass(frozen=True, slots=True)
class EstimateNoise:
    """Sizes (one sigma) and correlation times of the estimate's errors, corridor axes x, y, z; attitude as roll, pitch, yaw.

    `position_bias_m`: sigma of the constant offset drawn at the start of each flight. `acceleration_m_s2`: white, per sample.
    Raises `ValueError` on a negative size or a time that is not positive.
    """

    position_m: Triple = (0.0, 0.0, 0.0)
    velocity_m_s: Triple = (0.0, 0.0, 0.0)
    attitude_rad: Triple = (0.0, 0.0, 0.0)
    position_time_s: Triple = (2.0, 2.0, 2.0)
    velocity_time_s: Triple = (2.0, 2.0, 2.0)
    attitude_time_s: Triple = (2.0, 2.0, 2.0)
    position_bias_m: Triple = (0.0, 0.0, 0.0)
    acceleration_m_s2: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for item in fields(self):
            values, is_time = getattr(self, item.name), item.name.endswith("_time_s")
            if any(not math.isfinite(v) or v < 0.0 or (is_time and v == 0.0) for v in values):
                raise ValueError(f"{item.name} is {values}: give finite values {'above' if is_time else 'not below'} 0")

    @staticmethod
    def held(attitude_bias_rad: Triple = (0.0, 0.0, 0.0)) -> EstimateNoise:
        """Errors that stay as they are put, for a driver that sets them itself (`Simulation.disturb`)."""
        for_ever = (1e9, 1e9, 1e9)
        return EstimateNoise(
            attitude_rad=attitude_bias_rad, position_time_s=for_ever, velocity_time_s=for_ever, attitude_time_s=for_ever
        )

    def as_array(self) -> Array:
        """The row that the kernels read: float64 [ESTIMATE_PARAM_SIZE]."""
        parts = (
            *(self.position_m, self.velocity_m_s, self.attitude_rad),
            *(self.position_time_s, self.velocity_time_s, self.attitude_time_s),
            *(self.position_bias_m, self.acceleration_m_s2),
        )
        return np.array(parts, dtype=np.float64).ravel()


PRESETS: dict[str, EstimateNoise] = {
    "none": EstimateNoise(),
    "nominal": EstimateNoise(
        position_m=(0.03, 0.03, 0.03),
        velocity_m_s=(0.05, 0.05, 0.05),
        attitude_rad=(0.01, 0.01, 0.01),
        acceleration_m_s2=(0.1, 0.1, 0.1),
    ),
    # PX4's simplest simulator, recorded: standard deviations over the 14-minute flight; correlation times where its
    # autocorrelation falls to 1/e; bias = root mean square, over all six recorded flights, of each flight's mean error.
    # Attitude and acceleration were not recorded: attitude sizes are twice the nominal ones, acceleration as nominal.
    "px4_sih": EstimateNoise(
        position_m=(0.127, 0.223, 0.533),
        velocity_m_s=(0.162, 0.319, 0.167),
        attitude_rad=(0.02, 0.02, 0.02),
        position_time_s=(4.7, 4.2, 20.0),
        velocity_time_s=(3.9, 3.4, 4.0),
        position_bias_m=(0.17, 0.066, 0.44),
        acceleration_m_s2=(0.1, 0.1, 0.1),
    ),
}


def estimate_preset(name: str) -> EstimateNoise:
    """The preset `none`, `nominal` or `px4_sih`. Raises `UnknownPresetError` listing the names."""
    if name not in PRESETS:
        raise UnknownPresetError(f"no estimate preset is called {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


@njit(cache=True)
def error_coefficients(params: Array, dt_s: float, out: Array) -> None:
    """What `step_error` needs for steps of `dt_s`: `out` [2, 9], decay and noise gain of each process."""
    for i in range(PROCESSES):
        decay = math.exp(-dt_s / params[_TAU + i])
        out[0, i] = decay
        out[1, i] = params[_SIGMA + i] * math.sqrt(1.0 - decay * decay)


@njit(cache=True)
def initial_error(params: Array, normals: Array, error: Array) -> None:
    """Start `error` [12] in the processes' stationary state and draw the bias, from standard `normals` [12]."""
    for i in range(PROCESSES):
        error[i] = params[_SIGMA + i] * normals[i]
    for i in range(3):
        error[POSITION_BIAS + i] = params[_BIAS_SIGMA + i] * normals[PROCESSES + i]


@njit(cache=True)
def step_error(error: Array, coefficients: Array, normals: Array) -> None:
    """One step of the nine processes in place; `coefficients` [2, 9] from `error_coefficients`, standard `normals` [>=9]."""
    for i in range(PROCESSES):
        error[i] = coefficients[0, i] * error[i] + coefficients[1, i] * normals[i]
