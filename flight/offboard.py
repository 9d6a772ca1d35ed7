"""OFFBOARD: the handshake, the 20 Hz loop, and every reason for which it ends.

Liveness by construction: each setpoint is one message sent by this loop and by nothing else. When the loop stalls, is
stopped or killed, the stream stops with it and PX4's own loss action (set and read back in preflight) takes over. After a
stall the first setpoint is zero velocity, then the loop flies on with fresh samples; missed ticks are not made up for.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from flight.errors import ExitCode, VehicleCommandError
from flight.interrupt import Interrupt
from flight.lidar.driver import ScipDriver
from flight.link import VehicleLink
from flight.mission import Mission
from flight.preflight import LOOP_RATE_HZ
from flight.px4 import FlightMode, mode_name
from flight.rate_keeper import RateKeeper
from flight.status import Status
from flight.tick import Pilot, TickRecord
from flight.trajectory import FlightLog
from safety.frames import CorridorFrame, CorridorVector
from safety.messages import SafeCommand

STILL = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)
SETPOINTS_BEFORE_OFFBOARD_S = 1.0
STUCK_PROGRESS_M = 0.5
LINK_LOST_S = 3.0
MAX_STALLS = 3
STALL_WINDOW_S = 5.0


@dataclass(frozen=True, slots=True)
class Ending:
    """How a flight ended. `in_control`: whether `fly` may still command the vehicle (False once a pilot or PX4 took over)."""

    outcome: str
    exit_code: ExitCode
    message: str
    in_control: bool = True


class OffboardFlight:
    """One engagement of OFFBOARD mode: `engage`, `run`, then `brake`. Made anew for every flight."""

    def __init__(
        self,
        link: VehicleLink,
        lidar: ScipDriver,
        pilot: Pilot,
        frame: CorridorFrame,
        mission: Mission,
        interrupt: Interrupt,
        status: Status,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.log = FlightLog(max_ticks=int(mission.timeouts.flight_s * LOOP_RATE_HZ) + 200)
        self.keeper = RateKeeper(LOOP_RATE_HZ, clock)
        self.events: list[str] = []
        self.stall_times_s: list[float] = []
        self._link, self._lidar, self._pilot, self._frame = link, lidar, pilot, frame
        self._mission, self._interrupt, self._status, self._clock = mission, interrupt, status, clock
        self._sent_s = -math.inf
        self._reboots = link.telemetry.clock.reboots
        self._judge = FlightJudge(mission)

    def engage(self) -> None:
        """Stream zero velocity for a second, then command OFFBOARD. Raises `VehicleCommandError` when PX4 refuses."""
        deadline = self._clock() + SETPOINTS_BEFORE_OFFBOARD_S
        self._pilot.tick(self._lidar.latest(), self._link.state(self._frame), self._clock())  # first call allocates
        while self._clock() < deadline:
            self.stay()
            time.sleep(0.01)
        self._pilot.reset()
        self._link.set_mode(FlightMode.OFFBOARD, keep_alive=self.stay)

    def stay(self) -> None:
        """Keep the stream alive with zero velocity, at the loop's rate however often it is called."""
        if self._clock() - self._sent_s >= 1.0 / LOOP_RATE_HZ:
            self._sent_s = self._link.send_velocity(STILL, self._frame)

    def run(self) -> Ending:
        """Fly until there is a reason to end. Raises nothing for what the vehicle or the policy does."""
        self._status.start_live(self._clock())
        self.keeper.reset()
        try:
            with _quiet_interpreter():
                while True:
                    ending = self._step()
                    if ending is not None:
                        return ending
        finally:
            self._status.stop_live()

    def _step(self) -> Ending | None:
        now_s = self.keeper.wait()
        if (ending := self._lost_control(now_s)) is not None:
            return ending
        if self._interrupt.requested:
            return Ending("stopped", ExitCode.NOT_REACHED, f"stopped by {self._interrupt.name}: braking, then landing")
        if now_s - self._sent_s > self._mission.failsafe.stall_s:
            return self._after_stall(now_s)
        scan, state = self._lidar.latest(), self._link.state(self._frame)
        record = self._pilot.tick(scan, state, now_s)
        self._sent_s = self._link.send_velocity(record.sent, self._frame)
        self.log.append(record, self._sent_s)
        self.log.see(scan, state)
        self._status.publish(record, self.keeper.deadline_misses)
        return self._judge.ending(record)

    def _after_stall(self, now_s: float) -> Ending | None:
        """The loop was held up: brake first, and look again in the next tick with samples that arrived since."""
        self.events.append(f"loop stalled for {now_s - self._sent_s:.2f} s")
        self._sent_s = self._link.send_velocity(STILL, self._frame)
        self.stall_times_s.append(now_s)
        recent = [time_s for time_s in self.stall_times_s[-MAX_STALLS:] if now_s - time_s < STALL_WINDOW_S]
        if len(recent) < MAX_STALLS:
            return None
        message = f"the loop stalled {MAX_STALLS} times in {STALL_WINDOW_S:g} s: this computer is too busy to fly"
        return Ending("loop_stalled", ExitCode.SAFETY_ENDED, message)

    def _lost_control(self, now_s: float) -> Ending | None:
        """Pilot first: a mode that fly did not command ends its control for good, whoever chose it."""
        telemetry = self._link.telemetry
        if telemetry.clock.reboots != self._reboots:
            return Ending("vehicle_rebooted", ExitCode.NOT_REACHED, "the autopilot restarted in flight: control given up", False)
        if telemetry.armed is False:
            return Ending("disarmed", ExitCode.NOT_REACHED, "the vehicle was disarmed in flight: control given up", False)
        if telemetry.mode != FlightMode.OFFBOARD:
            name = mode_name(telemetry.mode)
            return Ending(
                "pilot_took_over", ExitCode.NOT_REACHED, f"mode {name} was not commanded by fly: control given up", False
            )
        if now_s - telemetry.heartbeat_s > LINK_LOST_S:
            message = f"no heartbeat from the vehicle for {LINK_LOST_S:g} s: the stream stops, PX4's own failsafe flies"
            return Ending("link_lost", ExitCode.SAFETY_ENDED, message)
        return None

    def brake(self, duration_s: float) -> None:
        """Zero velocity for `duration_s` while OFFBOARD lasts. Never raises."""
        deadline = self._clock() + duration_s
        try:
            while self._clock() < deadline and self._link.mode == FlightMode.OFFBOARD:
                self.stay()
                time.sleep(0.01)
        except VehicleCommandError as error:
            self.events.append(str(error))


