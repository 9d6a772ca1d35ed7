"""What sensors and estimator say of a vehicle at one instant, and the random numbers in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_gateway.estimate import ATTITUDE_ERROR, POSITION_BIAS, POSITION_ERROR, VELOCITY_ERROR
from sim_gateway.scene import Point
from sim_gateway.vehicle import ACC, OMEGA, POS, VEL, roll_pitch_rad, yaw_rad

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion in the corridor frame, SI: the truth, or the vehicle's estimate of it.

    `acceleration_m_s2`: dv/dt, gravity removed. `roll_rad` right side down, `pitch_rad` nose up, `yaw_rad` counter-clockwise,
    in [-pi, pi]. `angular_rate_rad_s`: body axes (ahead, left, up).
    """

    time_s: float
    position_m: Point
    velocity_m_s: Point
    acceleration_m_s2: Point
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    angular_rate_rad_s: Point


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan. `ranges_m`: float32 [beams], right to left; +inf = nothing seen, 0 = nearer than `range_min_m`."""

    time_s: float
    ranges_m: NDArray[np.float32]
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float


@njit(cache=True)
def read_motion(state: Array, error: Array, acceleration_error: Array, out: Array) -> None:
    """Position, velocity, acceleration, roll, pitch, yaw (not wrapped) and body rates with their errors into `out` [15]."""
    for i in range(3):
        out[i] = state[POS + i] + error[POSITION_ERROR + i] + error[POSITION_BIAS + i]
        out[3 + i] = state[VEL + i] + error[VELOCITY_ERROR + i]
        out[6 + i] = state[ACC + i] + acceleration_error[i]
        out[12 + i] = state[OMEGA + i]
    roll, pitch = roll_pitch_rad(state)
    out[9], out[10], out[11] = (
        roll + error[ATTITUDE_ERROR],
        pitch + error[ATTITUDE_ERROR + 1],
        yaw_rad(state) + error[ATTITUDE_ERROR + 2],
    )


class NoiseStream:
    """Random numbers of one sensor: counter-based, so that those of a time do not depend on what was read before."""

    def __init__(self, key: NDArray[np.unsignedinteger]) -> None:
        self._bits = np.random.Philox(key=key)
        self._generator = np.random.Generator(self._bits)
        self._fresh = self._bits.state

    def at(self, step: int) -> np.random.Generator:
        """The generator at the start of its numbers for a step. The same object each time: draw before asking again."""
        self._fresh["state"]["counter"][2] = step
        self._bits.state = self._fresh
        return self._generator
