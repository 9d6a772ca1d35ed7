"""Replays of commands.json and override.json: acknowledgements, texts, changes of mode, the parameter protocol, sticks."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from pymavlink.dialects.v20 import development as mav

from sim_gateway.conformance.bench import VELOCITY_AND_YAW_RATE, Bench, Client
from sim_gateway.conformance.facts import Json
from sim_gateway.conformance.rows import EVENT_S, SPEED_M_S, Row, Table, numbers_hidden
from sim_gateway.flight_modes import FlightMode

WAIT_S = 0.5  # for acknowledgements and texts
_ARM, _SET_MODE = mav.MAV_CMD_COMPONENT_ARM_DISARM, mav.MAV_CMD_DO_SET_MODE
REASONS = {
    "inject gps": "GPS can be lost here, as in PX4's other simulators; the recorded one could not",
}


def _ground() -> Bench:
    return Bench()


def _armed() -> Bench:
    return Bench().command(_ARM, 1).run(0.2)


def _ground_offboard() -> Bench:
    return Bench().command(_SET_MODE, 1, 6).run(0.2)


def _streaming(seconds: float, offboard: bool = False, height_m: float = 0.0) -> Callable[[], Bench]:
    def make() -> Bench:
        bench = Bench(height_m).fly(0.0).run(seconds)
        return bench.command(_SET_MODE, 1, 6).run(0.3) if offboard else bench

    return make


def _hold() -> Bench:
    return Bench(5.0).run(0.5)


def _offboard() -> Bench:
    return Bench(5.0).offboard()


def _returning() -> Bench:
    return Bench(5.0).fly(0.0).command(mav.MAV_CMD_NAV_RETURN_TO_LAUNCH).run(1.0)


def _killed() -> Bench:
    return Bench().command(_ARM, 1).run(0.2).command(_ARM, 0, 21196).run(0.2)


def _battery_failed() -> Bench:
    return Bench().command(mav.MAV_CMD_INJECT_FAILURE, 100, 1).run(0.2)


# how the vehicle stood when a command was sent; all others: on the ground, disarmed
_BEFORE: dict[str, Callable[[], Bench]] = {
    "disarm_on_ground": _armed,
    "arm_in_offboard_without_stream": _ground_offboard,
    "takeoff_nan_params": _armed,
    "takeoff_while_flying_hold": _hold,
    "set_offboard_no_stream_flying_hold": _hold,
    "set_offboard_flying_streaming": _streaming(0.5, height_m=5.0),
    "arm_while_armed_in_air": _offboard,
    "disarm_in_air": _offboard,
    "hold_from_offboard_176": _offboard,
    "posctl_no_manual_input": _hold,
    "manual_mode_no_input": _hold,
    "altctl_no_input": _hold,
    "mission_without_mission": _hold,
    "bad_submode": _hold,
    "bad_mainmode": _hold,
    "back_to_offboard": _streaming(0.5, height_m=5.0),
    "rtl_cmd20": _hold,
    "offboard_from_rtl": _returning,
    "land_cmd21": _offboard,
    "force_disarm_21196_in_air": _offboard,
    "arm_after_force_disarm": _killed,
    **{f"set_offboard_disarmed_after_stream_{s}s": _streaming(float(s)) for s in ("0.2", "0.5", "1.0", "2.0")},
    **{f"arm_in_offboard_streaming_{s}s": _streaming(float(s), offboard=True) for s in ("0.2", "0.5", "1.0", "2.0")},
    **{f"set_offboard_flying_after_stream_{s}s": _streaming(float(s), height_m=5.0) for s in ("0.2", "0.5", "1.0", "2.0")},
}


def commands(facts: Json) -> list[Row]:
    """Every command that was sent, and what else was tried over the link."""
    table = Table("commands", REASONS)
    for name, recorded in facts["commands"].items():
        _command(table, name, recorded)
    for recorded in facts["sequences"]:
        _sequence(table, recorded)
    for case, acks in facts["changes"].items():
        bench = _BEFORE_CHANGE.get(case, _hold)()
        since_s = bench.time_s
        bench.command(_SET_MODE, 1, *_WANTED[case.split("->")[1].split()[0].rstrip(",")](case)).run(WAIT_S)
        table.equal(f"{case}: both acknowledgements", acks, bench.acks(_SET_MODE, since_s))
    _streams(table, facts)
    _small_things(table, facts)
    _parameters(table, facts)
    return table.rows


def _command(table: Table, name: str, recorded: Json) -> None:
    bench = _BEFORE.get(name, _ground)()
    since_s, before = bench.time_s, bench.mode
    component = 77 if name.startswith("command_to_wrong_target") else 1
    params = [math.nan if value is None else float(value) for value in recorded["params"]]
    bench.command(recorded["command"], *params, component=component).run(WAIT_S)
    acks = bench.acks(recorded["command"], since_s)
    table.equal(f"{name}: first acknowledgement", recorded["ack"], acks[0] if acks else None)
    texts = [(severity, text) for _, severity, text in bench.texts(since_s)]
    wanted = [t for t in recorded["texts"] if not t[1].startswith("[logger]")]
    hidden = [numbers_hidden(text for _, text in side) for side in (wanted, texts)]
    table.equal(f"{name}: texts", hidden[0], hidden[1])
    table.equal(f"{name}: severities", [t[0] for t in wanted], [t[0] for t in texts])
    table.equal(f"{name}: mode after", recorded["mode"] or before, bench.mode)


_SEQUENCE: dict[str, tuple[Callable[[], Bench], tuple[float, ...]]] = {
    "set OFFBOARD, disarmed, no stream": (_ground, (1, 6)),
    "arm in OFFBOARD without stream (denied)": (_ground_offboard, (1,)),
    "set HOLD, disarmed": (_ground_offboard, (1, 4, 3)),
    "arm": (_ground, (1,)),
    "disarm on ground": (_armed, (0,)),
    "request AUTOPILOT_VERSION": (_ground, (148,)),
    "request unknown message id": (_ground, (60001,)),
    "set interval LOCAL_POSITION_NED": (_ground, (32, 20000)),
    "set interval HEARTBEAT": (_ground, (0, 100000)),
    "set interval unknown id": (_ground, (60001, 20000)),
    "get interval": (_ground, (32,)),
    "takeoff while disarmed": (_ground, (math.nan,) * 7),
    "takeoff": (_armed, (math.nan,) * 7),
    "takeoff in the air": (_hold, (math.nan,) * 7),
    "inject gps failure": (_ground, (4, 1)),
    "inject battery failure": (_ground, (100, 1)),
    "inject battery OK": (_battery_failed, (100, 0)),
    "disarm in air (denied)": (_offboard, (0,)),
    "arm in air": (_offboard, (1,)),
    "set OFFBOARD in air, no stream": (_hold, (1, 6)),
    "set OFFBOARD in air, streaming": (_streaming(0.5, height_m=5.0), (1, 6)),
    "set HOLD in air": (_offboard, (1, 4, 3)),
    "RTL cmd 20": (_hold, ()),
    "DO_REPOSITION 192 hold here": (_offboard, (-1, 1, 0, math.nan, math.nan, math.nan, math.nan)),
    "set LAND by mode": (_hold, (1, 4, 6)),
    "change speed 178": (_offboard, (1, 2, -1)),
    "set home 179 (current)": (_offboard, (1,)),
    "land": (_offboard, (0, 0, 0, *[math.nan] * 4)),
    "force disarm": (_offboard, (0, 21196)),
}


def _sequence(table: Table, recorded: Json) -> None:
    case = recorded["case"]
    make, params = _SEQUENCE.get(case, (_hold, ()))
    if case == "set OFFBOARD":
        make, params = _streaming(0.5, height_m=5.0), (1, 6)
    elif case == "set HOLD":
        make, params = _ground, (1, 4, 3)
    bench = make()
    since_s = bench.time_s
    bench.command(recorded["command"], *params).run(WAIT_S)
    acks = [m for _, m in bench.named("COMMAND_ACK", since_s) if m.command == recorded["command"]]
    names = [mav.enums["MAV_RESULT"][m.result].name.removeprefix("MAV_RESULT_") for m in acks]
    table.equal(f"{case}: all acknowledgements", [a[0] for a in recorded["acks"]], names)
    if acks and recorded["acks"]:
        table.equal(f"{case}: addressed to", recorded["acks"][0][1], [acks[0].target_system, acks[0].target_component])


_WANTED: dict[str, Callable[[str], tuple[int, ...]]] = {
    "OFFBOARD": lambda _: (6,),
    "POSCTL": lambda _: (3,),
    "ALTCTL": lambda _: (2,),
    "MANUAL": lambda _: (1,),
    "MISSION": lambda _: (4, 4),
    "HOLD": lambda _: (4, 3),
    "bad": lambda case: (77,) if "main" in case else (4, 99),
}
_BEFORE_CHANGE: dict[str, Callable[[], Bench]] = {
    "HOLD->OFFBOARD after 0.1 s of stream": _streaming(0.1, height_m=5.0),
    "OFFBOARD->POSCTL, no manual input": _offboard,
    "OFFBOARD->HOLD while stream continues": _offboard,
    "HOLD->OFFBOARD streaming": _streaming(0.5, height_m=5.0),
}


# ---- slow streams, foreign targets


def _streams(table: Table, facts: Json) -> None:
    for test in facts["rates"]:
        bench, modes = _offboard(), []
        since_s, setpoint = bench.time_s, bench.stream
        assert setpoint is not None
        bench.stream = None
        for _ in range(max(round(7.6 * test["hz"]), 1)):
            bench.onboard.send(setpoint())
            bench.run(1.0 / test["hz"])
        modes = [m[1] for m in bench.modes(since_s)]
        shown = "none" if not test["modes"] else "lost and back"
        seen = "none" if not modes else "lost and back" if {"AUTO.RTL", "OFFBOARD"} == set(modes) else str(modes)
        table.equal(f"setpoints at {test['hz']} Hz: changes of mode", shown, seen)
    bench = _offboard()
    bench.stream, since_s = None, bench.time_s
    bench.run(3.0).fly(0.0).run(0.3)
    modes_seen = bench.modes(since_s)
    table.equal("stream resumes: modes", [m[1:] for m in facts["resume"]], [list(m[1:]) for m in modes_seen])
    for recorded, seen_mode in zip(facts["resume"], modes_seen, strict=False):
        table.within(f"stream resumes: {recorded[1]}, s", [recorded[0]], seen_mode[0], EVENT_S)
    for target in facts["targets"]:
        bench = _offboard()
        since_s = bench.time_s
        bench.set_stream(1, VELOCITY_AND_YAW_RATE, (0.0,) * 11, target["system"]).run(3.0)
        table.equal(f"setpoints for system {target['system']}: modes", target["modes"], [m[1] for m in bench.modes(since_s)])


# ---- requests, intervals, old messages


def _small_things(table: Table, facts: Json) -> None:
    bench = _ground().command(mav.MAV_CMD_REQUEST_MESSAGE, 148).run(0.1)
    version = bench.named("AUTOPILOT_VERSION")
    for key, value in facts["version"].items():
        table.equal(f"AUTOPILOT_VERSION.{key}", value, getattr(version[-1][1], key) if version else None)
    bench.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, 32, 20000).run(0.1)
    since_s = bench.time_s
    bench.command(mav.MAV_CMD_GET_MESSAGE_INTERVAL, 32).run(5.0)
    replies = bench.named("MESSAGE_INTERVAL", since_s)
    table.equal("GET_MESSAGE_INTERVAL: interval_us", facts["interval_us"], replies[0][1].interval_us if replies else None)
    hz = len(bench.named("LOCAL_POSITION_NED", since_s)) / 5.0
    table.within("SET_MESSAGE_INTERVAL to 50 Hz gives, Hz", [facts["interval_hz"], 50.0], hz, 1.0)
    since_s = bench.time_s
    bench.onboard.send(mav.MAVLink_command_int_message(1, 1, 0, _SET_MODE, 0, 0, 1, 4, 3, 0, 0, 0, 0))
    table.equal("mode by COMMAND_INT: acknowledgements", facts["command_int"], bench.run(0.2).acks(_SET_MODE, since_s))
    since_s = bench.time_s
    bench.onboard.send(mav.MAVLink_set_mode_message(1, 1, FlightMode.LOITER.custom_mode))
    table.equal("mode by SET_MODE: acknowledgements", facts["set_mode"], bench.run(0.2).acks(_SET_MODE, since_s))


def _parameters(table: Table, facts: Json) -> None:
    bench = _ground()
    for case, item in facts["parameters"].items():
        wrong_type = "wrong_type" in case
        kind = 6 if item["reply"] is not None and item["reply"][1] == 6 else 9
        wire = struct.unpack("<f", struct.pack("<i", int(item["sent"])))[0] if kind == 6 and not wrong_type else item["sent"]
        since_s = bench.time_s
        bench.onboard.send(mav.MAVLink_param_set_message(1, 1, item["name"].encode(), wire, kind))
        replies = [m for _, m in bench.run(0.1).named("PARAM_VALUE", since_s) if m.param_id == item["name"]]
        seen = [_decoded(replies[0]), replies[0].param_type] if replies else None
        table.equal(f"{case}: answer", item["reply"], seen)
    for name in ("COM_OF_LOSS_T", "NO_SUCH_PARAM"):
        since_s = bench.time_s
        bench.onboard.send(mav.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        answers = bench.run(0.1).named("PARAM_VALUE", since_s)
        table.equal(f"PARAM_REQUEST_READ {name}: answers", int(name != "NO_SUCH_PARAM"), len(answers))
    since_s = bench.time_s
    bench.onboard.send(mav.MAVLink_param_request_list_message(1, 1))
    listed = bench.run(5.0).named("PARAM_VALUE", since_s)
    table.equal("PARAM_REQUEST_LIST: values, count", facts["listed"], [len(listed), listed[0][1].param_count])


def _decoded(message: Json) -> float:
    """PX4 puts the bytes of an integer into the float field."""
    if message.param_type != 6:
        return float(message.param_value)
    return int(struct.unpack("<i", struct.pack("<f", message.param_value))[0])


# ---- sticks and the pilot's modes


def override(facts: Json) -> list[Row]:
    """What sticks and a ground station's mode changes do to OFFBOARD."""
    table, seen = Table("override"), set()
    for recorded in facts:
        case = recorded["case"].split("_rep")[0]
        if case not in seen:
            seen.add(case)
            _override(table, case, recorded)
    return table.rows


