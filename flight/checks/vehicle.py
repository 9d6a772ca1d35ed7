"""The vehicle itself: link, firmware, health, where its position comes from."""

from __future__ import annotations

import math

from flight.checks.facts import Fields, Value, VehicleFacts
from flight.mission import Mission
from flight.preflight import Check, Level
from flight.telemetry import LocalPosition, StatusText

SLOW_ROUND_TRIP_S, TOO_SLOW_ROUND_TRIP_S = 0.1, 0.3
RATE_SHARE = 0.6
OLD_HEARTBEAT_S = 2.5
RECORDED_VERSION, OLDEST_VERSION = (1, 17), (1, 14)
MAX_REST_SPEED_M_S, MAX_REST_DRIFT_M = 0.5, 0.5
VAGUE_POSITION_M, LOST_POSITION_M = 1.0, 3.0

# MAV_SYS_STATUS_SENSOR
SENSORS = {
    0x1: "gyro",
    0x2: "accelerometer",
    0x4: "magnetometer",
    0x8: "barometer",
    0x20: "GPS",
    0x40: "optical flow",
    0x80: "vision position",
    0x100: "distance sensor",
    0x8000: "motor outputs",
    0x10000: "RC receiver",
    0x200000: "AHRS (estimate)",
    0x2000000: "battery",
    0x20000000: "obstacle avoidance",
}
MUST_BE_PRESENT = 0x1 | 0x2 | 0x200000
RC_RECEIVER, PREARM_CHECK = 0x10000, 0x10000000
# ESTIMATOR_STATUS_FLAGS
ATTITUDE, SPEED, CLIMB, POSITION_RELATIVE, POSITION_ABSOLUTE, HEIGHT_ABSOLUTE, HEIGHT_GROUND = 1, 2, 4, 8, 16, 32, 64
NO_AIDING, GPS_GLITCH = 128, 1024
ENOUGH_FIX = 3


def check_link(facts: VehicleFacts, mission: Mission) -> list[Check]:
    """Heartbeat, round trip of a command, rates of the messages the loop needs."""
    if facts.heartbeat_age_s > OLD_HEARTBEAT_S:
        seen = f"last heartbeat {facts.heartbeat_age_s:.1f} s ago"
        return [Check("link", Level.FAIL, seen, "check power and cable, and that no other program reads this port")]
    trip_s, wanted_hz = facts.round_trip_s, mission.vehicle.stream_rate_hz
    names = ("LOCAL_POSITION_NED", "ATTITUDE", "HIGHRES_IMU")
    rates = {name: facts.rate_hz(name) for name in names}
    slow = [f"{name} {rate:.0f} Hz" for name, rate in rates.items() if rate < RATE_SHARE * wanted_hz]
    seen = f"round trip {1e3 * trip_s:.0f} ms" if trip_s is not None else "commands are not answered"
    if trip_s is None or trip_s > TOO_SLOW_ROUND_TRIP_S:
        return [Check("link", Level.FAIL, seen, "use a faster link: 921600 baud serial, or Ethernet, to PX4's TELEM2")]
    if slow:
        advice = f"{wanted_hz:g} Hz were asked for: raise the link's baud rate and MAV_x_RATE, use MAV_x_MODE onboard"
        return [Check("link", Level.FAIL, f"{seen}; slow: {', '.join(slow)}", advice)]
    level = Level.WARN if trip_s > SLOW_ROUND_TRIP_S else Level.PASS
    advice = "slow: shorten the link before flying fast" if level is Level.WARN else ""
    return [Check("link", level, f"{seen}, position {rates['LOCAL_POSITION_NED']:.0f} Hz", advice)]


def check_version(version: Fields | None) -> list[Check]:
    """AUTOPILOT_VERSION against what this project was recorded with (v1.17) and written for (v1.14 on)."""
    if version is None:
        return [Check("PX4 version", Level.FAIL, "not told", "PX4 v1.14 or later answers AUTOPILOT_VERSION: update the firmware")]
    number = int(version.get("flight_sw_version", 0))
    major, minor, patch = number >> 24 & 0xFF, number >> 16 & 0xFF, number >> 8 & 0xFF
    seen = f"v{major}.{minor}.{patch}"
    if (major, minor) < OLDEST_VERSION:
        return [Check("PX4 version", Level.FAIL, seen, "update PX4: v1.14 is the oldest that can be flown")]
    if (major, minor) != RECORDED_VERSION:
        return [Check("PX4 version", Level.WARN, seen, "the behaviour relied on was recorded with v1.17: fly tethered first")]
    return [Check("PX4 version", Level.PASS, seen)]


