"""What the autopilot says about itself reaches the safety layer, and its recording reaches the replay."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from flight_records import record
from hypothesis import given
from hypothesis import strategies as st
from recorded_flight import SAFETY, header_of

from campaigns.lockstep import LockstepFlight, StackConfig
from flight.authority import Authority
from flight.health import health_of
from flight.mission import load_mission
from flight.offboard import FlightJudge
from flight.px4 import FlightMode
from flight.recorder import Recorder
from flight.recording_config import RecordingConfig
from flight.recording_reader import read_recording
from flight.recording_schema import TickSample, decode_tick, encode_tick, from_plain, to_plain
from flight.replay import compare
from flight.telemetry import Telemetry
from policy_export.runner import PolicyRunner
from safety.escalation import Level
from safety.frames import CorridorFrame, CorridorVector, NedVector
from safety.messages import Health, Verdict
from sim_gateway.world import load_world

ROOT = Path(__file__).parents[2]
EAST = CorridorFrame(NedVector(0.0, 0.0, 0.0), math.pi / 2)
ODOMETRY = {"time_usec": 5_000_000, "reset_counter": 7, "pose_covariance": [None] * 21}
ESTIMATOR = {"time_usec": 5_000_000, "flags": 0x33F, "pos_horiz_accuracy": 0.3}
TARGET = {"time_boot_ms": 5000, "vx": 0.0, "vy": 0.5, "vz": -0.25}


def told(*messages: tuple[str, dict[str, object]], arrival_s: float = 100.0) -> Telemetry:
    telemetry = Telemetry()
    for name, fields in messages:
        telemetry.feed(name, 1, json.dumps(fields), arrival_s)
    return telemetry


def test_nothing_heard_is_unknown() -> None:
    health = health_of(Telemetry(), EAST, 0.001)
    assert to_plain(health) == to_plain(Health(lateness_s=0.001, boots=0))


def test_everything_heard_is_told_in_the_corridor_frame() -> None:
    telemetry = told(("ODOMETRY", ODOMETRY), ("ESTIMATOR_STATUS", ESTIMATOR), ("POSITION_TARGET_LOCAL_NED", TARGET))
    telemetry.feed("SYS_STATUS", 1, json.dumps({"battery_remaining": 40}), 100.0)
    telemetry.feed("TIMESYNC", 1, json.dumps({"tc1": int(5e9), "ts1": int(99.8e9)}), 100.0)
    assert telemetry.dropped == 0
    health = health_of(telemetry, EAST, 0.001, Authority(telemetry), overruled=True)
    assert (health.estimate_valid, health.accuracy_m, health.battery_fraction, health.in_control) == (True, 0.3, 0.4, True)
    assert health.link_delay_s == pytest.approx(0.2)
    assert health.echo is not None
    assert (health.echo.x, health.echo.y, health.echo.z) == pytest.approx((0.5, 0.0, 0.25))  # flying east is ahead
    assert health.echo_time_s == pytest.approx(100.0)
    assert (health.landed, health.boots, health.overruled) == (False, 0, True)


def test_reset_counter_is_part_of_the_state() -> None:
    motion = {"time_boot_ms": 5000, "x": 0, "y": 0, "z": 0, "vx": 0, "vy": 0, "vz": 0}
    attitude = {"time_boot_ms": 5000, "roll": 0, "pitch": 0, "yaw": 0, "yawspeed": 0}
    imu = {"time_usec": 5_000_000, "xacc": 0, "yacc": 0, "zacc": -9.8}
    telemetry = told(("LOCAL_POSITION_NED", motion), ("ATTITUDE", attitude), ("HIGHRES_IMU", imu))
    assert (state := telemetry.state(EAST)) is not None
    assert state.reset_counter is None
    telemetry.feed("ODOMETRY", 1, json.dumps(ODOMETRY), 100.0)
    assert (state := telemetry.state(EAST)) is not None
    assert state.reset_counter == 7


@pytest.mark.parametrize(
    ("flags", "valid"),
    [(0x33F, True), (0x2F, True), (0x37, True), (0x27, False), (0x3E, False), (0x3D, False), (0x3B, False), (0x1F, False)],
)
def test_estimator_flags(flags: int, valid: bool) -> None:
    """Attitude, both velocities, height, and relative or absolute position are all needed; 0x27 is PX4 before its position."""
    assert told(("ESTIMATOR_STATUS", ESTIMATOR | {"flags": flags})).report.estimate_valid is valid


def test_setpoint_without_velocity_is_no_echo() -> None:
    telemetry = told(("POSITION_TARGET_LOCAL_NED", TARGET), ("POSITION_TARGET_LOCAL_NED", TARGET | {"vx": None}))
    assert telemetry.report.echo is None
    assert telemetry.dropped == 0


def test_who_has_the_vehicle_is_told() -> None:
    telemetry = told(("HEARTBEAT", {"autopilot": 12, "base_mode": 0x81, "custom_mode": FlightMode.OFFBOARD << 16}))
    authority = Authority(telemetry)
    assert health_of(telemetry, EAST, 0.0, authority).in_control is True
    telemetry.feed(
        "HEARTBEAT", 1, json.dumps({"autopilot": 12, "base_mode": 0x81, "custom_mode": FlightMode.POSCTL << 16}), 101.0
    )
    assert health_of(telemetry, EAST, 0.0, authority).in_control is False
    assert health_of(telemetry, EAST, 0.0).in_control is None


HEALTH = Health(0.001, 0.01, 0.9, True, False, 0, True, 0.3, CorridorVector(0.1, math.nan, -0.0), 3.0, math.inf, 4.0, True)


def sample_of(health: Health | None) -> TickSample:
    one = replace(record(3), health=health)
    return TickSample(3, one, None, None, one.sent, one.now_s, CorridorVector(1.0, 2.0, 3.0))


@pytest.mark.parametrize("health", [None, HEALTH, Health()])
def test_health_is_recorded_exactly(health: Health | None) -> None:
    read, _ = decode_tick(encode_tick(sample_of(health), None).encode())
    assert to_plain(read.record.health) == to_plain(health)


def test_recording_without_health_is_read_and_one_without_a_needed_field_is_not() -> None:
    document = to_plain(sample_of(HEALTH))
    del document["record"]["health"]
    assert from_plain(TickSample, document).record.health is None
    del document["record"]["yaw_rad"]
    with pytest.raises(KeyError, match="yaw_rad"):
        from_plain(TickSample, document)


@given(st.floats(allow_nan=True), st.floats(allow_nan=True), st.one_of(st.none(), st.integers(0, 255)), st.booleans())
def test_any_health_survives_a_recording(lateness: float, charge: float, boots: int | None, overruled: bool) -> None:
    health = Health(lateness_s=lateness, battery_fraction=charge, boots=boots, overruled=overruled)
    assert to_plain(from_plain(Health, json.loads(json.dumps(to_plain(health))))) == to_plain(health)


class TroubledLoop:
    """A pilot whose loop has something to tell at every tick, and a recorder that hears it."""

    def __init__(self, pilot, recorder: Recorder) -> None:  # type: ignore[no-untyped-def]
        self.pilot, self.recorder, self.random, self.faults = pilot, recorder, np.random.default_rng(5), set[str | None]()

    def reset(self) -> None:
        self.pilot.reset()

    def tick(self, scan, state, now_s: float, _health=None):  # type: ignore[no-untyped-def]
        late, delay = float(self.random.exponential(0.012)), float(self.random.uniform(0.0, 0.3))
        step = float(self.random.exponential(0.012))
        health = Health(late, delay, in_control=True, boots=0, inference_s=step, overruled=bool(self.random.random() < 0.05))
        one = self.pilot.tick(scan, state, now_s, health)
        self.faults.add(one.verdict.fault)
        self.recorder.tick(one, scan, state, one.sent, now_s, self.pilot.goal)
        return one


def test_flight_with_a_troubled_loop_replays_bit_for_bit(tmp_path: Path, seeker_policy: Path) -> None:
    """Caps, late ticks, hung inference and overruled commands all come out again, although nothing is late in the replay."""
    path, runner = tmp_path / "flight.mcap", PolicyRunner.load(seeker_policy)
    world = load_world(ROOT / "configs" / "worlds" / "corridor.yaml", 2)
    flight = LockstepFlight(world, StackConfig(seeker_policy, SAFETY, time_limit_s=8.0), runner)
    with Recorder(path, header_of(flight, runner), seeker_policy.read_bytes(), RecordingConfig()) as recorder:
        loop = TroubledLoop(flight.pilot, recorder)
        flight.pilot = loop  # type: ignore[assignment]
        flight.run()
    recording = read_recording(path)
    rules = {item.rule for sample in recording.ticks for item in sample.record.verdict.interventions}
    assert {"speed_cap", "inference_hung"} <= rules
    result = compare(recording)
    assert result.identical, result.first
    recording.ticks[30] = dataclasses.replace(
        recording.ticks[30], record=replace(recording.ticks[30].record, health=Health(in_control=False))
    )
    assert not compare(recording).identical


def test_exploded_memory_is_reset(seeker_policy: Path) -> None:
    """P5: the filter names it and the pilot starts the policy anew."""

    class Exploded(PolicyRunner):
        resets = 0

        @property
        def hidden_norm(self) -> float:
            return 11.0

        def reset(self, reason: str = "") -> None:
            self.resets += 1
            super().reset(reason)

    runner = Exploded.load(seeker_policy)
    world = load_world(ROOT / "configs" / "worlds" / "corridor.yaml", 2)
    flight = LockstepFlight(world, StackConfig(seeker_policy, SAFETY, time_limit_s=0.5), runner)
    before = runner.resets
    flight.run()
    assert {one.verdict.fault for one in flight.log.records} == {"hidden_exploded"}
    assert runner.resets >= before + len(flight.log.records)


@pytest.mark.parametrize(
    ("rule", "in_control"), [("autopilot_rebooted", False), ("battery_low", True), ("battery_critical", True)]
)
def test_severe_faults_end_the_flight_at_once(rule: str, in_control: bool) -> None:
    judge = FlightJudge(load_mission(ROOT / "configs" / "corridor.yaml"))
    one = replace(record(0), verdict=Verdict(braking=True, fault=rule), goal_reached=False)
    assert judge.pausing(one)
    ending = judge.ending(one)
    assert ending is not None
    assert (ending.outcome, ending.in_control) == ("safety", in_control)
    assert rule in ending.message
    assert (judge.escalation.level == Level.YIELD) is not in_control
