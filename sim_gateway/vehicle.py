"""Compiled six-degree-of-freedom quadrotor under a PX4-like cascade, 250 Hz, in place on one float64 state row.

World frame: x, y horizontal, z up, ground plane z = 0. Body frame: x ahead, y left, z up (FLU). The state row is
`float64[STATE_SIZE]`, the parameter row comes from `VehicleParams.as_array()`; both may be rows of larger arrays, and
every kernel may be called from other compiled code. Nothing is allocated, nothing is random: equal inputs give
bit-equal outputs.

The cascade restates PX4 v1.17's multicopter control laws (PositionControl, AttitudeControl, RateControl, sequential
desaturation) for OFFBOARD velocity setpoints with a yaw rate. As in PX4, a yaw rate without a yaw makes the current yaw
the yaw setpoint, so the yaw gain only sees that setpoint's age.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_gateway import vehicle_params as vp
from sim_gateway.vehicle_params import GRAVITY_M_S2, VehicleParams

STEP_S = 0.004

# state row
POS = 0  # 3, m, world
VEL = 3  # 3, m/s, world
QUAT = 6  # 4, w x y z, body to world
OMEGA = 10  # 3, rad/s, body
MOTOR = 13  # 4, normalised thrust now: front right, rear left, front left, rear right
ACC = 17  # 3, m/s2, world: true dv/dt of the last step (gravity removed)
LANDED = 20  # 1.0 while resting on the ground
VEL_INT = 21  # 3, m/s2, velocity integrator
ACC_LP = 24  # 3, m/s2, low-passed acceleration the velocity loop damps with
RATE_INT = 27  # 3, normalised torque, rate integrator
ALPHA = 30  # 3, rad/s2, angular acceleration of the last step
ALPHA_LP = 33  # 3, rad/s2, low-passed
BODY_Z_SP = 36  # 3, wanted thrust direction, world
THRUST_SP = 39  # wanted collective thrust, normalised
PHASE = 40  # steps since the outer loop ran
YAW_TORQUE = 41  # low-passed yaw torque, normalised
STATE_SIZE = 42

_OUTER_STEPS = 2  # PX4's position loop runs on the estimator's output, about half the rate of its rate loop
_TAKEOFF_MIN_M_S = 0.05  # on the ground, slower climb setpoints leave the motors idle
_XY_THRUST_MARGIN = 0.3  # MPC_THR_XY_MARG
_RATE_INT_LIMIT = 0.3  # MC_RR_INT_LIM
_RATE_INT_FADE_RAD_S = math.radians(400.0)  # PX4 fades the rate integrator out towards this error
_YAW_OVERSHOOT = 0.15  # yaw may ask this much above full thrust, paid by the collective
_HEIGHT_RATE_M_S = 0.7  # MPC_LAND_SPEED: from this vertical setpoint on, PX4 flies on the height's derivative alone
_ROLL_PITCH_MIX = math.sqrt(0.5)  # PX4's normalised quad X effectiveness

Row = NDArray[np.float64]


def initial_state(
    position: tuple[float, float, float] | Row, yaw_rad: float, flying: bool, params: VehicleParams | None = None
) -> Row:
    """State row at rest at `position` (world, m): hovering in trim when `flying`, else on the ground with motors off."""
    state = np.zeros(STATE_SIZE)
    row = (params or VehicleParams()).as_array()
    reset_state(state, row, float(position[0]), float(position[1]), float(position[2]), float(yaw_rad), bool(flying))
    return state


@njit(cache=True)
def reset_state(state: Row, params: Row, x_m: float, y_m: float, z_m: float, yaw_rad: float, flying: bool) -> None:
    """Compiled twin of `initial_state`, in place on a row."""
    state[:] = 0.0
    state[POS], state[POS + 1], state[POS + 2] = x_m, y_m, z_m
    state[QUAT], state[QUAT + 3] = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    state[BODY_Z_SP + 2] = 1.0
    if flying:
        trim = params[vp.MASS] * GRAVITY_M_S2 / (4.0 * params[vp.MOTOR_THRUST_MAX])
        state[MOTOR : MOTOR + 4] = trim
        state[THRUST_SP] = trim
        state[VEL_INT + 2] = GRAVITY_M_S2 * (trim / params[vp.HOVER_THRUST] - 1.0)
    else:
        state[POS + 2] = 0.0
        state[LANDED] = 1.0


@njit(cache=True)
def height_rate_share(climb_sp: float) -> float:
    """How much of the vertical velocity flown on is the derivative of the estimated height, not the estimated velocity."""
    return float(min(abs(climb_sp) / _HEIGHT_RATE_M_S, 1.0))


@njit(cache=True, error_model="numpy")
def step_velocity(
    state: Row, params: Row, velocity_sp: Row, yaw_rate_sp: float, wind: Row, estimate_error: Row, n_steps: int
) -> None:
    """Advance `n_steps` of 4 ms under a velocity setpoint, in place.

    `velocity_sp`, `wind`: world m/s [3]. `yaw_rate_sp`: rad/s, counter-clockwise. `estimate_error`: m/s [3], added to the
    true velocity to give the one the controller flies on. On the ground, a climb setpoint takes off and any other idles.
    """
    motor_gain = 1.0 - math.exp(-STEP_S / params[vp.MOTOR_LAG])
    for _ in range(n_steps):
        _cascade(state, params, velocity_sp, yaw_rate_sp, estimate_error, motor_gain)
        _rigid_body(state, params, wind)


@njit(cache=True, error_model="numpy")
def step_motors_off(state: Row, params: Row, wind: Row, n_steps: int) -> None:
    """Advance `n_steps` of 4 ms with the motors commanded off (disarmed or terminated), in place."""
    motor_gain = 1.0 - math.exp(-STEP_S / params[vp.MOTOR_LAG])
    _reset_controller(state)
    for _ in range(n_steps):
        _run_down(state, motor_gain)
        _rigid_body(state, params, wind)


@njit(cache=True, error_model="numpy")
def drive_motors(state: Row, params: Row, velocity_sp: Row, yaw_rate_sp: float, estimate_error: Row, motors_on: bool) -> None:
    """One step of the cascade and of the motors alone, in place: for dynamics that move the airframe by themselves."""
    motor_gain = 1.0 - math.exp(-STEP_S / params[vp.MOTOR_LAG])
    if motors_on:
        _cascade(state, params, velocity_sp, yaw_rate_sp, estimate_error, motor_gain)
    else:
        _reset_controller(state)
        _run_down(state, motor_gain)


@njit(cache=True)
def yaw_rad(state: Row) -> float:
    """Yaw of the body x axis in the world, counter-clockwise, in [-pi, pi]."""
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


@njit(cache=True)
def roll_pitch_rad(state: Row) -> tuple[float, float]:
    """(roll, pitch) with aerospace signs: right side down positive, nose up positive."""
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return roll, -math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x))))


@njit(cache=True)
def rotation_into(state: Row, out: Row) -> None:
    """Write the body-to-world rotation matrix into `out` float64[3, 3]."""
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def rotation(state: Row) -> Row:
    """Body-to-world rotation matrix, float64[3, 3] (allocates; compiled loops use `rotation_into`)."""
    out = np.empty((3, 3))
    rotation_into(state, out)
    return out


@njit(cache=True)
def _reset_controller(state: Row) -> None:
    state[VEL_INT : VEL_INT + 3] = 0.0
    state[ACC_LP : ACC_LP + 3] = 0.0
    state[RATE_INT : RATE_INT + 3] = 0.0
    state[ALPHA_LP : ALPHA_LP + 3] = 0.0
    state[BODY_Z_SP], state[BODY_Z_SP + 1], state[BODY_Z_SP + 2] = 0.0, 0.0, 1.0
    state[THRUST_SP] = 0.0
    state[YAW_TORQUE] = 0.0
    state[PHASE] = 0.0


@njit(cache=True, error_model="numpy")
def _velocity_loop(state: Row, params: Row, velocity_sp: Row, estimate_error: Row) -> None:
    """PX4 PositionControl without its position part: velocity PID to a thrust vector, vertical first, with anti-windup."""
    dt = _OUTER_STEPS * STEP_S
    if state[LANDED] > 0.0 and velocity_sp[2] < _TAKEOFF_MIN_M_S:
        _reset_controller(state)
        return
    gain = dt / (dt + 1.0 / (2.0 * math.pi * params[vp.ACC_CUTOFF_HZ]))
    for i in range(3):
        state[ACC_LP + i] += gain * (state[ACC + i] - state[ACC_LP + i])
    speed_xy = math.sqrt(velocity_sp[0] * velocity_sp[0] + velocity_sp[1] * velocity_sp[1])
    scale = params[vp.VEL_MAX_XY] / speed_xy if speed_xy > params[vp.VEL_MAX_XY] else 1.0
    climb = min(params[vp.VEL_MAX_UP], max(-params[vp.VEL_MAX_DOWN], velocity_sp[2]))
    error_x = scale * velocity_sp[0] - state[VEL] - estimate_error[0]
    error_y = scale * velocity_sp[1] - state[VEL + 1] - estimate_error[1]
    # the derivative of the height has no such slow error
    error_z = climb - state[VEL + 2] - (1.0 - height_rate_share(velocity_sp[2])) * estimate_error[2]
    if state[LANDED] > 0.0:
        error_x, error_y = 0.0, 0.0
    acc_x = params[vp.VEL_P_XY] * error_x + state[VEL_INT] - params[vp.VEL_D_XY] * state[ACC_LP]
    acc_y = params[vp.VEL_P_XY] * error_y + state[VEL_INT + 1] - params[vp.VEL_D_XY] * state[ACC_LP + 1]
    acc_z = params[vp.VEL_P_Z] * error_z + state[VEL_INT + 2] - params[vp.VEL_D_Z] * state[ACC_LP + 2]

    thrust_x, thrust_y, thrust_z = _thrust_vector(params, acc_x, acc_y, acc_z)
    thrust = math.sqrt(thrust_x * thrust_x + thrust_y * thrust_y + thrust_z * thrust_z)
    state[BODY_Z_SP], state[BODY_Z_SP + 1], state[BODY_Z_SP + 2] = thrust_x / thrust, thrust_y / thrust, thrust_z / thrust
    state[THRUST_SP] = thrust

    # stop the vertical integrator at saturation; bleed the horizontal one by what could not be produced
    if (thrust_z <= params[vp.THRUST_MIN] and error_z < 0.0) or (thrust_z >= 1.0 and error_z > 0.0):
        error_z = 0.0
    to_acc = GRAVITY_M_S2 / params[vp.HOVER_THRUST]
    made_x, made_y = thrust_x * to_acc, thrust_y * to_acc
    if acc_x * acc_x + acc_y * acc_y > made_x * made_x + made_y * made_y:
        error_x -= 2.0 / params[vp.VEL_P_XY] * (acc_x - made_x)
        error_y -= 2.0 / params[vp.VEL_P_XY] * (acc_y - made_y)
    state[VEL_INT] += params[vp.VEL_I_XY] * error_x * dt
    state[VEL_INT + 1] += params[vp.VEL_I_XY] * error_y * dt
    state[VEL_INT + 2] = min(GRAVITY_M_S2, max(-GRAVITY_M_S2, state[VEL_INT + 2] + params[vp.VEL_I_Z] * error_z * dt))


@njit(cache=True, error_model="numpy")
def _thrust_vector(params: Row, acc_x: float, acc_y: float, acc_z: float) -> tuple[float, float, float]:
    """Acceleration setpoint to normalised thrust vector: tilt limited, then full thrust shared with the vertical first."""
    hover = params[vp.HOVER_THRUST]
    # direction from horizontal acceleration and gravity alone (MPC_ACC_DECOUPLE), so the tilt limit is a limit on it
    lean = math.sqrt(acc_x * acc_x + acc_y * acc_y) / GRAVITY_M_S2
    shrink = params[vp.TAN_TILT_MAX] / lean if lean > params[vp.TAN_TILT_MAX] else 1.0
    tan_x, tan_y = shrink * acc_x / GRAVITY_M_S2, shrink * acc_y / GRAVITY_M_S2
    cos_tilt = 1.0 / math.sqrt(1.0 + tan_x * tan_x + tan_y * tan_y)
    collective = max((acc_z / GRAVITY_M_S2 + 1.0) * hover / cos_tilt, params[vp.THRUST_MIN])
    thrust_z = collective * cos_tilt
    thrust_xy = thrust_z * math.sqrt(tan_x * tan_x + tan_y * tan_y)
    kept_xy = min(thrust_xy, _XY_THRUST_MARGIN)
    limited_z = min(thrust_z, math.sqrt(1.0 - kept_xy * kept_xy))
    room_xy = math.sqrt(max(0.0, 1.0 - limited_z * limited_z))
    fit = room_xy / thrust_xy if thrust_xy > room_xy else 1.0
    return fit * thrust_z * tan_x, fit * thrust_z * tan_y, limited_z


@njit(cache=True, error_model="numpy")
def _attitude_and_rate_loops(state: Row, params: Row, yaw_rate_sp: float) -> tuple[float, float, float]:
    """Normalised body torques (roll, pitch, yaw) from the wanted thrust direction and yaw rate; zero on the ground."""
    if state[LANDED] > 0.0:
        return 0.0, 0.0, 0.0
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    up_x, up_y, up_z = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)  # world up in body axes
    bx, by, bz = state[BODY_Z_SP], state[BODY_Z_SP + 1], state[BODY_Z_SP + 2]
    aim_x = (1.0 - 2.0 * (y * y + z * z)) * bx + 2.0 * (x * y + w * z) * by + up_x * bz
    aim_y = 2.0 * (x * y - w * z) * bx + (1.0 - 2.0 * (x * x + z * z)) * by + up_y * bz
    aim_z = 2.0 * (x * z + w * y) * bx + 2.0 * (y * z - w * x) * by + up_z * bz
    half_cos = math.sqrt(max(1e-6, 0.5 * (1.0 + aim_z)))  # reduced attitude error: 2 sin(angle / 2) about aim's axis
    rate_x = -params[vp.ATT_P_ROLL] * aim_y / half_cos + up_x * yaw_rate_sp
    rate_y = params[vp.ATT_P_PITCH] * aim_x / half_cos + up_y * yaw_rate_sp
    rate_z = up_z * yaw_rate_sp - params[vp.ATT_P_YAW] * params[vp.YAW_SETPOINT_AGE] * state[OMEGA + 2]
    limit_xy, limit_z = params[vp.RATE_MAX_XY], params[vp.RATE_MAX_Z]
    gain = STEP_S / (STEP_S + 1.0 / (2.0 * math.pi * params[vp.DGYRO_CUTOFF_HZ]))
    for i in range(3):
        state[ALPHA_LP + i] += gain * (state[ALPHA + i] - state[ALPHA_LP + i])
    p_xy, i_xy, d_xy = params[vp.RATE_P_XY], params[vp.RATE_I_XY], params[vp.RATE_D_XY]
    p_z, i_z, d_z = params[vp.RATE_P_Z], params[vp.RATE_I_Z], params[vp.RATE_D_Z]
    yaw_torque = _rate_pid(state, 2, min(limit_z, max(-limit_z, rate_z)), p_z, i_z, d_z)
    smoothing = STEP_S / (STEP_S + 1.0 / (2.0 * math.pi * params[vp.YAW_TORQUE_CUTOFF_HZ]))
    state[YAW_TORQUE] += smoothing * (yaw_torque - state[YAW_TORQUE])
    return (
        _rate_pid(state, 0, min(limit_xy, max(-limit_xy, rate_x)), p_xy, i_xy, d_xy),
        _rate_pid(state, 1, min(limit_xy, max(-limit_xy, rate_y)), p_xy, i_xy, d_xy),
        state[YAW_TORQUE],
    )


@njit(cache=True, error_model="numpy")
def _rate_pid(state: Row, axis: int, rate_sp: float, p_gain: float, i_gain: float, d_gain: float) -> float:
    """One axis of PX4's RateControl; the integrator holds while the output is saturated in the error's direction."""
    error = rate_sp - state[OMEGA + axis]
    torque = p_gain * error + state[RATE_INT + axis] - d_gain * state[ALPHA_LP + axis]
    if abs(torque) < 1.0 or torque * error < 0.0:
        faded = error / _RATE_INT_FADE_RAD_S
        grown = state[RATE_INT + axis] + max(0.0, 1.0 - faded * faded) * i_gain * error * STEP_S
        state[RATE_INT + axis] = min(_RATE_INT_LIMIT, max(-_RATE_INT_LIMIT, grown))
    return float(min(1.0, max(-1.0, torque)))


@njit(cache=True, error_model="numpy")
def _cascade(state: Row, params: Row, velocity_sp: Row, yaw_rate_sp: float, estimate_error: Row, motor_gain: float) -> None:
    """From the velocity setpoint to the motors' thrust, one step of 4 ms."""
    if state[PHASE] <= 0.0:
        _velocity_loop(state, params, velocity_sp, estimate_error)
        state[PHASE] = _OUTER_STEPS
    state[PHASE] -= 1.0
    roll, pitch, yaw = _attitude_and_rate_loops(state, params, yaw_rate_sp)
    _mix(state, motor_gain, state[THRUST_SP], roll, pitch, yaw)


