"""`fly check` against the real gateway: each parameter and each sensor wrong in turn is found, and the line says what to do."""

from __future__ import annotations

import json
import math
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from air import Air, open_air, quiet
from stand import Stand

from flight.check_command import Checkup, Pace, run_check
from flight.checks.computer import (
    check_clock,
    check_disk,
    check_heat,
    check_load,
    check_real_time,
    check_wake_up,
)
from flight.checks.facts import VehicleFacts
from flight.checks.hand_motion import HandTest
from flight.checks.lidar import check_coverage
from flight.checks.parameters import READ_ALSO, RULES, Needs, corrections, judge_parameters
from flight.checks.vehicle import check_position, check_version
from flight.fence_outline import cuts_into
from flight.fence_upload import VERTEX_INCLUSION, FenceClient, FenceVertex, GeoPoint, outer_fence
from flight.lidar import LidarHealth
from flight.link import VehicleLink
from flight.mission import load_mission
from flight.preflight import Check, Level, check_lidar
from flight.preparation import Place, anchor_frame, resolve_place
from policy_export.contract import PolicyMetadata
from policy_export.runner import PolicyRunner
from safety.frames import CorridorFrame, CorridorVector, NedVector
from safety.messages import LidarScan

QUICK = Pace(listen_s=0.3, settle_s=0.8, rest_samples=6, scans=6)
# parameter: (wrong value, level that it must get on a real vehicle, what the advice must say)
WRONG: dict[str, tuple[float, Level, str]] = {
    "COM_OF_LOSS_T": (2.0, Level.WARN, "0.5"),
    "COM_OBL_RC_ACT": (0, Level.WARN, "set it to 5"),
    "COM_RC_OVERRIDE": (1, Level.FAIL, "set it to 3"),
    "COM_RC_STICK_OV": (95.0, Level.FAIL, "set it to 30"),
    "COM_RC_IN_MODE": (4, Level.FAIL, "nobody could take over"),
    "NAV_RCL_ACT": (0, Level.FAIL, "set it to 3"),
    "COM_RCL_EXCEPT": (4, Level.WARN, "set it to 0"),
    "COM_RC_LOSS_T": (20.0, Level.FAIL, "set it to 0.5"),
    "GF_ACTION": (1, Level.FAIL, "set it to 2"),
    "GF_MAX_HOR_DIST": (3.0, Level.FAIL, "cuts into the mission's"),
    "GF_MAX_VER_DIST": (1.0, Level.FAIL, "cuts into the mission's"),
    "GF_PREDICT": (1, Level.FAIL, "set it to 0"),
    "MPC_XY_VEL_MAX": (0.5, Level.FAIL, "the mission flies 0.8 m/s"),
    "MPC_Z_VEL_MAX_UP": (0.2, Level.FAIL, "set it to 1"),
    "MPC_Z_VEL_MAX_DN": (0.2, Level.FAIL, "set it to 1"),
    "MPC_TILTMAX_AIR": (8.0, Level.FAIL, "too little tilt"),
    "MPC_ACC_HOR": (1.0, Level.FAIL, "set it to 3"),
    "MPC_JERK_MAX": (1.0, Level.FAIL, "set it to 8"),
    "MC_YAWRATE_MAX": (20.0, Level.FAIL, "57 deg/s"),
    "RTL_RETURN_ALT": (30.0, Level.FAIL, "climb to 30 m"),
    "COM_LOW_BAT_ACT": (0, Level.WARN, "set it to 2"),
    "CP_DIST": (3.0, Level.WARN, "would be stuck"),
    "COM_DISARM_LAND": (-1.0, Level.FAIL, "never would"),
    "COM_ARM_WO_GPS": (0, Level.FAIL, "there is none"),
    "SYS_HITL": (1, Level.FAIL, "motors do not run"),
}
RIGHT = {
    "COM_OF_LOSS_T": 0.5,
    "COM_OBL_RC_ACT": 5,
    "COM_RC_OVERRIDE": 3,
    "NAV_RCL_ACT": 3,
    "GF_MAX_HOR_DIST": 14.0,
    "GF_MAX_VER_DIST": 5.0,
    "MPC_XY_VEL_MAX": 2.0,
    "RTL_RETURN_ALT": 1.2,
}
HERE = Place((1.0, 0.0), 0.0, CorridorVector(10.0, -0.4, 1.2))


