"""How each flight mode moves: every task turns the estimated state into a velocity and yaw rate setpoint (NED, clockwise).

The laws are those of PX4's flight tasks in simple form: proportional position control, speed limited by the distance left,
velocity references limited in acceleration. Gains and limits are read from PX4's parameters at every update.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Protocol

from sim_gateway.attitude_setpoints import AttitudeLaw, AttitudeSetpoint, Thrust, thrust_for
from sim_gateway.local_frame import NedState, Vector, wrap_pi
from sim_gateway.parameters import ParameterStore
from sim_gateway.setpoints import NAN, NOTHING, OffboardSetpoint
from sim_gateway.sticks import Sticks, shaped

_ZERO: Vector = (0.0, 0.0, 0.0)
_STOPPED_M_S = 0.15
_BRAKE_TIMEOUT_S = 3.0
_DESCEND_M_S = 0.8
_STICK_EXPO = 0.6  # PX4 default of MPC_XY_MAN_EXPO, which the recorded build does not list
_TAKEOFF_GAIN = 0.6  # 1/s; recorded climbs slow down like this towards their altitude
_TAKEOFF_AT_LEAST_S = 1.5  # recorded: a takeoff in the air is over after about two seconds


@dataclass(frozen=True, slots=True)
class MotionCommand:
    """What a task wants now; `target` is what POSITION_TARGET_LOCAL_NED reports. With `thrust`, that instead of a velocity."""

    velocity: Vector
    yaw_rate_rad_s: float
    target: OffboardSetpoint
    thrust: Thrust | None = None


class FlightTask(Protocol):
    """A mode's motion. `finished`: the mode has done its work. `landing`: it is in its final descent."""

    finished: bool
    landing: bool

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """The setpoint for this instant; `dt_s` since the last update."""
        ...


def _clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def _limit_horizontal(x: float, y: float, limit: float) -> tuple[float, float]:
    length = math.hypot(x, y)
    scale = limit / length if length > limit else 1.0
    return x * scale, y * scale


def limit_velocity(velocity: Vector, parameters: ParameterStore) -> Vector:
    """Inside MPC_XY_VEL_MAX, MPC_Z_VEL_MAX_UP and MPC_Z_VEL_MAX_DN."""
    x, y = _limit_horizontal(velocity[0], velocity[1], max(parameters.get("MPC_XY_VEL_MAX"), 0.0))
    return (x, y, _clamp(velocity[2], -parameters.get("MPC_Z_VEL_MAX_UP"), parameters.get("MPC_Z_VEL_MAX_DN")))


def yaw_rate_towards(yaw_rad: float, state: NedState, parameters: ParameterStore) -> float:
    """Proportional heading control, limited to MPC_YAWRAUTO_MAX."""
    limit = math.radians(parameters.get("MPC_YAWRAUTO_MAX"))
    return _clamp(parameters.get("MC_YAW_P") * wrap_pi(yaw_rad - state.yaw_rad), -limit, limit)


@dataclass(slots=True)
class _Motion:
    """A velocity reference that changes no faster than the acceleration limits allow."""

    parameters: ParameterStore
    velocity: Vector

    def towards(self, wanted: Vector, dt_s: float) -> Vector:
        get = self.parameters.get
        change = [wanted[i] - self.velocity[i] for i in range(3)]
        dx, dy = _limit_horizontal(change[0], change[1], get("MPC_ACC_HOR") * dt_s)
        dz = _clamp(change[2], -get("MPC_ACC_UP_MAX") * dt_s, get("MPC_ACC_DOWN_MAX") * dt_s)
        self.velocity = (self.velocity[0] + dx, self.velocity[1] + dy, self.velocity[2] + dz)
        return self.velocity

    def horizontal_to(self, state: NedState, target: Vector, speed_m_s: float) -> tuple[float, float]:
        """Wanted horizontal velocity to a point: slows down so that it can stop there."""
        dx, dy = target[0] - state.position[0], target[1] - state.position[1]
        distance = math.hypot(dx, dy)
        if distance < 1e-6:
            return 0.0, 0.0
        get = self.parameters.get
        speed = min(speed_m_s, math.sqrt(get("MPC_ACC_HOR") * distance), get("MPC_XY_P") * distance)
        return dx / distance * speed, dy / distance * speed

    def vertical_to(self, state: NedState, down_m: float, up_m_s: float, down_m_s: float) -> float:
        return _clamp(self.parameters.get("MPC_Z_P") * (down_m - state.position[2]), -up_m_s, down_m_s)


