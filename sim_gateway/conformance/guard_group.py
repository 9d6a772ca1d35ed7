"""Replays of geofence.json and failures.json: breaches, lost GPS, an empty battery, injected failures."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import development as mav

from sim_gateway.conformance.bench import Bench
from sim_gateway.conformance.facts import Json
from sim_gateway.conformance.rows import BATTERY_S, DISTANCE_M, EVENT_S, Row, Table, numbers_hidden

WATCHED_S = 5.95  # the recordings end 5.8 to 6.0 s after the crossing
_FENCE = mav.MAV_MISSION_TYPE_FENCE
_CORNERS_M = ((10.0, 10.0), (10.0, -10.0), (-10.0, -10.0), (-10.0, 10.0))
REASONS = {
    "inject gps_off": "GPS can be lost here, as in PX4's other simulators; the recorded one could not",
    "hor, GF_ACTION 2: in the end": "Hold is where a look found the vehicle outside, in PX4 0.2 s later here",
}


# ---- geofence


def geofence(facts: Json) -> list[Row]:
    """Breaches of a square, of the greatest height and of the greatest distance."""
    table = Table("geofence", REASONS)
    for case, recorded in facts.items():
        _breach(table, case, recorded)
    return table.rows


def upload(bench: Bench, corners_m: tuple[tuple[float, float], ...] = _CORNERS_M) -> list[list[Any]]:
    """Upload an inclusion polygon the way a client does; returns what the vehicle said: [message, type of acknowledgement]."""
    said: list[list[Any]] = []
    since_s = bench.time_s
    bench.onboard.send(mav.MAVLink_mission_count_message(1, 1, len(corners_m), _FENCE))
    for _ in range(len(corners_m) + 1):
        bench.run(0.04)
        asked = bench.named("MISSION_REQUEST_INT", since_s)
        if len(said) < len(asked):
            said.append(["MISSION_REQUEST_INT", None])
            bench.onboard.send(_vertex(bench, asked[-1][1].seq, corners_m))
    said += [["MISSION_ACK", m.type] for _, m in bench.named("MISSION_ACK", since_s)]
    return said


def _vertex(bench: Bench, number: int, corners_m: tuple[tuple[float, float], ...]) -> Any:
    latitude, longitude, _ = bench.vehicle.frame.to_global((*corners_m[number], 0.0))
    command = mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
    place = (round(latitude * 1e7), round(longitude * 1e7), 0.0)
    return mav.MAVLink_mission_item_int_message(1, 1, number, 0, command, 0, 1, len(corners_m), 0, 0, 0, *place, _FENCE)


def _breach(table: Table, case: str, recorded: Json) -> None:
    runs, up = recorded["runs"], recorded["kind"] == "ver"
    limits = {"ver": {"GF_MAX_VER_DIST": 8.0}, "hor": {"GF_MAX_HOR_DIST": 10.0}}.get(recorded["kind"], {})
    bench = Bench(5.0, parameters={"GF_ACTION": recorded["action"], **limits})
    if recorded["kind"] == "polygon":
        table.equal(f"{case}: upload", runs[0]["upload"], upload(bench))
    bench.offboard(0.0 if up else 2.0, 0.0, -1.5 if up else 0.0)

    def reach_m() -> float:
        position = bench.pilot.state.position
        return -position[2] if up else position[0]

    limit_m = runs[0]["limit_m"]
    bench.run(15.0, until=lambda: reach_m() > limit_m)
    since_s, furthest = bench.time_s, 0.0
    while bench.time_s - since_s < WATCHED_S:
        bench.run(0.04)
        furthest = max(furthest, reach_m() - limit_m)
    _breach_rows(table, case, runs, bench, since_s, furthest, reach_m())


def _breach_rows(table: Table, case: str, runs: Json, bench: Bench, since_s: float, over_m: float, end_m: float) -> None:
    texts, modes = bench.texts(since_s), bench.modes(since_s)
    table.equal(f"{case}: texts", numbers_hidden(t[1] for t in runs[0]["texts"]), numbers_hidden(t[2] for t in texts))
    table.equal(f"{case}: severities", [t[0] for t in runs[0]["texts"]], [t[1] for t in texts])
    # PX4 looks some five times a second: how late it is depends on when it happened to look
    told = [run["t_first_fence_text_after_cross"] for run in runs]
    table.within(f"{case}: told, s", (0.0, max(told)), texts[0][0] if texts else None, EVENT_S)
    table.equal(f"{case}: modes", runs[0]["modes"], [list(m[1:]) for m in modes])
    changed = [run["t_mode_change_after_cross"] for run in runs if run["t_mode_change_after_cross"] is not None]
    if changed:
        table.within(f"{case}: first change of mode, s", (0.0, max(changed)), modes[0][0] if modes else None, EVENT_S)
    if len(runs[0]["after_s"]) > 1:
        table.within(
            f"{case}: Hold lasts, s", [r["after_s"][1] for r in runs], modes[1][0] - modes[0][0] if modes[1:] else None, EVENT_S
        )
    status = bench.heartbeat().system_status
    table.equal(f"{case}: system_status", runs[0]["status"][-1] if runs[0]["status"] else 4, status)
    table.within(f"{case}: overshoot, m", [run["max_overshoot_m"] for run in runs], over_m, DISTANCE_M)
    table.within(f"{case}: in the end, m", [run["end_value_m"] for run in runs], end_m, DISTANCE_M)
    bench.command(mav.MAV_CMD_DO_SET_MODE, 1, 6).run(0.5)
    table.equal(f"{case}: OFFBOARD chosen again while outside", runs[0]["again"], bench.mode)


# ---- failures


def failures(facts: Json) -> list[Row]:
    """GPS, battery, MAV_CMD_INJECT_FAILURE."""
    table = Table("failures", REASONS)
    _gps(table, [run for name, run in facts["runs"].items() if name.startswith("gps")])
    drained = Bench(5.0, parameters={"SIM_BAT_MIN_PCT": 0, "SIM_BAT_DRAIN": 20.0}).offboard()
    _battery(table, "battery drained in 20 s", facts["runs"]["battery_drain_20s"], drained)
    failed = Bench(5.0).offboard().command(mav.MAV_CMD_INJECT_FAILURE, 100, 1)
    _battery(table, "battery failure injected", facts["runs"]["battery_inject_off"], failed)
    for name, (params, ack) in facts["inject"].items():
        table.equal(f"inject {name}: acknowledgement", ack, _injected({"SYS_FAILURE_EN": 1}, params))
    table.equal("inject with SYS_FAILURE_EN 0", facts["inject_off"], _injected({"SYS_FAILURE_EN": 0}, [4, 1]))
    bench = Bench(5.0).offboard().command(mav.MAV_CMD_INJECT_FAILURE, 101, 1, 1)
    since_s = bench.time_s
    table.equal("inject motor: changes of mode", [], [m[1] for m in bench.run(5.0).modes(since_s)])
    return table.rows


def _injected(parameters: dict[str, float], params: list[float]) -> str | None:
    bench = Bench(5.0, parameters=parameters).offboard()
    since_s = bench.time_s
    acks = bench.command(mav.MAV_CMD_INJECT_FAILURE, *params).run(0.5).acks(mav.MAV_CMD_INJECT_FAILURE, since_s)
    return acks[0] if acks else None


def _gps(table: Table, runs: list[Json]) -> None:
    bench, case = Bench(5.0).offboard(), "SIM_GPS_USED 0"
    since_s = bench.time_s
    bench.pilot.parameters.set("SIM_GPS_USED", 0)
    bench.run(25.0, until=lambda: not bench.pilot.armed).run(0.5)
    modes, texts = bench.modes(since_s), bench.texts(since_s)
    table.equal(f"{case}: modes", [m[1:] for m in runs[0]["modes"]], [list(m[1:]) for m in modes])
    table.within(f"{case}: descends, s", [run["modes"][0][0] for run in runs], modes[0][0] if modes else None, EVENT_S)
    table.equal(f"{case}: texts", [t[1:] for t in runs[0]["texts"]], [list(t[1:]) for t in texts])
    raw = bench.named("GPS_RAW_INT", since_s)[-1][1]
    table.equal(f"{case}: GPS_RAW_INT fix, satellites", runs[0]["gps"][-1], [raw.fix_type, raw.satellites_visible])
    flags = [m.flags for _, m in bench.named("ESTIMATOR_STATUS", since_s)]
    table.equal(f"{case}: ESTIMATOR_STATUS.flags", [f[1] for f in runs[0]["flags"]], list(dict.fromkeys(flags)))


def _battery(table: Table, case: str, recorded: Json, bench: Bench) -> None:
    """Times count from the moment when the charge is low: the recorded batteries had flown before."""
    since_s = bench.time_s
    bench.run(45.0, until=lambda: not bench.pilot.armed).run(0.2)
    texts = recorded["texts"]
    upto = next(i for i, t in enumerate(texts) if t[2].startswith("Disarmed")) + 1
    seen = bench.texts(since_s)
    table.equal(f"{case}: texts", [t[1:] for t in texts[:upto]], [list(t[1:]) for t in seen][:upto])
    table.equal(f"{case}: modes", [m[1:] for m in recorded["modes"]], [list(m[1:]) for m in bench.modes(since_s)])
    low_s = next((at for at, _, text in seen if text == "Low battery"), 0.0)
    for at, _, text in texts[1:5]:
        found = next((t - low_s for t, _, other in seen if other == text), None)
        table.within(f"{case}: from low to {text!r}, s", [at - texts[0][0]], found, BATTERY_S)
    states = list(dict.fromkeys(m.charge_state for _, m in bench.named("BATTERY_STATUS", since_s)))[:4]
    table.equal(f"{case}: charge states", [s[1] for s in recorded["charge"]][:4], states)
