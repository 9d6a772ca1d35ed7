"""The same faults in real time: the `fly` command over MAVSDK against the running gateway, one short flight each.

The gateway injects the fault three seconds after OFFBOARD and writes down when each setpoint arrived and each mode began; nothing
is asked of `fly` itself. A setpoint is counted when it arrives at the autopilot, so the bound grows by `SLACK_S`: the sample's
period, both wires, and a machine that other programs use too.
"""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from campaigns.faults.campaign import ENTRIES, Result, result_of, summarise
from campaigns.faults.catalogue import Entry, Reaction
from campaigns.faults.oracle import judge
from campaigns.faults.run import Case
from campaigns.faults.stage import Trace
from campaigns.ports import free_port
from campaigns.realtime import fence_margin_m
from flight.mission import load_mission
from flight.px4 import COMMAND_DO_SET_MODE
from sim_gateway.faults import Fault
from sim_gateway.flight_modes import FlightMode

SCENE = "real time"
SLACK_S = 0.15
BEGIN_S = 3.0
DEADLINE_S = 240.0
GUARD = (245, 192)
FLOWN = (
    *("L1", "L2", "L3", "L4", "L5", "L6", "L8", "L11", "L14", "E1", "E2", "E3", "E4", "E6", "E8", "E9", "E10", "E11"),
    *("K1", "K2", "K4", "K5", "K6", "K7", "K8", "K9", "K11", "V1", "V3", "V4", "V6", "V9"),
)
WORLD = """\
kind: boxes
boxes:
  start: [1.0, 0.0, 0.0]
  goal: [13.0, 0.3, 2.0]
  boxes:
    - {center: [8.0, 2.6, 2.0], size: [20.0, 0.2, 4.0]}
    - {center: [8.0, -2.8, 2.0], size: [20.0, 0.2, 4.0]}
    - {center: [9.0, 1.6, 2.0], size: [0.5, 0.5, 4.0]}
"""
MISSION = """\
name: faults
vehicle: {{connection: sim}}
policy: {{path: {policy}}}
frame: {{takeoff_point_m: world, heading_deg: 0}}
takeoff_height_m: 2.0
goal: {{position_m: world, radius_m: 0.3}}
lidar: {{port: {lidar_port}}}
safety:
  fence: {{min_m: [-1.0, -2.7, 0.5], max_m: [16.0, 2.5, 4.0]}}
recording: {{enabled: false}}
timeouts: {{flight_s: 40.0, land_s: 40.0}}
sim:
  world: {world}
  seed: 1
  onboard_port: {onboard_port}
  gcs_port: {gcs_port}
  faults: {faults}
"""


def text_of(fault: Fault) -> str:
    """The fault in the words of the command line, counted from OFFBOARD."""
    lasting = f"+{fault.duration_s!r}" if fault.duration_s is not None else ""
    given = ",".join(f"{name}={value!r}" for name, value in fault.parameters.items())
    return f"{fault.kind}@offboard:{BEGIN_S + fault.start_s!r}{lasting}" + (f":{given}" if given else "")


def write_mission(entry: Entry, policy: Path, folder: Path) -> Path:
    """World and mission of one flight, on free ports."""
    world, mission = folder / "world.yaml", folder / "mission.yaml"
    world.write_text(WORLD)
    onboard, ground = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    faults = json.dumps([text_of(fault) for fault in entry.faults])
    ports = {"onboard_port": onboard, "gcs_port": ground, "lidar_port": free_port(socket.SOCK_STREAM)}
    mission.write_text(MISSION.format(policy=policy.resolve(), world=world, faults=faults, **ports))
    return mission


def fly(entry: Entry, policy: Path) -> Result:
    """One flight of the real command, judged at the autopilot's side."""
    with TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name)
        mission = write_mission(entry, policy, folder)
        command = [sys.executable, "-m", "flight", "--mission", str(mission), "--out", str(folder / "run")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
        report = _read(folder / "run" / "gateway.json")
        if not report.get("faults"):
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            return Result(entry.id, SCENE, 1, entry.expected.reaction.value, f"not flown: {said}")
        summary = _read(folder / "run" / "summary.json")
        return _judged(entry, report, summary, fence_margin_m(report, load_mission(mission).safety))


def _read(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return content


def _judged(entry: Entry, report: dict[str, Any], summary: dict[str, Any], margin_m: float | None) -> Result:
    expected = replace(entry.expected, rules=(), bound_s=entry.expected.bound_s + SLACK_S)
    trace = trace_of(report, entry.felt_after_s)
    trace.fence_margin_m = math.inf if margin_m is None else margin_m
    outcome = str(summary.get("outcome", "no summary"))
    timed = expected.reaction in (Reaction.BRAKE, Reaction.HOLD, Reaction.YIELD, Reaction.STOP)
    verdict = judge(trace, expected if timed else replace(expected, reaction=Reaction.SAFE))
    verdict = replace(verdict, outcome=outcome)
    if expected.reaction is Reaction.FLY and outcome != "goal_reached":
        verdict = replace(verdict, problem=f"the flight ended: {summary.get('message', outcome)}")
    return result_of(Case(entry.id, SCENE, 1), expected.reaction.value, expected.bound_s if timed else None, verdict)


def trace_of(report: dict[str, Any], felt_after_s: float = 0.0) -> Trace:
    """What the gateway's report says, in the words of a lockstep run: setpoints as they arrived, modes as they began."""
    begin_s = float(report["faults"][0]["begin_s"])
    trace = Trace(begin_s, felt_s=begin_s + felt_after_s, contacts=int(report.get("contacts") or 0))
    trace.sent = [(row[0], (row[1], row[2], row[3], row[4])) for row in report["setpoints"]["rows"] if tuple(row[5:7]) == GUARD]
    modes = {mode.px4_name: mode for mode in FlightMode}
    for event in report["events"]:
        mode = modes[event["mode"]]
        trace.modes.append((event["t"], mode, event["failsafe"]))
        if event["t"] >= trace.felt_s and not event["failsafe"] and mode in (FlightMode.LOITER, FlightMode.LAND):
            trace.commands.append((event["t"], COMMAND_DO_SET_MODE, 4.0, float(mode.sub)))
    trace.end_s = float(report["duration_s"])
    return trace


def fly_all(mission_file: Path, only: list[str] | None, command: str, keep: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """One flight after the other; each is told as soon as it is over, and `keep` gets all results so far."""
    policy = load_mission(mission_file).policy.path
    if unknown := set(only or ()) - set(FLOWN):
        raise ValueError(f"not flown in real time: {', '.join(sorted(unknown))}; there are: {', '.join(FLOWN)}")
    chosen = [ENTRIES[name] for name in FLOWN if only is None or name in only]
    results = []
    for entry in chosen:
        result = fly(entry, policy)
        results.append(result)
        took = "" if result.reaction_s is None else f", {1e3 * result.reaction_s:.0f} ms"
        sys.stderr.write(f"{entry.id} {entry.title}: {result.problem or 'right'}{took}; {result.outcome}\n")
        sys.stderr.flush()
        keep(_summary(results, command))
    return _summary(results, command)


def _summary(results: list[Result], command: str) -> dict[str, Any]:
    return summarise(results, command, 1) | {"kind": "fault campaign in real time", "slack_s": SLACK_S}