@dataclass(slots=True)
class HoldTask:
    """AUTO.LOITER: brake, then stay; on the ground, idle. With a target it flies there instead, at cruise speed."""

    parameters: ParameterStore
    state_at_entry: NedState
    target: Vector | None = None
    yaw_rad: float | None = None
    finished: bool = False
    landing: bool = False
    _motion: _Motion = field(init=False)

    def __post_init__(self) -> None:
        self._motion = _Motion(self.parameters, self.state_at_entry.velocity)
        if self.yaw_rad is None:
            self.yaw_rad = self.state_at_entry.yaw_rad

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint of the hold."""
        assert self.yaw_rad is not None
        yaw_rate = yaw_rate_towards(self.yaw_rad, state, self.parameters)
        if self.target is None:
            velocity = self._motion.towards(_ZERO, dt_s)
            slow = velocity == _ZERO and math.dist(state.velocity, _ZERO) < _STOPPED_M_S
            stopped = slow or state.time_s - self.state_at_entry.time_s > _BRAKE_TIMEOUT_S
            if stopped and not state.on_ground:  # on the ground PX4 idles: to hold a noisy estimate there would be to take off
                self.target = state.position
            return MotionCommand(velocity, yaw_rate, OffboardSetpoint(NOTHING, velocity, NOTHING, self.yaw_rad, 0.0))
        get = self.parameters.get
        north, east = self._motion.horizontal_to(state, self.target, get("MPC_XY_CRUISE"))
        down = self._motion.vertical_to(state, self.target[2], get("MPC_Z_V_AUTO_UP"), get("MPC_Z_V_AUTO_DN"))
        velocity = self._motion.towards((north, east, down), dt_s)
        return MotionCommand(velocity, yaw_rate, OffboardSetpoint(self.target, velocity, NOTHING, self.yaw_rad, 0.0))


@dataclass(slots=True)
class TakeoffTask:
    """AUTO.TAKEOFF: straight up to `target_down_m`; finished within NAV_MC_ALT_RAD of it."""

    parameters: ParameterStore
    state_at_entry: NedState
    target_down_m: float
    finished: bool = False
    landing: bool = False
    _motion: _Motion = field(init=False)

    def __post_init__(self) -> None:
        self._motion = _Motion(self.parameters, self.state_at_entry.velocity)

    @property
    def target(self) -> Vector:
        """Where the takeoff ends."""
        return (self.state_at_entry.position[0], self.state_at_entry.position[1], self.target_down_m)

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint of the climb."""
        get = self.parameters.get
        north, east = self._motion.horizontal_to(state, self.target, get("MPC_XY_CRUISE"))
        up_m_s = min(get("MPC_TKO_SPEED"), _TAKEOFF_GAIN * max(state.position[2] - self.target_down_m, 0.0))
        down = self._motion.vertical_to(state, self.target_down_m, up_m_s, get("MPC_Z_V_AUTO_DN"))
        velocity = self._motion.towards((north, east, down), dt_s)
        there = abs(self.target_down_m - state.position[2]) < get("NAV_MC_ALT_RAD")
        self.finished = there and state.time_s - self.state_at_entry.time_s > _TAKEOFF_AT_LEAST_S
        yaw = self.state_at_entry.yaw_rad
        target = OffboardSetpoint(self.target, velocity, NOTHING, yaw, 0.0)
        return MotionCommand(velocity, yaw_rate_towards(yaw, state, self.parameters), target)


