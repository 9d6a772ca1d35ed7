"""Scans from two sources, scans that turn the wrong way, and parts of the vehicle in the view."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import cast, config, scan, state

from safety.messages import LidarScan
from safety.scan_monitor import ScanMonitor

CONFIG = config()
C = CONFIG.monitors
ROOM = np.array([[-3.0, 2.0, 12.0, 2.5], [-3.0, -3.5, 12.0, -3.0], [6.0, 0.5, 6.5, 1.0], [3.0, -2.0, 3.6, -1.5]])


def view(yaw, time_s, x=4.0, mirrored=False, noise=0.01, seed=0, beams=180, fov=math.pi):
    step = fov / beams
    bearings = -fov / 2 + step * (np.arange(beams) + 0.5)
    ranges = cast(ROOM, x, 0.0, bearings + yaw)
    ranges = ranges + noise * np.random.default_rng([seed, round(1000 * time_s)]).standard_normal(beams)
    return scan(ranges[::-1] if mirrored else ranges, time_s, beams, fov)


def turning(rate, ticks=60, **parts):
    """Rules while turning at `rate` and flying along at 0.4 m/s."""
    monitor, result = ScanMonitor(CONFIG), []
    for k in range(ticks):
        t, found = 0.05 * k, []
        yaw = 0.3 * math.sin(rate * t) if parts.get("swing") else rate * t
        speed = 0.3 * rate * math.cos(rate * t) if parts.get("swing") else rate
        seen = view(yaw, t, 4.0 + 0.4 * t, **{key: value for key, value in parts.items() if key != "swing"})
        monitor.judge(seen, state(x=4.0 + 0.4 * t, v=(0.4, 0, 0), yaw=yaw, yaw_rate=speed, time_s=t), found)
        result.append([item.rule for item in found])
    return result


@pytest.mark.parametrize("rate", [0.4, -0.4, 1.0, -1.0])
def test_mirrored_scan_is_told_while_turning(rate):
    """L9: within four comparisons of at least 0.15 rad; the right way round never."""
    assert not any(turning(rate))
    found = turning(rate, mirrored=True)
    first = next(k for k, names in enumerate(found) if names)
    assert found[first] == ["scan_mirrored"]
    assert abs(rate) * 0.05 * first <= 6 * C.mirror_turn_rad


def test_swinging_to_and_fro_changes_nothing():
    assert not any(turning(1.5, 200, swing=True))


def test_without_turning_a_mirror_is_not_told():
    """Not observable: nothing is said."""
    assert not any(turning(0.0, mirrored=True))
    assert not any(turning(0.05, mirrored=True))  # 0.15 rad take longer than a reference is kept


def test_an_empty_room_is_not_mirrored():
    monitor, found = ScanMonitor(CONFIG), []
    for k in range(80):
        monitor.judge(scan(time_s=0.05 * k), state(yaw=0.05 * k, yaw_rate=1.0, time_s=0.05 * k), found)
    assert not found


def test_differences_as_small_as_noise_decide_nothing():
    """Ripples of 2 cm on a round wall, turning the wrong way: better mirrored, but not by enough."""
    monitor, found = ScanMonitor(CONFIG), []
    for k in range(80):
        turn = 0.05 * k
        ripples = 2.0 + 0.02 * np.sin(5.0 * (np.arange(180) * math.pi / 180 - turn))
        monitor.judge(scan(ripples, 0.05 * k), state(yaw=turn, yaw_rate=1.0, time_s=0.05 * k), found)
    assert not found


def test_a_turn_beyond_the_view_compares_nothing():
    """Four beams and half a turn between two scans: no beam overlaps, no vote."""
    monitor, found = ScanMonitor(CONFIG), []
    for k in range(20):
        ranges = np.full(4, 1.0 + k % 2)
        monitor.judge(scan(ranges, 0.05 * k, fov=math.pi / 2), state(yaw=math.pi * k, time_s=0.05 * k), found)
    assert not found


@settings(max_examples=25, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(2.0, 8.0), st.integers(0, 99), st.floats(0.0, 0.03))
def test_no_scan_the_right_way_round_is_ever_told(rate, x, seed, noise):
    monitor, found = ScanMonitor(CONFIG), []
    for k in range(50):
        t = 0.05 * k
        seen = view(rate * t, t, x, noise=noise, seed=seed)
        monitor.judge(seen, state(x=x, yaw=rate * t, yaw_rate=rate, time_s=t), found)
    assert not found


def numbered(numbers, geometry=None):
    monitor, result = ScanMonitor(CONFIG), []
    for k, number in enumerate(numbers):
        found = []
        one = scan(np.full(180, 2.0) if geometry is None else geometry[k], 0.05 * k, sequence=number)
        monitor.judge(one, state(time_s=0.05 * k), found)
        result.append([item.rule for item in found])
    return result


def test_two_senders_are_told_by_their_numbers():
    """L18: two counters in turn; gaps are lost scans, and scans without numbers say nothing."""
    assert numbered([5, 6, 900, 7, 901]) == [[], [], [], ["scan_source"], []]
    assert numbered([5, 5]) == [[], ["scan_source"]]
    assert numbered([5, 0]) == [[], ["scan_source"]]
    assert not any(numbered([0, 1, 2, 9, 40]))
    assert not any(numbered([0, 0, 0]))


def test_another_geometry_in_flight_is_another_sender():
    """L8: told once, then the new one is the reference."""
    mixed = [np.full(180, 2.0), np.full(180, 2.0), np.full(90, 2.0), np.full(90, 2.0)]
    assert numbered([0, 0, 0, 0], mixed) == [[], [], ["scan_source"], []]


def test_a_scan_seen_before_is_not_judged_again():
    monitor, found = ScanMonitor(CONFIG), []
    one = scan(np.full(180, 2.0), 1.0, sequence=7)
    for _ in range(5):
        monitor.judge(one, state(time_s=1.0), found)
    assert not found


def with_leg(ticks, speed=0.4, near=0.2, beams=slice(88, 92), every=1):
    """Masked beams per tick, while something `near` is in `beams` in all but each `every`-th scan."""
    monitor, result = ScanMonitor(CONFIG), []
    for k in range(ticks):
        ranges = np.full(180, 3.0, dtype=np.float32)
        if every == 1 or k % every:
            ranges[beams] = near
        one = dataclasses.replace(scan(time_s=0.0625 * k), ranges_m=ranges)
        told = []
        monitor.judge(one, state(v=(speed, 0, 0), time_s=0.0625 * k), [])
        masked = monitor.masked(one, told)
        unknown = np.isnan(masked.ranges_m)
        assert [item.rule for item in told] == (["scan_sector_masked"] if unknown.any() else [])
        assert unknown.any() or masked is one
        result.append(int(unknown.sum()))
    return result


def test_a_part_of_the_vehicle_becomes_unknown():
    """L15: after more than half a second (8 ticks of 62.5 ms) and more than 0.2 m of motion."""
    assert with_leg(12) == [0] * 9 + [4] * 3
    assert with_leg(12, near=0.0) == [0] * 9 + [4] * 3  # tape over the lens


def test_what_may_be_an_obstacle_stays_one():
    """Outside the hull, or while standing still, or with breaks: never taken for a part of the vehicle."""
    assert not any(with_leg(60, near=CONFIG.vehicle_radius_m))
    assert not any(with_leg(60, speed=0.0))
    assert not any(with_leg(60, every=6))
    slow = with_leg(60, speed=0.1)  # 0.2 m take two seconds
    assert slow.index(4) * 0.0625 * 0.1 == pytest.approx(C.mask_motion_m, abs=0.01)


def test_mask_ends_with_what_caused_it():
    monitor = ScanMonitor(CONFIG)
    for k in range(40):
        near = k < 20
        one = scan(np.where(np.arange(180) < 3, 0.2 if near else 3.0, 3.0), 0.05 * k)
        monitor.judge(one, state(v=(0.5, 0, 0), time_s=0.05 * k), [])
        assert (monitor.masked(one, []) is one) == (k <= 10 or not near)


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 5.0, width=32), min_size=40, max_size=40), st.floats(0.0, 1.0))
def test_masking_only_ever_forgets_what_is_inside_the_hull(near, speed):
    """Whatever the scans show: a beam that is not inside the hull keeps its range, and nothing becomes free."""
    monitor = ScanMonitor(CONFIG)
    for k, value in enumerate(near):
        ranges = np.array([value, 0.1, value, 3.0] * 5, dtype=np.float32)
        one = LidarScan(0.05 * k, ranges, -1.0, 0.1, 0.1, 4.0)
        monitor.judge(one, state(v=(speed, 0, 0), time_s=0.05 * k), [])
        masked = monitor.masked(one, []).ranges_m
        outside = ranges >= np.float32(CONFIG.vehicle_radius_m)
        assert np.array_equal(masked[outside], ranges[outside])
        assert np.all(np.isnan(masked) | (masked == ranges))