@pytest.fixture(scope="module")
def air(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Iterator[Air]:
    with open_air(tmp_path_factory.mktemp("air"), seeker_policy, dict(RIGHT)) as air:
        yield air


@pytest.fixture
def facts(air: Air) -> VehicleFacts:
    return VehicleFacts(air.link)


def parameter_needs(air: Air, facts: VehicleFacts, gps: bool = True) -> Needs:
    values = facts.read_parameters([*((rule.name, rule.kind) for rule in RULES), *READ_ALSO])
    fence = outer_fence(air.mission.safety, CorridorFrame(NedVector(0.0, 0.0, 0.0), 0.0), HERE)
    return Needs(air.mission, values, gps, fence.max_horizontal_m, fence.max_vertical_m)


def line(checks: list[Check], name: str) -> Check:
    found = [check for check in checks if check.name == name]
    assert found, f"no line {name!r} among {[check.name for check in checks]}"
    return max(found, key=lambda check: list(Level).index(check.level))


def test_a_right_vehicle_passes_every_parameter(air: Air, facts: VehicleFacts) -> None:
    needs = parameter_needs(air, facts)
    assert {check.name: check.seen for check in judge_parameters(needs) if check.level is not Level.PASS} == {}
    assert corrections(needs) == {}


def test_every_rule_has_a_wrong_value_in_this_file() -> None:
    assert {rule.name for rule in RULES} == set(WRONG)


@pytest.mark.parametrize("name", WRONG)
def test_each_parameter_wrong_in_turn_is_found(air: Air, facts: VehicleFacts, name: str) -> None:
    """Written over MAVLink, read back over MAVLink; only its own line changes, and says what to do."""
    value, level, advice = WRONG[name]
    before = air.autopilot.parameters.get(name)
    kind = next(rule.kind for rule in RULES if rule.name == name)
    air.link.set_parameter(name, kind(value))
    try:
        needs = parameter_needs(air, facts, gps=name != "COM_ARM_WO_GPS")
        checks = judge_parameters(needs)
        assert line(checks, name).level is level
        assert advice in line(checks, name).advice
        assert line(checks, name).seen == f"{value:g}"
        others = [check.name for check in checks if check.level is not Level.PASS and check.name != name]
        assert others == []
        for wrong, right in corrections(needs).items():
            assert wrong == name
            air.link.set_parameter(wrong, right)
            assert line(judge_parameters(parameter_needs(air, facts)), name).level is Level.PASS
    finally:
        air.link.set_parameter(name, kind(before))


def test_a_return_under_the_ceiling_is_no_problem_and_one_above_it_is(air: Air, facts: VehicleFacts) -> None:
    needs = parameter_needs(air, facts)
    for height_m, level in ((1.2, Level.PASS), (30.0, Level.FAIL)):
        values = {**needs.values, "NAV_RCL_ACT": 2, "RTL_RETURN_ALT": height_m}
        assert line(judge_parameters(Needs(air.mission, values)), "NAV_RCL_ACT").level is level


def bits(remove: int) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        message.onboard_control_sensors_health &= ~remove

    return change


def setting(**fields: Any) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        for name, value in fields.items():
            setattr(message, name, value)

    return change


# fault: (message, change or None for silence, line that must fail or warn, level, what is seen, what to do)
VEHICLE_FAULTS: dict[str, tuple[str, Callable[[Any], None] | None, str, Level, str, str]] = {
    "accelerometer": ("SYS_STATUS", bits(0x2), "health", Level.FAIL, "unhealthy: accelerometer", "calibration"),
    "gyro": ("SYS_STATUS", bits(0x1), "health", Level.FAIL, "gyro", "calibration"),
    "magnetometer": ("SYS_STATUS", bits(0x4), "health", Level.FAIL, "magnetometer", "calibration"),
    "barometer": ("SYS_STATUS", bits(0x8), "health", Level.FAIL, "barometer", "wiring"),
    "pre-arm": ("SYS_STATUS", bits(0x10000000), "pre-arm", Level.FAIL, "refuse to arm", "commander check"),
    "battery": ("SYS_STATUS", setting(battery_remaining=12), "battery", Level.FAIL, "12%", "charge it"),
    "battery unknown": ("SYS_STATUS", setting(battery_remaining=-1), "battery", Level.WARN, "unknown", "by hand"),
    "no position": ("ESTIMATOR_STATUS", setting(flags=0x27), "local position", Level.FAIL, "horizontal position", "optical flow"),
    "dead reckoning": ("ESTIMATOR_STATUS", setting(flags=0x3BF), "local position", Level.FAIL, "aiding", "GPS"),
    "vague": ("ESTIMATOR_STATUS", setting(pos_horiz_accuracy=2.0), "local position", Level.WARN, "2.00 m", "fence"),
    "GPS glitch": ("ESTIMATOR_STATUS", setting(flags=0x73F), "local position", Level.FAIL, "GPS glitch", "GPS fix"),
    "estimator silent": ("ESTIMATOR_STATUS", None, "local position", Level.FAIL, "no ESTIMATOR_STATUS", "companion link"),
    "runs away": ("LOCAL_POSITION_NED", setting(vx=1.5), "estimate at rest", Level.FAIL, "1.50 m/s", "recalibrate"),
    "no receiver": ("SYS_STATUS", bits(0x10000), "pilot's link", Level.WARN, "no RC receiver", "transmitter"),
    "armed": ("HEARTBEAT", setting(base_mode=157), "vehicle", Level.FAIL, "armed", "disarm"),
    "in the air": ("EXTENDED_SYS_STATE", setting(landed_state=2), "vehicle", Level.FAIL, "in the air", "land"),
    "heartbeat silent": ("HEARTBEAT", None, "link", Level.FAIL, "last heartbeat", "check power"),
    "attitude silent": ("ATTITUDE", None, "link", Level.FAIL, "ATTITUDE", "baud rate"),
    "position silent": ("LOCAL_POSITION_NED", None, "link", Level.FAIL, "LOCAL_POSITION_NED", "baud rate"),
    "imu silent": ("HIGHRES_IMU", None, "link", Level.FAIL, "HIGHRES_IMU", "baud rate"),
    "old firmware": ("AUTOPILOT_VERSION", setting(flight_sw_version=0x010D0000), "PX4 version", Level.FAIL, "v1.13.0", "update"),
    "new firmware": ("AUTOPILOT_VERSION", setting(flight_sw_version=0x01120000), "PX4 version", Level.WARN, "v1.18.0", "tether"),
}


def checkup(air: Air) -> Checkup:
    status, interrupt = quiet()
    return Checkup(air.mission, status, interrupt, pace=QUICK)


@pytest.mark.parametrize("fault", VEHICLE_FAULTS)
def test_each_fault_of_the_vehicle_in_turn_is_found(air: Air, fault: str) -> None:
    message, change, name, level, seen, advice = VEHICLE_FAULTS[fault]
    if change is None:
        air.telemetry.silent.add(message)
    else:
        air.telemetry.alter[message] = change
    time.sleep(2.6 if message == "HEARTBEAT" else 0.3)  # it comes once a second
    try:
        checks = checkup(air).check_vehicle(air.link, VehicleFacts(air.link), HERE)
    finally:
        air.telemetry.silent.clear()
        air.telemetry.alter.clear()
    found = line(checks, name)
    assert found.level is level, found
    assert seen in found.seen
    assert advice in found.advice


def test_a_right_vehicle_has_no_failed_line(air: Air) -> None:
    time.sleep(1.2)  # the last fault's messages have been replaced
    checks = checkup(air).check_vehicle(air.link, VehicleFacts(air.link), HERE)
    assert [check for check in checks if check.level is Level.FAIL] == []
    assert line(checks, "local position").seen.startswith("source: GPS")


def frozen() -> Callable[[Any], Any]:
    kept: list[Any] = []

    def change(ranges: Any) -> Any:
        kept.append(ranges.copy())
        return kept[0]

    return change


def every(n: int) -> Callable[[Any], Any]:
    count = [0]

    def change(ranges: Any) -> Any:
        count[0] += 1
        return ranges if count[0] % n == 0 else None

    return change


SCAN_FAULTS: dict[str, tuple[Callable[[], Callable[[Any], Any]], str, Level, str, str]] = {
    "frozen": (frozen, "LiDAR content", Level.FAIL, "identical", "restart"),
    "covered": (lambda: np.zeros_like, "LiDAR content", Level.FAIL, "too near", "covers"),
    "sees nothing": (lambda: lambda ranges: np.full_like(ranges, np.inf), "LiDAR content", Level.WARN, "0%", "near a wall"),
    "half rate": (lambda: every(3), "lidar", Level.FAIL, "Hz", "at least 10 Hz"),
}


@pytest.mark.parametrize("fault", SCAN_FAULTS)
def test_each_fault_of_the_lidar_in_turn_is_found(air: Air, fault: str) -> None:
    change, name, level, seen, advice = SCAN_FAULTS[fault]
    air.gateway.alter_scan = change()
    time.sleep(4.2 if fault == "half rate" else 0.3)  # the driver's rate looks back over its last 40 scans
    own = checkup(air)
    own.check_policy_file()
    try:
        checks = own.check_lidar(air.lidar)
    finally:
        air.gateway.alter_scan = None
    found = line(checks, name)
    assert found.level is level, checks
    assert seen in found.seen
    assert advice in found.advice


def aged(scan: LidarScan, health: LidarHealth, _: PolicyMetadata) -> list[Check]:
    return check_lidar(scan, health, scan.time_s + 0.3)


def mostly_unknown(scan: LidarScan, health: LidarHealth, _: PolicyMetadata) -> list[Check]:
    ranges = scan.ranges_m.copy()
    ranges[: ranges.size * 2 // 3] = np.nan
    return check_lidar(replace(scan, ranges_m=ranges), health, scan.time_s + 0.05)


def narrow(scan: LidarScan, _: LidarHealth, metadata: PolicyMetadata) -> list[Check]:
    return check_coverage(replace(scan, ranges_m=scan.ranges_m[60:]), metadata)


def turned_away(scan: LidarScan, _: LidarHealth, metadata: PolicyMetadata) -> list[Check]:
    return check_coverage(replace(scan, angle_min_rad=scan.angle_min_rad + math.pi / 2), metadata)


def short_sighted(scan: LidarScan, _: LidarHealth, metadata: PolicyMetadata) -> list[Check]:
    return check_coverage(replace(scan, range_max_m=2.0), metadata)


@pytest.mark.parametrize(
    ("fault", "name", "level", "advice"),
    [
        (aged, "lidar", Level.FAIL, "arrive too late"),
        (mostly_unknown, "lidar", Level.FAIL, "blind sectors"),
        (narrow, "LiDAR coverage", Level.FAIL, "180 deg wide"),
        (turned_away, "LiDAR coverage", Level.FAIL, "mount_yaw_deg"),
        (short_sighted, "LiDAR coverage", Level.WARN, "trained with 4 m"),
    ],
)
def test_age_and_coverage_of_a_scan(
    air: Air,
    seeker_policy: Path,
    fault: Callable[[LidarScan, LidarHealth, PolicyMetadata], list[Check]],
    name: str,
    level: Level,
    advice: str,
) -> None:
    """A real scan, made old, blind, narrow, turned or short-sighted."""
    air.wait(lambda: air.lidar.health().rate_hz > 15.0)
    scan, health, metadata = air.lidar.latest(), air.lidar.health(), PolicyRunner.load(seeker_policy).metadata
    assert scan is not None
    assert line(check_lidar(scan, health, scan.time_s + 0.05), "lidar").level is Level.PASS
    assert line(check_coverage(scan, metadata), "LiDAR coverage").level is Level.PASS
    found = line(fault(scan, health, metadata), name)
    assert found.level is level, found
    assert advice in found.advice


def test_a_dead_lidar_and_a_dead_vehicle_are_lines_of_their_own(
    air: Air, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = air.path.read_text().replace(f"port: {air.gateway.lidar.port}", "port: 9").replace("connect_s: 10", "connect_s: 0.5")
    port = air.mission.vehicle.connection.rsplit(":", 1)[1]
    path = tmp_path / "mission.yaml"
    path.write_text(text.replace(f":{port}", ":9003"))
    assert run_check(path, as_json=True) == 3
    document = json.loads(capsys.readouterr().out)
    failed = {check["name"]: check for check in document["checks"] if check["level"] == "fail"}
    assert "no vehicle" in failed["link"]["seen"]
    assert "no scan" in failed["lidar"]["seen"]
    assert document["ok"] is False
    assert document["failed"] == len(failed) >= 2


def test_usage_errors_give_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_check(tmp_path / "missing.yaml") == 2
    assert "missing.yaml" in capsys.readouterr().err


def test_the_policy_file_and_its_hash(air: Air, tmp_path: Path, seeker_policy: Path) -> None:
    def lines(text: str) -> list[Check]:
        path = tmp_path / "mission.yaml"
        path.write_text(text)
        status, interrupt = quiet()
        return Checkup(load_mission(path), status, interrupt).check_policy_file()

    text = air.path.read_text()
    unpinned = line(lines(text), "policy file")
    assert unpinned.level is Level.WARN
    digest = unpinned.advice.split("policy.sha256: ")[1]
    pinned = text.replace(str(seeker_policy), f"{seeker_policy}, sha256: {digest}")
    assert line(lines(pinned), "policy file").level is Level.PASS
    wrong = line(lines(pinned.replace(digest, "0" * 64)), "policy file")
    assert wrong.level is Level.FAIL
    assert "policy.sha256" in wrong.advice
    assert line(lines(text.replace(str(seeker_policy), "nowhere.onnx")), "policy file").level is Level.FAIL


@pytest.mark.realtime  # the check measures how late this computer wakes up
def test_apply_sets_what_is_wrong_and_uploads_a_fence_that_is_read_back(
    tmp_path: Path, seeker_policy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The whole command against a gateway process with PX4's defaults."""
    stand = Stand(tmp_path, seeker_policy)
    path = stand.mission()
    assert run_check(path, apply=True, as_json=True) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["applied"]["COM_RC_OVERRIDE"] == 3
    assert document["applied"]["COM_OF_LOSS_T"] == 0.5
    rows = {check["name"]: check for check in document["checks"]}
    for name in document["applied"]:
        assert rows[name]["level"] == "pass", rows[name]
    assert "4 vertices uploaded and read back, 2.03 m further out" in rows["fence in PX4"]["seen"]
    assert "2.034 m at 1.8 m/s" in rows["fence overshoot"]["seen"]


# ---- the fence in PX4


@pytest.fixture
def geo(air: Air) -> GeoPoint:
    position, (latitude, longitude, _) = air.link.telemetry.position, air.gateway.vehicle.frame.to_global((0.0, 0.0, 0.0))
    assert position is not None
    return GeoPoint(NedVector(0.0, 0.0, 0.0), latitude, longitude)


def test_fence_is_uploaded_downloaded_and_cleared(air: Air, geo: GeoPoint) -> None:
    frame = anchor_frame(air.link, air.mission, HERE, lambda: None)
    fence, client, store = outer_fence(air.mission.safety, frame, HERE), FenceClient(air.link), air.gateway.server.fence
    before = (store.uploads, store.downloads, store.clears)
    client.upload(fence.items(geo))
    held = client.download()
    assert held == fence.items(geo)
    assert [item.polygon_size for item in held] == [4] * 4
    air.wait(lambda: (store.uploads, store.downloads) == (before[0] + 1, before[1] + 1), 2.0)  # the last ack is on its way
    for wanted, item in zip(fence.corners_ned, store.items, strict=True):  # in the vehicle's own projection
        north, east, _ = air.gateway.vehicle.frame.from_global(item.latitude_e7 * 1e-7, item.longitude_e7 * 1e-7, 0.0)
        assert math.hypot(north - wanted.x, east - wanted.y) < 0.02
    client.clear()
    assert client.download() == []
    air.wait(lambda: store.clears == before[2] + 1, 2.0)


def test_outer_fence_is_larger_by_the_overshoot_on_every_side(air: Air) -> None:
    frame = CorridorFrame(NedVector(3.0, -2.0, 0.5), 0.7)
    fence = outer_fence(air.mission.safety, frame, HERE)
    corners = [frame.point_to_corridor(corner) for corner in fence.corners_ned]
    assert min(c.x for c in corners) == pytest.approx(-5.0 - 2.034)
    assert max(c.x for c in corners) == pytest.approx(11.5 + 2.034)
    assert min(c.y for c in corners) == pytest.approx(-2.9 - 2.034)
    assert max(c.y for c in corners) == pytest.approx(1.9 + 2.034)
    assert fence.max_vertical_m == pytest.approx(3.0 + 1.568)
    assert not cuts_into([tuple((c.x, c.y) for c in corners)], (), air.mission.safety.fence.polygon, ())


def test_a_fence_that_cuts_into_the_missions_fails_and_none_warns(air: Air, geo: GeoPoint) -> None:
    frame, client = CorridorFrame(NedVector(0.0, 0.0, 0.0), 0.0), FenceClient(air.link)
    client.clear()
    own = checkup(air)
    assert line(own.check_vehicle(air.link, VehicleFacts(air.link), HERE), "fence in PX4").level is Level.WARN
    corners = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    small = [FenceVertex(VERTEX_INCLUSION, 4, geo.of_ned(NedVector(x, y, 0.0))) for x, y in corners]
    client.upload(small)
    found = line(own.check_vehicle(air.link, VehicleFacts(air.link), HERE), "fence in PX4")
    assert found.level is Level.FAIL
    assert "--apply" in found.advice
    client.upload(outer_fence(air.mission.safety, CorridorFrame(NedVector(-1.0, 0.0, 0.0), 0.0), HERE).items(geo))
    assert line(own.check_vehicle(air.link, VehicleFacts(air.link), HERE), "fence in PX4").level is Level.PASS
    client.clear()
    assert frame.heading_rad == 0.0


# ---- position without GPS


class _Told(VehicleFacts):
    """Facts that were noted down, not heard."""

    def __init__(self, told: dict[str, dict[str, Any]]) -> None:
        self._newest = {name: (0.0, fields) for name, fields in told.items()}


@pytest.mark.parametrize(
    ("told", "values", "source"),
    [
        ({"OPTICAL_FLOW_RAD": {}}, {"EKF2_OF_CTRL": 1, "EKF2_GPS_CTRL": 0}, "optical flow"),
        ({}, {"EKF2_EV_CTRL": 15, "EKF2_GPS_CTRL": 0}, "vision or mocap"),
    ],
)
def test_a_vehicle_without_gps_passes(air: Air, told: dict[str, Any], values: dict[str, int], source: str) -> None:
    status = {"flags": 0x1 | 0x2 | 0x4 | 0x8 | 0x40, "pos_horiz_accuracy": 0.1}
    position = air.link.telemetry.position
    assert position is not None
    checks = check_position(_Told({"ESTIMATOR_STATUS": status, **told}), values, [position] * 3)
    assert checks[0].level is Level.PASS
    assert source in checks[0].seen


def test_no_version_at_all() -> None:
    assert check_version(None)[0].level is Level.FAIL


# ---- the computer


@pytest.mark.parametrize(
    ("checks", "level", "advice"),
    [
        (check_clock(1000.0, None), Level.WARN, "NTP"),
        (check_clock(1.8e9, 1.8e9 + 3600.0), Level.WARN, "NTP"),
        (check_clock(1.8e9, 1.8e9 + 1.0), Level.PASS, ""),
        (check_wake_up(80.0, 200.0), Level.FAIL, "too busy"),
        (check_wake_up(8.0, 20.0), Level.WARN, "stop other programs"),
        (check_wake_up(0.2, 1.0), Level.PASS, ""),
        (check_load(9.0, 4), Level.WARN, "other programs"),
        (check_load(0.5, 4), Level.PASS, ""),
        (check_real_time(0, resource.RLIM_INFINITY, []), Level.WARN, "LimitRTPRIO"),
        (check_real_time(90, 65536, []), Level.WARN, "LimitMEMLOCK"),
        (check_real_time(90, resource.RLIM_INFINITY, ["performance"]), Level.PASS, ""),
        (check_real_time(90, resource.RLIM_INFINITY, ["performance", "ondemand"])[1:], Level.WARN, "performance"),
        (check_heat(90.0), Level.FAIL, "cool"),
        (check_heat(78.0), Level.WARN, "cooling"),
        (check_heat(50.0), Level.PASS, ""),
        (check_disk(50.0, True, Path()), Level.FAIL, "delete"),
        (check_disk(500.0, True, Path()), Level.WARN, "delete"),
        (check_disk(5e4, False, Path()), Level.FAIL, "--out"),
        (check_disk(5e4, True, Path()), Level.PASS, ""),
    ],
)
def test_each_state_of_the_computer(checks: list[Check], level: Level, advice: str) -> None:
    assert checks[0].level is level
    assert advice in checks[0].advice


# ---- frame self-test by hand


class Hand:
    """Moves the vehicle as it is told to: the person of the frame self-test. `wrong` does one step the other way round."""

    def __init__(self, air: Air, wrong: str = "") -> None:
        self.air, self.wrong = air, wrong
        self.place, self.yaw = (1.0, -0.6, 0.0), 0.0

    def told(self, text: str) -> None:
        step = next(name for name, word in STEP_WORDS.items() if word in text)
        sign = -1.0 if step == self.wrong else 1.0
        (x, y, z), yaw, start_s = self.place, self.yaw, self.air.gateway.vehicle.time_s
        ahead, left, up, turn = (sign * value for value in STEP_MOTION[step])
        goal = (x + math.cos(yaw) * ahead - math.sin(yaw) * left, y + math.sin(yaw) * ahead + math.cos(yaw) * left, z + up)
        self.place, self.yaw = goal, yaw + turn

        def motion(now_s: float) -> tuple[tuple[float, float, float], float]:
            share = min(1.0, max(0.0, (now_s - start_s) / 1.2))
            a, b, c = (p + share * (q - p) for p, q in zip((x, y, z), goal, strict=True))
            return (a, b, c), yaw + share * turn

        self.air.gateway.carry = motion


STEP_WORDS = {"turn": "counter-clockwise", "forward": "FORWARD", "left": "move it", "lift": "LIFT"}
STEP_MOTION = {
    "turn": (0.0, 0.0, 0.0, 1.0),
    "forward": (0.7, 0.0, 0.0, 0.0),
    "left": (0.0, 0.7, 0.0, 0.0),
    "lift": (0.0, 0.0, 0.5, 0.0),
}


def hand_test(air: Air, wrong: str = "", link: VehicleLink | None = None) -> list[Check]:
    hand, link = Hand(air, wrong), link or air.link
    air.gateway.carry = lambda _: ((1.0, -0.6, 0.0), 0.0)
    time.sleep(0.3)
    frame = CorridorFrame(NedVector(-1.0, 0.0, 0.0), 0.0)
    try:
        return HandTest(air.lidar.latest, lambda: link.state(frame), hand.told, lambda: None, deadline_s=5.0).run(frame)
    finally:
        air.gateway.carry = lambda _: ((1.0, 0.0, 0.0), 0.0)
        time.sleep(0.3)
        air.gateway.carry = None
        air.gateway.alter_scan = None


def test_axes_that_agree_pass(air: Air) -> None:
    checks = hand_test(air)
    assert [(check.name, check.level) for check in checks] == [
        *((f"axes: {name}", Level.PASS) for name in STEP_WORDS),
        ("LiDAR orientation", Level.PASS),
    ], checks


def test_a_mirrored_lidar_is_found(air: Air) -> None:
    air.gateway.alter_scan = lambda ranges: ranges[::-1].copy()
    found = line(hand_test(air), "LiDAR orientation")
    assert found.level is Level.FAIL
    assert "lidar.mirror" in found.advice


def test_a_turned_lidar_is_found_with_its_angle(air: Air) -> None:
    """The device's front points 40 degrees left of the nose, the mission says straight ahead."""
    air.gateway.alter_scan = lambda ranges: np.concatenate([ranges[80:], np.full(80, np.inf, np.float32)])
    found = line(hand_test(air), "LiDAR orientation")
    assert found.level is Level.FAIL
    turned_deg = float(found.advice.split("add ")[1].split(" deg")[0])
    assert turned_deg == pytest.approx(40.0, abs=10.0)


@pytest.mark.parametrize("wrong", ["turn", "forward", "left", "lift"])
def test_an_axis_that_runs_the_wrong_way_is_found(air: Air, wrong: str) -> None:
    assert line(hand_test(air, wrong), f"axes: {wrong}").level is Level.FAIL


def test_resolve_place_needs_numbers_on_a_real_vehicle(air: Air) -> None:
    assert resolve_place(air.mission, None).takeoff_point == (1.0, 0.0)