@dataclass(slots=True)
class LandTask:
    """AUTO.LAND: brake, then straight down, slower near the ground; `ground_down_m` is the home altitude."""

    parameters: ParameterStore
    state_at_entry: NedState
    ground_down_m: float
    target: Vector | None = None
    finished: bool = False
    landing: bool = True
    _motion: _Motion = field(init=False)

    def __post_init__(self) -> None:
        self._motion = _Motion(self.parameters, self.state_at_entry.velocity)

    def _speed(self, height_m: float) -> float:
        """MPC_Z_V_AUTO_DN above MPC_LAND_ALT1, MPC_LAND_SPEED below MPC_LAND_ALT2, a straight line between."""
        get = self.parameters.get
        fast, slow, high, low = (get(n) for n in ("MPC_Z_V_AUTO_DN", "MPC_LAND_SPEED", "MPC_LAND_ALT1", "MPC_LAND_ALT2"))
        share = _clamp((height_m - low) / max(high - low, 0.1), 0.0, 1.0)
        return slow + (fast - slow) * share

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint of the descent."""
        wanted = (0.0, 0.0)
        if self.target is not None:
            wanted = self._motion.horizontal_to(state, self.target, self.parameters.get("MPC_XY_CRUISE"))
        elif math.hypot(state.velocity[0], state.velocity[1]) < _STOPPED_M_S:
            self.target = state.position
        speed = self._speed(self.ground_down_m - state.position[2])
        velocity = self._motion.towards((wanted[0], wanted[1], speed), dt_s)
        yaw = self.state_at_entry.yaw_rad
        spot = (NAN, NAN, NAN) if self.target is None else (self.target[0], self.target[1], NAN)
        target = OffboardSetpoint(spot, velocity, NOTHING, yaw, 0.0)
        return MotionCommand(velocity, yaw_rate_towards(yaw, state, self.parameters), target)


@dataclass(slots=True)
class DescendTask:
    """Without a position: level and down at `_DESCEND_M_S` (recorded about 0.8 m/s), carried by the wind."""

    parameters: ParameterStore
    state_at_entry: NedState
    finished: bool = False
    landing: bool = True

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint of the descent."""
        velocity = (state.velocity[0], state.velocity[1], _DESCEND_M_S)
        return MotionCommand(velocity, 0.0, OffboardSetpoint(NOTHING, velocity, NOTHING, NAN, 0.0))


def return_height_m(distance_m: float, height_m: float, parameters: ParameterStore) -> float:
    """Height above home at which RTL flies back.

    RTL_RETURN_ALT; near home (RTL_MIN_DIST) only as high as a cone of half angle RTL_CONE_ANG over home asks for, but at least
    twice NAV_ACC_RAD; never below the present height.
    """
    get = parameters.get
    wanted = get("RTL_RETURN_ALT")
    cone_deg = get("RTL_CONE_ANG")
    if cone_deg > 0.0 and distance_m <= get("RTL_MIN_DIST"):
        cone_height = 0.0 if cone_deg >= 90.0 else distance_m / math.tan(math.radians(_clamp(cone_deg, 1.0, 89.0)))
        wanted = max(min(wanted, cone_height), 2.0 * get("NAV_ACC_RAD"))
    return max(wanted, height_m)


