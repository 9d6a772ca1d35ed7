"""OFFBOARD: the handshake, the 20 Hz loop, and every reason for which it ends.

Liveness by construction: each setpoint is handed to the guard (`flight.guard`) with the time at which it was decided, and goes
out once or never. When the loop stalls, is stopped or killed, the guard brakes and falls silent, and PX4's own loss action (set
and read back in preflight) takes over. A loop that comes back while the guard brakes sends zero velocity first, then flies on
with fresh samples; missed ticks are not made up for. Once the guard is silent, the flight is over.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from flight.authority import Authority
from flight.errors import ExitCode, VehicleCommandError
from flight.guard.core import Reason
from flight.health import health_of
from flight.interrupt import Interrupt
from flight.lidar.driver import LidarDriver
from flight.link import VehicleLink
from flight.mission import Mission
from flight.preflight import LOOP_RATE_HZ
from flight.px4 import FlightMode
from flight.rate_keeper import RateKeeper
from flight.recorder import FlightRecorder, NoRecorder
from flight.status import Status
from flight.tick import Pilot, TickRecord
from flight.trajectory import FlightLog
from safety.escalation import EscalationState, Level, escalate
from safety.frames import CorridorFrame, CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState

STILL = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)
SETPOINTS_BEFORE_OFFBOARD_S = 1.0
STUCK_PROGRESS_M = 0.5
LINK_LOST_S = 3.0
MODE_REPORT_S = 0.1
SCAN_MARGIN_S = 0.008
ALIGNING_SCANS = 4
MAX_STALLS = 3
STALL_WINDOW_S = 5.0
TICKS_PER_TIME_QUESTION = 4
SWITCH_INTERVAL_S = 1e-4
"""The longest that a telemetry callback may keep the waking loop from the interpreter."""


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
        lidar: LidarDriver,
        pilot: Pilot,
        frame: CorridorFrame,
        mission: Mission,
        interrupt: Interrupt,
        status: Status,
        clock: Callable[[], float] = time.monotonic,
        recorder: FlightRecorder | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """`clock`, `sleep`: seconds of one monotonic clock; campaigns give those of simulated time."""
        self.log = FlightLog(max_ticks=int(mission.timeouts.flight_s * LOOP_RATE_HZ) + 200)
        self.log.reserve()
        self.keeper = RateKeeper(LOOP_RATE_HZ, clock, sleep)
        self.events: list[str] = []
        self.stall_times_s: list[float] = []
        self._link, self._lidar, self._pilot, self._frame = link, lidar, pilot, frame
        self._mission, self._interrupt, self._status, self._clock = mission, interrupt, status, clock
        self._sleep = sleep
        self._sent_s = -math.inf
        self._overruled = False
        self._judge = FlightJudge(mission)
        self._recorder = recorder if recorder is not None else NoRecorder()

    def engage(self) -> None:
        """Stream zero velocity for a second, then command OFFBOARD.

        Raises `VehicleCommandError` when PX4 refuses, `ControlLostError` when the pilot was quicker.
        """
        if self._link.authority is None:
            self._link.authority = Authority(self._link.telemetry)
        self._pilot.tick(self._lidar.latest(), self._link.state(self._frame), self._clock())  # first call allocates
        self._link.open_stream()
        deadline = self._clock() + SETPOINTS_BEFORE_OFFBOARD_S
        while self._clock() < deadline:
            self.stay()
            self._sleep(0.01)
        self._pilot.reset()
        self._link.set_mode(FlightMode.OFFBOARD, keep_alive=self.stay)

    def stay(self) -> None:
        """Keep the stream alive with zero velocity, at the loop's rate however often it is called.

        A stream that the guard has ended is not taken up again.
        """
        if self._link.stream_open and self._clock() - self._sent_s >= 1.0 / LOOP_RATE_HZ:
            self._stand_still()

    def _stand_still(self) -> None:
        sent_s = self._link.send_velocity(STILL, self._frame)
        if sent_s is not None:
            self._sent_s = sent_s

    def run(self) -> Ending:
        """Fly until there is a reason to end. Raises nothing for what the vehicle or the policy does."""
        self._status.start_live(self._clock())
        try:
            self.stay()
            self._align_with_scans()
            while True:
                ending = self._step()
                if ending is not None:
                    if not ending.in_control:
                        self._link.close_stream()
                    return ending
        finally:
            self._status.stop_live()

    def _align_with_scans(self) -> None:
        """Start the loop's grid a little after scans come in: at equal rates every tick then finds one that is fresh.

        The quickest of a few arrivals counts, so that one late wake-up does not shift the whole flight.
        """
        due_s = math.inf
        for _ in range(ALIGNING_SCANS):
            self.stay()
            scan = self._lidar.wait_for_scan(2.0 / LOOP_RATE_HZ)
            if scan is not None:
                phase_s = (self._clock() + SCAN_MARGIN_S - scan.time_s) % (1.0 / LOOP_RATE_HZ)
                due_s = min(due_s, phase_s)
        scan = self._lidar.latest()
        if scan is not None and math.isfinite(due_s):
            self._sleep((scan.time_s + due_s - self._clock()) % (1.0 / LOOP_RATE_HZ))
        self.keeper.reset()

    def _step(self) -> Ending | None:
        now_s = self.keeper.wait()
        if (ending := self._lost_control(now_s)) is not None:
            return ending
        if self._interrupt.requested:
            return Ending("stopped", ExitCode.NOT_REACHED, f"stopped by {self._interrupt.name}: braking, then landing")
        if now_s - self._sent_s > self._mission.failsafe.stall_s:
            return self._after_stall(now_s)
        scan, state = self._lidar.latest(), self._link.state(self._frame)
        health = health_of(
            self._link.telemetry, self._frame, self.keeper.lateness_s, self._link.authority, overruled=self._overruled
        )
        decided = record = self._pilot.tick(scan, state, now_s, health)
        self._overruled = self._judge.pausing(record) and record.sent != STILL
        if self._overruled:
            record = replace(record, sent=STILL)
        sent_s = self._link.send_velocity(record.sent, self._frame, now_s)
        if sent_s is None:  # held up since the tick began, or not ours any more
            self._record(decided, scan, state, None)
            return self._lost_control(self._clock()) or self._after_stall(self._clock())
        self._sent_s = sent_s
        self.log.append(record, self._sent_s, self.keeper.lateness_s)
        self.log.see(scan, state)
        self._status.publish(record, self.keeper.deadline_misses)
        if self.keeper.ticks % TICKS_PER_TIME_QUESTION == 0:
            self._link.ask_time()
        ending = self._judge.ending(record)
        self._record(decided, scan, state, record.sent)
        return ending

    def _record(self, decided: TickRecord, scan: LidarScan | None, state: VehicleState | None, sent: SafeCommand | None) -> None:
        """Leave the tick with the recorder, last of all: its writer then works while the loop sleeps."""
        sent_s, keeper = self._sent_s if sent is not None else math.nan, self.keeper
        self._recorder.tick(decided, scan, state, sent, sent_s, self._pilot.goal, keeper.lateness_s, keeper.deadline_misses)

    def _after_stall(self, now_s: float) -> Ending | None:
        """The loop was held up: brake first, and look again in the next tick with samples that arrived since."""
        self._overruled = True
        self.events.append(f"loop stalled for {now_s - self._sent_s:.2f} s")
        self._stand_still()
        self.stall_times_s.append(now_s)
        recent = [time_s for time_s in self.stall_times_s[-MAX_STALLS:] if now_s - time_s < STALL_WINDOW_S]
        if len(recent) < MAX_STALLS:
            return None
        message = f"the loop stalled {MAX_STALLS} times in {STALL_WINDOW_S:g} s: this computer is too busy to fly"
        return Ending("loop_stalled", ExitCode.SAFETY_ENDED, message)

    def _lost_control(self, now_s: float) -> Ending | None:
        """Pilot first: a mode that fly did not command ends its control for good, whoever chose it."""
        if (ending := self._lost_stream(now_s)) is not None:
            return ending
        authority, telemetry = self._link.authority, self._link.telemetry
        if authority is not None and (reason := authority.lost) is not None:
            return Ending(authority.outcome, ExitCode.NOT_REACHED, reason, in_control=False)
        if now_s - telemetry.heartbeat_s > LINK_LOST_S:
            message = f"no heartbeat from the vehicle for {LINK_LOST_S:g} s: the stream stops, PX4's own failsafe flies"
            return Ending("link_lost", ExitCode.SAFETY_ENDED, message, in_control=False)  # blind: a pilot may have it
        return None

    def _lost_stream(self, now_s: float) -> Ending | None:
        """What the guard did while this loop was not looking, or that it is gone: the cause, where a mode is the effect."""
        guard = self._link.guard
        if guard.lost is not None:
            return Ending("guard_lost", ExitCode.SAFETY_ENDED, guard.lost, in_control=False)
        if guard.reason is Reason.TERMINATED:
            return Ending("guard_stopped", ExitCode.SAFETY_ENDED, "the guard process was told to end: braking, then landing")
        if self._link.stream_open:
            return None
        if guard.reason is Reason.MISSED_BEAT:
            stalled_s, action = now_s - self._sent_s, self._mission.failsafe.setpoint_loss_action
            message = f"the loop stood still for {stalled_s:.1f} s: the guard braked, PX4's own loss action ({action}) follows"
            return Ending("loop_stalled", ExitCode.SAFETY_ENDED, message, in_control=False)
        self._link.wait_until(lambda: not self._link.in_control, MODE_REPORT_S)  # the guard reads the mode before MAVSDK does
        authority = self._link.authority
        reason = authority.lost if authority is not None else None
        outcome = authority.outcome if authority is not None and reason is not None else "pilot_took_over"
        return Ending(outcome, ExitCode.NOT_REACHED, reason or "the vehicle left OFFBOARD: control given up", in_control=False)

    def brake(self, duration_s: float) -> None:
        """Zero velocity for `duration_s` while OFFBOARD lasts. Never raises."""
        deadline = self._clock() + duration_s
        try:
            while self._clock() < deadline and self._link.in_control and self._link.mode == FlightMode.OFFBOARD:
                self.stay()
                self._sleep(0.01)
        except VehicleCommandError as error:
            self.events.append(str(error))


class FlightJudge:
    """Ends a flight that has arrived, that gets nowhere, or that the safety layer's escalation ends. No I/O, no clock."""

    def __init__(self, mission: Mission) -> None:
        self.escalation = EscalationState()
        self._config = mission.failsafe.escalation
        self._timeouts = mission.timeouts
        self._started_s = math.nan
        self._best_m = math.inf
        self._best_s = math.nan

    def pausing(self, record: TickRecord) -> bool:
        """Take note of this tick's verdict; True while a fault, or the healthy second after it, forbids to move."""
        self.escalation = escalate(self.escalation, record.verdict, record.now_s, self._config)
        return self.escalation.level >= Level.BRAKE

    def ending(self, record: TickRecord) -> Ending | None:
        """The ending that this tick brings, or None. Call `pausing` first."""
        if math.isnan(self._started_s):
            self._started_s = self._best_s = record.now_s
        if record.goal_reached:
            return Ending("goal_reached", ExitCode.GOAL_REACHED, f"goal reached ({record.distance_to_goal_m:.2f} m)")
        cause = self.escalation.cause
        if self.escalation.level == Level.YIELD:
            message = f"safety gave up control ({cause}): the stream stops, PX4 or the pilot has the vehicle"
            return Ending("safety", ExitCode.SAFETY_ENDED, message, in_control=False)
        if self.escalation.level >= Level.HOLD:
            return Ending("safety", ExitCode.SAFETY_ENDED, f"safety ended the flight ({cause}): holding, then landing")
        return self._late(record)

    def _late(self, record: TickRecord) -> Ending | None:
        timeouts = self._timeouts
        if record.now_s - self._started_s > timeouts.flight_s:
            return Ending("timeout", ExitCode.NOT_REACHED, f"goal not reached within {timeouts.flight_s:g} s")
        if record.distance_to_goal_m < self._best_m - STUCK_PROGRESS_M:
            self._best_m, self._best_s = record.distance_to_goal_m, record.now_s
        if record.now_s - self._best_s > timeouts.stuck_s:
            return Ending("stuck", ExitCode.NOT_REACHED, f"no progress towards the goal for {timeouts.stuck_s:g} s")
        return None


@contextmanager
def quiet_interpreter() -> Iterator[None]:
    """No garbage collection in the loop, and quick hand-over between threads.

    Enter it before OFFBOARD: the collection that it begins with takes 10 to 100 ms, in which no setpoint could be sent.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()
        sys.setswitchinterval(interval)
