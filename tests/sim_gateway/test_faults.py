"""Faults on demand: records, their texts and files, and what each kind does to the simulated vehicle."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import development as mav

from sim_gateway.faults import KINDS, Fault, FaultError, load_faults
from sim_gateway.flight_modes import FlightMode
from sim_gateway.gateway import connect_faults
from sim_gateway.lidar import LidarConfig
from sim_gateway.link_faults import RawBytes
from sim_gateway.mavlink_links import MemoryLink
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.readings import Scan
from sim_gateway.scene import World, box_row
from sim_gateway.setpoints import OffboardSetpoint
from sim_gateway.simulation import Simulation
from sim_gateway.stream_rates import ONBOARD
from sim_gateway.telemetry import Telemetry
from strict_yaml import ConfigError

WALLS = np.vstack([box_row((5.0, 3.0, 2.0), (20.0, 0.2, 4.0)), box_row((5.0, -2.0, 2.0), (20.0, 0.2, 4.0))])
WORLD = World("two walls", 0, 15.0, 6.0, 4.0, WALLS, (), (1.0, 0.0, 0.0), 0.0, (10.0, 0.0, 2.0))
BEGIN_S = 1.0


class Rig:
    """A hovering vehicle with its autopilot and one link in memory, and what came over it."""

    def __init__(self, *faults: Fault, airborne: bool = True) -> None:
        simulation = Simulation(WORLD, lidar=LidarConfig.device(), estimate="none", hover_height_m=2.0 if airborne else None)
        self.vehicle = PilotedVehicle(simulation, ready_after_s=0.0)
        self.pilot = self.vehicle.autopilot
        self.telemetry = Telemetry(self.pilot, self.vehicle.frame, self.vehicle.snapshot, lambda: self.vehicle.time_s)
        self.link = MemoryLink("onboard", ONBOARD, lambda: self.vehicle.time_s)
        self.server = MavlinkServer(self.pilot, self.vehicle.frame, self.telemetry, links=[self.link])
        self.incidents = connect_faults(self.vehicle, self.server, self.telemetry, seed=3)
        for fault in faults:
            simulation.inject(fault)
        self.scans: list[tuple[float, Scan]] = []
        self.messages: list[tuple[float, Any]] = []
        self.fly: tuple[float, float, float] | None = None

    def run(self, seconds: float) -> Rig:
        for _ in range(round(seconds / 0.004)):
            if self.fly is not None:
                self.pilot.set_setpoint(OffboardSetpoint(velocity=self.fly, yaw_rate_rad_s=0.0))
            self.vehicle.advance(1)
            if self.vehicle.simulation.steps % 12 == 0:
                self.scans += [(self.vehicle.time_s, scan) for scan in self.vehicle.simulation.device_scans()]
            self.incidents.step()
            self.server.poll()
            self.messages += [(self.vehicle.time_s, message) for message in self.link.outbox]
            self.link.outbox.clear()
        return self

    def offboard(self, *velocity: float) -> Rig:
        """Armed, in the air, in OFFBOARD under a steady velocity setpoint (NED)."""
        self.fly = (velocity[0], velocity[1], velocity[2])
        self.run(0.1)
        assert self.pilot.set_mode(FlightMode.OFFBOARD) == 0
        self.pilot.arm(force=True)
        self.pilot.landed = False
        return self

    def named(self, name: str, since_s: float = BEGIN_S) -> list[tuple[float, Any]]:
        kept = [(t, m) for t, m in self.messages if t >= since_s and not isinstance(m, RawBytes)]
        return [(t, m) for t, m in kept if m.get_type() == name]

    def newest(self) -> Scan:
        return self.scans[-1][1]


def fault(kind: str, duration_s: float | None = None, **parameters: float) -> Fault:
    return Fault(kind=kind, start_s=BEGIN_S, duration_s=duration_s, parameters=parameters)


# -- records


def test_texts_are_records() -> None:
    assert Fault.parse("lidar_freeze@12+3") == Fault(kind="lidar_freeze", start_s=12.0, duration_s=3.0)
    jump = Fault.parse("estimate_jump@offboard:5:y_m=1.5,x_m=-2")
    assert (jump.after, jump.start_s, jump.duration_s, jump["y_m"], jump["x_m"], jump["z_m"]) == (
        "offboard",
        5.0,
        None,
        1.5,
        -2,
        0,
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("lidar_freeze", "write kind@start"),
        ("lidar_freze@1", "no fault is called 'lidar_freze'; there are: lidar_silent"),
        ("lidar_noise@1:sigma=2", "no parameter 'sigma'; it has: sigma_m"),
        ("lidar_noise@1:sigma_m=x", "not a number"),
        ("disarm@1+2", "happens at once"),
        ("lidar_max@landed:1", "'start', 'armed' or 'offboard'"),
        ("lidar_noise@1:sigma_m=nan", "finite"),
        ("lidar_max@1..2", "not a number"),
    ],
)
def test_a_text_that_is_no_fault_says_what_to_write(text: str, said: str) -> None:
    with pytest.raises(FaultError, match=said):
        Fault.parse(text)


def test_scenario_file(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(
        "faults:\n  - {kind: lidar_freeze, start_s: 12, duration_s: 3}\n  - {kind: battery, start_s: 20, after: armed}\n"
    )
    assert [f.kind for f in load_faults(path)] == ["lidar_freeze", "battery"]
    path.write_text("faults:\n  - {kind: lidar_freeze, start: 12}\n")
    with pytest.raises(ConfigError, match=r"faults.yaml:2: faults.0.start: unknown key"):
        load_faults(path)
    with pytest.raises(ValidationError, match="no fault is called"):
        Fault(kind="nothing")


def test_faults_wait_for_their_event() -> None:
    rig = Rig(Fault(kind="lidar_max", start_s=0.2, duration_s=0.3, after="offboard"))
    rig.run(0.5).offboard(0.0, 0.0, 0.0).run(1.0)
    begun = rig.vehicle.simulation.faults.placed[0].begin_s
    blank = [t for t, scan in rig.scans if np.isinf(scan.ranges_m).all()]
    assert begun == pytest.approx(0.8, abs=0.03)
    assert blank
    assert all(begun <= t < begun + 0.3 for t in blank)


def test_the_same_faults_give_the_same_bytes_however_time_is_cut() -> None:
    states = []
    for pieces in (1, 5, 125):
        simulation = Simulation(WORLD, seed=4, hover_height_m=2.0)
        simulation.inject(Fault(kind="gust", start_s=0.1, duration_s=0.4))
        simulation.inject(Fault(kind="estimate_drift", start_s=0.2))
        for _ in range(250 // pieces):
            simulation.advance(pieces, (0.5, 0.0, 0.0), 0.0)
        states.append(simulation.state_row.tobytes())
    assert states[0] == states[1] == states[2]


def test_every_kind_runs_and_does_something() -> None:
    """Each kind changes scans, messages, motion or mode against the same flight without it."""

    def trace(*faults: Fault) -> bytes:
        rig = Rig(*faults).offboard(0.3, 0.1, 0.0)
        rig.run(1.2)
        scans = b"".join(scan.ranges_m.tobytes() + np.float64(scan.time_s).tobytes() for _, scan in rig.scans)
        told = "".join(repr((t, m.data if isinstance(m, RawBytes) else m.to_dict())) for t, m in rig.messages)
        return scans + told.encode() + rig.vehicle.simulation.state_row.tobytes()

    quiet = trace()
    alike = [kind for kind in KINDS if trace(fault(kind)) == quiet]
    # no commands here that could be lost, refused or overwritten for longer than a step; sticks do nothing by default
    assert set(alike) <= {"link_up", "refuse_offboard", "rogue", "pilot_sticks"}


# -- LiDAR


def test_lidar_faults_change_the_scan_only_while_they_last() -> None:
    for kind, check in {
        "lidar_max": lambda r: np.isinf(r).all(),
        "lidar_min": lambda r: (r == 0.0).all(),
        "lidar_nan": lambda r: np.isnan(r).all(),
        "lidar_beams": lambda r: r.size == 180,
        "lidar_phantom": lambda r: r[180] == np.float32(0.5),
        "lidar_sector": lambda r: np.isnan(r[180]) and not np.isnan(r[0]),
    }.items():
        rig = Rig(fault(kind, 0.5)).run(1.3)
        assert check(rig.newest().ranges_m), kind
        healthy = Rig().run(1.3).newest().ranges_m
        assert not check(healthy), kind
        assert np.array_equal(rig.run(0.5).newest().ranges_m, Rig().run(1.8).newest().ranges_m), kind


def test_frozen_scans_have_new_or_old_stamps() -> None:
    fresh, old = Rig(fault("lidar_freeze", 1.0)).run(1.5), Rig(fault("lidar_freeze_old", 1.0)).run(1.5)
    frozen = [scan for t, scan in fresh.scans if t >= BEGIN_S]
    assert all(np.array_equal(scan.ranges_m, frozen[0].ranges_m) for scan in frozen)
    assert all(scan.time_s == t for t, scan in fresh.scans)
    assert {scan.time_s for t, scan in old.scans if t >= BEGIN_S} == {max(t for t, _ in old.scans if t < BEGIN_S)}


def test_late_slow_and_silent_scans() -> None:
    late = Rig(fault("lidar_delay", 1.0, delay_s=0.2)).run(1.9)
    delays = [t - scan.time_s for t, scan in late.scans if 1.3 < t < 1.9]
    assert delays
    assert all(0.19 < delay < 0.26 for delay in delays)
    assert len(Rig(fault("lidar_slow", 1.0, every=4.0)).run(1.9).scans) < len(late.scans) - 8
    assert not [t for t, _ in Rig(fault("lidar_silent")).run(2.0).scans if t >= BEGIN_S]


# -- estimate and vehicle


def test_a_jump_moves_the_estimate_and_not_the_vehicle() -> None:
    rig = Rig(fault("estimate_jump", y_m=1.0)).run(1.2)
    simulation = rig.vehicle.simulation
    assert simulation.estimate().position_m[1] - simulation.truth.position_m[1] == pytest.approx(1.0)
    assert abs(simulation.truth.position_m[1]) < 0.05


def test_a_velocity_error_makes_the_vehicle_drift() -> None:
    rig = Rig(fault("estimate_velocity", y_m_s=0.5)).offboard(0.0, 0.0, 0.0).run(4.0)
    truth, estimate = rig.vehicle.simulation.truth, rig.vehicle.simulation.estimate()
    assert truth.velocity_m_s[1] == pytest.approx(-0.5, abs=0.1)
    assert estimate.velocity_m_s[1] == pytest.approx(0.0, abs=0.1)


def test_with_a_wrong_yaw_it_flies_elsewhere() -> None:
    rig = Rig(fault("estimate_yaw", offset_deg=90.0)).offboard(0.5, 0.0, 0.0).run(4.0)
    vx, vy, _ = rig.vehicle.simulation.truth.velocity_m_s
    assert (vx, vy) == pytest.approx((0.0, -0.5), abs=0.1)


def test_wind_gust_and_weakness() -> None:
    def reach(*faults: Fault) -> float:
        return Rig(*faults).offboard(0.0, 0.0, 0.0).run(2.5).vehicle.simulation.truth.position_m[0]

    assert reach(fault("wind")) > reach() + 0.1
    assert reach(fault("gust", 1.5)) > reach() + 0.1
    slow = Rig(fault("sluggish")).offboard(1.0, 0.0, 0.0).run(1.6).vehicle.simulation.truth.velocity_m_s[0]
    fast = Rig().offboard(1.0, 0.0, 0.0).run(1.6).vehicle.simulation.truth.velocity_m_s[0]
    assert slow < fast
    weak = Rig(fault("motor_weak", share=0.45)).offboard(0.0, 0.0, 0.0).run(2.0)
    assert weak.vehicle.simulation.truth.velocity_m_s[2] < -0.2


# -- reports


def test_reports_freeze_go_back_and_lie() -> None:
    def places(kind: str, **parameters: float) -> list[tuple[float, Any]]:
        rig = Rig(fault(kind, 0.5, **parameters)).offboard(0.5, 0.0, 0.0).run(1.3)
        return rig.named("LOCAL_POSITION_NED", BEGIN_S + 0.05)

    frozen = places("report_freeze")
    assert len({m.x for _, m in frozen}) == 1
    assert len({m.time_boot_ms for _, m in frozen}) == len(frozen)
    assert len({m.time_boot_ms for _, m in places("report_stale")}) == 1
    assert all(math.isnan(m.x) for _, m in places("report_nan"))
    assert all(t - m.time_boot_ms * 1e-3 == pytest.approx(0.3, abs=0.01) for t, m in places("report_backwards"))
    assert places("report_silent") == []


def test_estimator_status_and_reset_counter_are_told() -> None:
    rig = Rig(fault("report_invalid"), fault("report_reset"), fault("estimate_drift", y_m_s=0.5)).run(3.0)
    _, status = rig.named("ESTIMATOR_STATUS")[-1]
    assert not status.flags & 6
    assert status.pos_horiz_accuracy > 0.9
    assert rig.named("ODOMETRY")[-1][1].reset_counter == 1


# -- links


def test_link_faults() -> None:
    def heard(kind: str, **parameters: float) -> list[tuple[float, Any]]:
        return Rig(fault(kind, 1.0, **parameters)).run(1.9).named("ATTITUDE", BEGIN_S + 0.3)

    healthy = len(Rig().run(1.9).named("ATTITUDE", BEGIN_S + 0.3))
    assert heard("link_down") == []
    assert 0.4 * healthy < len(heard("link_loss", share=0.3)) < 0.9 * healthy
    assert len(heard("link_duplicate")) > 1.2 * healthy
    assert all(t - m.time_boot_ms * 1e-3 == pytest.approx(0.3, abs=0.01) for t, m in heard("link_delay"))
    times = [m.time_boot_ms for _, m in heard("link_reorder")]
    assert times != sorted(times)
    garbage = [m for _, m in Rig(fault("link_garbage")).run(2.0).messages if isinstance(m, RawBytes)]
    assert 40 <= len(garbage) <= 60
    flood = [m for _, m in Rig(fault("link_flood", 0.5)).run(1.5).messages if isinstance(m, RawBytes)]
    texts = mav.MAVLink(None).parse_buffer(b"".join(m.data for m in flood))
    assert len(texts) == pytest.approx(5000, rel=0.05)
    assert {m.text for m in texts} == {"flood"}


def test_uplink_loss_ends_in_the_loss_action() -> None:
    rig = Rig(fault("link_up"))
    rig.pilot.parameters.set("COM_OBL_RC_ACT", 5)
    rig.offboard(0.0, 0.0, 0.0)
    rig.fly = None
    rig.run(2.0)
    assert rig.pilot.mode is FlightMode.LOITER
    assert rig.pilot.failsafe


# -- incidents


@pytest.mark.parametrize(
    ("kind", "parameters", "mode"),
    [
        ("pilot_mode", {}, FlightMode.LOITER),
        ("pilot_mode", {"main": 3.0, "sub": 0.0}, FlightMode.POSCTL),
        ("px4_failsafe", {}, FlightMode.RTL),
        ("rogue_mode", {}, FlightMode.LAND),
    ],
)
def test_who_changes_the_mode(kind: str, parameters: dict[str, float], mode: FlightMode) -> None:
    rig = Rig(fault(kind, **parameters)).offboard(0.0, 0.0, 0.0).run(1.4)
    assert rig.pilot.mode is mode
    assert not [m for m in rig.pilot.mode_changes if m.mode is FlightMode.OFFBOARD and m.time_s > BEGIN_S]


def test_sticks_take_over_where_the_parameter_says_so() -> None:
    rig = Rig(fault("pilot_sticks"))
    rig.pilot.parameters.set("COM_RC_OVERRIDE", 3)
    rig.offboard(0.0, 0.0, 0.0).run(1.3)
    assert rig.pilot.mode is FlightMode.OFFBOARD
    assert rig.run(0.5).pilot.mode is FlightMode.POSCTL


def test_kill_and_restart_stop_the_motors() -> None:
    killed = Rig(fault("disarm")).offboard(0.0, 0.0, 0.0).run(1.5)
    assert not killed.pilot.armed
    restarted = Rig(fault("reboot")).offboard(0.0, 0.0, 0.0).run(2.5)
    assert not restarted.pilot.armed
    assert restarted.named("LOCAL_POSITION_NED")[-1][1].time_boot_ms < 1600
    assert restarted.vehicle.simulation.truth.position_m[2] < 0.5


def test_gps_loss_descends_after_five_seconds_as_recorded() -> None:
    rig = Rig(fault("gps_loss")).offboard(0.0, 0.0, 0.0).run(5.5)
    assert rig.named("GPS_RAW_INT")[-1][1].fix_type == 0
    assert rig.pilot.mode is FlightMode.OFFBOARD
    assert rig.run(1.0).pilot.mode is FlightMode.ALTCTL
    assert rig.run(1.0).vehicle.simulation.truth.velocity_m_s[2] == pytest.approx(-0.8, abs=0.2)


def test_low_battery_warns_holds_and_lands_as_recorded() -> None:
    rig = Rig(fault("battery", fraction=0.12)).offboard(0.0, 0.0, 0.0).run(2.0)
    assert rig.named("SYS_STATUS")[-1][1].battery_remaining == 12
    assert rig.pilot.mode is FlightMode.OFFBOARD
    rig = Rig(fault("battery", fraction=0.04)).offboard(0.0, 0.0, 0.0).run(2.0)
    assert rig.pilot.mode is FlightMode.LOITER
    assert rig.run(5.0).pilot.mode is FlightMode.LAND


def test_another_program_moves_the_vehicle() -> None:
    rig = Rig(fault("rogue", x_m_s=0.5)).offboard(0.0, 0.0, 0.0).run(0.5)
    rig.fly = None
    rig.run(3.0)
    assert rig.vehicle.simulation.truth.velocity_m_s[0] == pytest.approx(0.5, abs=0.1)
    assert {item.sender for item in rig.server.wire_log.entries} == {(200, 191)}


# -- MAV_CMD_INJECT_FAILURE


def inject(rig: Rig, unit: int, kind: int) -> list[int]:
    from pymavlink.dialects.v20 import development as mav

    message = mav.MAVLink_command_long_message(1, 1, mav.MAV_CMD_INJECT_FAILURE, 0, unit, kind, 0, 0, 0, 0, 0)
    message.pack(mav.MAVLink(None, srcSystem=245, srcComponent=191))
    rig.messages.clear()
    rig.link.inbox.append(message)
    rig.run(0.2)
    return [m.result for _, m in rig.named("COMMAND_ACK", 0.0)]


def test_inject_failure_needs_its_parameter_and_answers_as_recorded() -> None:
    rig = Rig().run(1.0)
    rig.pilot.parameters.set("SYS_FAILURE_EN", 0)
    assert inject(rig, 4, 1) == [2]
    rig.pilot.parameters.set("SYS_FAILURE_EN", 1)
    assert inject(rig, 0, 1) == []
    assert inject(rig, 101, 1) == [0]
    assert inject(rig, 4, 1) == [0]
    assert not rig.pilot.gps_fix
    assert inject(rig, 4, 0) == [0]
    assert rig.pilot.gps_fix
    assert inject(rig, 100, 1) == [0]
    assert rig.run(5.0).pilot.battery.percent == 0
