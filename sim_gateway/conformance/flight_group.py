"""Replays of lifecycle.json, offboard_loss.json and odd_setpoints.json: whole flights, with times and motion."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import development as mav

from sim_gateway.conformance.bench import VELOCITY_AND_YAW_RATE, Bench, Texts
from sim_gateway.conformance.facts import Json
from sim_gateway.conformance.rows import (
    DISTANCE_M,
    EVENT_S,
    LANDING_S,
    SPEED_M_S,
    START_UP_S,
    YAW_RAD,
    Row,
    Table,
    numbers_hidden,
)
from sim_gateway.local_frame import wrap_pi

DRIFT = (
    "the same law (0.95 1/s times the distance, plus the velocity), but the drifting estimate had the recorded vehicle 1.3 m off"
)
TUMBLE = "a yaw rate of 10^6 rad/s is limited to MC_YAWRATE_MAX: the recorded vehicle tumbled"


def _first(texts: Texts, start: str) -> float | None:
    return next((at for at, _, text in texts if text.startswith(start)), None)


def _landed_states(bench: Bench, since_s: float) -> list[tuple[float, str]]:
    """Changes of EXTENDED_SYS_STATE.landed_state."""
    changes: list[tuple[float, str]] = []
    last = None
    for at, message in bench.named("EXTENDED_SYS_STATE"):
        if last is not None and message.landed_state != last and at >= since_s:
            name = mav.enums["MAV_LANDED_STATE"][message.landed_state].name
            changes.append((at - since_s, name.removeprefix("MAV_LANDED_STATE_")))
        last = message.landed_state
    return changes


# ---- lifecycle


def lifecycle(facts: Json) -> list[Row]:
    """Start-up, takeoff, landing, disarming by itself."""
    table = Table("lifecycle")
    _start_up(table, facts)
    _take_off(table, facts)
    _land(table, facts)
    bench = Bench()
    bench.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1).run(12.0, until=lambda: bench.time_s > 1 and not bench.pilot.armed)
    table.within("disarms by itself without takeoff, s", facts["auto_disarm_s"], bench.time_s - 0.1, EVENT_S)
    _velocity_take_off(table, facts["velocity_takeoff"])
    return table.rows


_FIRSTS = {
    "gps_3dfix": "GPS_RAW_INT",
    "first_local_position_ned": "LOCAL_POSITION_NED",
    "first_heartbeat": "HEARTBEAT",
    "first_home_position": "HOME_POSITION",
    "first_global_position_int": "GLOBAL_POSITION_INT",
}


def _start_up(table: Table, facts: Json) -> None:
    bench = Bench(ready_after_s=None, everything=True)
    accepted_s = math.nan
    while bench.time_s < 6.0 and not bench.pilot.armed:
        if bench.named("HEARTBEAT"):
            bench.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        bench.run(0.2)
        accepted_s = bench.time_s - 0.2
    times = {key: next((at for at, _ in bench.named(name)), None) for key, name in _FIRSTS.items()}
    flags = [at for at, m in bench.named("ESTIMATOR_STATUS") if m.flags & 16]
    times |= {"estimator_status_pos_horiz_abs_flag": flags[0] if flags else None, "arm_accepted": accepted_s}
    for key, seconds in times.items():
        recorded = facts["startup"][key]
        slack = START_UP_S + (1.0 if key.startswith("estimator") else 0.0)  # that message comes once a second
        table.within(f"start-up: {key}, s", (recorded["min"], recorded["max"]), seconds, slack)
    order = sorted(_FIRSTS, key=lambda key: facts["startup"][key]["median"])
    table.equal("start-up: order of first messages", order, sorted(_FIRSTS, key=lambda key: times[key] or math.inf))
    denials = bench.acks(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)[:-1]
    table.equal("start-up: arming is denied with", ["TEMPORARILY_REJECTED"], sorted(set(denials)))
    beats = [[m.base_mode, m.custom_mode, m.system_status] for _, m in bench.run(1.2).named("HEARTBEAT")]
    table.equal("start-up: first heartbeat", facts["startup_status"][0][1], beats[0])
    table.equal("start-up: heartbeat when armed", facts["startup_status"][-1][1], beats[-1])


def _take_off(table: Table, facts: Json) -> None:
    runs, bench = facts["takeoff"], Bench()
    bench.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1).run(0.1)
    since_s, climb = bench.time_s, 0.0
    bench.command(mav.MAV_CMD_NAV_TAKEOFF, *[math.nan] * 7)
    for _ in range(100):
        bench.run(0.1)
        climb = max(climb, -bench.pilot.state.velocity[2])
    landed, texts = _landed_states(bench, since_s), bench.texts(since_s)
    table.equal("takeoff: texts", runs[0]["texts"], [text for _, _, text in texts])
    table.equal("takeoff: landed_state", runs[0]["landed"], [state for _, state in landed])
    detected = landed[0][0] if landed else None
    table.within("takeoff: detected, s", [r["detected_s"] for r in runs], detected, EVENT_S)
    modes = bench.modes(since_s)
    table.equal("takeoff: modes", ["AUTO.TAKEOFF", "AUTO.LOITER"], [m[1] for m in modes])
    table.within("takeoff: Hold, s", [r["loiter_s"] for r in runs], modes[-1][0] if modes else None, LANDING_S)
    limits = facts["climb_m_s"]
    table.within("takeoff: fastest climb, m/s", (limits["min"], limits["max"]), climb, SPEED_M_S)


def _land(table: Table, facts: Json) -> None:
    runs, bench = facts["land"], Bench(5.0).offboard()
    since_s = bench.time_s
    bench.command(mav.MAV_CMD_NAV_LAND, 0, 0, 0, *[math.nan] * 4).run(25.0, until=lambda: not bench.pilot.armed)
    texts, landed = bench.run(0.2).texts(since_s), _landed_states(bench, since_s)
    table.equal("land: texts", runs[0]["texts"], [text for _, _, text in texts])
    table.equal("land: landed_state", runs[0]["landed"], [state for _, state in landed])
    detected, disarmed = _first(texts, "Landing detected"), _first(texts, "Disarmed")
    table.within("land: detected, s", [r["detected_s"] for r in runs], detected, LANDING_S)
    waited = None if detected is None or disarmed is None else disarmed - detected
    table.within("land: from landing to disarming, s", [r["disarm_s"] - r["detected_s"] for r in runs], waited, EVENT_S)
    table.equal("land: mode after disarming", runs[0]["mode"], bench.mode)


def _velocity_take_off(table: Table, runs: Json) -> None:
    bench = Bench().fly(0.0, 0.0, -1.0).run(0.5)
    bench.command(mav.MAV_CMD_DO_SET_MODE, 1, 6).run(0.2)
    since_s = bench.time_s
    bench.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1).run(8.0, until=lambda: bench.pilot.state.position[2] < -1.0)
    rise_s, landed = bench.time_s - since_s, _landed_states(bench, since_s)
    case = "takeoff in OFFBOARD by velocity"
    table.equal(f"{case}: landed_state", [s[1] for s in runs[0]["landed"]], [state for _, state in landed])
    table.within(f"{case}: detected, s", [r["landed"][0][0] for r in runs], landed[0][0] if landed else None, EVENT_S)
    table.within(f"{case}: 1 m up, s", [r["rise_1m_s"] for r in runs], rise_s, LANDING_S)
    table.equal(f"{case}: texts", numbers_hidden(runs[0]["texts"]), [text for _, _, text in bench.texts(since_s)])


# ---- loss of the setpoint stream


def offboard_loss(facts: Json) -> list[Row]:
    """The failsafe for every recorded combination of parameters."""
    table = Table("offboard_loss")
    for recorded in facts:
        _loss(table, recorded)
    return table.rows


def _loss(table: Table, recorded: Json) -> None:
    gcs = "" if recorded["gcs"] else ", no ground station"
    case = f"COM_OF_LOSS_T {recorded['loss_s']}, COM_OBL_RC_ACT {recorded['action']}{gcs}"
    settings = {"COM_OF_LOSS_T": recorded["loss_s"], "COM_OBL_RC_ACT": recorded["action"]}
    bench = Bench(5.0, parameters=settings, ground_station=recorded["gcs"]).offboard(1.0).run(4.0)
    bench.stream, since_s, start = None, bench.time_s, bench.pilot.state.position
    speed_m_s, stopped = math.hypot(*bench.pilot.state.velocity[:2]), None
    lasts = recorded["t_disarmed_s"] is not None
    while bench.time_s - since_s < (30.0 if lasts else 6.0) and bench.pilot.armed:
        bench.run(0.04)
        if stopped is None and bench.time_s - since_s > 0.5 and math.hypot(*bench.pilot.state.velocity[:2]) < 0.2:
            stopped = (bench.time_s - since_s, math.dist(bench.pilot.state.position[:2], start[:2]))
    bench.run(0.1)
    _loss_rows(table, case, recorded, bench, since_s, speed_m_s, stopped)


def _loss_rows(
    table: Table, case: str, recorded: Json, bench: Bench, since_s: float, speed_m_s: float, stopped: tuple[float, float] | None
) -> None:
    modes, texts = bench.modes(since_s), [text for _, _, text in bench.texts(since_s)]
    span = {key: (value["min"], value["max"]) for key, value in recorded.items() if isinstance(value, dict)}
    table.equal(f"{case}: modes", recorded["modes"], [list(m[1:]) for m in modes])
    table.within(f"{case}: change of mode, s", span["t_mode_change_s"], modes[0][0] if modes else None, EVENT_S)
    table.equal(f"{case}: texts", numbers_hidden(recorded["texts"]), numbers_hidden(texts))
    table.within(f"{case}: speed before, m/s", span["speed_at_loss"], speed_m_s, SPEED_M_S)
    table.within(f"{case}: slower than 0.2 m/s, s", span["t_speed_below_0p2_s"], stopped and stopped[0], DISTANCE_M)
    table.within(f"{case}: way until then, m", span["distance_until_stop_m"], stopped and stopped[1], DISTANCE_M)


# ---- odd setpoints


def odd_setpoints(facts: Json) -> list[Row]:
    """Unusual setpoints in OFFBOARD, four seconds each."""
    table = Table("odd_setpoints", {"huge_yawrate_1e6": TUMBLE, "position_plus_velocity": DRIFT})
    for recorded in facts:
        _odd(table, recorded)
    return table.rows


def _odd(table: Table, recorded: Json) -> None:
    bench, case = Bench(5.0).offboard(), recorded["case"]
    since_s = bench.time_s
    bench.set_stream(recorded["frame"], recorded["type_mask"], tuple(float(v) for v in recorded["values"])).run(3.98)
    velocity, yaw, echo = (
        bench.pilot.state.velocity,
        bench.pilot.state.yaw_rad,
        bench.telemetry.build("POSITION_TARGET_LOCAL_NED"),
    )
    bench.set_stream(1, VELOCITY_AND_YAW_RATE, (0.0,) * 11).run(0.3)
    modes = bench.modes(since_s)
    table.equal(f"{case}: modes", [m[1] for m in recorded["modes_during"]], [m[1] for m in modes])
    for i, (at, _) in enumerate(recorded["modes_during"]):
        table.within(f"{case}: change {i + 1}, s", [at], modes[i][0] if i < len(modes) else None, EVENT_S)
    if not recorded["left_offboard"]:
        for axis, (name, value) in enumerate(zip("xyz", recorded["vel_at_4s"], strict=True)):
            table.within(f"{case}: velocity {name}, m/s", [value], velocity[axis], SPEED_M_S)
        turned = wrap_pi(recorded["yaw_end"] - recorded["yaw_start"])
        table.within(f"{case}: turned, rad", [turned], wrap_pi(yaw), YAW_RAD)
        table.equal(f"{case}: echoed type_mask", recorded["echo"]["type_mask"], echo.type_mask)
    seen = list(dict.fromkeys(text for _, _, text in bench.texts(since_s)))
    table.equal(f"{case}: texts", numbers_hidden(recorded["texts"])[:3], numbers_hidden(seen)[:3])