class FlightJudge:
    """Ends a flight that has arrived, that gets nowhere, or that the safety filter has been holding for too long."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        self._started_s = math.nan
        self._best_m = math.inf
        self._best_s = math.nan
        self._braking_since_s = math.nan

    def ending(self, record: TickRecord) -> Ending | None:
        """The ending that this tick brings, or None."""
        now_s = record.now_s
        if math.isnan(self._started_s):
            self._started_s = self._best_s = now_s
        if record.goal_reached:
            return Ending("goal_reached", ExitCode.GOAL_REACHED, f"goal reached ({record.distance_to_goal_m:.2f} m)")
        return self._held(record) or self._late(record)

    def _held(self, record: TickRecord) -> Ending | None:
        if not record.verdict.braking:
            self._braking_since_s = math.nan
            return None
        if math.isnan(self._braking_since_s):
            self._braking_since_s = record.now_s
        hold_after_s = self._mission.failsafe.hold_after_s
        if record.now_s - self._braking_since_s < hold_after_s:
            return None
        rules = ", ".join(sorted({item.rule for item in record.verdict.interventions})) or "no command"
        return Ending(
            "safety", ExitCode.SAFETY_ENDED, f"braking for {hold_after_s:g} s without a cure ({rules}): holding, then landing"
        )

    def _late(self, record: TickRecord) -> Ending | None:
        timeouts = self._mission.timeouts
        if record.now_s - self._started_s > timeouts.flight_s:
            return Ending("timeout", ExitCode.NOT_REACHED, f"goal not reached within {timeouts.flight_s:g} s")
        if record.distance_to_goal_m < self._best_m - STUCK_PROGRESS_M:
            self._best_m, self._best_s = record.distance_to_goal_m, record.now_s
        if record.now_s - self._best_s > timeouts.stuck_s:
            return Ending("stuck", ExitCode.NOT_REACHED, f"no progress towards the goal for {timeouts.stuck_s:g} s")
        return None


@contextmanager
def _quiet_interpreter() -> Iterator[None]:
    """No garbage collection in the loop (a full one takes 10 to 100 ms), and quick hand-over between threads."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(0.001)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
        sys.setswitchinterval(interval)
