"""What moves the vehicle: the compiled rigid body of `vehicle`, or another program under the same cascade and motors.

Around each of them a step is the same: wind and estimate errors before it, movers, clearance and contacts after it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_gateway.collision import clearance_m
from sim_gateway.errors import DivergedError
from sim_gateway.estimate import PROCESSES, VELOCITY_ERROR, step_error
from sim_gateway.scene import place_movers
from sim_gateway.vehicle import MOTOR, OMEGA, POS, QUAT, STEP_S, VEL, step_motors_off, step_velocity
from sim_gateway.vehicle_params import VehicleParams

Array = NDArray[np.float64]

DYNAMICS = ("internal", "jsbsim")
NORMALS = PROCESSES + 3  # one step's draws: estimate errors, then gusts

# running log of a flight
LEAST_CLEARANCE, _TOUCHING, CONTACTS, FLOWN = 0, 1, 2, 3

_WATCHED = MOTOR + 4  # leading entries of the state row that must stay finite
_STATE_NAMES = ((POS, "position"), (VEL, "velocity"), (QUAT, "attitude"), (OMEGA, "angular rate"), (MOTOR, "motors"))


@dataclass(frozen=True, slots=True)
class Course:
    """Arrays of one simulation that every step changes in place; see `Simulation` for what they hold."""

    state: Array
    boxes: Array
    fixed: int
    movers: Array
    error: Array
    error_coefficients: Array
    gust: Array
    gust_coefficients: Array
    contact_radius_m: float
    log: Array


@dataclass(frozen=True, slots=True)
class Demand:
    """What holds over some steps. `velocity_sp`, `wind_mean`: world m/s [3]; `yaw_rate_sp` rad/s counter-clockwise."""

    params: Array
    velocity_sp: Array
    yaw_rate_sp: float
    motors_on: bool
    wind_mean: Array


class Dynamics(Protocol):
    """Moves a vehicle in steps of 4 ms."""

    name: str

    def moved(self) -> None:
        """Somebody else has changed position, velocity, attitude or rates in the state row."""

    def advance(self, course: Course, demand: Demand, normals: Array, first_step: int) -> None:
        """Fly `normals.shape[0]` steps, in place. Raises `DivergedError`."""


class InternalDynamics:
    """The compiled six-degree-of-freedom vehicle of `sim_gateway.vehicle`."""

    name = "internal"

    def moved(self) -> None:
        """Nothing is kept outside the state row."""

    def advance(self, course: Course, demand: Demand, normals: Array, first_step: int) -> None:
        """See `Dynamics.advance`."""
        reached = _advance(
            *(course.state, demand.params, demand.velocity_sp, demand.yaw_rate_sp, demand.motors_on, normals, first_step),
            *(course.boxes, course.fixed, course.movers, course.error, course.error_coefficients),
            *(demand.wind_mean, course.gust, course.gust_coefficients, course.contact_radius_m, course.log),
        )
        check_finite(course.state, reached, "the vehicle")


def make_dynamics(name: str, params: VehicleParams) -> Dynamics:
    """The dynamics of that name for a vehicle. Raises `ValueError` for another name, `DynamicsMissingError`."""
    if name == "internal":
        return InternalDynamics()
    if name == "jsbsim":
        from sim_gateway.jsbsim_dynamics import JsbsimDynamics  # noqa: PLC0415  (optional)

        return JsbsimDynamics(params)
    raise ValueError(f"dynamics {name!r}: choose one of {', '.join(DYNAMICS)}")


def require_dynamics(name: str) -> None:
    """Raise `DynamicsMissingError` if the dynamics of that name cannot run here."""
    make_dynamics(name, VehicleParams())


def check_finite(state: Array, step: int, who: str) -> None:
    """Raise `DivergedError` when position, velocity, attitude, rates or motors of a state row are not finite."""
    index = _first_not_finite(state)
    if index >= 0:
        name = next(name for start, name in reversed(_STATE_NAMES) if index >= start)
        raise DivergedError(f"{who} diverged: {name} is {state[index]} at {step * STEP_S:.3f} s; the flight ends here")


@njit(cache=True)
def _first_not_finite(state: Array) -> int:
    for i in range(_WATCHED):
        if not math.isfinite(state[i]):
            return i
    return -1


@njit(cache=True)
def watch_clearance(boxes: Array, state: Array, radius: float, log: Array) -> None:
    """Keep the least clearance, and count a contact whenever clearance falls below zero."""
    clearance = clearance_m(boxes, state[POS : POS + 3], radius)
    log[LEAST_CLEARANCE] = min(log[LEAST_CLEARANCE], clearance)
    touching = 1.0 if clearance < 0.0 else 0.0
    if touching > log[_TOUCHING]:
        log[CONTACTS] += 1.0
    log[_TOUCHING] = touching


@njit(cache=True)
def before_step(
    normals_row: Array, wind: Array, wind_mean: Array, gust: Array, gust_coefficients: Array, error: Array,
    error_coefficients: Array,
) -> None:  # fmt: skip
    """Wind of this step into `wind` [3], the next estimate errors into `error`."""
    for i in range(3):
        gust[i] = gust_coefficients[0] * gust[i] + gust_coefficients[1] * normals_row[PROCESSES + i]
        wind[i] = wind_mean[i] + gust[i]
    step_error(error, error_coefficients, normals_row)


@njit(cache=True)
def after_step(
    state: Array, x: float, y: float, z: float, step: int, boxes: Array, fixed: int, movers: Array, radius: float,
    log: Array,
) -> None:  # fmt: skip
    """Path flown since (x, y, z), movers at the end of step number `step`, clearance and contacts."""
    dx, dy, dz = state[POS] - x, state[POS + 1] - y, state[POS + 2] - z
    log[FLOWN] += math.sqrt(dx * dx + dy * dy + dz * dz)
    place_movers(movers, movers.shape[0], (step + 1) * STEP_S, boxes[fixed:])
    watch_clearance(boxes, state, radius, log)


@njit(cache=True)
def _advance(
    state: Array, params: Array, velocity_sp: Array, yaw_rate_sp: float, motors_on: bool, normals: Array,
    first_step: int, boxes: Array, fixed: int, movers: Array, error: Array, error_coefficients: Array, wind_mean: Array,
    gust: Array, gust_coefficients: Array, radius: float, log: Array,
) -> int:  # fmt: skip
    """All steps of the internal vehicle, in one call; ends at the first state that is not finite. Gives the step reached."""
    wind = np.empty(3)
    for step in range(normals.shape[0]):
        before_step(normals[step], wind, wind_mean, gust, gust_coefficients, error, error_coefficients)
        x, y, z = state[POS], state[POS + 1], state[POS + 2]
        if motors_on:
            step_velocity(state, params, velocity_sp, yaw_rate_sp, wind, error[VELOCITY_ERROR : VELOCITY_ERROR + 3], 1)
        else:
            step_motors_off(state, params, wind, 1)
        if _first_not_finite(state) >= 0:
            return first_step + step + 1
        after_step(state, x, y, z, first_step + step, boxes, fixed, movers, radius, log)
    return first_step + len(normals)
