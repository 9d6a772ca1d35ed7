"""Missions: the uploaded items, which one is current, and how AUTO.MISSION flies them one after the other.

Flown: takeoff, waypoint, loiter for a time, land, return (which leaves the mission for that mode), change of speed. Others
are passed over, as PX4 does with those that its hardware lacks. The protocol is in `fence` (`ItemStore`).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from pymavlink.dialects.v20 import development as mav

from sim_gateway.flight_tasks import FlightTask, HoldTask, LandTask, MotionCommand, TakeoffTask
from sim_gateway.local_frame import NedState, Vector
from sim_gateway.parameters import ParameterStore

_TURN_FROM_M = 1.0  # nearer than this the vehicle does not turn towards a waypoint
_STAYS = (mav.MAV_CMD_NAV_WAYPOINT, mav.MAV_CMD_NAV_LOITER_TIME)
FLOWN = (*_STAYS, mav.MAV_CMD_NAV_TAKEOFF, mav.MAV_CMD_NAV_LAND)


@dataclass(frozen=True, slots=True)
class Leg:
    """One item: local north and east, altitude above home or in local up (`above_home`); not finite: where the vehicle is."""

    command: int
    north_m: float
    east_m: float
    altitude_m: float
    above_home: bool
    params: tuple[float, float, float, float]

    def target(self, here: Vector, home: Vector) -> Vector:
        """Where it ends, local NED."""
        down = home[2] - self.altitude_m if self.above_home else -self.altitude_m
        down = down if math.isfinite(down) else here[2]
        north, east = (self.north_m, self.east_m) if math.isfinite(self.north_m) else here[:2]
        return (north, east, down)


class Mission:
    """The mission of one vehicle. `current`: the item that is flown next or now; `reached`: those to be told of."""

    def __init__(self) -> None:
        self.legs: tuple[Leg, ...] = ()
        self.current = 0
        self.reached: deque[int] = deque(maxlen=256)

    def replace(self, legs: tuple[Leg, ...]) -> None:
        """A new mission begins at its first item."""
        self.legs, self.current = legs, 0

    def set_current(self, number: int) -> bool:
        """Go on from this item; False if there is none."""
        if not 0 <= number < len(self.legs):
            return False
        self.current = number
        return True

    @property
    def complete(self) -> bool:
        """Whether its last item has been flown."""
        return bool(self.legs) and self.current >= len(self.legs)


@dataclass(slots=True)
class MissionTask:
    """AUTO.MISSION: fly the items from the current one on. `finished`: there is none left, and it was no landing.

    `returns`: a return was reached, for the autopilot to change its mode.
    """

    parameters: ParameterStore
    state_at_entry: NedState
    mission: Mission
    home: Vector
    finished: bool = False
    landing: bool = False
    returns: bool = False
    _part: FlightTask | None = None
    _flying: int = -1
    _there_since_s: float | None = None

    @property
    def target(self) -> Vector | None:
        """Where it is going or has arrived."""
        return self._part.target if isinstance(self._part, HoldTask | TakeoffTask) else None

    def update(self, state: NedState, dt_s: float) -> MotionCommand:
        """Setpoint of the item that is being flown."""
        mission = self.mission
        if self._flying != mission.current:
            self._begin(state)
        elif self._arrived(state):
            mission.reached.append(mission.current)
            mission.current += 1
            self._begin(state)
        assert self._part is not None
        command = self._part.update(state, dt_s)
        self.landing = self._part.landing
        return command

    def _begin(self, state: NedState) -> None:
        """Start the current item; those that fly nowhere are done at once."""
        mission, self._there_since_s = self.mission, None
        while not (self.returns or mission.complete) and mission.legs[mission.current].command not in FLOWN:
            self._do(mission.legs[mission.current])
            mission.reached.append(mission.current)
            mission.current += 1
        self._flying = mission.current
        self.finished = mission.complete and not self.returns
        if not (mission.complete or self.returns):
            self._part = self._task_of(mission.legs[mission.current], state)
        elif self._part is None:
            self._part = HoldTask(self.parameters, state)

    def _do(self, leg: Leg) -> None:
        self.returns = leg.command == mav.MAV_CMD_NAV_RETURN_TO_LAUNCH
        if leg.command == mav.MAV_CMD_DO_CHANGE_SPEED and leg.params[1] > 0.0:
            self.parameters.set("MPC_XY_CRUISE", leg.params[1])

    def _task_of(self, leg: Leg, state: NedState) -> FlightTask:
        target = leg.target(state.position, self.home)
        if leg.command == mav.MAV_CMD_NAV_TAKEOFF:
            return TakeoffTask(self.parameters, state, min(target[2], state.position[2]))
        if leg.command == mav.MAV_CMD_NAV_LAND:
            return LandTask(self.parameters, state, self.home[2], target=(target[0], target[1], self.home[2]))
        return HoldTask(self.parameters, state, target, self._heading(leg, state, target))

    def _heading(self, leg: Leg, state: NedState, target: Vector) -> float:
        """The item's own, or towards the waypoint."""
        if math.isfinite(leg.params[3]):
            return math.radians(leg.params[3])
        north, east = target[0] - state.position[0], target[1] - state.position[1]
        return math.atan2(east, north) if math.hypot(north, east) > _TURN_FROM_M else state.yaw_rad

    def _arrived(self, state: NedState) -> bool:
        leg, part = self.mission.legs[self.mission.current], self._part
        if isinstance(part, TakeoffTask):
            return part.finished
        if not isinstance(part, HoldTask) or part.target is None:
            return False
        get = self.parameters.get
        radius_m = leg.params[1] if leg.command == mav.MAV_CMD_NAV_WAYPOINT and leg.params[1] > 0.0 else get("NAV_ACC_RAD")
        near = math.dist(state.position[:2], part.target[:2]) < radius_m
        if self._there_since_s is None and near and abs(state.position[2] - part.target[2]) < get("NAV_MC_ALT_RAD"):
            self._there_since_s = state.time_s
        stay_s = leg.params[0] if leg.command in _STAYS and leg.params[0] > 0.0 else 0.0
        return self._there_since_s is not None and state.time_s - self._there_since_s >= stay_s