@njit(cache=True)
def _run_down(state: Row, motor_gain: float) -> None:
    for i in range(4):
        state[MOTOR + i] -= motor_gain * state[MOTOR + i]


@njit(cache=True, error_model="numpy")
def _mix(state: Row, motor_gain: float, thrust: float, roll: float, pitch: float, yaw: float) -> None:
    """Quad X mixer without airmode, then motor lag. Yaw gives way first; then the collective is lowered, then roll and pitch."""
    roll, pitch = _ROLL_PITCH_MIX * roll, _ROLL_PITCH_MIX * pitch
    spread = abs(roll) + abs(pitch)  # of the four motors: some are up and some down by exactly this
    thrust = max(min(thrust, 1.0 - spread), min(thrust, 0.5))
    if spread > thrust:
        roll, pitch, spread = roll * thrust / spread, pitch * thrust / spread, thrust
    # clockwise motors carry +yaw, counter-clockwise ones -yaw; each pair differs inside by its own lean
    ccw_lean, cw_lean = abs(roll + pitch), abs(roll - pitch)
    up_lean, down_lean = (cw_lean, ccw_lean) if yaw > 0.0 else (ccw_lean, cw_lean)
    room = max(0.0, min(1.0 + _YAW_OVERSHOOT - thrust - up_lean, thrust - down_lean))
    yaw = min(room, max(-room, yaw))
    thrust -= max(0.0, thrust + abs(yaw) + up_lean - 1.0)
    _lag(state, 0, motor_gain, thrust - roll - pitch - yaw)
    _lag(state, 1, motor_gain, thrust + roll + pitch - yaw)
    _lag(state, 2, motor_gain, thrust + roll - pitch + yaw)
    _lag(state, 3, motor_gain, thrust - roll + pitch + yaw)


