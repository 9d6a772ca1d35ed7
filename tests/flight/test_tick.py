"""The tick with a real policy file and the real safety filter: once a tick, repeatable, and braking when in doubt."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from flight.tick import Pilot, TickRecord
from policy_export.checkpoint import Checkpoint, PolicyLayout
from policy_export.contract import ActionLayout, TrainingRecord, default_layout
from policy_export.export import export_policy
from policy_export.network import NetworkConfig, PolicyNetwork
from policy_export.runner import PolicyRunner
from safety.config import Fence, SafetyConfig
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState

TICK_S = 0.05
GOAL = CorridorVector(20.0, 0.0, 2.0)
FENCE = Fence(min_m=(0.0, -4.0, 0.3), max_m=(35.0, 4.0, 6.0))


@pytest.fixture(scope="module")
def policy_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained policy of the shipped shape: what it wants does not matter here, only how it is asked."""
    path = tmp_path_factory.mktemp("policy") / "untrained.onnx"
    torch.manual_seed(3)
    network = PolicyNetwork(NetworkConfig()).eval()
    layout = PolicyLayout(observation=default_layout(), action=ActionLayout())
    export_policy(Checkpoint(network, layout, TrainingRecord()), path, name="untrained")
    return path


@pytest.fixture
def policy(policy_path: Path) -> PolicyRunner:
    return PolicyRunner.load(policy_path)


def pilot_of(policy: PolicyRunner) -> Pilot:
    counts = iter(range(1_000_000))
    return Pilot(policy, SafetyFilter(SafetyConfig(fence=FENCE)), GOAL, 0.3, timer=lambda: float(next(counts)))


def state_at(time_s: float, *, x: float = 4.0, y: float = 0.0, yaw: float = 0.0, vx: float = 0.0) -> VehicleState:
    zero = CorridorVector(0.0, 0.0, 0.0)
    return VehicleState(time_s, CorridorVector(x, y, 2.0), CorridorVector(vx, 0.0, 0.0), zero, 0.0, 0.0, yaw, 0.0)


def scan_at(time_s: float, *, sequence: int = 0, beams: int = 361) -> LidarScan:
    rng = np.random.default_rng(sequence)
    ranges = np.where(rng.random(beams) < 0.3, np.inf, 2.5 + rng.random(beams)).astype(np.float32)
    return LidarScan(time_s, ranges, -math.pi / 2, math.pi / (beams - 1), 0.1, 4.0, sequence)


def inputs(ticks: int) -> list[tuple[LidarScan | None, VehicleState | None, float]]:
    return [
        (scan_at(now - 0.02, sequence=k), state_at(now - 0.01, x=4.0 + 0.02 * k, yaw=0.01 * k, vx=0.4), now)
        for k in range(ticks)
        for now in [100.0 + TICK_S * k]
    ]


def fly(pilot: Pilot, ticks: list[tuple[LidarScan | None, VehicleState | None, float]]) -> list[TickRecord]:
    return [pilot.tick(*one) for one in ticks]


def braked(record: TickRecord, fault: str) -> bool:
    still = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)
    return record.wanted is None and record.sent == still and record.verdict.braking and record.verdict.fault == fault


def test_a_good_tick_says_everything(policy: PolicyRunner) -> None:
    record = pilot_of(policy).tick(scan_at(99.98), state_at(99.99), 100.0)
    assert record.wanted is not None
    assert (record.now_s, record.scan_time_s, record.state_time_s) == (100.0, 99.98, 99.99)
    assert record.position == CorridorVector(4.0, 0.0, 2.0)
    assert record.distance_to_goal_m == pytest.approx(16.0)
    assert not record.goal_reached
    assert record.inference_s == 1.0  # one step of the scripted timer
    assert record.hidden_norm == policy.hidden_norm > 0.0
    assert record.hidden_reset
    assert record.verdict.scan_age_s == pytest.approx(0.02)


def test_the_recurrent_state_advances_exactly_once_a_tick(policy: PolicyRunner, policy_path: Path) -> None:
    pilot = pilot_of(policy)
    norms = []
    for k, one in enumerate(inputs(40)):
        record = pilot.tick(*one)
        norms.append(record.hidden_norm)
        assert policy.step_count == k + 1
        assert record.hidden_reset is (k == 0)
    assert len(set(norms)) == 40, "every tick moves the state, also with a scan seen before"


def test_the_same_inputs_give_identical_records(policy_path: Path) -> None:
    ticks = inputs(60)
    ticks[20:24] = [(None, state, now) for _, state, now in ticks[20:24]]
    ticks[40] = (ticks[40][0], None, ticks[40][2])
    flights = [fly(pilot_of(PolicyRunner.load(policy_path)), ticks) for _ in range(2)]
    assert repr(flights[0]) == repr(flights[1])  # repr: bit for bit, and NaN equals NaN


def test_reset_makes_the_pilot_forget(policy: PolicyRunner) -> None:
    pilot, ticks = pilot_of(policy), inputs(10)
    first = fly(pilot, ticks)
    pilot.reset()
    again = fly(pilot, ticks)
    assert [r.sent for r in again] == [r.sent for r in first]
    assert [r.hidden_norm for r in again] == [r.hidden_norm for r in first]


def test_a_new_goal_starts_from_zero_and_the_same_goal_does_not(policy: PolicyRunner) -> None:
    pilot, ticks = pilot_of(policy), inputs(4)
    fly(pilot, ticks[:2])
    pilot.set_goal(GOAL)
    assert not pilot.tick(*ticks[2]).hidden_reset
    pilot.set_goal(CorridorVector(10.0, 1.0, 2.0))
    record = pilot.tick(*ticks[3])
    assert record.hidden_reset
    assert record.distance_to_goal_m < 7.0


