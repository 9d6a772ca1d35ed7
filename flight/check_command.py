"""`fly check`: everything that can be checked without arming, as one table with pass, warn, fail and what to do.

Nothing here arms, changes the mode or sends a setpoint. Without `--apply` nothing in the vehicle is changed.
"""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from flight.checks.computer import check_computer
from flight.checks.facts import Value, VehicleFacts
from flight.checks.fence import apply_fence, check_fence, check_overshoot
from flight.checks.hand_motion import HandTest
from flight.checks.lidar import check_content, check_coverage
from flight.checks.parameters import READ_ALSO, RULES, Needs, corrections, judge_parameters
from flight.checks.vehicle import check_health, check_link, check_position, check_version, position_source
from flight.errors import ExitCode, FlyError, MissionError, RefusedError, VehicleCommandError
from flight.fence_upload import FenceClient, GeoPoint, OuterFence, outer_fence
from flight.gateway_process import GatewayProcess, GatewayReady
from flight.interrupt import Interrupt, Interrupted
from flight.lidar import LidarDriver, open_lidar
from flight.lidar.from_link import feed_from_link
from flight.link import VehicleLink
from flight.mavsdk_support import check_port_is_free
from flight.mission import Mission, load_mission
from flight.preflight import (
    LOOP_RATE_HZ,
    Check,
    Level,
    check_goal_clear,
    check_lidar,
    check_policy,
    check_start,
    check_vehicle,
)
from flight.preparation import Place, anchor_frame, gateway_arguments, lidar_source, resolve_place, vehicle_url
from flight.status import Status
from flight.telemetry import LocalPosition
from flight.tether import tethered
from policy_export.errors import PolicyError
from policy_export.runner import PolicyRunner
from safety.frames import CorridorFrame
from safety.messages import LidarScan

REST_PERIOD_S = 0.1
INFERENCE_STEPS, SLOW_INFERENCE_MS = 40, 15.0


def run_check(
    mission_path: Path, apply: bool = False, as_json: bool = False, *, motion: bool = False, tether: bool = False
) -> int:
    """The command: 0 all pass or warn, 3 something fails, 2 usage or mission, 1 stopped by a signal.

    `apply`: write the parameters that are wrong and upload the fence. `motion`: the frame self-test by hand, with prompts.
    """
    try:
        mission = load_mission(mission_path)
        with Status(machine_output=as_json) as status, Interrupt() as interrupt:
            checkup = Checkup(mission, status, interrupt, apply=apply, motion=motion, tether=tether)
            checks = checkup.run()
            status.checks(checks)
            status.phase(_verdict(checks))
    except Interrupted:
        typer.echo("fly check: stopped, nothing was armed", err=True)
        return int(ExitCode.NOT_REACHED)
    except FlyError as error:
        typer.echo(f"fly check: {error}", err=True)
        return int(error.exit_code)
    if as_json:
        typer.echo(json.dumps(as_document(checks, checkup.applied)))
    return int(ExitCode.REFUSED if _failed(checks) else ExitCode.GOAL_REACHED)


def as_document(checks: Sequence[Check], applied: dict[str, Value]) -> dict[str, object]:
    """Machine-readable result."""
    rows = [
        {"name": check.name, "level": check.level.name.lower(), "seen": check.seen, "advice": check.advice} for check in checks
    ]
    levels = [check.level for check in checks]
    return {
        "ok": Level.FAIL not in levels,
        "failed": levels.count(Level.FAIL),
        "warned": levels.count(Level.WARN),
        "applied": applied,
        "checks": rows,
    }


def _failed(checks: Sequence[Check]) -> bool:
    return any(check.level is Level.FAIL for check in checks)


def _verdict(checks: Sequence[Check]) -> str:
    levels = [check.level for check in checks]
    failed, warned = levels.count(Level.FAIL), levels.count(Level.WARN)
    if failed:
        return f"{failed} of {len(levels)} checks fail: do not fly; the last column says what to do"
    return f"ready as far as can be seen without arming, {warned} warning(s)"


