"""`--shadow`: the pilot flies; policy and safety run on what the vehicle and the LiDAR say, and are logged; nothing is sent.

The flight holds the vehicle only through `Observed`, which has no way to send: no setpoint, no mode, no arming, no parameter.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol

from flight.errors import ExitCode
from flight.health import health_of
from flight.interrupt import Interrupt
from flight.lidar.driver import LidarDriver
from flight.mission import Mission
from flight.offboard import LINK_LOST_S, Ending, quiet_interpreter
from flight.preflight import LOOP_RATE_HZ
from flight.px4 import LANDED_STATE_ON_GROUND
from flight.rate_keeper import RateKeeper
from flight.recorder import FlightRecorder, NoRecorder
from flight.status import Status
from flight.telemetry import Telemetry
from flight.tick import Pilot
from flight.trajectory import FlightLog
from safety.frames import CorridorFrame
from safety.messages import VehicleState

POLL_S = 0.02


class Observed(Protocol):
    """A vehicle that is only looked at."""

    @property
    def telemetry(self) -> Telemetry:
        """What the vehicle says."""
        ...

    def state(self, frame: CorridorFrame) -> VehicleState | None:
        """The newest estimate in the corridor frame."""
        ...


class ShadowFlight:
    """Follows one flight of the pilot, from takeoff to disarm. `log` holds what `fly` would have sent."""

    def __init__(
        self,
        vehicle: Observed,
        lidar: LidarDriver,
        pilot: Pilot,
        frame: CorridorFrame,
        mission: Mission,
        interrupt: Interrupt,
        status: Status,
        clock: Callable[[], float] = time.monotonic,
        *,
        recorder: FlightRecorder | None = None,
    ) -> None:
        self._recorder = recorder if recorder is not None else NoRecorder()
        self.log = FlightLog(max_ticks=int(mission.timeouts.flight_s * LOOP_RATE_HZ) + 200)
        self.keeper = RateKeeper(LOOP_RATE_HZ, clock)
        self.events: list[str] = []
        self._vehicle, self._lidar, self._pilot, self._frame = vehicle, lidar, pilot, frame
        self._mission, self._interrupt, self._status, self._clock = mission, interrupt, status, clock
        self._arrived = False

    def watch(self) -> tuple[Ending, bool]:
        """Wait for the pilot's takeoff, follow the flight; (ending, whether the vehicle is disarmed)."""
        self._status.phase(
            f"shadow: take off by hand within {self._mission.timeouts.pilot_s:g} s; fly sends nothing (Ctrl-C ends)"
        )
        ending = self._wait_for_takeoff() or self._follow()
        self._status.phase(ending.message)
        return ending, self._vehicle.telemetry.armed is False

    @property
    def _airborne(self) -> bool:
        telemetry = self._vehicle.telemetry
        return telemetry.armed is True and telemetry.landed_state != LANDED_STATE_ON_GROUND

    def _wait_for_takeoff(self) -> Ending | None:
        deadline = self._clock() + self._mission.timeouts.pilot_s
        while not self._airborne:
            if self._interrupt.requested:
                return _ended("stopped", f"stopped by {self._interrupt.name} before the pilot took off")
            if self._clock() > deadline:
                return _ended("no_takeoff", "the pilot did not take off: start again, or raise timeouts.pilot_s")
            time.sleep(POLL_S)
        return None

    def _follow(self) -> Ending:
        self._status.phase("shadow: following the pilot")
        self._pilot.tick(self._lidar.latest(), self._vehicle.state(self._frame), self._clock())  # first call allocates
        self._pilot.reset()
        self.keeper.reset()
        self._status.start_live(started_s := self._clock())
        try:
            with quiet_interpreter():
                while True:
                    ending = self._step(started_s)
                    if ending is not None:
                        return ending
        finally:
            self._status.stop_live()

    def _step(self, started_s: float) -> Ending | None:
        now_s = self.keeper.wait()
        telemetry = self._vehicle.telemetry
        if telemetry.armed is False:
            return Ending("shadow", ExitCode.GOAL_REACHED, "the pilot has landed: shadow flight logged, nothing was sent")
        if self._interrupt.requested:
            return _ended("stopped", f"stopped by {self._interrupt.name}: the pilot flies on, nothing was sent")
        if now_s - telemetry.heartbeat_s > LINK_LOST_S:
            return _ended("link_lost", f"no heartbeat from the vehicle for {LINK_LOST_S:g} s")
        if now_s - started_s > self._mission.timeouts.flight_s:
            return _ended("timeout", f"{self._mission.timeouts.flight_s:g} s logged: the pilot flies on, nothing was sent")
        scan, state = self._lidar.latest(), self._vehicle.state(self._frame)
        health = health_of(telemetry, self._frame, self.keeper.lateness_s)
        record = self._pilot.tick(scan, state, now_s, health)
        self.log.append(record, math.nan)
        self.log.see(scan, state)
        self._status.publish(record, self.keeper.deadline_misses)
        keeper = self.keeper
        self._recorder.tick(record, scan, state, None, math.nan, self._pilot.goal, keeper.lateness_s, keeper.deadline_misses)
        if record.goal_reached and not self._arrived:
            self._arrived = True
            self.events.append(f"goal reached by the pilot ({record.distance_to_goal_m:.2f} m)")
        return None


def _ended(outcome: str, message: str) -> Ending:
    return Ending(outcome, ExitCode.NOT_REACHED, message, in_control=False)
