"""The autopilot's mode logic: arming, flight modes, OFFBOARD's stream rule, as PX4 v1.17 does it.

Pure logic in vehicle time: no clock, no threads, no sockets. `Autopilot.step` takes the estimated state and returns what the
velocity loop shall fly; commands come in through methods that return a MAV_RESULT. What the recordings show is the rule here
(px4_reference: commands.json, modes.json, offboard_loss.json, lifecycle.json); docs/gateway.md lists what differs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from sim_gateway.attitude_setpoints import AttitudeSetpoint
from sim_gateway.autopilot_output import MOTORS_OFF, ControlOutput, ModeChange, StatusText
from sim_gateway.battery import Battery
from sim_gateway.failsafes import Failsafes
from sim_gateway.flight_modes import AUTO_MAIN_MODE, CRITICAL, INFO, FlightMode, LandedState, Result, SystemStatus
from sim_gateway.flight_tasks import (
    DescendTask,
    FlightTask,
    HoldTask,
    LandTask,
    MotionCommand,
    OffboardTask,
    PositionTask,
    ReturnTask,
    TakeoffTask,
)
from sim_gateway.local_frame import DEFAULT_ALTITUDE_M, NedState, Vector
from sim_gateway.mission import Mission, MissionTask
from sim_gateway.parameters import ParameterStore
from sim_gateway.setpoints import OffboardSetpoint
from sim_gateway.sticks import Sticks, moved
from sim_gateway.takeoff_landing import TakeoffLanding

CONTROL_PERIOD_S = 0.02  # PX4's flight tasks run at 50 Hz
FORCE_MAGIC = 21196  # param 2 of MAV_CMD_COMPONENT_ARM_DISARM: skip the checks
READY_AFTER_S = 4.3  # recorded: arming is denied until about here

_ARMING_DENIED = "Arming denied: Resolve system health failures first"
_KEPT_TEXTS = 200
_OVERRIDE_AUTO, _OVERRIDE_OFFBOARD = 1, 2  # bits of COM_RC_OVERRIDE
_STICKS_DISABLED, _RADIO_ONLY = 4, 0  # COM_RC_IN_MODE values that ignore MANUAL_CONTROL


class Autopilot:
    """One vehicle's commander. Call `step` every `CONTROL_PERIOD_S` of vehicle time; requests may come at any time between."""

    def __init__(
        self,
        parameters: ParameterStore | None = None,
        *,
        ready_after_s: float = READY_AFTER_S,
        altitude_amsl_m: float = DEFAULT_ALTITUDE_M,
    ) -> None:
        self.parameters = parameters or ParameterStore()
        self.state = NedState(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, True)
        self.texts: deque[StatusText] = deque(maxlen=_KEPT_TEXTS)
        self.mode_changes: deque[ModeChange] = deque(maxlen=_KEPT_TEXTS)
        self.battery = Battery()
        self.gps_fix = True  # cleared by faults
        self.refuses_offboard = False
        self._start_up_s = ready_after_s
        self._altitude_amsl_m = altitude_amsl_m
        self.failsafes = Failsafes(self)
        self.mission = Mission()
        self._forget(0.0)

    def _forget(self, now_s: float) -> None:
        """The state after power came on at `now_s`."""
        self.mode = FlightMode.LOITER
        self.intended = FlightMode.LOITER
        self.armed = False
        self.failsafe = False
        self.landed = True
        self.home: Vector = (0.0, 0.0, 0.0)
        self.target = OffboardSetpoint()
        self.output = MOTORS_OFF
        self._ready_after_s = now_s + self._start_up_s
        self._setpoint: OffboardSetpoint | AttitudeSetpoint = OffboardSetpoint(velocity=(0.0, 0.0, 0.0))
        self._setpoint_time_s, self._setpoint_fresh = -math.inf, False
        self._after_disarming = FlightMode.LOITER
        self._task: FlightTask | None = None
        self._task_target: Vector | None = None
        self._task_yaw_rad: float | None = None
        self._takeoff_altitude_m = math.nan
        self._ground = TakeoffLanding(self)
        self._last_step_s: float | None = None
        self.sticks = Sticks()
        self.failsafes.clear()

    # ---- what telemetry reports

    @property
    def now_s(self) -> float:
        """Vehicle time of the last step."""
        return self.state.time_s

    @property
    def healthy(self) -> bool:
        """Whether start-up has finished, so that arming is possible in a mode that allows it."""
        return self.now_s >= self._ready_after_s

    @property
    def can_arm(self) -> bool:
        """The pre-arm verdict for the mode now selected."""
        stream = self.mode is not FlightMode.OFFBOARD or self.stream_alive
        return self.healthy and stream and self.mode not in (FlightMode.LAND, FlightMode.RTL)

    @property
    def stream_alive(self) -> bool:
        """Whether a valid setpoint came within COM_OF_LOSS_T."""
        return self.now_s - self._setpoint_time_s < self.parameters.get("COM_OF_LOSS_T")

    @property
    def has_pilot(self) -> bool:
        """Whether stick input came within COM_RC_LOSS_T."""
        return self.now_s - self.sticks.time_s < self.parameters.get("COM_RC_LOSS_T")

    @property
    def system_status(self) -> SystemStatus:
        """HEARTBEAT.system_status."""
        if self.armed:
            return SystemStatus.CRITICAL if self.failsafe else SystemStatus.ACTIVE
        return SystemStatus.STANDBY if self.can_arm else SystemStatus.UNINIT

    @property
    def landed_state(self) -> LandedState:
        """EXTENDED_SYS_STATE.landed_state."""
        if self.landed:
            return LandedState.ON_GROUND
        if self._task is not None and self._task.landing:
            return LandedState.LANDING
        return LandedState.TAKEOFF if self.mode is FlightMode.TAKEOFF else LandedState.IN_AIR

    # ---- requests

    def set_setpoint(self, setpoint: OffboardSetpoint | AttitudeSetpoint) -> None:
        """A valid offboard setpoint arrived now."""
        self._setpoint = setpoint
        self._setpoint_time_s, self._setpoint_fresh = self.now_s, True

    def set_sticks(self, sticks: Sticks) -> None:
        """Stick input arrived now. Moving sticks take the vehicle over where COM_RC_OVERRIDE says so (override.json)."""
        get = self.parameters.get
        if int(get("COM_RC_IN_MODE")) in (_RADIO_ONLY, _STICKS_DISABLED):
            return
        before, self.sticks = self.sticks, sticks
        wanted = _OVERRIDE_OFFBOARD if self.mode is FlightMode.OFFBOARD else _OVERRIDE_AUTO
        if not self.armed or self.mode.needs_pilot or not int(get("COM_RC_OVERRIDE")) & wanted:
            return
        if moved(before, sticks, get("COM_RC_STICK_OV") / 100.0):
            self.say(INFO, "Pilot took over using sticks")
            self._intend(FlightMode.POSCTL)

    def arm(self, force: bool = False) -> Result:
        """Arm; `force` skips the checks."""
        if self.armed:
            return Result.ACCEPTED
        if not force and not self.can_arm:
            self.say(CRITICAL, _ARMING_DENIED)
            return Result.TEMPORARILY_REJECTED
        self.armed = True
        self._ground.armed()
        self.home = self.state.position
        self._task = None
        self.say(INFO, "Armed by external command")
        self._record()
        return Result.ACCEPTED

    def disarm(self, force: bool = False) -> Result:
        """Disarm; refused in the air unless forced."""
        if not self.armed:
            return Result.ACCEPTED
        if not self.landed and not force:
            self.say(CRITICAL, "Disarming denied: not landed")
            return Result.TEMPORARILY_REJECTED
        self.stop_motors("external command")
        return Result.ACCEPTED

    def set_mode_numbers(self, main: int, sub: int, from_pilot: bool = False) -> Result:
        """MAV_CMD_DO_SET_MODE with PX4's numbers. An unknown main mode is accepted and does nothing, as recorded."""
        mode = FlightMode.from_numbers(main, sub)
        if mode is not None:
            return self.set_mode(mode, from_pilot)
        if main != AUTO_MAIN_MODE:
            return Result.ACCEPTED
        self.say(CRITICAL, "Unsupported auto mode")
        return Result.TEMPORARILY_REJECTED

    def set_mode(self, mode: FlightMode, from_pilot: bool = False) -> Result:
        """Change the intended mode; any mode is taken while disarmed. A ground station is also told why not."""
        if self.armed and not self._can_fly(mode):
            if from_pilot:
                self.say(CRITICAL, f"Switching to {mode.label} is currently not available")
            return Result.TEMPORARILY_REJECTED
        self._task_target = self._task_yaw_rad = None
        self._takeoff_altitude_m = math.nan
        self._intend(mode)
        return Result.ACCEPTED

    def takeoff(self, altitude_amsl_m: float = math.nan) -> Result:
        """MAV_CMD_NAV_TAKEOFF: to an altitude above sea level, or MIS_TAKEOFF_ALT above home."""
        self._takeoff_altitude_m = altitude_amsl_m
        self._intend(FlightMode.TAKEOFF)
        return Result.ACCEPTED

    def land(self) -> Result:
        """MAV_CMD_NAV_LAND: here."""
        self.say(INFO, "Landing at current position")
        return self.set_mode(FlightMode.LAND)

    def return_to_launch(self) -> Result:
        """MAV_CMD_NAV_RETURN_TO_LAUNCH."""
        self.say(INFO, "Returning to launch")
        return self.set_mode(FlightMode.RTL)

    def reposition(self, target: Vector, yaw_rad: float | None = None) -> Result:
        """MAV_CMD_DO_REPOSITION: hold at a local NED point; components that are not finite mean here."""
        self.set_mode(FlightMode.LOITER)
        if any(math.isfinite(value) for value in target):
            here = self.state.position
            x, y, z = (value if math.isfinite(value) else here[i] for i, value in enumerate(target))
            self._task_target = (x, y, z)
        self._task_yaw_rad = yaw_rad
        return Result.ACCEPTED

    def enter_failsafe(self, mode: FlightMode, at: Vector | None = None) -> None:
        """A failsafe takes the vehicle over; the intended mode stays. `at`: where to hold."""
        self.failsafe = True
        self._task_target, self._task_yaw_rad = at, None
        self._enter(mode)

    def leave_failsafe(self) -> None:
        """Its reason has gone: back to the intended mode."""
        self.failsafe = False
        self._enter(self.intended)

    def begin_in_air(self, state: NedState, home: Vector) -> None:
        """Start flying: armed, in Hold, with the takeoff behind it."""
        self.step(state)
        self.armed, self.landed, self._ground.flown, self.home = True, False, True, home

    def restart(self) -> None:
        """Power lost and back: motors off, everything but the parameters forgotten."""
        self._forget(self.now_s)
        self.landed = self.state.on_ground
        self._record()

    def say(self, severity: int, text: str) -> None:
        """Queue a STATUSTEXT."""
        self.texts.append(StatusText(self.now_s, severity, text))

    # ---- the step

    def step(self, state: NedState) -> ControlOutput:
        """Advance to `state.time_s` and return the setpoint to fly until the next step."""
        dt_s = CONTROL_PERIOD_S if self._last_step_s is None else max(state.time_s - self._last_step_s, 0.0)
        self._last_step_s = state.time_s
        self.state = state
        if self._setpoint_fresh:  # it came between the last step and this one: the stream's clock starts now
            self._setpoint_time_s, self._setpoint_fresh = state.time_s, False
        self.failsafes.watch(dt_s)
        if not self.armed:
            self.landed = self.landed or state.on_ground
            return self.output
        self.failsafes.check()
        if not self.armed:
            return self.output
        if self._task is None:
            self._task = self._start_task()
        command = self._run(self._task, dt_s)
        self.output = self._ground.output(command)
        self._ground.watch()
        return self.output

    def _run(self, task: FlightTask, dt_s: float) -> MotionCommand:
        if isinstance(task, OffboardTask):
            task.setpoint = self._setpoint
        elif isinstance(task, PositionTask):
            task.sticks = self.sticks
        was_landing = task.landing
        command = task.update(self.state, dt_s)
        self.target = command.target
        if task.landing and not was_landing and isinstance(task, ReturnTask):
            self.say(INFO, "RTL: land at destination")
        if isinstance(task, MissionTask) and task.returns:
            self.return_to_launch()
        elif isinstance(task, TakeoffTask | MissionTask) and task.finished:
            self._task_target = task.target
            self._task_yaw_rad = self.state.yaw_rad if isinstance(task, MissionTask) else task.state_at_entry.yaw_rad
            self._intend(FlightMode.LOITER)
        return command

    def _can_fly(self, mode: FlightMode) -> bool:
        if mode is FlightMode.OFFBOARD:
            return self.stream_alive and not self.refuses_offboard
        return self.has_pilot if mode.needs_pilot else mode is not FlightMode.MISSION or bool(self.mission.legs)

    def _intend(self, mode: FlightMode) -> None:
        self.intended = mode
        if mode not in (FlightMode.LAND, FlightMode.RTL):
            self._after_disarming = mode
        self.failsafe = False
        self.failsafes.clear()
        self._enter(mode)

    def _enter(self, mode: FlightMode) -> None:
        self.mode = mode
        self._task = None
        self._record()

    def _record(self) -> None:
        self.mode_changes.append(ModeChange(self.now_s, self.mode, self.intended, self.armed, self.failsafe))

    def _start_task(self) -> FlightTask:
        parameters, state = self.parameters, self.state
        if self.mode is FlightMode.OFFBOARD:
            return OffboardTask(parameters, self._setpoint)
        if self.mode.needs_pilot:
            blind = self.mode is FlightMode.ALTCTL and self.failsafes.latched
            return DescendTask(parameters, state) if blind else PositionTask(parameters, state, self.sticks)
        starts: dict[FlightMode, Callable[[], FlightTask]] = {
            FlightMode.TAKEOFF: lambda: TakeoffTask(parameters, state, self._takeoff_target_down_m()),
            FlightMode.LAND: lambda: LandTask(parameters, state, self.home[2]),
            FlightMode.RTL: self._start_return,
        }
        if self.mission.legs:
            starts[FlightMode.MISSION] = self._start_mission
        hold = HoldTask(parameters, state, self._task_target, self._task_yaw_rad)
        return starts[self.mode]() if self.mode in starts else hold

    def _takeoff_target_down_m(self) -> float:
        """Down coordinate of the takeoff altitude; never below where the vehicle is."""
        if math.isfinite(self._takeoff_altitude_m):
            down = self._altitude_amsl_m - self._takeoff_altitude_m
        else:
            height = self.parameters.get("MIS_TAKEOFF_ALT")
            self.say(INFO, f"Using default takeoff altitude: {height:.1f} m")
            down = self.home[2] - height
        return min(down, self.state.position[2])

    def _start_mission(self) -> MissionTask:
        if self.mission.complete:
            self.mission.set_current(0)
        return MissionTask(self.parameters, self.state, self.mission, self.home)

    def _start_return(self) -> ReturnTask:
        task = ReturnTask(self.parameters, self.state, self.home)
        above_sea_m = self._altitude_amsl_m - self.home[2] + task.return_height_m
        self.say(INFO, f"RTL: start return at {int(above_sea_m)} m ({int(task.return_height_m)} m above destination)")
        return task

    def stop_motors(self, reason: str) -> None:
        """Motors off; the mode falls back to the last one intended that may be armed in."""
        self.armed = self.failsafe = False
        self.landed = self.landed or self.state.on_ground
        self._ground.stopped()
        self._task_target = self._task_yaw_rad = None
        self.intended = self._after_disarming
        self.output, self.target = MOTORS_OFF, OffboardSetpoint()
        self.say(INFO, f"Disarmed by {reason}")
        self._enter(self.intended)
