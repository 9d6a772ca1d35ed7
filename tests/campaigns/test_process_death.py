"""How a run of the process-death matrix is recorded and judged; and that no fault can be asked for in `fly` itself."""

from __future__ import annotations

import math
import socket
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mav

from campaigns.death_scene import CELLS, Cell
from campaigns.process_death import Run, judge, markdown, summarise
from campaigns.wire_tap import ByteTap, Seen, Setpoint, WireTap

ROOT = Path(__file__).resolve().parents[2]
STRUCK_S, BOOT_S = 1000.0, 990.0
GOOD = Run(
    process="fly", fault="hang", seed=1, speed_m_s=1.0, late_moving=0, last_moving_s=None, first_still_s=0.08,
    last_setpoint_s=0.6, left_offboard_s=1.1, distance_m=0.7, final_speed_m_s=0.1, contacts=0,
    ended="PX4 failsafe (AUTO.LOITER)", exit_code=None,
)  # fmt: skip


class Wire:
    """What a relay would have recorded: setpoints at these times after the fault, moving or not."""

    def __init__(self, *found: tuple[float, float]) -> None:
        self._found = found

    def setpoints(self) -> list[Setpoint]:
        return [Setpoint(STRUCK_S + after_s, speed, 0.0) for after_s, speed in self._found]

    def seen(self) -> Seen:
        times = [STRUCK_S + 0.02 * k for k in range(-20, 60)]
        return Seen(
            [(t, t - BOOT_S) for t in times], [(STRUCK_S - 1.0, 6), (STRUCK_S + 1.0, 4 | 3 << 8)], [(t, 1.0) for t in times]
        )


def report(**event: object) -> dict[str, Any]:
    """Flies along x at 1 m/s, stands 0.5 s after the fault."""
    rows = []
    for k in range(-20, 80):
        after_s = 0.05 * k
        moving = after_s < 0.5
        rows.append([STRUCK_S - BOOT_S + after_s, min(after_s, 0.5), 0.0, 2.0, float(moving), 0.0, 0.0, 0.0])
    last = {"t": 11.0, "mode": "AUTO.LOITER", "armed": True, "failsafe": True} | event
    return {"trajectory": {"rows": rows}, "contacts": 0, "events": [last]}


def judged(*found: tuple[float, float], cell: Cell = CELLS[0], **event: object) -> Run:
    return judge(cell, 1, Wire(*found), STRUCK_S, report(**event), None)  # type: ignore[arg-type]


def test_a_good_run() -> None:
    run = judged((-0.05, 1.0), (0.02, 1.0), (0.1, 0.0), (0.15, 0.0))
    assert (run.late_moving, run.last_moving_s, run.first_still_s) == (0, 0.02, 0.1)
    assert run.left_offboard_s == pytest.approx(1.0)
    assert run.distance_m == pytest.approx(0.5, abs=0.051)
    assert run.speed_m_s == 1.0
    assert run.ended == "PX4 failsafe (AUTO.LOITER)"
    assert run.good


def test_one_late_moving_setpoint_is_too_many() -> None:
    run = judged((0.1, 0.0), (0.16, 1.0))
    assert run.late_moving == 1
    assert not run.good
    assert judged((0.16, 1.0), cell=Cell("LiDAR", "silent", bound_s=0.3)).late_moving == 0


@pytest.mark.parametrize("spoilt", [{"contacts": 1}, {"final_speed_m_s": 0.5}, {"ended": "OFFBOARD"}, {"late_moving": 1}])
def test_anything_wrong_is_not_good(spoilt: dict[str, Any]) -> None:
    assert GOOD.good
    assert not replace(GOOD, **spoilt).good


def test_landed_and_held_are_told_apart() -> None:
    assert judged(armed=False).ended == "landed"
    assert judged(failsafe=False).ended == "Hold by fly"
    assert judged(failsafe=False, mode="AUTO.LAND").ended == "landing"
    assert judged(failsafe=False, mode="OFFBOARD").ended == "OFFBOARD"


