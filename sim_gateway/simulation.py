"""One vehicle in one world, in process: physics, wind, estimate errors, LiDAR, contacts. Time passes only when asked.

Deterministic: equal arguments give bit-equal results, however the steps are split over calls and however often anything is
read. Physics noise comes from one stream, drawn in step order; what a sensor shows at a time is a pure function of
(seed, time). The gateway drives this in real time, campaigns in lockstep.

Boxes are not solid: a contact is counted, once per entry, and the vehicle flies on. Whoever runs the flight decides what
a contact means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_gateway.collision import clearance_m
from sim_gateway.dynamics import (
    CONTACTS,
    FLOWN,
    LEAST_CLEARANCE,
    NORMALS,
    Course,
    Demand,
    Dynamics,
    make_dynamics,
    watch_clearance,
)
from sim_gateway.estimate import (
    ACCELERATION_SIGMA,
    ERROR_SIZE,
    POSITION_ERROR,
    PROCESSES,
    VELOCITY_ERROR,
    EstimateNoise,
    error_coefficients,
    estimate_preset,
    initial_error,
)
from sim_gateway.faults import Fault, FaultSchedule
from sim_gateway.lidar import Lidar, LidarConfig
from sim_gateway.motion_faults import MotionFaults
from sim_gateway.readings import Motion, NoiseStream, Scan, read_motion
from sim_gateway.scan_faults import ScanFaults
from sim_gateway.scene import Boxes, Point, World
from sim_gateway.vehicle import (
    BODY_Z_SP,
    LANDED,
    OMEGA,
    PHASE,
    POS,
    QUAT,
    STEP_S,
    THRUST_SP,
    VEL,
    initial_state,
    rotation,
)
from sim_gateway.vehicle_params import HOVER_THRUST, VehicleParams

Array = NDArray[np.float64]

MAX_STEPS_PER_CALL = 250 * 3600
_SCAN_STREAM, _ACCELERATION_STREAM = 0, 1
_NO_ERROR, _NO_NOISE = np.zeros(ERROR_SIZE), np.zeros(3)


@dataclass(frozen=True, slots=True)
class WindConfig:
    """Steady wind plus gusts (first-order Gauss-Markov per axis), world frame, m/s. Raises `ValueError` on bad values."""

    mean_m_s: Point = (0.0, 0.0, 0.0)
    gust_sigma_m_s: float = 0.0
    gust_time_s: float = 2.0

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.mean_m_s, self.gust_sigma_m_s, self.gust_time_s))):
            raise ValueError("wind: every value must be finite")
        if self.gust_sigma_m_s < 0.0 or self.gust_time_s <= 0.0:
            raise ValueError("wind: gust_sigma_m_s must not be negative and gust_time_s must be above 0")


def step_at(time_s: float) -> int:
    """Number of the physics step nearest to `time_s` (halves round up): tick k of 20 Hz is at `step_at(k * 0.05)`.

    A tick is 12.5 steps, so drivers advance by `step_at(next tick) - simulation.steps`, 12 and 13 in turn.
    """
    return math.floor(time_s / STEP_S + 0.5 + 1e-9)


class Simulation:
    """A vehicle in `world`, from time 0, in steps of 4 ms.

    Args:
        world: where; its start and start yaw are used.
        params: the vehicle; Iris class by default.
        lidar: the scanner; the policy's 180 beams by default, `LidarConfig.device()` for the SCIP emulator.
        estimate: preset name or sizes of the estimate's errors.
        wind: steady wind and gusts.
        seed: of everything random here (the world has its own).
        hover_height_m: None starts on the ground with motors off; a number starts hovering there above the start.
        contact_radius_m: radius of the sphere whose distance to boxes is the clearance.
        dynamics: what moves the airframe: a name of `dynamics.DYNAMICS` (raises `DynamicsMissingError` if it is not installed),
            or an object that does.
    """

    def __init__(
        self,
        world: World,
        params: VehicleParams | None = None,
        lidar: LidarConfig | None = None,
        estimate: EstimateNoise | str = "nominal",
        wind: WindConfig | None = None,
        seed: int = 0,
        *,
        hover_height_m: float | None = None,
        contact_radius_m: float = 0.35,
        dynamics: str | Dynamics = "internal",
    ) -> None:
        params, wind = params or VehicleParams(), wind or WindConfig()
        self.world, self.seed, self.steps, self.contact_radius_m = world, seed, 0, contact_radius_m
        self._lidar = Lidar(lidar or LidarConfig())
        self._params = params.as_array()
        flying = hover_height_m is not None
        place = (*world.start[:2], world.start[2] if hover_height_m is None else hover_height_m)
        self._state = initial_state(place, world.start_yaw_rad, flying, params)
        self._reading = np.empty(15)
        self._boxes = world.boxes_at(0.0)
        self._generator = np.random.Generator(np.random.PCG64([seed, 0]))
        self._sensors = [NoiseStream(np.random.SeedSequence([seed, 1, i]).generate_state(2, np.uint64)) for i in range(2)]
        self._start_errors(estimate_preset(estimate) if isinstance(estimate, str) else estimate)
        self._start_wind(wind)
        self.faults = FaultSchedule()
        self.motion_faults = MotionFaults(self.faults)
        self._scan_faults = ScanFaults(self.faults, seed)
        self._log = np.array([math.inf, 0.0, 0.0, 0.0])
        watch_clearance(self._boxes, self._state, contact_radius_m, self._log)
        self._dynamics = make_dynamics(dynamics, params) if isinstance(dynamics, str) else dynamics
        self._course = Course(
            *(self._state, self._boxes, len(world.static_boxes), world.mover_rows, self._error, self._coefficients),
            *(self._gust, self._gust_coefficients, contact_radius_m, self._log),
        )

    def _start_errors(self, noise: EstimateNoise) -> None:
        row = noise.as_array()
        self._error, self._coefficients = np.empty(ERROR_SIZE), np.empty((2, PROCESSES))
        self._acceleration_sigma = row[ACCELERATION_SIGMA : ACCELERATION_SIGMA + 3]
        error_coefficients(row, STEP_S, self._coefficients)
        initial_error(row, self._generator.standard_normal(ERROR_SIZE), self._error)

    def _start_wind(self, wind: WindConfig) -> None:
        decay = math.exp(-STEP_S / wind.gust_time_s)
        self._wind_mean = np.array(wind.mean_m_s, dtype=np.float64)
        self._gust = wind.gust_sigma_m_s * self._generator.standard_normal(3)
        self._gust_coefficients = np.array([decay, wind.gust_sigma_m_s * math.sqrt(1.0 - decay * decay)])

    def inject(self, fault: Fault) -> None:
        """Let something go wrong; see `sim_gateway.faults`. Faults of links and reports need the gateway around this."""
        self.faults.add(fault)

    # time

    @property
    def time_s(self) -> float:
        """Vehicle time since the start."""
        return self.steps * STEP_S

    def advance(self, n_steps: int, velocity_sp: Sequence[float] | Array, yaw_rate_sp: float) -> None:
        """Fly `n_steps` of 4 ms under a velocity setpoint (world, m/s) and yaw rate (rad/s, counter-clockwise).

        Raises `ValueError` if a setpoint is not finite or `n_steps` is negative or absurdly large, and `DivergedError`
        when the vehicle's state is no longer finite.
        """
        setpoint = np.array(velocity_sp, dtype=np.float64)
        if setpoint.shape != (3,) or not all(map(math.isfinite, (*setpoint.tolist(), yaw_rate_sp))):
            raise ValueError(f"setpoint {velocity_sp}, {yaw_rate_sp}: give three finite velocities and a finite yaw rate")
        self._step(n_steps, setpoint, float(yaw_rate_sp), motors_on=True)

    @property
    def hover_thrust(self) -> float:
        """The collective thrust, share of the motors', that the autopilot takes for hovering."""
        return float(self._params[HOVER_THRUST])

    def advance_thrust(self, n_steps: int, direction: Sequence[float] | Array, thrust: float, yaw_rate_sp: float) -> None:
        """Fly `n_steps` of 4 ms past the velocity loop: collective `thrust` (0 to 1 of the motors') along a unit vector (world).

        On the ground it lifts off when that carries the weight. Raises what `advance` raises.
        """
        if not all(map(math.isfinite, (*direction, thrust, yaw_rate_sp))):
            raise ValueError(f"thrust {thrust} along {direction}, {yaw_rate_sp}: give finite values")
        self._state[BODY_Z_SP : BODY_Z_SP + 3], self._state[THRUST_SP] = direction, min(max(thrust, 0.0), 1.0)
        self._state[PHASE] = n_steps  # the velocity loop's turn comes after these
        self._step(n_steps, np.zeros(3), float(yaw_rate_sp), motors_on=True)

    def carry(self, position_m: Sequence[float], yaw_rad: float, velocity_m_s: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Put the vehicle there, level, as a hand would: the next step starts from this motion (corridor frame)."""
        state = self._state
        state[POS : POS + 3], state[VEL : VEL + 3] = position_m, velocity_m_s
        state[QUAT : QUAT + 4] = (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad))
        state[OMEGA : OMEGA + 3] = 0.0
        self._dynamics.moved()

    def disturb(self, position_m: Sequence[float], velocity_m_s: Sequence[float], wind_m_s: Sequence[float]) -> None:
        """Put the estimate's errors and the steady wind where an adversary wants them (corridor frame), from the next step on.

        They stay only where nothing random moves them: `EstimateNoise.held()` and no gusts.
        """
        self._error[POSITION_ERROR : POSITION_ERROR + 3] = position_m
        self._error[VELOCITY_ERROR : VELOCITY_ERROR + 3] = velocity_m_s
        self._wind_mean[:] = wind_m_s

    def advance_motors_off(self, n_steps: int) -> None:
        """Let `n_steps` of 4 ms pass with the motors off: at rest on the ground, falling in the air."""
        self._step(n_steps, np.zeros(3), 0.0, motors_on=False)

    def _step(self, n_steps: int, setpoint: Array, yaw_rate_sp: float, *, motors_on: bool) -> None:
        if not 0 <= n_steps <= MAX_STEPS_PER_CALL:
            raise ValueError(f"n_steps is {n_steps}: it must lie in 0..{MAX_STEPS_PER_CALL}")
        if not self.motion_faults.any:
            self._step_alike(n_steps, setpoint, yaw_rate_sp, self._params, self._wind_mean, motors_on=motors_on)
            return
        faults, end = self.motion_faults, self.steps + n_steps
        while self.steps < end:
            now_s, steps = self.time_s, faults.steps_alike(self.steps, end - self.steps)
            params, wind = faults.params(self._params, now_s), self._wind_mean + faults.wind(now_s)
            self._step_alike(steps, faults.setpoint(setpoint, now_s), yaw_rate_sp, params, wind, motors_on=motors_on)

    def _step_alike(
        self, n_steps: int, setpoint: Array, yaw_rate_sp: float, params: Array, wind_mean: Array, *, motors_on: bool
    ) -> None:
        normals = self._generator.standard_normal((n_steps, NORMALS))
        demand = Demand(params, setpoint, yaw_rate_sp, motors_on, wind_mean)
        self._dynamics.advance(self._course, demand, normals, self.steps)
        self.steps += n_steps

    # motion

    @property
    def truth(self) -> Motion:
        """What really is."""
        return self._motion(_NO_ERROR, _NO_NOISE)

    def estimate(self, *, acceleration_noise: bool = True) -> Motion:
        """What the vehicle believes: truth plus the estimate's errors. Reading twice at one time gives the same.

        Without `acceleration_noise` the acceleration is the true one: quicker, for readers that have no use for it.
        """
        motion = self._motion(self._error, self._acceleration_error() if acceleration_noise else _NO_NOISE)
        return self.motion_faults.estimate(motion) if self.motion_faults.any else motion

    def _acceleration_error(self) -> Array:
        if not self._acceleration_sigma.any():
            return _NO_NOISE
        return self._acceleration_sigma * self._sensors[_ACCELERATION_STREAM].at(self.steps).standard_normal(3)

    def _motion(self, error: Array, acceleration_error: Array) -> Motion:
        read_motion(self._state, error, acceleration_error, self._reading)
        x, y, z, vx, vy, vz, ax, ay, az, roll, pitch, heading, p, q, r = self._reading.tolist()
        yaw = math.remainder(heading, 2.0 * math.pi)
        return Motion(self.time_s, (x, y, z), (vx, vy, vz), (ax, ay, az), roll, pitch, yaw, (p, q, r))

    @property
    def truth_position_m(self) -> Point:
        """Where the vehicle really is."""
        return _triple(self._state[POS : POS + 3])

    @property
    def landed(self) -> bool:
        """Whether the vehicle rests on the ground."""
        return bool(self._state[LANDED] > 0.0)

    @property
    def wind_m_s(self) -> Point:
        """The wind now."""
        return _triple(self._wind_mean + self._gust + self.motion_faults.wind(self.time_s))

    @property
    def state_row(self) -> Array:
        """A copy of the vehicle's state row (see `vehicle`), for records and bit-for-bit comparison."""
        return self._state.copy()

    # surroundings

    @property
    def lidar_config(self) -> LidarConfig:
        """The scanner's configuration."""
        return self._lidar.config

    def scan(self) -> Scan:
        """What the scanner sees now, from the vehicle's true place and tilt. Reading twice at one time gives the same."""
        generator = self._sensors[_SCAN_STREAM].at(self.steps)
        ranges = self._lidar.scan(self._boxes, self._state[POS : POS + 3], rotation(self._state), generator)
        config = self._lidar.config
        angles = (config.angle_min_rad, config.angle_increment_rad)
        return Scan(self.time_s, ranges.astype(np.float32), *angles, config.range_min_m, config.range_max_m)

    def device_scans(self) -> list[Scan]:
        """What leaves the scanner at its scan time now: the scan it measured, or what LiDAR faults make of it. Once per scan."""
        return self._scan_faults.pass_on(self.scan())

    def boxes(self) -> Boxes:
        """All boxes where they are now, static ones first: a copy, float64 [m, 6]."""
        return self._boxes.copy()

    @property
    def clearance_m(self) -> float:
        """Distance now from the vehicle's sphere to the nearest box, m; negative inside one; the floor does not count."""
        return float(clearance_m(self._boxes, self._state[POS : POS + 3], self.contact_radius_m))

    @property
    def min_clearance_m(self) -> float:
        """The least `clearance_m` so far, at 250 Hz."""
        return float(self._log[LEAST_CLEARANCE])

    @property
    def contacts(self) -> int:
        """How many times the clearance has fallen below zero (a start inside a box counts as one)."""
        return int(self._log[CONTACTS])

    @property
    def flown_m(self) -> float:
        """Length of the true path so far, at 250 Hz."""
        return float(self._log[FLOWN])


def _triple(values: Array) -> Point:
    return float(values[0]), float(values[1]), float(values[2])