def _override(table: Table, case: str, recorded: Json) -> None:
    bench = Bench(5.0, parameters=_override_parameters(case, recorded)).offboard()
    if "without_manual_input" not in case:
        bench.sticks = (0, 0, 500, 0)
    bench.run(2.0)
    if case.endswith("lost_while_in_POSCTL"):
        bench.command(_SET_MODE, 1, 3, client=bench.ground).run(0.5)
    since_s = bench.time_s
    client = _do_override(bench, case)
    bench.run(4.0)
    modes = bench.modes(since_s)
    table.equal(f"{case}: modes", [m[1:] for m in recorded["modes"]], [list(m[1:]) for m in modes])
    for wanted, got in zip(recorded["modes"], modes, strict=False):
        if "returns" not in case:
            table.within(f"{case}: {wanted[1]}, s", [wanted[0]], got[0], EVENT_S)
    table.equal(f"{case}: mode in the end", recorded["mode_end"], bench.mode)
    if recorded["acks"]:
        table.equal(f"{case}: acknowledgements", recorded["acks"], bench.acks(_SET_MODE, since_s, client))
    texts = [text for _, _, text in bench.texts(since_s)]
    table.equal(f"{case}: texts", numbers_hidden(t[1] for t in recorded["texts"]), numbers_hidden(texts))
    table.within(f"{case}: velocity north in the end, m/s", [recorded["vel_end"][0]], bench.pilot.state.velocity[0], SPEED_M_S)


def _override_parameters(case: str, recorded: Json) -> dict[str, float]:
    settings = {"COM_RC_OVERRIDE": 3.0} if "override_3" in case else {}
    hold = next((text for _, text in recorded["texts"] if "entering Hold for" in text), None)
    return settings | ({"COM_FAIL_ACT_T": float(hold.split()[-2])} if hold else {})


def _do_override(bench: Bench, case: str) -> Client:
    if "sticks_pitch_full" in case:
        bench.sticks = (1000, 0, 500, 0)
    elif "stick_20pct" in case:
        bench.sticks = (200, 0, 500, 0)
    elif case.startswith("gcs_set_mode_POSCTL"):
        bench.command(_SET_MODE, 1, 3, client=bench.ground)
    elif case.startswith("gcs_set_mode_HOLD"):
        bench.command(_SET_MODE, 1, 4, 3, client=bench.ground)
    elif "manual_input_lost" in case:
        bench.sticks = None
    elif "offboard_loss" in case:
        bench.stream = None
    elif "returns_to_offboard" in case:
        bench.command(_SET_MODE, 1, 3, client=bench.ground).run(1.2).command(_SET_MODE, 1, 6)
    return bench.ground