@njit(cache=True)
def _lag(state: Row, motor: int, motor_gain: float, command: float) -> None:
    state[MOTOR + motor] += motor_gain * (min(1.0, max(0.0, command)) - state[MOTOR + motor])


@njit(cache=True, error_model="numpy")
def _rigid_body(state: Row, params: Row, wind: Row) -> None:
    """One semi-implicit Euler step of the free body, or rest on the ground while thrust does not carry the weight."""
    full = params[vp.MOTOR_THRUST_MAX]
    t0, t1, t2, t3 = full * state[MOTOR], full * state[MOTOR + 1], full * state[MOTOR + 2], full * state[MOTOR + 3]
    thrust_acc = (t0 + t1 + t2 + t3) / params[vp.MASS]
    if state[LANDED] > 0.0:
        if thrust_acc <= GRAVITY_M_S2:
            return
        state[LANDED] = 0.0
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    air_x, air_y, air_z = state[VEL] - wind[0], state[VEL + 1] - wind[1], state[VEL + 2] - wind[2]
    air_speed = math.sqrt(air_x * air_x + air_y * air_y + air_z * air_z)
    drag = (params[vp.DRAG_LINEAR] + params[vp.DRAG_QUADRATIC] * air_speed) / params[vp.MASS]
    state[ACC] = 2.0 * (x * z + w * y) * thrust_acc - drag * air_x
    state[ACC + 1] = 2.0 * (y * z - w * x) * thrust_acc - drag * air_y
    state[ACC + 2] = (1.0 - 2.0 * (x * x + y * y)) * thrust_acc - drag * air_z - GRAVITY_M_S2
    for i in range(3):
        state[VEL + i] += STEP_S * state[ACC + i]
        state[POS + i] += STEP_S * state[VEL + i]
    _rotate(
        state,
        params,
        params[vp.ARM_Y] * (t1 + t2 - t0 - t3),
        params[vp.ARM_X] * (t1 + t3 - t0 - t2),
        params[vp.YAW_MOMENT] * (t2 + t3 - t0 - t1),
    )
    if state[POS + 2] <= 0.0 and state[VEL + 2] <= 0.0:
        touch_down(state)


