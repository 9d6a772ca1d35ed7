"""One flight from mission to results: start what is needed, check, arm, take off, fly the policy, land, write the folder.

Order of care: nothing is armed before every check has passed; once armed, every way out goes through `Landing`, whatever
happened; results are written last, so that no disk can delay a landing.
"""

from __future__ import annotations

import logging
import math
import time
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from flight.authority import Authority, ControlLostError
from flight.conclusion import bring_down, ending_of
from flight.errors import ExitCode, MissionError, RefusedError, VehicleCommandError
from flight.gateway_process import GatewayProcess, GatewayReady
from flight.guard.client import GuardLostError
from flight.interrupt import Interrupt
from flight.landing import Landing
from flight.lidar import LidarDriver, body_motion, open_lidar
from flight.lidar.from_link import feed_from_link
from flight.link import VehicleLink
from flight.mavsdk_support import check_port_is_free
from flight.mission import Mission
from flight.offboard import Ending, OffboardFlight, quiet_interpreter
from flight.preflight import (
    LOOP_RATE_HZ,
    Level,
    check_goal_clear,
    check_lidar,
    check_policy,
    check_start,
    check_vehicle,
    require,
)
from flight.preparation import (
    ANCHOR_SAMPLES,
    Place,
    anchor_frame,
    gateway_arguments,
    lidar_source,
    resolve_place,
    vehicle_url,
)
from flight.px4 import FlightMode
from flight.px4_log import fetch_px4_log
from flight.realtime import real_time
from flight.recording_setup import FlightRecording, flight_header, record_flight
from flight.report import write_report
from flight.results import FlightResult, judge_flight, true_distance_m, truth_from_report, write_log
from flight.setpoint_loss import set_loss_action
from flight.shadow import ShadowFlight
from flight.status import Status
from flight.summary import build_summary, fence_summary, write_json_atomic
from flight.tether import tethered
from flight.tick import Pilot
from flight.trajectory import draw_trajectory_png
from policy_export.errors import PolicyError
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter
from safety.frames import CorridorFrame

log = logging.getLogger("flight.session")

HEIGHT_TOLERANCE_M = 0.5
STILL_SPEED_M_S = 0.25
STILL_FOR_S = 1.0
ARM_RETRY_S = 0.5
TAKEOFF_ENDS_WITHIN_M = 1.0  # PX4's default NAV_MC_ALT_RAD, 0.8 m, and the error of the estimate


