"""One run: a scene, a fault, the real flight code from the handshake to its end, and what the autopilot and the truth saw."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from campaigns.faults.air import SCAN_S, Air, Setpoint
from campaigns.faults.computer import CLOCK_OFFSET_S, Computer, CurtainFallError, LockstepLidar, LockstepLink
from campaigns.faults.scenes import ENGAGE_S, HEIGHT_M, Scene, WishfulPolicy
from flight.authority import Authority
from flight.conclusion import bring_down, ending_of
from flight.guard.core import Velocity
from flight.interrupt import Interrupt
from flight.landing import Landing
from flight.mission import Mission, load_mission
from flight.offboard import Ending, OffboardFlight
from flight.recorder import FlightRecorder, NoRecorder
from flight.recording_setup import flight_header, record_flight
from flight.status import Status
from flight.tick import Pilot, TickRecord
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter
from safety.frames import CorridorFrame, CorridorVector, NedVector
from sim_gateway.faults import Fault
from sim_gateway.flight_modes import FlightMode

WARM_UP_S = 0.5
OBSERVED_S = 6.0


class ProcessDeathError(BaseException):
    """The loop's process ends here, without a word."""


@dataclass(slots=True)
class Trace:
    """What one run left behind. Times are vehicle time; `begin_s`, `over_s`: of the fault; `felt_s`: first faulty sample felt.

    `sent`: setpoints as they left the computer, NED m/s and rad/s; `commands`: (time, MAV_CMD, parameters 2 and 3) that fly sent;
    `modes`: (time, mode, in failsafe) of the autopilot; `fence_margin_m`: least distance of the hull to the fence; `refused`: the
    loop never ran, so the safety layer was not asked.
    """

    begin_s: float
    felt_s: float = math.nan
    over_s: float = math.inf
    offboard_s: float = math.nan
    setpoints: list[Setpoint] = field(default_factory=list)
    sent: list[tuple[float, Velocity]] = field(default_factory=list)
    modes: list[tuple[float, FlightMode, bool]] = field(default_factory=list)
    commands: list[tuple[float, int, float, float]] = field(default_factory=list)
    records: list[tuple[float, TickRecord]] = field(default_factory=list)
    ending: Ending | None = None
    refused: bool = False
    contacts: int = 0
    fence_margin_m: float = math.inf
    end_s: float = 0.0
    events: list[str] = field(default_factory=list)


class _Witness:
    """Takes the place of the recorder: keeps what was decided and what was sent."""

    def __init__(self, inner: FlightRecorder, trace: Trace) -> None:
        self._inner, self._trace = inner, trace

    def tick(self, *tick: object) -> None:
        record = tick[0]
        assert isinstance(record, TickRecord)
        self._trace.records.append((record.now_s - CLOCK_OFFSET_S, record))
        self._inner.tick(*tick)  # type: ignore[arg-type]

    def event(self, text: str) -> None:
        self._trace.events.append(text)