def test_a_gap_longer_than_the_file_allows_starts_from_zero(policy: PolicyRunner) -> None:
    pilot, allowed_s = pilot_of(policy), policy.metadata.reset.max_gap_s
    first = pilot.tick(scan_at(100.0), state_at(100.0), 100.0)
    now_s = 100.0 + allowed_s - 0.01
    assert not pilot.tick(scan_at(now_s, sequence=1), state_at(now_s), now_s).hidden_reset
    now_s += allowed_s + 0.01
    late = pilot.tick(scan_at(now_s), state_at(now_s), now_s)
    assert late.hidden_reset
    assert late.hidden_norm == first.hidden_norm


@pytest.mark.parametrize(
    ("scan", "state", "fault"),
    [
        (None, state_at(100.0), "scan_missing"),
        (scan_at(100.0), None, "state_missing"),
        (scan_at(99.7), state_at(100.0), "scan_stale"),
        (scan_at(100.1), state_at(100.0), "scan_future"),
        (scan_at(100.0), state_at(99.7), "state_stale"),
        (scan_at(100.0), state_at(100.0, x=math.nan), "state_not_finite"),
        (scan_at(100.0), state_at(100.0, yaw=math.inf), "state_not_finite"),
        (dataclasses.replace(scan_at(100.0), angle_increment_rad=-0.01), state_at(100.0), "scan_geometry"),
        (dataclasses.replace(scan_at(100.0), ranges_m=np.zeros((2, 5), np.float32)), state_at(100.0), "scan_shape"),
        (dataclasses.replace(scan_at(100.0), ranges_m=np.full(361, np.nan, np.float32)), state_at(100.0), "scan_unknown"),
    ],
)
def test_without_a_good_scan_and_state_the_policy_is_not_asked(
    policy: PolicyRunner, scan: LidarScan | None, state: VehicleState | None, fault: str
) -> None:
    pilot = pilot_of(policy)
    pilot.tick(scan_at(99.95, sequence=9), state_at(99.95), 99.95)
    record = pilot.tick(scan, state, 100.0)
    assert braked(record, fault) or braked(record, "command_missing"), record.verdict
    assert policy.step_count == 1
    assert math.isnan(record.inference_s)


def test_unknown_beams_are_far_for_the_policy_only(policy_path: Path) -> None:
    full = scan_at(100.0)
    holes = dataclasses.replace(full, ranges_m=np.where(np.arange(361) < 20, np.nan, full.ranges_m).astype(np.float32))
    far = dataclasses.replace(full, ranges_m=np.where(np.arange(361) < 19, np.inf, full.ranges_m).astype(np.float32))
    with_holes = pilot_of(PolicyRunner.load(policy_path)).tick(holes, state_at(100.0), 100.0)
    with_far = pilot_of(PolicyRunner.load(policy_path)).tick(far, state_at(100.0), 100.0)
    assert with_holes.hidden_norm == pytest.approx(with_far.hidden_norm, rel=0.05)
    assert with_holes.wanted is not None


def test_a_policy_that_answers_nan_brakes_and_starts_again(policy: PolicyRunner) -> None:
    pilot, ticks = pilot_of(policy), inputs(5)
    records = fly(pilot, ticks[:2])
    policy._states[policy._current][:] = np.nan  # a flipped bit in memory: the graph itself now answers NaN
    records += fly(pilot, ticks[2:])
    assert [r.wanted is None for r in records] == [False, False, True, False, False]
    assert braked(records[2], "command_missing")
    assert [r.hidden_reset for r in records] == [True, False, True, True, False]
    assert records[2].hidden_norm == 0.0


def test_the_action_is_turned_by_yaw_into_the_corridor(policy: PolicyRunner) -> None:
    pilot = pilot_of(policy)
    record = pilot.tick(scan_at(100.0), state_at(100.0, yaw=math.pi / 2), 100.0)
    assert record.wanted is not None
    policy.reset()
    action = policy.step(pilot._builder._observation)  # what the pilot showed it
    vx, vy, vz, turn = (float(value) for value in action)
    wanted = record.wanted
    assert (wanted.velocity.x, wanted.velocity.y) == pytest.approx((-vy, vx))
    assert (wanted.velocity.z, wanted.yaw_rate_rad_s) == pytest.approx((vz, turn))


def test_the_goal_is_reached_within_its_radius(policy: PolicyRunner) -> None:
    pilot = pilot_of(policy)
    assert pilot.tick(scan_at(100.0), state_at(100.0, x=19.75), 100.0).goal_reached
    assert not pilot.tick(scan_at(100.05), state_at(100.05, x=19.65), 100.05).goal_reached


@pytest.mark.parametrize("radius_m", [0.0, -1.0, math.nan, math.inf])
def test_an_impossible_goal_is_refused(policy: PolicyRunner, radius_m: float) -> None:
    with pytest.raises(ValueError, match="radius"):
        Pilot(policy, SafetyFilter(SafetyConfig(fence=FENCE)), GOAL, radius_m)
    with pytest.raises(ValueError, match="finite"):
        pilot_of(policy).set_goal(CorridorVector(math.nan, 0.0, 0.0))


def test_a_tick_is_a_small_part_of_its_period(policy_path: Path) -> None:
    """50 ms are there; a median over 5 would mean that something is very wrong."""
    import time

    pilot = Pilot(PolicyRunner.load(policy_path), SafetyFilter(SafetyConfig(fence=FENCE)), GOAL, 0.3)
    taken = []
    for one in inputs(100):
        before_s = time.perf_counter()
        pilot.tick(*one)
        taken.append(time.perf_counter() - before_s)
    assert np.median(taken) < 0.02, f"median tick {1e3 * np.median(taken):.2f} ms"