class FlightSession:
    """Runs one mission once. `run` raises `FlyError` for everything that ends before arming."""

    def __init__(
        self,
        mission: Mission,
        folder: Path,
        status: Status,
        interrupt: Interrupt,
        *,
        shadow: bool = False,
        tether: bool = False,
    ) -> None:
        """`shadow`: the pilot flies, nothing is sent. `tether`: the mission's reduced limits for first flights."""
        self._mission, self._folder, self._status, self._interrupt = mission, folder, status, interrupt
        self._shadow, self._tether = shadow, tether
        self._events: list[str] = []
        self._setpoints_sent = 0
        self._gateway: GatewayProcess | None = None
        self._ready: GatewayReady | None = None
        self._recording = FlightRecording(None)

    def run(self) -> FlightResult:
        """The whole flight. Raises `FlyError` (nothing armed) or `Interrupted` (stopped before arming)."""
        policy = self._load_policy()
        with ExitStack() as stack:
            self._start_gateway(stack)
            place = self._place()
            lidar = stack.enter_context(open_lidar(lidar_source(self._mission)))
            fifo = self._mission.realtime.fifo_priority
            link = stack.enter_context(VehicleLink(vehicle_url(self._mission), guard_priority=fifo + 1 if fifo else 0))
            self._connect(link, lidar)
            self._preflight(link, lidar, policy, place)
            frame = self._anchor(link, place)
            lidar.follow(lambda: body_motion(link.state(frame)))
            level = self._mission.lidar.tilt_compensation
            pilot = Pilot(policy, SafetyFilter(self._mission.safety), place.goal, self._mission.goal.radius_m, level_scans=level)
            self._recording = stack.enter_context(self._record(policy, place, frame))
            with real_time(self._mission.realtime, self._status.phase):
                flight, ending, landed = self._follow_or_fly(link, lidar, pilot, frame)
            self._setpoints_sent = link.setpoints_sent
            self._recording.recorder.event(f"{ending.outcome}: {ending.message}; {'landed' if landed else 'not landed'}")
            if self._mission.recording.px4_log:
                self._status.phase(fetch_px4_log(link.system, self._folder, self._interrupt))
            link.close()
            stack.close()  # the gateway writes its report when it ends
        return self._results(flight, policy, place, ending, landed)

    def _follow_or_fly(
        self, link: VehicleLink, lidar: LidarDriver, pilot: Pilot, frame: CorridorFrame
    ) -> tuple[OffboardFlight | ShadowFlight, Ending, bool]:
        """The flight itself: flown by the policy, or with `shadow` by the pilot; its ending, and whether the vehicle landed."""
        parts = (link, lidar, pilot, frame, self._mission, self._interrupt, self._status)
        recorder = self._recording.recorder
        if self._shadow:
            shadow = ShadowFlight(*parts, recorder=recorder)
            ending, landed = shadow.watch()
            self._events += shadow.events
            return shadow, ending, landed
        flight = OffboardFlight(*parts, recorder=recorder)
        return flight, *self._fly(link, flight, frame)

    # -- before arming ------------------------------------------------------------------------------------------

    def _load_policy(self) -> PolicyRunner:
        section = self._mission.policy
        try:
            return PolicyRunner.load(section.path, rate_hz=LOOP_RATE_HZ, expected_sha256=section.sha256)
        except PolicyError as error:
            raise MissionError(f"policy.path {section.path}: {error}") from None

    def _start_gateway(self, stack: ExitStack) -> None:
        mission, sim = self._mission, self._mission.sim
        if not mission.simulated or sim is None:
            return
        check_port_is_free(vehicle_url(mission))
        self._status.phase(f"starting the simulator: {sim.world.name}, seed {sim.seed} (the first start compiles for a minute)")
        self._gateway = stack.enter_context(GatewayProcess(gateway_arguments(mission), self._folder / "gateway.json"))
        self._ready = self._gateway.start(mission.timeouts.gateway_s, self._interrupt.check)

    def _place(self) -> Place:
        """Takeoff point and goal as numbers, checked; with `tether` the mission is reduced around them."""
        mission, ready = self._mission, self._ready
        place = resolve_place(mission, ready)
        if self._tether:
            self._mission, place, notes = tethered(mission, place)
            for note in notes:
                self._status.phase(f"tether: {note}")
        if ready is not None:
            require(check_start(place.takeoff_point, self._mission.takeoff_height_m, ready.boxes, self._mission.safety))
            require(check_goal_clear(place.goal, ready.boxes, self._mission.safety))
        return place

    def _connect(self, link: VehicleLink, lidar: LidarDriver) -> None:
        timeouts, source = self._mission.timeouts, self._mission.lidar
        self._status.phase(f"connecting to the vehicle on {link.url}")
        link.connect(timeouts.connect_s, self._interrupt.check)
        feed_from_link(lidar, source, link)
        self._status.phase(f"vehicle {link.system_id} answers; waiting for the LiDAR on {source.place}")
        deadline = time.monotonic() + timeouts.lidar_s
        while lidar.health().scans < ANCHOR_SAMPLES:
            self._interrupt.check()
            if time.monotonic() > deadline:
                health = lidar.health()
                reason = f" ({health.last_error})" if health.last_error else ""
                raise RefusedError(
                    f"LiDAR not answering on {source.place} within {timeouts.lidar_s:g} s{reason}: check that it is "
                    f"powered and {source.advice} in the mission"
                )
            lidar.wait_for_scan(0.2)

    def _preflight(self, link: VehicleLink, lidar: LidarDriver, policy: PolicyRunner, place: Place) -> None:
        mission = self._mission
        link.request_stream_rates(mission.vehicle.stream_rate_hz)
        self._wait(lambda: link.telemetry.imu is not None and link.telemetry.position is not None, link, mission.timeouts.ready_s)
        now_s = time.monotonic()
        checks = check_vehicle(link.telemetry, now_s) + check_lidar(lidar.latest(), lidar.health(), now_s)
        checks += check_policy(policy.metadata, mission.safety)
        if self._ready is not None:
            checks += check_start(place.takeoff_point, mission.takeoff_height_m, self._ready.boxes, mission.safety)
            checks += check_goal_clear(place.goal, self._ready.boxes, mission.safety)
        if not self._shadow and all(check.level is not Level.FAIL for check in checks):
            checks.append(set_loss_action(link, mission))
        self._status.checks(checks)
        require(checks)

    def _anchor(self, link: VehicleLink, place: Place) -> CorridorFrame:
        """The corridor frame through the spot where the vehicle stands."""
        return anchor_frame(link, self._mission, place, self._interrupt.check)

    def _record(self, policy: PolicyRunner, place: Place, frame: CorridorFrame) -> AbstractContextManager[FlightRecording]:
        boxes = self._ready.boxes if self._ready is not None else None
        header = flight_header(self._mission, policy, place.goal, frame, boxes)
        return record_flight(self._mission, self._folder, header, self._status.phase)

    # -- armed --------------------------------------------------------------------------------------------------

    def _fly(self, link: VehicleLink, flight: OffboardFlight, frame: CorridorFrame) -> tuple[Ending, bool]:
        """Arm to disarm. From arming on, every exception ends in the landing."""
        link.authority = None
        if link.mode != FlightMode.HOLD:
            link.set_mode(FlightMode.HOLD)
        link.authority = Authority(link.telemetry)
        self._arm(link)
        logging.getLogger("flight").setLevel(logging.WARNING)
        ending = ending_of(lambda: self._take_off(link, frame) or self._engage_and_run(flight), link)
        self._status.phase(ending.message)
        landing = Landing(link, self._status, self._interrupt, self._mission.timeouts.land_s)
        landed = bring_down(ending, link, flight, landing)
        self._events += [*flight.events, *landing.events]
        return ending, landed

    def _arm(self, link: VehicleLink) -> None:
        """Arm from Hold; PX4 refuses while its estimate settles, so ask again until the deadline. Raises `RefusedError`."""
        deadline = time.monotonic() + self._mission.timeouts.ready_s
        self._status.phase("arming")
        while True:
            self._interrupt.check()
            try:
                link.arm()
                return
            except ControlLostError as error:
                raise RefusedError(f"not armed: {error}") from None
            except GuardLostError as error:
                raise RefusedError(f"{error}; look whether the vehicle is armed") from None
            except VehicleCommandError as error:
                if link.armed:
                    return
                if time.monotonic() > deadline:
                    raise RefusedError(f"arming refused for {self._mission.timeouts.ready_s:g} s: {error}") from None
            self._pause(ARM_RETRY_S)

    def _take_off(self, link: VehicleLink, frame: CorridorFrame) -> Ending | None:
        """Climb with PX4's own takeoff until height and speed are steady. An ending when that is not to be."""
        mission, height_m = self._mission, self._mission.takeoff_height_m
        self._status.phase(f"taking off to {height_m:g} m")
        self._recording.recorder.event(f"taking off to {height_m:g} m")
        link.take_off(height_m)
        deadline = time.monotonic() + mission.timeouts.takeoff_s
        steady_since, climbing = math.nan, False
        while time.monotonic() < deadline:
            if self._interrupt.requested:
                return Ending("stopped", ExitCode.NOT_REACHED, f"stopped by {self._interrupt.name} during takeoff: landing")
            link.require_control()
            if link.mode == FlightMode.TAKEOFF:
                climbing = True
            elif climbing and self._stopped_early(link, frame):
                message = "Hold during takeoff was not commanded by fly: control given up"
                return Ending("pilot_took_over", ExitCode.NOT_REACHED, message, in_control=False)
            else:
                climbing = False
            steady_since = self._steady_since(link, frame, steady_since)
            if time.monotonic() - steady_since >= STILL_FOR_S:
                return None
            time.sleep(0.02)
        return Ending(
            "takeoff_timeout", ExitCode.NOT_REACHED, f"height not reached within {mission.timeouts.takeoff_s:g} s: landing"
        )

    def _stopped_early(self, link: VehicleLink, frame: CorridorFrame) -> bool:
        """Whether Hold came before PX4's own takeoff can have ended: it ends within NAV_MC_ALT_RAD of the height."""
        state = link.state(frame)
        return state is not None and state.position.z < self._mission.takeoff_height_m - TAKEOFF_ENDS_WITHIN_M

    def _steady_since(self, link: VehicleLink, frame: CorridorFrame, since_s: float) -> float:
        """Since when height and speed have been within tolerance, NaN while they are not."""
        state = link.state(frame)
        if state is None:
            return math.nan
        speed = math.hypot(state.velocity.x, state.velocity.y, state.velocity.z)
        steady = abs(state.position.z - self._mission.takeoff_height_m) < HEIGHT_TOLERANCE_M and speed < STILL_SPEED_M_S
        if not steady:
            return math.nan
        return time.monotonic() if math.isnan(since_s) else since_s

    def _engage_and_run(self, flight: OffboardFlight) -> Ending:
        self._status.phase("height reached; switching to OFFBOARD")
        with quiet_interpreter():
            flight.engage()
            self._status.phase("the policy flies (Ctrl-C: brake, hold, land)")
            self._recording.recorder.event("the policy flies")
            return flight.run()

    def _pause(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not self._interrupt.requested:
            time.sleep(0.02)

    def _wait(self, condition: Any, link: VehicleLink, timeout_s: float) -> None:
        """Wait before arming; what is still missing then fails its own check."""
        link.wait_until(condition, timeout_s, self._interrupt.check)

    # -- results ------------------------------------------------------------------------------------------------

    def _results(
        self, flight: OffboardFlight | ShadowFlight, policy: PolicyRunner, place: Place, ending: Ending, landed: bool
    ) -> FlightResult:
        report = self._gateway.report() if self._gateway is not None else {}
        contacts = report.get("contacts")
        exit_code, outcome, message = judge_flight(ending, landed, contacts)
        summary = build_summary(
            flight.log,
            flight.keeper.statistics(),
            outcome=outcome,
            goal=place.goal,
            goal_reached=ending.outcome == "goal_reached",
            policy_path=str(self._mission.policy.path),
            policy_sha256=policy.sha256,
            dynamics=self._mission.sim.dynamics if self._mission.simulated and self._mission.sim else "vehicle",
            collisions=contacts,
            min_clearance_m=report.get("min_clearance_m"),
            failsafe_events=self._events,
            extra={
                "message": message,
                "exit_code": int(exit_code),
                "landed": landed,
                "shadow": self._shadow,
                "tether": self._tether,
                "setpoints_sent": self._setpoints_sent,
                "mission": self._mission.name,
                "seed": self._mission.sim.seed if self._mission.sim else None,
                "goal_m": [place.goal.x, place.goal.y, place.goal.z],
                "goal_radius_m": self._mission.goal.radius_m,
                "fence_m": fence_summary(self._mission.safety.fence),
                "true_distance_to_goal_m": true_distance_m(report, place.goal),
                "recording": asdict(recorded) if (recorded := self._recording.summary) is not None else None,
            },
        )
        write_json_atomic(self._folder / "summary.json", summary)
        write_log(self._folder, flight.log)
        self._illustrate(flight, place, report, f"{self._mission.name}: {outcome}")
        return FlightResult(exit_code, outcome, message, self._folder, summary)

    def _illustrate(self, flight: OffboardFlight | ShadowFlight, place: Place, report: dict[str, Any], title: str) -> None:
        """Picture and report. The flight is over and its data are written: a failure here is told, and changes nothing else."""
        boxes = np.array(self._ready.boxes, dtype=np.float64).reshape(-1, 6) if self._ready is not None else None
        mission, folder = self._mission, self._folder
        try:
            draw_trajectory_png(
                folder / "trajectory.png",
                flight.log,
                boxes=boxes,
                goal=place.goal,
                goal_radius_m=mission.goal.radius_m,
                fence=mission.safety.fence,
                truth=truth_from_report(report),
                title=title,
            )
            write_report(folder)
        except Exception as error:  # noqa: BLE001  (a picture must not turn a good landing into an error)
            log.warning("no picture or report: %s: %s; try `fly report %s`", type(error).__name__, error, folder)