def test_the_table_has_the_worst_of_each_cell() -> None:
    result = summarise([GOOD, replace(GOOD, distance_m=0.9, first_still_s=0.12, contacts=1)], ["fly gil: never at full speed"])
    assert (result["runs"], result["good"], result["contacts"]) == (2, 1, 1)
    row = markdown(result).splitlines()[-1]
    assert row.startswith("| fly | hang | 2 | 0 | none | 120 ms | 1100 ms | 0.90 | 1 |")


def test_the_relay_passes_and_dates_what_it_records() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fly, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        fly.bind(("127.0.0.1", 0))
        port = free_pair(vehicle)
        vehicle.settimeout(2.0)
        fly.settimeout(2.0)
        packer = mav.MAVLink(None, 1, 1)
        with WireTap(port, fly.getsockname()[1]) as tap:
            position = mav.MAVLink_local_position_ned_message(5000, 0, 0, 0, 0.6, 0.8, 0).pack(packer)
            vehicle.sendto(position, ("127.0.0.1", port))
            data, relay = fly.recvfrom(500)
            assert data == position
            sent_s = time.monotonic()
            wanted = mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x5C7, 0, 0, 0, 0, 2.0, 0, 0, 0, 0, 0, 0)
            fly.sendto(wanted.pack(mav.MAVLink(None, 245, 192)), relay)
            vehicle.recvfrom(500)
            (setpoint,) = tap.setpoints()
            assert setpoint.speed_m_s == pytest.approx(2.0)
            assert setpoint.moving
            assert 0.0 <= setpoint.time_s - sent_s < 1.0
            assert tap.flying_speed_m_s() == pytest.approx(1.0)
            tap.mute = True
            vehicle.sendto(position, ("127.0.0.1", port))
            fly.settimeout(0.2)
            with pytest.raises(TimeoutError):
                fly.recvfrom(500)


def free_pair(vehicle: socket.socket) -> int:
    """Bind `vehicle` 40 above a free port; gives that port."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        try:
            vehicle.bind(("127.0.0.1", port + 40))
            return port
        except (OSError, OverflowError):
            continue


def test_a_muted_lidar_says_nothing_more() -> None:
    with ExitStack() as stack:
        device = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        tap = stack.enter_context(ByteTap(device.getsockname()[1]))
        client = stack.enter_context(socket.create_connection(("127.0.0.1", tap.port), 2.0))
        served = stack.enter_context(device.accept()[0])
        served.sendall(b"scan")
        assert client.recv(10) == b"scan"
        client.sendall(b"BM")
        assert served.recv(10) == b"BM"
        tap.mute = True
        served.sendall(b"scan")
        client.settimeout(0.2)
        with pytest.raises(TimeoutError):
            client.recv(10)


def test_every_process_is_struck_in_every_way_that_the_issue_names() -> None:
    faults = {(cell.process, cell.fault, cell.resume_s) for cell in CELLS}
    assert {("fly", fault, None) for fault in ("hang", "swallowed", "gil", "SIGSTOP", "SIGKILL", "SIGTERM")} <= faults
    assert {("guard", fault, None) for fault in ("SIGSTOP", "SIGKILL", "SIGTERM")} <= faults
    assert {(process, "SIGSTOP", resume_s) for process in ("fly", "guard") for resume_s in (1.0, 5.0)} <= faults
    assert all(cell.bound_s == 0.15 for cell in CELLS if cell.process in ("fly", "guard"))
    assert math.isfinite(max(cell.bound_s for cell in CELLS))


def test_the_flight_code_knows_no_sabotage() -> None:
    for path in (ROOT / "flight").rglob("*.py"):
        assert "sabotage" not in path.read_text().lower(), path
        assert "SIGUSR" not in path.read_text(), path