@dataclass(frozen=True, slots=True)
class Pace:
    """How long to look. `listen_s`: at the vehicle before it is judged; `settle_s`: at most, for its estimate to start."""

    listen_s: float = 2.0
    settle_s: float = 10.0
    rest_samples: int = 20
    scans: int = 10


class Checkup:
    """One run of all checks. What is not there becomes a failed line, and what hangs on it is left out."""

    def __init__(
        self,
        mission: Mission,
        status: Status,
        interrupt: Interrupt,
        *,
        apply: bool = False,
        motion: bool = False,
        tether: bool = False,
        pace: Pace | None = None,
    ) -> None:
        self.applied: dict[str, Value] = {}
        self._mission, self._status, self._interrupt = mission, status, interrupt
        self._apply, self._motion, self._tether = apply, motion, tether
        self._pace = pace or Pace()
        self._policy: PolicyRunner | None = None

    def run(self) -> list[Check]:
        """All lines. Raises `MissionError` or `GatewayError` where nothing can be checked at all."""
        checks = self.check_policy_file()
        with ExitStack() as stack:
            ready = self._start_gateway(stack)
            place, problems = self._place(ready)
            checks += problems
            lidar = stack.enter_context(open_lidar(lidar_source(self._mission)))
            link = stack.enter_context(VehicleLink(vehicle_url(self._mission)))
            facts = self._connect(link)
            if facts is None:
                checks.append(Check("link", Level.FAIL, f"no vehicle on {link.url}", "check power, cable, vehicle.connection"))
            else:
                feed_from_link(lidar, self._mission.lidar, link)
                checks += self.check_vehicle(link, facts, place)
            checks += self.check_lidar(lidar)
            if self._motion and facts is not None and place is not None:
                checks += self._move_by_hand(link, lidar, place)
            elif not self._mission.simulated:
                checks.append(_orientation_untested())
        return checks + check_computer(_vehicle_clock_s(facts), Path.cwd())

    # -- without a vehicle --------------------------------------------------------------------------------------

    def check_policy_file(self) -> list[Check]:
        """The policy file itself: readable, the one that was meant, within the limits, quick enough here."""
        section = self._mission.policy
        try:
            policy = PolicyRunner.load(section.path, rate_hz=LOOP_RATE_HZ, expected_sha256=section.sha256)
        except PolicyError as error:
            return [
                Check(
                    "policy file",
                    Level.FAIL,
                    f"{section.path.name}: {error}",
                    "export it again, or correct policy.path or policy.sha256",
                )
            ]
        self._policy = policy
        seen = f"{section.path.name}, SHA-256 {policy.sha256[:12]}..."
        if section.sha256 is None:
            file = Check("policy file", Level.WARN, seen, f"pin it: policy.sha256: {policy.sha256}")
        else:
            file = Check("policy file", Level.PASS, f"{seen} as the mission demands")
        return [file, *check_policy(policy.metadata, self._mission.safety), _check_inference(policy)]

    def _start_gateway(self, stack: ExitStack) -> GatewayReady | None:
        mission = self._mission
        if not mission.simulated:
            return None
        check_port_is_free(vehicle_url(mission))
        self._status.phase("starting the simulator (the first start compiles for a minute)")
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="fly-check-"))
        gateway = stack.enter_context(GatewayProcess(gateway_arguments(mission), Path(folder) / "gateway.json"))
        return gateway.start(mission.timeouts.gateway_s, self._interrupt.check)

    def _place(self, ready: GatewayReady | None) -> tuple[Place | None, list[Check]]:
        try:
            place = resolve_place(self._mission, ready)
            if self._tether:
                self._mission, place, _ = tethered(self._mission, place)
        except MissionError:
            raise
        except RefusedError as error:
            return None, [Check("mission", Level.FAIL, str(error), "change the mission")]
        if ready is None:
            return place, []
        safety = self._mission.safety
        start = check_start(place.takeoff_point, self._mission.takeoff_height_m, ready.boxes, safety)
        return place, start + check_goal_clear(place.goal, ready.boxes, safety)

    # -- vehicle ------------------------------------------------------------------------------------------------

    def _connect(self, link: VehicleLink) -> VehicleFacts | None:
        self._status.phase(f"connecting to the vehicle on {link.url}")
        try:
            link.connect(self._mission.timeouts.connect_s, self._interrupt.check)
            return VehicleFacts(link)
        except VehicleCommandError:
            raise
        except RefusedError as error:
            self._status.phase(str(error))
            return None

    def check_vehicle(self, link: VehicleLink, facts: VehicleFacts, place: Place | None) -> list[Check]:
        """All that the vehicle says and holds. `place` None leaves out what needs the mission's geometry."""
        mission, telemetry = self._mission, link.telemetry
        try:
            link.request_stream_rates(mission.vehicle.stream_rate_hz)
        except VehicleCommandError as error:
            return [Check("link", Level.FAIL, str(error), "check that PX4's companion link answers commands")]
        facts.ask_version()
        values = facts.read_parameters([*((rule.name, rule.kind) for rule in RULES), *READ_ALSO])
        self._wait_until_settled(link, facts)
        rested_facts, rest = self._rest(link)
        checks = check_link(rested_facts, mission) + check_version(facts.newest("AUTOPILOT_VERSION"))
        checks += check_vehicle(telemetry, time.monotonic())
        checks += check_health(facts.newest("SYS_STATUS"), tuple(telemetry.texts), mission.simulated)
        checks += check_position(facts, values, rest)
        if place is None or telemetry.position is None:
            return checks + judge_parameters(Needs(mission, values))
        frame = anchor_frame(link, mission, place, self._interrupt.check)
        return checks + self._check_limits(link, facts, values, frame, place)

    def _wait_until_settled(self, link: VehicleLink, facts: VehicleFacts) -> None:
        """The start-up of an estimate takes a while: wait for PX4's own consent, at most `ready_s`."""
        self._status.phase("listening to the vehicle")
        before_s = time.monotonic()

        def settled() -> bool:
            status, estimator = facts.newest("SYS_STATUS"), facts.newest("ESTIMATOR_STATUS")
            told = status is not None and estimator is not None and link.telemetry.imu is not None
            return told and time.monotonic() - before_s > self._pace.listen_s and _all_healthy(status)

        link.wait_until(settled, min(self._mission.timeouts.ready_s, self._pace.settle_s), self._interrupt.check)

    def _rest(self, link: VehicleLink) -> tuple[VehicleFacts, list[LocalPosition]]:
        """A while of a standing vehicle: facts with fresh rates, and its position samples."""
        facts = VehicleFacts(link)
        found: list[LocalPosition] = []
        for _ in range(self._pace.rest_samples):
            self._interrupt.check()
            if link.telemetry.position is not None:
                found.append(link.telemetry.position)
            time.sleep(REST_PERIOD_S)
        facts.ask_version()
        return facts, found

    def _check_limits(
        self, link: VehicleLink, facts: VehicleFacts, values: dict[str, Value], frame: CorridorFrame, place: Place
    ) -> list[Check]:
        """Parameters and PX4's fence; with `--apply` both are put right first, then read again."""
        mission = self._mission
        fence, client, geo = outer_fence(mission.safety, frame, place), FenceClient(link), _geo_point(link, facts)
        needs = self._needs(facts, values, fence)
        refused: list[Check] = []
        if self._apply:
            refused = self._write(link, corrections(needs))
            fresh = facts.read_parameters([(rule.name, rule.kind) for rule in RULES if rule.name in self.applied])
            needs = self._needs(facts, {**values, **fresh}, fence)
            stored = apply_fence(client, fence, geo)
        else:
            stored = check_fence(client, mission.safety, frame, geo)
        return refused + judge_parameters(needs) + stored + check_overshoot(mission.safety)

    def _needs(self, facts: VehicleFacts, values: dict[str, Value], fence: OuterFence) -> Needs:
        gps = position_source(facts, values).startswith("GPS")
        return Needs(self._mission, values, gps, fence.max_horizontal_m, fence.max_vertical_m)

    def _write(self, link: VehicleLink, wrong: dict[str, Value]) -> list[Check]:
        refused = []
        for name, value in wrong.items():
            try:
                link.set_parameter(name, value)
                self.applied[name] = value
            except VehicleCommandError as error:
                refused.append(Check(name, Level.FAIL, str(error), f"set it to {value:g} in QGroundControl"))
        return refused

    # -- LiDAR --------------------------------------------------------------------------------------------------

    def check_lidar(self, lidar: LidarDriver) -> list[Check]:
        """A few scans of a standing vehicle."""
        scans: list[LidarScan] = []
        deadline = time.monotonic() + self._mission.timeouts.lidar_s
        while len(scans) < self._pace.scans and time.monotonic() < deadline:
            self._interrupt.check()
            scan = lidar.wait_for_scan(0.2)
            if scan is not None:
                scans.append(scan)
        checks = check_lidar(lidar.latest(), lidar.health(), time.monotonic())
        if not scans:
            return checks
        if self._policy is not None:
            checks += check_coverage(scans[-1], self._policy.metadata)
        return checks + check_content(scans)

    def _move_by_hand(self, link: VehicleLink, lidar: LidarDriver, place: Place) -> list[Check]:
        frame = anchor_frame(link, self._mission, place, self._interrupt.check)
        prompt = lambda text: self._status.phase(f"by hand: {text}")  # noqa: E731
        return HandTest(lidar.latest, lambda: link.state(frame), prompt, self._interrupt.check).run(frame)


