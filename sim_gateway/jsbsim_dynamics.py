"""JSBSim as the airframe: it integrates mass, inertia, thrust, drag and gravity at 250 Hz under our cascade and motors.

The airframe is our own (`aircraft/quad_x.xml`) with the numbers of a `VehicleParams`. JSBSim knows no ground here: resting,
taking off and touching down are decided as in `sim_gateway.vehicle`, on the same state row.

Frames: JSBSim flies over the WGS84 ellipsoid with north = world x, east = -y, down = -z, from `_ORIGIN_LATITUDE_RAD` on; its
body axes are front, right, down. It counts in feet, pounds and slugs.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from sim_gateway import vehicle_params as vp
from sim_gateway.dynamics import Array, Course, Demand, after_step, before_step, check_finite
from sim_gateway.errors import DivergedError, DynamicsError, DynamicsMissingError
from sim_gateway.estimate import VELOCITY_ERROR
from sim_gateway.vehicle import ACC, ALPHA, LANDED, MOTOR, OMEGA, POS, QUAT, STEP_S, VEL, drive_motors, touch_down
from sim_gateway.vehicle_params import GRAVITY_M_S2, VehicleParams

_FOOT_M = 0.3048
_POUND_N = 4.4482216152605
_POUND_FOOT_NM = _POUND_N * _FOOT_M

_ORIGIN_LATITUDE_RAD = math.radians(45.0)  # where gravity is the standard one within 0.1 mm/s2
_SEMI_MAJOR_M, _ECCENTRICITY_2 = 6378137.0, 6.69437999014e-3  # WGS84
_NO_TERRAIN_FT = -30000.0

_LOADS = (
    *(f"external_reactions/{motor}/magnitude" for motor in ("front_right", "rear_left", "front_left", "rear_right")),
    "external_reactions/reaction/magnitude-lbsft",
    *(f"atmosphere/wind-{axis}-fps" for axis in ("north", "east", "down")),
)
_READING = (
    *("position/lat-geod-rad", "position/long-gc-rad", "position/h-sl-ft"),
    *(f"velocities/v-{axis}-fps" for axis in ("north", "east", "down")),
    *(f"attitude/{angle}-rad" for angle in ("phi", "theta", "psi")),
    *(f"velocities/{axis}-rad_sec" for axis in "pqr"),
)
_PLACE = (
    *("ic/lat-geod-rad", "ic/long-gc-rad", "ic/h-sl-ft", "ic/phi-rad", "ic/theta-rad", "ic/psi-true-rad"),
    *("ic/vn-fps", "ic/ve-fps", "ic/vd-fps", "ic/p-rad_sec", "ic/q-rad_sec", "ic/r-rad_sec"),
)
_DRAG = (
    ("airframe/drag-lbs_sec_ft", vp.DRAG_LINEAR, _FOOT_M / _POUND_N),
    ("airframe/drag-lbs_sec2_ft2", vp.DRAG_QUADRATIC, _FOOT_M * _FOOT_M / _POUND_N),
    ("airframe/drag-lbsft_sec", vp.DRAG_ANGULAR, 1.0 / _POUND_FOOT_NM),
)


class JsbsimDynamics:
    """One airframe in JSBSim. Raises `DynamicsMissingError` when the package is not installed."""

    name = "jsbsim"

    def __init__(self, params: VehicleParams) -> None:
        self._fdm = _load(params)
        manager = self._fdm.get_property_manager()
        self._loads = [manager.get_node(name) for name in _LOADS]
        self._read = [manager.get_node(name).get_double_value for name in _READING]
        self._in_flight = False
        self._wind, self._load_row = np.empty(3), np.empty(len(_LOADS))

    def moved(self) -> None:
        """JSBSim takes the state row over at the next step in the air."""
        self._in_flight = False

    def advance(self, course: Course, demand: Demand, normals: Array, first_step: int) -> None:
        """See `Dynamics.advance`."""
        for name, index, factor in _DRAG:
            self._fdm[name] = float(demand.params[index]) * factor
        for step in range(normals.shape[0]):
            self._step(course, demand, normals[step], first_step + step)

    def _step(self, course: Course, demand: Demand, normals_row: Array, step: int) -> None:
        state = course.state
        x, y, z = state[POS : POS + 3].tolist()
        airborne = _prepare(
            *(state, demand.params, demand.velocity_sp, demand.yaw_rate_sp, demand.motors_on, normals_row, self._wind),
            *(demand.wind_mean, course.gust, course.gust_coefficients, course.error, course.error_coefficients, self._load_row),
        )
        if airborne:
            self._fly(state, step)
        else:
            self._in_flight = False
        after_step(state, x, y, z, step, course.boxes, course.fixed, course.movers, course.contact_radius_m, course.log)

    def _fly(self, state: Array, step: int) -> None:
        """Loads in, one step of JSBSim, motion out."""
        for node, load in zip(self._loads, self._load_row.tolist(), strict=True):
            node.set_double_value(load)
        if not self._in_flight:
            self._place(state)
        try:
            self._fdm.run()
        except Exception as error:  # JSBSim's own exceptions have no useful common base
            raise DivergedError(f"JSBSim gave up at {(step + 1) * STEP_S:.3f} s: {error}") from error
        _take_over(state, np.array([read() for read in self._read]))
        check_finite(state, step + 1, "JSBSim")
        self._in_flight = state[LANDED] == 0.0

    def _place(self, state: Array) -> None:
        """Start JSBSim from the motion in the state row."""
        row = np.empty(len(_PLACE))
        _motion_to_place(state, row)
        for name, value in zip(_PLACE, row.tolist(), strict=True):
            self._fdm[name] = value
        self._fdm.run_ic()


def _load(params: VehicleParams) -> Any:
    """A silent JSBSim with the airframe of these parameters."""
    try:
        import jsbsim  # noqa: PLC0415  (optional)
    except ImportError:
        raise DynamicsMissingError("JSBSim is not installed: pip install 'lstm-pilot[jsbsim]'") from None
    base: Any = jsbsim.FGJSBBase
    base().debug_lvl = 0  # before anything else: JSBSim prints to stdout
    fdm = jsbsim.FGFDMExec(None)
    fdm.set_debug_level(0)
    text = resources.files("sim_gateway").joinpath("aircraft", "quad_x.xml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="sim-gateway-") as folder:
        aircraft = Path(folder) / "quad_x"
        aircraft.mkdir()
        (aircraft / "quad_x.xml").write_text(text.format_map(asdict(params)), encoding="utf-8")
        fdm.set_aircraft_path(folder)
        if not fdm.load_model("quad_x"):
            raise DynamicsError("JSBSim refuses aircraft/quad_x.xml: is its version the one in constraints.txt?")
    fdm.disable_output()
    fdm.set_dt(STEP_S)
    fdm["ic/terrain-elevation-ft"] = _NO_TERRAIN_FT
    return fdm


@njit(cache=True)
def _radii_m() -> tuple[float, float]:
    """WGS84 at the origin: radius of curvature along the meridian, and across it."""
    flattened = 1.0 - _ECCENTRICITY_2 * math.sin(_ORIGIN_LATITUDE_RAD) ** 2
    return _SEMI_MAJOR_M * (1.0 - _ECCENTRICITY_2) / flattened**1.5, _SEMI_MAJOR_M / math.sqrt(flattened)


@njit(cache=True)
def _prepare(
    state: Array, params: Array, velocity_sp: Array, yaw_rate_sp: float, motors_on: bool, normals_row: Array,
    wind: Array, wind_mean: Array, gust: Array, gust_coefficients: Array, error: Array, error_coefficients: Array,
    loads: Array,
) -> bool:  # fmt: skip
    """Wind, errors, cascade, motors; `loads` [8] as in `_LOADS`. Whether the vehicle is in the air in this step."""
    before_step(normals_row, wind, wind_mean, gust, gust_coefficients, error, error_coefficients)
    drive_motors(state, params, velocity_sp, yaw_rate_sp, error[VELOCITY_ERROR : VELOCITY_ERROR + 3], motors_on)
    full = params[vp.MOTOR_THRUST_MAX] / _POUND_N
    for i in range(4):
        loads[i] = full * state[MOTOR + i]
    # front right and rear left turn counter-clockwise and push the body clockwise, seen from above: positive about down
    loads[4] = params[vp.YAW_MOMENT] / _FOOT_M * (loads[0] + loads[1] - loads[2] - loads[3])
    loads[5], loads[6], loads[7] = wind[0] / _FOOT_M, -wind[1] / _FOOT_M, -wind[2] / _FOOT_M
    lift_n = (loads[0] + loads[1] + loads[2] + loads[3]) * _POUND_N
    if state[LANDED] > 0.0 and lift_n > params[vp.MASS] * GRAVITY_M_S2:
        state[LANDED] = 0.0
    return bool(state[LANDED] == 0.0)


@njit(cache=True)
def _motion_to_place(state: Array, row: Array) -> None:
    """The state row's motion as in `_PLACE`."""
    meridian_m, across_m = _radii_m()
    row[0] = _ORIGIN_LATITUDE_RAD + state[POS] / meridian_m
    row[1] = -state[POS + 1] / (across_m * math.cos(row[0]))
    row[2] = state[POS + 2] / _FOOT_M
    w, x, y, z = state[QUAT], state[QUAT + 1], -state[QUAT + 2], -state[QUAT + 3]  # front-right-down to north-east-down
    row[3] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    row[4] = math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))
    row[5] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    row[6], row[7], row[8] = state[VEL] / _FOOT_M, -state[VEL + 1] / _FOOT_M, -state[VEL + 2] / _FOOT_M
    row[9], row[10], row[11] = state[OMEGA], -state[OMEGA + 1], -state[OMEGA + 2]


