"""The true values behind a vehicle's sensors, from corridor and body axes (left, up) into PX4's (NED, FRD): one compiled call."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_gateway.vehicle import ACC, POS, QUAT, VEL, rotation_into

Array = NDArray[np.float64]

# entries of a reading: specific force, rate and magnetic field in the body; place, velocity, attitude, acceleration in NED
FORCE, RATE, FIELD, PLACE, SPEED, TURN, CHANGE, READING = 0, 3, 6, 9, 12, 15, 19, 22


@njit(cache=True)
def read_truth(state: Array, force: Array, rate: Array, field: Array, frame: Array, out: Array) -> None:
    """The true values into `out` [READING], in NED and FRD; `frame`: origin, cosine and sine of the heading and of its half."""
    turn = np.empty((3, 3))
    rotation_into(state, turn)
    cos, sin, half_cos, half_sin = frame[3], frame[4], frame[5], frame[6]
    # the field in corridor axes, then in the body's
    fx, fy, fz = cos * field[0] + sin * field[1], sin * field[0] - cos * field[1], -field[2]
    for i in range(3):
        sign = 1.0 if i == 0 else -1.0
        out[FORCE + i] = sign * force[i]
        out[RATE + i] = sign * rate[i]
        out[FIELD + i] = sign * (turn[0, i] * fx + turn[1, i] * fy + turn[2, i] * fz)
    for start, source in ((PLACE, POS), (SPEED, VEL), (CHANGE, ACC)):
        x, y, z = state[source], state[source + 1], state[source + 2]
        if source == POS:
            x, y, z = x - frame[0], y - frame[1], z - frame[2]
        out[start], out[start + 1], out[start + 2] = cos * x + sin * y, sin * x - cos * y, -z
    w, x, y, z = state[QUAT], state[QUAT + 1], -state[QUAT + 2], -state[QUAT + 3]
    out[TURN], out[TURN + 3] = half_cos * w - half_sin * z, half_cos * z + half_sin * w
    out[TURN + 1], out[TURN + 2] = half_cos * x - half_sin * y, half_cos * y + half_sin * x