def _orientation_untested() -> Check:
    advice = "run fly check --motion once after every change of mounting: it shows a turned or mirrored LiDAR"
    return Check("LiDAR orientation", Level.WARN, "not tested", advice)


def _check_inference(policy: PolicyRunner) -> Check:
    """How long one step takes here, against its share of the 50 ms."""
    observation = np.ones(policy.metadata.observation.size, dtype=np.float32)
    times = []
    for _ in range(INFERENCE_STEPS):
        before_s = time.perf_counter()
        policy.step(observation)
        times.append(time.perf_counter() - before_s)
    policy.reset()
    worst_ms = 1e3 * float(np.percentile(times, 95))
    seen = f"{1e3 * float(np.median(times)):.2f} ms a step, {worst_ms:.2f} ms at p95"
    if worst_ms > SLOW_INFERENCE_MS:
        return Check("inference", Level.FAIL, seen, "too slow for 20 Hz: stop other programs or use a smaller policy")
    return Check("inference", Level.PASS, seen)


def _all_healthy(status: dict[str, object] | None) -> bool:
    if status is None:
        return False
    enabled, health = (int(str(status[f"onboard_control_sensors_{key}"])) for key in ("enabled", "health"))
    return enabled & ~health == 0


def _geo_point(link: VehicleLink, facts: VehicleFacts) -> GeoPoint | None:
    """The vehicle's place in both frames; None without a global position."""
    position, place = link.telemetry.position, facts.newest("GLOBAL_POSITION_INT")
    if position is None or place is None or (int(place["lat"]) == 0 and int(place["lon"]) == 0):
        return None
    latitude, longitude = int(place["lat"]) * 1e-7, int(place["lon"]) * 1e-7
    if not (math.isfinite(latitude) and abs(latitude) < 89.0):
        return None
    return GeoPoint(position.position, latitude, longitude)


def _vehicle_clock_s(facts: VehicleFacts | None) -> float | None:
    """The vehicle's idea of UTC now, s; None before it knows (no GPS time)."""
    told = facts.newest("SYSTEM_TIME") if facts is not None else None
    unix_us = int(told.get("time_unix_usec", 0)) if told is not None else 0
    return unix_us * 1e-6 if unix_us > 0 else None