@njit(cache=True, error_model="numpy")
def _rotate(state: Row, params: Row, torque_x: float, torque_y: float, torque_z: float) -> None:
    """Euler's equation and the quaternion kinematics under body torques, N m."""
    ixx, iyy, izz, damping = params[vp.IXX], params[vp.IYY], params[vp.IZZ], params[vp.DRAG_ANGULAR]
    p, q, r = state[OMEGA], state[OMEGA + 1], state[OMEGA + 2]
    state[ALPHA] = (torque_x - damping * p - (izz - iyy) * q * r) / ixx
    state[ALPHA + 1] = (torque_y - damping * q - (ixx - izz) * p * r) / iyy
    state[ALPHA + 2] = (torque_z - damping * r - (iyy - ixx) * p * q) / izz
    p, q, r = p + STEP_S * state[ALPHA], q + STEP_S * state[ALPHA + 1], r + STEP_S * state[ALPHA + 2]
    state[OMEGA], state[OMEGA + 1], state[OMEGA + 2] = p, q, r
    w, x, y, z = state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3]
    half = 0.5 * STEP_S
    nw = w - half * (x * p + y * q + z * r)
    nx = x + half * (w * p + y * r - z * q)
    ny = y + half * (w * q + z * p - x * r)
    nz = z + half * (w * r + x * q - y * p)
    inverse = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3] = nw * inverse, nx * inverse, ny * inverse, nz * inverse


@njit(cache=True)
def touch_down(state: Row) -> None:
    """Come to rest level on the ground, heading kept: no bouncing, no sliding."""
    heading = yaw_rad(state)
    state[POS + 2] = 0.0
    state[VEL : VEL + 3] = 0.0
    state[OMEGA : OMEGA + 3] = 0.0
    state[ACC : ACC + 3] = 0.0
    state[ALPHA : ALPHA + 3] = 0.0
    state[QUAT], state[QUAT + 1], state[QUAT + 2], state[QUAT + 3] = math.cos(0.5 * heading), 0.0, 0.0, math.sin(0.5 * heading)
    _reset_controller(state)
    state[LANDED] = 1.0
