"""What is compared, out of the recordings: a folder of px4_reference, or a file of facts that was written from one."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

Json = Any
FILES = ("link_census", "modes", "commands", "lifecycle", "offboard_loss", "odd_setpoints", "override", "geofence", "failures")


class RecordingsError(ValueError):
    """The recordings cannot be read; the message says which file."""


def read_facts(place: Path) -> dict[str, Json]:
    """The facts of a folder of recordings, or those in a file that `write_facts` made."""
    if place.is_file():
        return dict(_read(place))
    facts = {name: _CONDENSE[name](_read(place / f"{name}.json")) for name in FILES}
    facts["parameters"] = {k: [v["type"], v["value"]] for k, v in _read(place / "parameters_full.json").items() if k[0] != "_"}
    return facts


def write_facts(facts: dict[str, Json], path: Path) -> None:
    """Write them so that `read_facts` reads them back."""
    path.write_text(json.dumps(facts, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")


def _read(path: Path) -> Json:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordingsError(f"{path} cannot be read ({error}): give the folder px4_reference") from None


def _census(data: Json) -> Json:
    """{situation: {link: {message: Hz}}}."""
    situations = ("disarmed", "flying_offboard", "flying_hold")
    return {s: {k: {n: m["hz"] for n, m in v.items()} for k, v in data[s].items() if k != "duration_s"} for s in situations}


def _modes(data: Json) -> Json:
    dropped = ("base_mode_bits", "custom_mode_hex", "comment", "main", "sub", "mavlink_version")
    return {name: {k: v for k, v in mode.items() if k not in dropped} for name, mode in data.items()}


def _commands(data: Json) -> Json:
    other = data["other"]
    version = {k: v for k, v in other["autopilot_version_fields"].items() if k in ("capabilities", "flight_sw_version")}
    parameters = {
        name: {
            "name": item["name"],
            "sent": item["sent"],
            "reply": item["reply"] and [item["reply"][k] for k in ("value", "type")],
        }
        for name, item in other.items()
        if isinstance(item, dict) and "sent" in item
    }
    return {
        "commands": {name: _command(item) for name, item in data["commands"].items()},
        "sequences": [_sequence(item) for item in data["ack_sequences"]],
        "changes": {c["case"]: [a[2] for a in c["all_acks"] if a[1] == 176] for c in data["mode_change_tests"]},
        "rates": [{"hz": t["setpoint_rate_hz"], "modes": [m[1] for m in t["modes"]]} for t in data["setpoint_rate_tests"]],
        "resume": data["setpoint_stream_resumes_after_loss"]["modes"],
        "targets": [
            {"system": t["target_system"], "modes": [m[1] for m in t["modes"]]} for t in data["setpoints_with_target_system"]
        ],
        "version": version,
        "interval_hz": other["set_message_interval_measured_hz"],
        "interval_us": other["get_message_interval_reply"]["interval_us"],
        "command_int": [a[0] for a in other["command_int_set_mode_hold"]],
        "set_mode": [a[1] for a in other["legacy_SET_MODE_hold"]["acks"]],
        "parameters": parameters,
        "listed": [other["param_request_list"][k] for k in ("n_received", "param_count_field")],
    }


def _command(item: Json) -> Json:
    first = item["repetitions"][0]
    return {
        "command": first["command"],
        "params": first["params"],
        "ack": None if item["ack"] == ["None"] else item["ack"][0],
        "texts": [[t["severity"], t["text"]] for t in first["statustext"]],
        "mode": item["mode_change_ms"][-1][1] if item["mode_change_ms"] else None,
    }


def _sequence(item: Json) -> Json:
    return {
        "case": item["case"],
        "command": item["command"],
        "acks": [[a["result"], a["target"]] for a in item["acks"]],
        "texts": [t[1] for t in item["texts"]],
        "modes": [m[1] for m in item["modes"]],
    }


def _lifecycle(data: Json) -> Json:
    takeoffs = [
        {
            "texts": [e["value"]["text"] for e in run["timeline"] if e["kind"] == "statustext"],
            "landed": [e["value"] for e in run["timeline"] if e["kind"] == "landed_state"],
            "detected_s": next(e["t_s"] for e in run["timeline"] if e["kind"] == "landed_state"),
            "loiter_s": [e["t_s"] for e in run["timeline"] if e["kind"] == "current_mode"][-1],
        }
        for run in data["takeoff"]["runs"]
    ]
    lands = [
        {
            "texts": [e["value"]["text"] for e in run["timeline"] if e["kind"] == "statustext"],
            "landed": [e["value"] for e in run["timeline"] if e["kind"] == "landed_state"],
            "detected_s": run["t_landing_detected_text"],
            "disarm_s": run["t_disarm_text"],
            "mode": run["mode_after_disarm"],
            "height_m": -run["start_z"],
        }
        for run in data["land"]["runs"]
    ]
    velocity = data["offboard_velocity_takeoff_from_ground"]
    return {
        "startup": data["startup"]["summary"],
        "startup_status": data["startup"]["runs"][0]["heartbeat_changes"],
        "takeoff": takeoffs,
        "climb_m_s": data["takeoff"]["summary"]["peak_climb_mps"],
        "land": lands,
        "auto_disarm_s": data["auto_disarm_after_arming_without_takeoff_s"],
        "velocity_takeoff": [
            {"landed": r["landed_states"], "rise_1m_s": r["t_rise_1m"], "texts": [t[1] for t in r["texts"]]} for r in velocity
        ],
    }


def _offboard_loss(data: Json) -> Json:
    keys = ("t_mode_change_s", "speed_at_loss", "t_speed_below_0p2_s", "distance_until_stop_m", "t_disarmed_s", "first_new_mode")
    rows = []
    for item in data["summary"]:
        texts = [t[1] for t in item["texts"][0]]
        row = {k: item[k] for k in keys} | {"loss_s": item["COM_OF_LOSS_T"], "action": item["COM_OBL_RC_ACT"]}
        rows.append(row | {"gcs": item["gcs_heartbeat"], "texts": texts, "modes": [m[1:] for m in item["modes_rep1"]]})
    return rows


def _odd_setpoints(data: Json) -> Json:
    keys = ("case", "frame", "type_mask", "values", "left_offboard", "modes_during", "vel_at_4s", "yaw_start", "yaw_end")
    rows = []
    for item in data["cases"]:
        echo = {k: float(v) for k, v in item["echo_POSITION_TARGET_LOCAL_NED"].items() if k in ("type_mask", "vx", "vy", "vz")}
        echo = {k: v for k, v in echo.items() if not math.isnan(v)}  # JSON has no NaN
        rows.append({k: item[k] for k in keys} | {"echo": echo, "texts": [t["text"] for t in item["statustext"]]})
    return rows


def _override(data: Json) -> Json:
    keys = ("case", "modes", "mode_end", "vel_end")
    rows = []
    for item in data["cases"]:
        acks = [a[0] for a in (item["command"] or {}).get("ack_seen_on_link", [])]
        texts = [[t[1]["severity"], t[1]["text"]] for t in item["statustext"]]
        rows.append({k: item[k] for k in keys} | {"acks": acks, "texts": texts, "status": [h[1:] for h in item["heartbeat_1hz"]]})
    return rows


def _geofence(data: Json) -> Json:
    """Per kind and action: the repetitions' values side by side."""
    groups: dict[str, Json] = {}
    for run in data["runs"]:
        group = groups.setdefault(
            f"{run['kind']}, GF_ACTION {run['GF_ACTION']}", {"kind": run["kind"], "action": run["GF_ACTION"], "runs": []}
        )
        keys = ("t_first_fence_text_after_cross", "t_mode_change_after_cross", "max_overshoot_m", "end_value_m", "limit_m")
        after = [m[0] - run["modes"][0][0] for m in run["modes"]]
        texts = [[t[1]["severity"], t[1]["text"]] for t in run["statustext"]]
        entry = {k: run[k] for k in keys} | {"modes": [m[1:] for m in run["modes"]], "after_s": after, "texts": texts}
        entry["status"] = [s[1] for s in run["system_status"]]
        entry["again"] = run.get("set_offboard_while_outside", {}).get("mode_after")
        entry["upload"] = [[m[1], m[3]] for m in run["upload"] or []]
        group["runs"].append(entry)
    return groups


def _failures(data: Json) -> Json:
    runs = {}
    for run in data["runs"]:
        states: list[list[float]] = []
        for at, percent, _, _, state in run["battery_changes_t_pct_mV_cA_chargestate"]:
            if not states or states[-1][1] != state:
                states.append([at, state, percent])
        runs[run["name"]] = {
            "modes": run["modes"],
            "texts": [[t[0], t[1]["severity"], t[1]["text"]] for t in run["statustext"]],
            "charge": states,
            "flags": [[f[0], f[1]] for f in run["estimator_flags_changes_t_flags_hacc"]],
            "gps": [f[1:] for f in run["gps_changes_t_fix_sats"]],
        }
    return {
        "runs": runs,
        "inject": {name: [item["params"], item["ack"]] for name, item in data["inject_ack"].items()},
        "inject_off": data["inject_with_SYS_FAILURE_EN_0"]["ack"],
    }


_CONDENSE: dict[str, Callable[[Json], Json]] = {
    "link_census": _census,
    "modes": _modes,
    "commands": _commands,
    "lifecycle": _lifecycle,
    "offboard_loss": _offboard_loss,
    "odd_setpoints": _odd_setpoints,
    "override": _override,
    "geofence": _geofence,
    "failures": _failures,
}