@njit(cache=True)
def _take_over(state: Array, reading: Array) -> None:
    """JSBSim's motion, as in `_READING`, into the state row; below the ground plane it touches down."""
    meridian_m, across_m = _radii_m()
    state[POS] = (reading[0] - _ORIGIN_LATITUDE_RAD) * meridian_m
    state[POS + 1] = -reading[1] * across_m * math.cos(reading[0])
    state[POS + 2] = reading[2] * _FOOT_M
    for i in range(3):
        sign = 1.0 if i == 0 else -1.0
        velocity, rate = sign * reading[3 + i] * _FOOT_M, sign * reading[9 + i]
        state[ACC + i], state[ALPHA + i] = (velocity - state[VEL + i]) / STEP_S, (rate - state[OMEGA + i]) / STEP_S
        state[VEL + i], state[OMEGA + i] = velocity, rate
    cr, sr = math.cos(0.5 * reading[6]), math.sin(0.5 * reading[6])
    cp, sp = math.cos(0.5 * reading[7]), math.sin(0.5 * reading[7])
    cy, sy = math.cos(0.5 * reading[8]), math.sin(0.5 * reading[8])
    state[QUAT], state[QUAT + 1] = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    state[QUAT + 2], state[QUAT + 3] = -(cr * sp * cy + sr * cp * sy), -(cr * cp * sy - sr * sp * cy)
    if state[POS + 2] <= 0.0 and state[VEL + 2] <= 0.0:
        touch_down(state)
