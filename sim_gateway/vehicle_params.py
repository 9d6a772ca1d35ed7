"""Parameters of the simulated multicopter and of its PX4-like controller, as a flat row for the compiled kernels.

Gains and limits carry the names and default values of PX4 v1.17's multicopter parameters. The row indices are
compiled into `sim_gateway.vehicle`; after changing their order, delete that module's numba cache.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

GRAVITY_M_S2 = 9.80665

(
    MASS, IXX, IYY, IZZ, ARM_X, ARM_Y, MOTOR_THRUST_MAX, YAW_MOMENT, MOTOR_LAG,
    DRAG_LINEAR, DRAG_QUADRATIC, DRAG_ANGULAR,
    VEL_P_XY, VEL_I_XY, VEL_D_XY, VEL_P_Z, VEL_I_Z, VEL_D_Z,
    VEL_MAX_XY, VEL_MAX_UP, VEL_MAX_DOWN, ACC_CUTOFF_HZ,
    TAN_TILT_MAX, HOVER_THRUST, THRUST_MIN,
    ATT_P_ROLL, ATT_P_PITCH, ATT_P_YAW, YAW_SETPOINT_AGE, RATE_MAX_XY, RATE_MAX_Z,
    RATE_P_XY, RATE_I_XY, RATE_D_XY, RATE_P_Z, RATE_I_Z, RATE_D_Z, DGYRO_CUTOFF_HZ, YAW_TORQUE_CUTOFF_HZ,
) = range(39)  # fmt: skip
PARAM_SIZE = 39

# What `randomised` spreads: the vehicle fully, the autopilot's gains by half (they are tuned to the vehicle, roughly).
# The rest are limits and filters of the autopilot, known exactly.
_VEHICLE_SPREAD = (
    "mass_kg", "inertia_xx_kg_m2", "inertia_yy_kg_m2", "inertia_zz_kg_m2", "motor_thrust_max_n", "yaw_moment_m", "motor_lag_s",
    "drag_linear_n_s_m", "drag_quadratic_n_s2_m2",
)  # fmt: skip
_GAIN_SPREAD = (
    "velocity_p_xy", "velocity_i_xy", "velocity_d_xy", "velocity_p_z", "velocity_i_z",
    "attitude_p_roll", "attitude_p_pitch", "rate_p_xy", "rate_p_yaw",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class VehicleParams:
    """An X quadrotor (Iris class by default) and the gains of its cascade. SI units, radians.

    Motors: thrust is proportional to the normalised command, behind a first-order lag. Motor order and turning
    directions are PX4's quad X: front right and rear left counter-clockwise, front left and rear right clockwise.
    Raises `ValueError` naming the field when a value is negative or not finite.
    """

    mass_kg: float = 1.5
    inertia_xx_kg_m2: float = 0.029125
    inertia_yy_kg_m2: float = 0.029125
    inertia_zz_kg_m2: float = 0.055225
    arm_x_m: float = 0.13  # motors lie at +-arm_x ahead, +-arm_y left
    arm_y_m: float = 0.21
    motor_thrust_max_n: float = 7.7  # four of them: 2.1 times the weight
    yaw_moment_m: float = 0.05  # reaction torque per newton of thrust
    motor_lag_s: float = 0.05
    drag_linear_n_s_m: float = 0.4  # of the air speed
    drag_quadratic_n_s2_m2: float = 0.02
    drag_angular_n_m_s: float = 0.01
    velocity_p_xy: float = 1.8  # MPC_XY_VEL_P_ACC, 1/s
    velocity_i_xy: float = 0.4  # MPC_XY_VEL_I_ACC, 1/s2
    velocity_d_xy: float = 0.2  # MPC_XY_VEL_D_ACC
    velocity_p_z: float = 4.0  # MPC_Z_VEL_P_ACC
    velocity_i_z: float = 2.0  # MPC_Z_VEL_I_ACC
    velocity_d_z: float = 0.0  # MPC_Z_VEL_D_ACC
    velocity_max_xy_m_s: float = 12.0  # MPC_XY_VEL_MAX
    velocity_max_up_m_s: float = 3.0  # MPC_Z_VEL_MAX_UP
    velocity_max_down_m_s: float = 1.5  # MPC_Z_VEL_MAX_DN
    acceleration_cutoff_hz: float = 5.0  # MPC_VELD_LP
    tilt_max_rad: float = math.radians(45.0)  # MPC_TILTMAX_AIR
    hover_thrust_factor: float = 1.0  # autopilot's hover thrust over the true one (MPC_USE_HTE makes it nearly 1)
    thrust_min: float = 0.12  # MPC_THR_MIN
    attitude_p_roll: float = 6.5  # MC_ROLL_P, 1/s
    attitude_p_pitch: float = 6.5  # MC_PITCH_P
    attitude_p_yaw: float = 2.8  # MC_YAW_P
    yaw_setpoint_age_s: float = 0.0125  # age of the yaw that PX4 takes as yaw setpoint; fits the recorded 3.5 % rate deficit
    rate_max_xy_rad_s: float = math.radians(220.0)  # MC_ROLLRATE_MAX, MC_PITCHRATE_MAX
    rate_max_yaw_rad_s: float = math.radians(200.0)  # MC_YAWRATE_MAX
    rate_p_xy: float = 0.15  # MC_ROLLRATE_P: normalised torque per rad/s
    rate_i_xy: float = 0.2
    rate_d_xy: float = 0.003
    rate_p_yaw: float = 0.2  # MC_YAWRATE_P
    rate_i_yaw: float = 0.1
    rate_d_yaw: float = 0.0
    angular_acceleration_cutoff_hz: float = 30.0  # IMU_DGYRO_CUTOFF
    yaw_torque_cutoff_hz: float = 2.0  # MC_YAW_TQ_CUTOFF

    def __post_init__(self) -> None:
        for name, value in self._values().items():
            if not math.isfinite(value) or value < 0.0:
                raise ValueError(f"vehicle parameter {name} is {value}: it must be finite and not negative")
        for name in ("mass_kg", "inertia_xx_kg_m2", "inertia_yy_kg_m2", "inertia_zz_kg_m2", "motor_thrust_max_n", "motor_lag_s"):
            if getattr(self, name) == 0.0:
                raise ValueError(f"vehicle parameter {name} is 0: it must be positive")
        if self.hover_thrust >= 1.0:
            raise ValueError("vehicle cannot hover: raise motor_thrust_max_n or lower mass_kg")
        if self.tilt_max_rad >= math.radians(89.0):
            raise ValueError(f"vehicle parameter tilt_max_rad is {self.tilt_max_rad}: it must be below 89 degrees")

    def _values(self) -> dict[str, float]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def hover_thrust(self) -> float:
        """Normalised collective thrust that carries the weight."""
        return self.mass_kg * GRAVITY_M_S2 / (4.0 * self.motor_thrust_max_n)

    def as_array(self) -> NDArray[np.float64]:
        """The row the kernels read: float64 [PARAM_SIZE], indexed by the constants of this module."""
        values = self._values()
        values["tilt_max_rad"] = math.tan(self.tilt_max_rad)
        values["hover_thrust_factor"] = self.hover_thrust * self.hover_thrust_factor
        return np.array(list(values.values()), dtype=np.float64)

    def randomised(self, rng: np.random.Generator, spread: float) -> VehicleParams:
        """A vehicle that is off by uniform factors: masses, motors and drag within 1 +- `spread`, gains within half of it.

        The autopilot's hover thrust is off by a quarter, since PX4 estimates it in flight. `spread` in [0, 0.3]: beyond
        that, stiff gains on slow motors make the attitude loop oscillate.
        """
        if not 0.0 <= spread <= 0.3:
            raise ValueError(f"spread is {spread}: it must lie in [0, 0.3]")
        names = _VEHICLE_SPREAD + _GAIN_SPREAD + ("hover_thrust_factor",)
        widths = np.repeat([1.0, 0.5, 0.25], [len(_VEHICLE_SPREAD), len(_GAIN_SPREAD), 1]) * spread
        factors = 1.0 + widths * rng.uniform(-1.0, 1.0, len(names))
        changed = {name: getattr(self, name) * float(factor) for name, factor in zip(names, factors, strict=True)}
        thrust_floor = 1.4 * changed["mass_kg"] * GRAVITY_M_S2 / 4.0  # heavy with weak motors must still fly
        changed["motor_thrust_max_n"] = max(changed["motor_thrust_max_n"], thrust_floor)
        return replace(self, **changed)


IRIS = VehicleParams()

# The vehicle of the reference recordings: PX4 SIH, airframe 10040 (mass 1 kg, 4 x 5 N, strong linear drag).
SIH_QUADX = VehicleParams(
    mass_kg=1.0,
    inertia_xx_kg_m2=0.025,
    inertia_yy_kg_m2=0.025,
    inertia_zz_kg_m2=0.03,
    arm_x_m=0.2,
    arm_y_m=0.2,
    motor_thrust_max_n=5.0,
    yaw_moment_m=0.02,
    drag_linear_n_s_m=1.0,
    drag_quadratic_n_s2_m2=0.0,
    drag_angular_n_m_s=0.025,
    attitude_p_roll=4.0,
    attitude_p_pitch=4.0,
)

PROFILES: dict[str, VehicleParams] = {"iris": IRIS, "sih_quadx": SIH_QUADX}
