"""The airframe under motor commands that come from outside: what a real PX4 flies (`px4_gateway`).

PX4's airframe 10016 (`none_iris`), with legs to stand on. A step of 4 ms is made of shorter ones, and the inertial sensor gets
what acted over all of it: a contact with the ground is too short for a sample at its end.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_gateway import vehicle_params as vp
from sim_gateway.dynamics import Course, Demand, after_step, before_step, check_finite
from sim_gateway.vehicle import ACC, ALPHA, LANDED, MOTOR, OMEGA, POS, QUAT, STEP_S, VEL, rotation_into
from sim_gateway.vehicle_params import GRAVITY_M_S2, VehicleParams

Array = NDArray[np.float64]

LEG_M = 0.1
"""Height of the body's origin over its feet."""

_SUBSTEPS = 4
_SUBSTEP_S = STEP_S / _SUBSTEPS
_STIFFNESS_N_M, _DAMPING_N_S_M = 1500.0, 60.0  # of each point of contact: softer than real legs, for PX4's coarse IMU
_FRICTION = 0.8

NONE_IRIS = VehicleParams(
    mass_kg=1.5,
    inertia_xx_kg_m2=0.029,
    inertia_yy_kg_m2=0.029,
    inertia_zz_kg_m2=0.055,
    motor_thrust_max_n=0.5 * 1.5 * GRAVITY_M_S2,  # hovers at half throttle, as PX4's MPC_THR_HOVER expects
    motor_lag_s=0.03,
    drag_linear_n_s_m=0.3,
    drag_quadratic_n_s2_m2=0.0,
    drag_angular_n_m_s=0.01,
)

# x ahead, y left, yaw torque (counter-clockwise) per torque of its propeller; in PX4's order
_MOTORS = np.array([[0.1515, -0.245, -1.0], [-0.1515, 0.1875, -1.0], [0.1515, 0.245, 1.0], [-0.1515, -0.1875, 1.0]])
# four feet, and the propellers' hubs for a vehicle that falls over; ahead, left, up
_CONTACTS = np.array(
    [[x, y, -LEG_M] for x in (-0.13, 0.13) for y in (-0.15, 0.15)] + [[x, y, 0.03] for x in (-0.2, 0.2) for y in (-0.25, 0.25)]
)


class MotorDynamics:
    """Moves the vehicle by `commands` [4] (0 to 1, PX4's motor order); the demand's setpoints mean nothing here.

    After a step `specific_force_m_s2` and `rate_rad_s` [3] hold the means over it, body axes (ahead, left, up).
    """

    name = "motors"

    def __init__(self) -> None:
        self.commands = np.zeros(4)
        self._inertial = np.zeros(6)

    @property
    def specific_force_m_s2(self) -> Array:
        """What an accelerometer measures."""
        return self._inertial[:3]

    @property
    def rate_rad_s(self) -> Array:
        """What a gyroscope measures."""
        return self._inertial[3:]

    def moved(self) -> None:
        """Nothing is kept outside the state row."""

    def advance(self, course: Course, demand: Demand, normals: Array, first_step: int) -> None:
        """See `dynamics.Dynamics.advance`."""
        reached = _advance(
            *(course.state, demand.params, _MOTORS, _CONTACTS, self.commands, self._inertial, normals, first_step),
            *(course.boxes, course.fixed, course.movers, course.error, course.error_coefficients),
            *(demand.wind_mean, course.gust, course.gust_coefficients, course.contact_radius_m, course.log),
        )
        check_finite(course.state, reached, "the vehicle")


def standing_height_m(params: VehicleParams) -> float:
    """Height of the body's origin when the vehicle stands on its feet."""
    return LEG_M - params.mass_kg * GRAVITY_M_S2 / (4.0 * _STIFFNESS_N_M)


@njit(cache=True)
def _advance(
    state: Array, params: Array, motors: Array, contacts: Array, commands: Array, inertial: Array, normals: Array,
    first_step: int, boxes: Array, fixed: int, movers: Array, error: Array, error_coefficients: Array, wind_mean: Array,
    gust: Array, gust_coefficients: Array, radius: float, log: Array,
) -> int:  # fmt: skip
    """All steps, in one call; the step reached."""
    wind, turn, force = np.empty(3), np.empty((3, 3)), np.empty(6)
    for step in range(normals.shape[0]):
        before_step(normals[step], wind, wind_mean, gust, gust_coefficients, error, error_coefficients)
        x, y, z = state[POS], state[POS + 1], state[POS + 2]
        inertial[:] = 0.0
        for _ in range(_SUBSTEPS):
            _substep(state, params, motors, contacts, commands, wind, turn, force, inertial)
        inertial /= _SUBSTEPS
        after_step(state, x, y, z, first_step + step, boxes, fixed, movers, radius, log)
    return first_step + len(normals)


