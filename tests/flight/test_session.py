"""Whole flights in real time: the real command, the real gateway, a policy that seeks the goal.

The flights run side by side, each on its own ports, so that the whole file takes as long as one of them.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink
from stand import Program, Stand

from flight.recording_reader import read_recording
from flight.replay import compare

pytestmark = pytest.mark.realtime

FLYING = "the policy flies"
FLIGHT_S = 150.0


def to_the_goal(stand: Stand) -> tuple[int, Program]:
    program = stand.fly("--json")
    return program.finish(FLIGHT_S), program


def interrupted(stand: Stand) -> tuple[int, Program]:
    """Ctrl-C in flight, and twice more for the impatient."""
    program = stand.fly()
    program.wait_for(FLYING, FLIGHT_S)
    time.sleep(1.0)
    for _ in range(3):
        program.process.send_signal(signal.SIGINT)
        time.sleep(0.1)
    return program.finish(FLIGHT_S), program


def taken_over(stand: Stand) -> tuple[int, Program]:
    """A ground station switches to Hold in flight."""
    program = stand.fly()
    program.wait_for(FLYING, FLIGHT_S)
    time.sleep(1.0)
    hold_from_ground_station(stand.gcs_port)
    return program.finish(FLIGHT_S), program


def stopped_in_flight(stand: Stand) -> tuple[int, Program]:
    """SIGSTOP for a second and a half: the stream ends with the program, PX4 holds; then the program goes on."""
    program = stand.fly()
    program.wait_for(FLYING, FLIGHT_S)
    time.sleep(1.0)
    os.kill(program.process.pid, signal.SIGSTOP)
    time.sleep(1.5)
    os.kill(program.process.pid, signal.SIGCONT)
    return program.finish(FLIGHT_S), program


def terminated_in_takeoff(stand: Stand) -> tuple[int, Program]:
    program = stand.fly()
    program.wait_for("taking off", FLIGHT_S)
    time.sleep(3.0)
    program.process.send_signal(signal.SIGTERM)
    return program.finish(FLIGHT_S), program


def hold_from_ground_station(gcs_port: int) -> None:
    """COMMAND_LONG DO_SET_MODE Hold from 255/190 on the ground station link."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", gcs_port))
        sender = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        command = mavlink.MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 3, 0, 0, 0, 0)
        station.sendto(command.pack(sender), ("127.0.0.1", gcs_port + 4020))


Flown = dict[str, tuple[Stand, Future[tuple[int, Program]]]]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Iterator[Flown]:
    stories = (to_the_goal, interrupted, taken_over, stopped_in_flight, terminated_in_takeoff)
    with ThreadPoolExecutor(len(stories)) as pool:
        flights: Flown = {}
        for story in stories:
            stand = Stand(tmp_path_factory.mktemp(story.__name__), seeker_policy)
            flights[story.__name__] = (stand, pool.submit(story, stand))
            time.sleep(0.5)
        yield flights


def result(flown: Flown, story: Any) -> tuple[Stand, int, Program]:
    stand, future = flown[story.__name__]
    code, program = future.result()
    return stand, code, program


def gateway_report(stand: Stand) -> dict[str, Any]:
    return dict(json.loads((stand.folder / "run" / "gateway.json").read_text()))


def test_flies_to_the_goal_and_lands(flown: Flown) -> None:
    stand, code, program = result(flown, to_the_goal)
    assert code == 0, program.out + program.err
    summary = stand.summary()
    assert json.loads(program.out) == summary
    assert summary["outcome"] == "goal_reached"
    assert summary["goal_reached"] is True
    assert summary["landed"] is True
    assert summary["collisions"] == 0
    assert summary["geofence_breaches"] == 0
    assert summary["true_distance_to_goal_m"] < 0.5
    assert 2.5 < summary["path_length_m"] < 5.0
    assert summary["loop"]["ticks"] > 50
    assert 19.0 < summary["loop"]["rate_hz"] < 20.5
    assert 0.0 < summary["loop"]["scan_to_setpoint_ms"]["p50"] < 150.0
    assert gateway_report(stand)["events"][-1]["armed"] is False


def test_writes_the_run_folder(flown: Flown) -> None:
    stand, _, _ = result(flown, to_the_goal)
    folder = stand.folder / "run"
    assert (folder / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    report = (folder / "report.html").read_text(encoding="utf-8")
    assert all(title in report for title in ("Map of the flight", "LiDAR ranges over time", "Histogram: From scan to setpoint"))
    with (folder / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    stalled = len([event for event in stand.summary()["failsafe_events"] if "stalled" in event])
    assert len(rows) == stand.summary()["loop"]["ticks"] - stalled
    assert float(rows[-1]["x_m"]) == pytest.approx(4.5, abs=0.6)


def test_the_recording_replays_bit_for_bit(flown: Flown) -> None:
    stand, _, _ = result(flown, to_the_goal)
    recording = read_recording(stand.folder / "run" / "flight.mcap")
    compared = compare(recording)
    assert compared.identical, compared.first
    summary = stand.summary()
    assert compared.ticks == summary["recording"]["ticks"] == summary["loop"]["ticks"]
    assert summary["recording"]["dropped"] == 0
    assert "goal_reached" in recording.events[-1][1]


def test_ctrl_c_brakes_holds_and_lands_however_often_it_is_pressed(flown: Flown) -> None:
    stand, code, program = result(flown, interrupted)
    assert code == 1, program.out + program.err
    summary = stand.summary()
    assert summary["outcome"] == "stopped"
    assert summary["landed"] is True
    modes = [event["mode"] for event in gateway_report(stand)["events"]]
    assert modes.index("OFFBOARD") < modes.index("AUTO.LAND")
    assert "AUTO.LOITER" in modes[modes.index("OFFBOARD") :]
    assert gateway_report(stand)["events"][-1]["armed"] is False


def test_a_mode_it_did_not_command_ends_its_control_for_good(flown: Flown) -> None:
    stand, code, program = result(flown, taken_over)
    assert code == 1, program.out + program.err
    assert stand.summary()["outcome"] == "pilot_took_over"
    assert "HOLD was not commanded by fly" in program.out
    last = gateway_report(stand)["events"][-1]
    assert last["mode"] == "AUTO.LOITER"
    assert last["armed"] is True


def test_a_stopped_program_leaves_the_vehicle_to_px4(flown: Flown) -> None:
    """No stream outlives the program: the guard brakes and falls silent, PX4's own loss action comes, and nothing follows it."""
    stand, code, program = result(flown, stopped_in_flight)
    assert (code, stand.summary()["outcome"]) == (4, "loop_stalled"), program.out + program.err
    last = gateway_report(stand)["events"][-1]
    assert (last["mode"], last["failsafe"]) == ("AUTO.LOITER", True)


def test_sigterm_during_takeoff_lands(flown: Flown) -> None:
    stand, code, program = result(flown, terminated_in_takeoff)
    assert code == 1, program.out + program.err
    summary = stand.summary()
    assert summary["outcome"] == "stopped"
    assert summary["landed"] is True
    assert summary["loop"]["ticks"] == 0
    assert gateway_report(stand)["events"][-1]["armed"] is False


def test_the_status_is_shown_in_plain_lines_without_a_terminal(flown: Flown) -> None:
    _, _, program = result(flown, interrupted)
    assert "preflight" in program.out
    assert "setpoint loss" in program.out
    assert "\x1b[" not in program.out


def test_no_child_is_left_behind(flown: Flown) -> None:
    for stand, future in flown.values():
        future.result()
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", stand.lidar_port))