@dataclass(slots=True)
class ReturnTask:
    """AUTO.RTL: climb to the return height, fly home, land."""

    parameters: ParameterStore
    state_at_entry: NedState
    home: Vector
    finished: bool = False
    landing: bool = False
    return_height_m: float = field(init=False)
    _climbed: bool = False
    _move: HoldTask = field(init=False)
    _land: LandTask | None = None

    def __post_init__(self) -> None:
        position = self.state_at_entry.position
        distance = math.hypot(position[0] - self.home[0], position[1] - self.home[1])
        self.return_height_m = return_height_m(distance, self.home[2] - position[2], self.parameters)
        self._move = HoldTask(self.parameters, self.state_at_entry)
        if self.state_at_entry.on_ground:
            self._start_landing(self.state_at_entry)

    def _start_landing(self, state: NedState) -> None:
        self.landing = True
        self._land = LandTask(self.parameters, state, self.home[2], target=self.home)

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint of the phase it is in."""
        if self._land is not None:
            return self._land.update(state, dt_s)
        get = self.parameters.get
        down = self.home[2] - self.return_height_m
        if self._move.target is not None and not self._climbed:
            self._climbed = abs(state.position[2] - down) < get("NAV_MC_ALT_RAD")
            north, east = (self.home[0], self.home[1]) if self._climbed else self._move.target[:2]
            self._move.target = (north, east, down)
        at_home = math.hypot(state.position[0] - self.home[0], state.position[1] - self.home[1]) < 0.5
        if self._climbed and at_home:
            self._start_landing(state)
        return self._move.update(state, dt_s)


@dataclass(slots=True)
class OffboardTask:
    """OFFBOARD: fly the newest setpoint. What PX4 cannot fly (an axis without setpoint) becomes a stop."""

    parameters: ParameterStore
    setpoint: OffboardSetpoint | AttitudeSetpoint
    finished: bool = False
    landing: bool = False
    _attitude: AttitudeLaw = field(default_factory=AttitudeLaw)

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint within the vehicle's limits."""
        if isinstance(self.setpoint, AttitudeSetpoint):
            return self._fly_attitude(self.setpoint, state, dt_s)
        self._attitude = AttitudeLaw()
        if self.setpoint.only_acceleration:
            return self._fly_acceleration(self.setpoint, state)
        return self._fly_motion(self.setpoint, state)

    def _fly_acceleration(self, given: OffboardSetpoint, state: NedState) -> MotionCommand:
        tilt = math.radians(self.parameters.get("MPC_TILTMAX_AIR"))
        target = replace(given, yaw_rad=given.yaw_rad if math.isfinite(given.yaw_rad) else state.yaw_rad)
        yaw_rate = self._yaw_rate(given.yaw_rad, given.yaw_rate_rad_s, state)
        return MotionCommand((0.0, 0.0, given.acceleration[2]), yaw_rate, target, thrust_for(given.acceleration, tilt))

    def _fly_attitude(self, given: AttitudeSetpoint, state: NedState, dt_s: float) -> MotionCommand:
        thrust = self._attitude.update(given, state.yaw_rad, dt_s)
        yaw, rate = self._attitude.yaw_rad, given.yaw_rate_rad_s
        return MotionCommand(_ZERO, self._yaw_rate(yaw, rate, state), OffboardSetpoint(), thrust)

    def _fly_motion(self, given: OffboardSetpoint, state: NedState) -> MotionCommand:
        wanted = tuple(self._axis(given, i, state) for i in range(3)) if given.flyable else _ZERO
        velocity = limit_velocity((wanted[0], wanted[1], wanted[2]), self.parameters)
        held = given.position if given.flyable else NOTHING
        yaw = given.yaw_rad if math.isfinite(given.yaw_rad) else state.yaw_rad
        rate = given.yaw_rate_rad_s if math.isfinite(given.yaw_rate_rad_s) else 0.0
        yaw_rate = self._yaw_rate(given.yaw_rad, given.yaw_rate_rad_s, state)
        return MotionCommand(velocity, yaw_rate, OffboardSetpoint(held, velocity, NOTHING, yaw, rate))

    def _axis(self, given: OffboardSetpoint, i: int, state: NedState) -> float:
        """Velocity wanted along one axis: position error plus feed-forward, velocity, or (beside those) an acceleration."""
        get = self.parameters.get
        if math.isfinite(given.position[i]):
            gain = get("MPC_XY_P") if i < 2 else get("MPC_Z_P")
            feed_forward = given.velocity[i] if math.isfinite(given.velocity[i]) else 0.0
            return gain * (given.position[i] - state.position[i]) + feed_forward
        if math.isfinite(given.velocity[i]):
            return given.velocity[i]
        # the velocity loop accelerates by gain times velocity error, so this error asks for the acceleration
        gain = get("MPC_XY_VEL_P_ACC") if i < 2 else get("MPC_Z_VEL_P_ACC")
        return state.velocity[i] + given.acceleration[i] / gain

    def _yaw_rate(self, yaw_rad: float, rate_rad_s: float, state: NedState) -> float:
        limit = math.radians(self.parameters.get("MC_YAWRATE_MAX"))
        rate = rate_rad_s if math.isfinite(rate_rad_s) else 0.0
        if math.isfinite(yaw_rad):
            rate += self.parameters.get("MC_YAW_P") * wrap_pi(yaw_rad - state.yaw_rad)
        return _clamp(rate, -limit, limit)


@dataclass(slots=True)
class PositionTask:
    """POSCTL (and the other stick modes, flown alike): sticks are velocities in the heading frame; centred, it stands still."""

    parameters: ParameterStore
    state_at_entry: NedState
    sticks: Sticks
    finished: bool = False
    landing: bool = False
    _motion: _Motion = field(init=False)

    def __post_init__(self) -> None:
        self._motion = _Motion(self.parameters, self.state_at_entry.velocity)

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint that the sticks ask for: full deflection is MPC_VEL_MANUAL, MPC_Z_VEL_MAX_* and MPC_MAN_Y_MAX."""
        get, sticks = self.parameters.get, self.sticks
        cos, sin = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        full = get("MPC_VEL_MANUAL")
        ahead, right = (shaped(axis, get("MAN_DEADZONE"), _STICK_EXPO) for axis in (sticks.ahead, sticks.right))
        north = full * (cos * ahead - sin * right)
        east = full * (sin * ahead + cos * right)
        down = -sticks.up * get("MPC_Z_VEL_MAX_UP" if sticks.up > 0.0 else "MPC_Z_VEL_MAX_DN")
        velocity = self._motion.towards(limit_velocity((north, east, down), self.parameters), dt_s)
        yaw_rate = math.radians(get("MPC_MAN_Y_MAX")) * sticks.turn
        return MotionCommand(velocity, yaw_rate, OffboardSetpoint(NOTHING, velocity, NOTHING, NAN, yaw_rate))