@dataclass
class Stage:
    """Everything of one run, for injectors to reach into before `play`."""

    scene: Scene
    mission: Mission
    runner: PolicyRunner
    seed: int
    faults: tuple[Fault, ...] = ()
    estimate: str = "none"
    duration_s: float = OBSERVED_S
    make_filter: Callable[..., SafetyFilter] = SafetyFilter

    def __post_init__(self) -> None:
        self.begin_s = WARM_UP_S + ENGAGE_S + self.scene.begin_s(self.seed)
        end_s = self.begin_s + self.duration_s
        world = self.scene.world(self.seed)
        placed = tuple(fault.model_copy(update={"start_s": self.begin_s + fault.start_s}) for fault in self.faults)
        self.air = Air(world, self.estimate, self.seed, HEIGHT_M, placed)
        self.computer = Computer(self.air, end_s)
        self.link = LockstepLink(self.computer)
        self.lidar = LockstepLidar(self.computer, self.mission.lidar)
        self.policy = WishfulPolicy(self.runner, self.scene, self.computer.clock)
        self.safety = self.scene.safety(self.mission)
        self.interrupt = Interrupt()
        self.trace = Trace(self.begin_s)
        self.computer.heard_since_s = self.begin_s
        self.air.watch = self._watch
        self._cleanup = ExitStack()
        self._scratch: Path | None = None

    def at(self, offset_s: float, deed: Callable[[], None]) -> None:
        """Do something once, `offset_s` after the fault's begin."""
        done: list[bool] = []

        def look() -> None:
            if not done and self.air.time_s >= self.begin_s + offset_s:
                done.append(True)
                deed()

        self.computer.every_step.append(look)

    def afterwards(self, deed: Callable[[], None]) -> None:
        """Do this when the run is over, however it ends."""
        self._cleanup.callback(deed)

    def record(self) -> None:
        """Let the real recorder write this run to a folder that is gone afterwards."""
        self._scratch = Path(self._cleanup.enter_context(TemporaryDirectory(prefix="faults-")))

    def play(self) -> Trace:
        """Run it to the end of the scene."""
        self.runner.reset()
        with self._cleanup, suppress(CurtainFallError):
            try:
                self.computer.sleep(WARM_UP_S)
                self._fly()
            except ProcessDeathError:
                self.link.lockstep_guard.core.orphaned = True
            self.computer.pass_time(math.inf)
        return self._finish()

    def _fly(self) -> None:
        self.link.authority = Authority(self.link.telemetry)
        mission = self.mission.model_copy(update={"safety": self.safety})
        goal = CorridorVector(*self.air.simulation.world.goal)
        pilot = Pilot(self.policy, self.make_filter(self.safety), goal, 0.2, timer=self.computer.clock)  # type: ignore[arg-type]
        frame, status = self._frame(), Status(console=Console(file=io.StringIO()))
        witness = _Witness(self._recorder(mission, goal), self.trace)
        parts = (self.link, self.lidar, pilot, frame, mission, self.interrupt, status, self.computer.clock, witness)
        flight = OffboardFlight(*parts, sleep=self.computer.sleep)  # type: ignore[arg-type]
        landing = Landing(self.link, status, self.interrupt, 60.0, self.computer.clock, self.computer.sleep)

        def engage_and_run() -> Ending:
            self.link.request_stream_rates()
            flight.engage()
            return flight.run()

        self.trace.ending = ending_of(engage_and_run, self.link)
        bring_down(self.trace.ending, self.link, flight, landing)
        self.trace.events += [*flight.events, *landing.events]

    def _recorder(self, mission: Mission, goal: CorridorVector) -> FlightRecorder:
        if self._scratch is None:
            return NoRecorder()
        header = flight_header(mission, self.runner, goal)
        recording = record_flight(mission, self._scratch, header, self.trace.events.append)
        return self._cleanup.enter_context(recording).recorder

    def _frame(self) -> CorridorFrame:
        """Anchored where the vehicle is known to be: on the ground this is the mean of a second of samples."""
        x, y, _ = self.air.simulation.world.start
        return CorridorFrame.anchored(NedVector(0.0, 0.0, 0.0), CorridorVector(x, y, 0.0), 0.0)

    def _watch(self) -> None:
        """The truth, at every step: distance of the hull to the fence once OFFBOARD was entered."""
        air, trace = self.air, self.trace
        if air.autopilot.mode is FlightMode.OFFBOARD and math.isnan(trace.offboard_s):
            trace.offboard_s = air.time_s
        if math.isnan(trace.offboard_s):
            return
        safety, place = self.safety, air.simulation.truth_position_m
        hull = (safety.vehicle_radius_m, safety.vehicle_radius_m, safety.vehicle_half_height_m)
        for axis in range(3):
            margins = [safety.fence.high_m[axis] - place[axis], place[axis] - safety.fence.low_m[axis]]
            lands = axis == 2 and air.autopilot.mode is not FlightMode.OFFBOARD
            trace.fence_margin_m = min(trace.fence_margin_m, min(margins[:1] if lands else margins) - hull[axis])

    def _finish(self) -> Trace:
        air, trace = self.air, self.trace
        trace.setpoints, trace.modes, trace.end_s = air.setpoints, air.modes, air.time_s
        trace.sent = self.link.lockstep_guard.sent
        trace.commands = self.link.direct.commands
        trace.contacts = air.simulation.contacts
        trace.refused = not trace.records
        return trace


def felt_s(stage: Stage, carrier: str) -> float:
    """When the first faulty sample was there, by what brings it; the fault's begin where nothing does."""
    begin_s = stage.begin_s
    if carrier == "scan":
        return min((t for t in stage.air.scan_times_s if t >= begin_s), default=begin_s) + SCAN_S
    if carrier == "tick":
        return min((t for t, _ in stage.trace.records if t >= begin_s), default=begin_s)
    return stage.computer.first_heard_s.get(carrier, begin_s)


def load(mission: Path, policy: Path | None = None) -> tuple[Mission, PolicyRunner]:
    """Mission and policy of a campaign."""
    loaded = load_mission(mission)
    return loaded, PolicyRunner.load(policy or loaded.policy.path)