@njit(cache=True, error_model="numpy")
def _substep(
    state: Array, params: Array, motors: Array, contacts: Array, commands: Array, wind: Array, turn: Array, force: Array,
    inertial: Array,
) -> None:  # fmt: skip
    """One semi-implicit Euler step; adds the specific force and the rate to `inertial` [6]."""
    rotation_into(state, turn)
    force[:] = 0.0  # without gravity: force in world axes, torque in body axes
    _air(state, params, wind, force)
    _propellers(state, params, motors, commands, turn, force)
    state[LANDED] = _ground(state, contacts, turn, force)
    for i in range(3):
        state[ACC + i] = force[i] / params[vp.MASS]
    for i in range(3):
        inertial[i] += turn[0, i] * state[ACC] + turn[1, i] * state[ACC + 1] + turn[2, i] * state[ACC + 2]
    state[ACC + 2] -= GRAVITY_M_S2
    for i in range(3):
        state[VEL + i] += _SUBSTEP_S * state[ACC + i]
        state[POS + i] += _SUBSTEP_S * state[VEL + i]
    _turn(state, params, force)
    for i in range(3):
        inertial[3 + i] += state[OMEGA + i]


@njit(cache=True, error_model="numpy")
def _air(state: Array, params: Array, wind: Array, force: Array) -> None:
    x, y, z = state[VEL] - wind[0], state[VEL + 1] - wind[1], state[VEL + 2] - wind[2]
    drag = params[vp.DRAG_LINEAR] + params[vp.DRAG_QUADRATIC] * math.sqrt(x * x + y * y + z * z)
    force[0], force[1], force[2] = -drag * x, -drag * y, -drag * z
    for i in range(3):
        force[3 + i] = -params[vp.DRAG_ANGULAR] * state[OMEGA + i]


@njit(cache=True, error_model="numpy")
def _propellers(state: Array, params: Array, motors: Array, commands: Array, turn: Array, force: Array) -> None:
    gain = 1.0 - math.exp(-_SUBSTEP_S / params[vp.MOTOR_LAG])
    total = 0.0
    for m in range(4):
        state[MOTOR + m] += gain * (min(1.0, max(0.0, commands[m])) - state[MOTOR + m])
        thrust = params[vp.MOTOR_THRUST_MAX] * state[MOTOR + m]
        total += thrust
        force[3] += motors[m, 1] * thrust
        force[4] -= motors[m, 0] * thrust
        force[5] += motors[m, 2] * params[vp.YAW_MOMENT] * thrust
    for i in range(3):
        force[i] += turn[i, 2] * total


@njit(cache=True, error_model="numpy")
def _ground(state: Array, contacts: Array, turn: Array, force: Array) -> float:
    """Springs, dampers and friction where the body is in the ground; 1 if it is anywhere, else 0."""
    touching = 0.0
    p, q, r = state[OMEGA], state[OMEGA + 1], state[OMEGA + 2]
    for c in range(contacts.shape[0]):
        x, y, z = contacts[c, 0], contacts[c, 1], contacts[c, 2]
        depth = -(state[POS + 2] + turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z)
        if depth <= 0.0:
            continue
        touching = 1.0
        bx, by, bz = q * z - r * y, r * x - p * z, p * y - q * x
        vx = state[VEL] + turn[0, 0] * bx + turn[0, 1] * by + turn[0, 2] * bz
        vy = state[VEL + 1] + turn[1, 0] * bx + turn[1, 1] * by + turn[1, 2] * bz
        vz = state[VEL + 2] + turn[2, 0] * bx + turn[2, 1] * by + turn[2, 2] * bz
        up = max(0.0, _STIFFNESS_N_M * depth - _DAMPING_N_S_M * vz)
        grip = min(_DAMPING_N_S_M, _FRICTION * up / max(math.sqrt(vx * vx + vy * vy), 1e-9))
        fx, fy = -grip * vx, -grip * vy
        force[0] += fx
        force[1] += fy
        force[2] += up
        ux = turn[0, 0] * fx + turn[1, 0] * fy + turn[2, 0] * up
        uy = turn[0, 1] * fx + turn[1, 1] * fy + turn[2, 1] * up
        uz = turn[0, 2] * fx + turn[1, 2] * fy + turn[2, 2] * up
        force[3] += y * uz - z * uy
        force[4] += z * ux - x * uz
        force[5] += x * uy - y * ux
    return touching


@njit(cache=True, error_model="numpy")
def _turn(state: Array, params: Array, force: Array) -> None:
    """Euler's equation and the quaternion kinematics under the torques in `force`."""
    ixx, iyy, izz = params[vp.IXX], params[vp.IYY], params[vp.IZZ]
    p, q, r = state[OMEGA], state[OMEGA + 1], state[OMEGA + 2]
    state[ALPHA] = (force[3] - (izz - iyy) * q * r) / ixx
    state[ALPHA + 1] = (force[4] - (ixx - izz) * p * r) / iyy
    state[ALPHA + 2] = (force[5] - (iyy - ixx) * p * q) / izz
    for i in range(3):
        state[OMEGA + i] += _SUBSTEP_S * state[ALPHA + i]
    p, q, r = state[OMEGA], state[OMEGA + 1], state[OMEGA + 2]
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    half = 0.5 * _SUBSTEP_S
    nw = w - half * (x * p + y * q + z * r)
    nx = x + half * (w * p + y * r - z * q)
    ny = y + half * (w * q + z * p - x * r)
    nz = z + half * (w * r + x * q - y * p)
    inverse = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3] = nw * inverse, nx * inverse, ny * inverse, nz * inverse