def check_health(status: Fields | None, texts: tuple[StatusText, ...], simulated: bool) -> list[Check]:
    """SYS_STATUS: what is enabled must be healthy, PX4's own pre-arm verdict good, a receiver there."""
    if status is None:
        return [Check("health", Level.FAIL, "no SYS_STATUS", "enable SYS_STATUS on the companion link")]
    present = int(status["onboard_control_sensors_present"])
    enabled = int(status["onboard_control_sensors_enabled"])
    healthy = int(status["onboard_control_sensors_health"])
    missing = [name for bit, name in SENSORS.items() if bit & MUST_BE_PRESENT and not bit & present]
    ill = [name for bit, name in SENSORS.items() if bit & enabled & present and not bit & healthy]
    checks = []
    if missing or ill:
        seen = "; ".join(f"{what}: {', '.join(names)}" for what, names in (("missing", missing), ("unhealthy", ill)) if names)
        checks.append(Check("health", Level.FAIL, seen, "look at it in QGroundControl (sensors, calibration, wiring)"))
    else:
        checks.append(Check("health", Level.PASS, "all enabled sensors healthy"))
    if present & PREARM_CHECK and not healthy & PREARM_CHECK:
        words = f' ("{texts[-1].text}")' if texts else ""
        checks.append(
            Check(
                "pre-arm", Level.FAIL, f"PX4 would refuse to arm{words}", "see `commander check`, or the events in QGroundControl"
            )
        )
    else:
        checks.append(Check("pre-arm", Level.PASS, "PX4 would arm"))
    if not simulated and not (present & RC_RECEIVER and healthy & RC_RECEIVER):
        advice = "bind and switch on the transmitter: the pilot must be able to take over at any time"
        checks.append(Check("pilot's link", Level.WARN, "no RC receiver reported", advice))
    return checks


def position_source(facts: VehicleFacts, values: dict[str, Value]) -> str:
    """Where the horizontal position comes from, in words; empty when nothing is there. GPS is not needed."""
    gps, flow = facts.newest("GPS_RAW_INT"), facts.newest("OPTICAL_FLOW_RAD")
    found = []
    if gps is not None and int(gps.get("fix_type", 0)) >= ENOUGH_FIX and int(values.get("EKF2_GPS_CTRL", 7)):
        found.append(f"GPS ({gps.get('satellites_visible', '?')} satellites)")
    if int(values.get("EKF2_EV_CTRL", 0)):
        found.append("vision or mocap")
    if flow is not None and int(values.get("EKF2_OF_CTRL", 0)):
        found.append("optical flow")
    return ", ".join(found)


def check_position(facts: VehicleFacts, values: dict[str, Value], rest: list[LocalPosition]) -> list[Check]:
    """The estimator's own flags and accuracy, its source, and that it stands still while the vehicle does."""
    status = facts.newest("ESTIMATOR_STATUS")
    advice = "wait for the estimate, or check its source: GPS fix, optical flow with distance sensor, vision, mocap (EKF2_*_CTRL)"
    source = position_source(facts, values)
    if status is None:
        return [Check("local position", Level.FAIL, "no ESTIMATOR_STATUS", "enable ESTIMATOR_STATUS on the companion link")]
    problem = _estimator_problem(int(status["flags"]))
    if problem is not None:
        return [Check("local position", Level.FAIL, f"{problem}; source: {source or 'none'}", advice)]
    accuracy_m = float(status.get("pos_horiz_accuracy") or math.nan)
    seen = f"source: {source or 'unknown'}, +-{accuracy_m:.2f} m by its own account"
    if accuracy_m > LOST_POSITION_M:
        return [Check("local position", Level.FAIL, seen, advice)]
    if accuracy_m > VAGUE_POSITION_M or not source:
        return [Check("local position", Level.WARN, seen, "keep the fence that much further away from what must not be hit")]
    return [Check("local position", Level.PASS, seen), *_at_rest(rest)]


def _estimator_problem(flags: int) -> str | None:
    needs = (
        (ATTITUDE, "attitude"),
        (SPEED, "horizontal velocity"),
        (CLIMB, "vertical velocity"),
        (POSITION_RELATIVE | POSITION_ABSOLUTE, "horizontal position"),
        (HEIGHT_ABSOLUTE | HEIGHT_GROUND, "height"),
    )
    lacking = [name for bits, name in needs if not flags & bits]
    if lacking:
        return f"the estimator has no {', '.join(lacking)}"
    if flags & NO_AIDING:
        return "the estimator runs without any aiding"
    return "GPS glitch" if flags & GPS_GLITCH else None


def _at_rest(rest: list[LocalPosition]) -> list[Check]:
    """Samples of a standing vehicle: a moving estimate means wrong calibration, or a source that cannot see the ground."""
    if len(rest) < 2:
        return [Check("estimate at rest", Level.FAIL, "no position samples", "check the link")]
    first, last = rest[0].position, rest[-1].position
    drift_m = math.dist((first.x, first.y, first.z), (last.x, last.y, last.z))
    speeds = [math.hypot(item.velocity.x, item.velocity.y, item.velocity.z) for item in rest]
    speed = sum(speeds) / len(speeds)
    seen = f"{speed:.2f} m/s, moved {drift_m:.2f} m in {rest[-1].time_s - rest[0].time_s:.1f} s while standing"
    if speed > MAX_REST_SPEED_M_S or drift_m > MAX_REST_DRIFT_M:
        return [Check("estimate at rest", Level.FAIL, seen, "recalibrate the IMU, check the position source's view")]
    return [Check("estimate at rest", Level.PASS, seen)]
