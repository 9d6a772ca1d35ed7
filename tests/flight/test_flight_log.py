"""The log gives back every tick as it was, in memory that was there from the start; scans survive as one byte a beam."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from flight_records import flown, record
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.flight_log import MAX_INTERVENTIONS, FlightLog
from flight.scan_log import MAX_COLUMNS, ScanLog, read_scans, write_scans
from safety.frames import CorridorVector
from safety.messages import Intervention, LidarScan, SafeCommand, VehicleState, VelocityCommand, Verdict

NUMBER = st.floats(allow_nan=False)
VECTOR = st.builds(CorridorVector, NUMBER, NUMBER, NUMBER)
RULES = st.sampled_from(["obstacle", "fence", "scan_stale", "speed_limit"])
VERDICT = st.builds(
    Verdict,
    st.booleans(),
    st.lists(st.builds(Intervention, RULES, NUMBER, NUMBER), max_size=MAX_INTERVENTIONS).map(tuple),
    *[NUMBER] * 4,
    st.none() | RULES,
)
TICK = st.fixed_dictionaries(
    {
        "position": st.none() | VECTOR,
        "velocity": st.none() | VECTOR,
        "wanted": st.none() | st.builds(VelocityCommand, VECTOR, NUMBER),
        "sent": st.builds(SafeCommand, VECTOR, NUMBER),
        "verdict": VERDICT,
        "goal_reached": st.booleans(),
        "hidden_reset": st.booleans(),
        "inference_s": NUMBER,
    }
)


@settings(max_examples=60)
@given(st.lists(TICK, max_size=5))
def test_a_tick_comes_back_exactly(changes: list[dict[str, object]]) -> None:
    log, given_in = FlightLog(max_ticks=5), [record(k, **change) for k, change in enumerate(changes)]
    for k, one in enumerate(given_in):
        log.append(one, 7.0 + k, 0.001 * k)
    assert list(log.records) == given_in
    assert [sent_s for _, sent_s in log] == [7.0 + k for k in range(len(given_in))]
    assert log.lateness_s.tolist() == [0.001 * k for k in range(len(given_in))]


def test_not_a_number_stays_so() -> None:
    log = FlightLog(max_ticks=1)
    log.append(record(0, position=None, velocity=None, yaw_rad=math.nan, wanted=None, inference_s=math.nan), math.nan)
    found = log.records[0]
    assert (found.position, found.velocity, found.wanted) == (None, None, None)
    assert all(map(math.isnan, (found.yaw_rad, found.inference_s, log.sent_times_s[0], log.lateness_s[0])))


def test_records_are_a_sequence() -> None:
    records = flown(20).records
    assert len(records) == 20
    assert records[-1] == record(19)
    assert records[3:5] == [record(3), record(4)]
    with pytest.raises(IndexError):
        records[20]


def test_an_hour_needs_no_more_memory_than_its_first_tick() -> None:
    import tracemalloc

    log, scan, state = FlightLog(max_ticks=72_000), scan_at(0.0), state_at(0.0)
    log.reserve()
    one = record(0, verdict=Verdict(False, (Intervention("obstacle", 1.0, 0.5),), 0.0, 0.0, 1.0, 1.0))
    log.append(one, 0.0)
    log.see(scan, state)
    tracemalloc.start()
    for k in range(2000):
        log.append(one, 0.05 * k)
        log.see(dataclasses.replace(scan, time_s=1.0 + 0.05 * k), state)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 20_000
    assert (len(log), len(log.scans)) == (2001, 2001)


def scan_at(time_s: float, ranges: np.ndarray | None = None) -> LidarScan:
    ranges = np.linspace(0.2, 3.9, 361, dtype=np.float32) if ranges is None else ranges.astype(np.float32)
    return LidarScan(time_s, ranges, -math.pi / 2, math.pi / (ranges.size - 1), 0.1, 4.0)


def state_at(time_s: float) -> VehicleState:
    zero = CorridorVector(0.0, 0.0, 0.0)
    return VehicleState(time_s, CorridorVector(5.0, 1.0, 2.0), zero, zero, 0.0, 0.0, 0.3, 0.0)


@settings(max_examples=50)
@given(st.lists(st.sampled_from([0.0, 0.05, 0.1, 0.5, 2.0, 3.999, 4.0, math.inf, math.nan]), min_size=1, max_size=MAX_COLUMNS))
def test_a_small_scan_keeps_every_beam_to_a_step(values: list[float]) -> None:
    ranges = np.array(values, dtype=np.float32)
    log = ScanLog(4)
    log.add(LidarScan(1.0, ranges, -1.0, 0.01, 0.1, 4.0), None)
    kept = log.scans().ranges_m()[0]
    expected = np.where(ranges < 0.1, 0.0, ranges)
    np.testing.assert_array_equal(np.isnan(kept), np.isnan(expected))
    np.testing.assert_allclose(kept, expected, atol=0.0081)


def test_a_group_of_beams_keeps_its_nearest_return() -> None:
    ranges = np.full(2 * MAX_COLUMNS, np.nan)
    ranges[0], ranges[1], ranges[2], ranges[3], ranges[4], ranges[5] = np.inf, 2.0, 1.0, 3.0, np.nan, np.inf
    log = ScanLog(4)
    log.add(scan_at(1.0, ranges), None)
    np.testing.assert_allclose(log.scans().ranges_m()[0][:4], [2.0, 1.0, np.inf, np.nan], atol=0.01)


def test_scans_are_bounded_old_ones_ignored_and_another_device_counted() -> None:
    log = ScanLog(3)
    for time_s in (1.0, 1.0, 0.5, 2.0):
        log.add(scan_at(time_s), state_at(time_s))
    log.add(scan_at(3.0, np.ones(181)), None)
    assert (len(log), log.dropped) == (2, 1)
    for time_s in (4.0, 5.0, 6.0):
        log.add(scan_at(time_s), None)
    assert (len(log), log.dropped) == (3, 3)


def test_scans_survive_the_file_and_damage_is_noticed(tmp_path: Path) -> None:
    log = ScanLog(10)
    for k in range(6):
        log.add(scan_at(100.0 + k), state_at(100.0) if k else None)
    path = tmp_path / "scans.npz"
    write_scans(path, log.scans(), 100.0)
    found = read_scans(path)
    assert found is not None
    assert found.poses[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    np.testing.assert_array_equal(found.codes, log.scans().codes)
    np.testing.assert_allclose(found.hit_points_m(), log.scans().hit_points_m())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert read_scans(path) is None
    assert read_scans(tmp_path / "absent.npz") is None
    np.savez(path, poses=np.zeros((2, 4)), codes=np.zeros((3, 5), np.uint8), bearings_rad=np.zeros(5), range_max_m=4.0)
    assert read_scans(path) is None
