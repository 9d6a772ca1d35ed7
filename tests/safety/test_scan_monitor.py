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
from safety.monitor_config import MonitorConfig
from safety.scan_monitor import ScanMonitor, _difference, _limited

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


def turned(rate, mirrored, ages=(0.0,), wrapped=False, ticks=60):
    """Rules while turning on the spot; `ages`: of the scan when the estimate is taken, in turn; `wrapped`: yaw within +-pi."""
    monitor, result = ScanMonitor(CONFIG), []
    for k in range(ticks):
        t, age, found = 0.05 * k, ages[k % len(ages)], []
        yaw = 2.9 + rate * (t + age)
        yaw = math.remainder(yaw, 2.0 * math.pi) if wrapped else yaw
        seen = view(2.9 + rate * t, t, mirrored=mirrored)
        monitor.judge(seen, state(yaw=yaw, yaw_rate=rate, time_s=t + age), found)
        result.append([item.rule for item in found])
    return result


@pytest.mark.parametrize("rate", [0.83, -0.83])
def test_mirrored_is_told_alike_however_yaw_is_counted_and_however_old_the_scan_is(rate):
    """The heading is that of the scan's own time, and passing +-pi is no turn."""
    assert not any(turned(rate, False, wrapped=True))
    assert not any(turned(rate, False, ages=(0.0, 0.2)))
    plain = turned(rate, True)
    assert any(plain)
    assert turned(rate, True, wrapped=True) == plain
    assert turned(rate, True, ages=(0.0, 0.2)) == plain


BEAMS, STEP_RAD = 9, 0.25
STEEP = MonitorConfig(mirror_turn_rad=STEP_RAD)


def votes(changes, time_step_s=0.125, monitors=STEEP, turn_beams=1.0):
    """Votes told at each scan of a slope of 0.25 m a beam, turning left by `turn_beams` a scan; `changes` of all ranges, m.

    Turning left things move to the right, so by rights every range grows by 0.25 m; mirrored it falls by as much.
    """
    monitor, result, offset_m = ScanMonitor(config(monitors=monitors)), [], 3.0
    for k, change_m in enumerate((0.0, *changes)):
        offset_m += change_m
        one = LidarScan(k * time_step_s, offset_m + 0.25 * np.arange(BEAMS), -1.0, STEP_RAD, 0.1, 40.0)
        found = []
        monitor.judge(one, state(yaw=turn_beams * STEP_RAD * k, time_s=k * time_step_s), found)
        result.append(found[0].value if found else 0.0)
    return result[1:]


def test_each_clear_comparison_is_a_vote_and_what_fits_the_right_way_as_well_takes_all_away():
    mirrored, right, either, weak = -0.25, 0.25, 0.0, -0.1
    assert votes([mirrored] * 6) == [0.0, 0.0, 0.0, 4.0, 5.0, 6.0]
    assert votes([mirrored] * 3 + [right] + [mirrored] * 4) == [0.0] * 7 + [4.0]
    assert votes([mirrored] * 3 + [either] + [mirrored] * 4) == [0.0] * 7 + [4.0]
    assert votes([mirrored] * 3 + [weak] + [mirrored]) == [0.0] * 4 + [4.0]  # better mirrored, but not by enough: undecided
    assert votes([right] * 8) == votes([either] * 8) == votes([weak] * 8) == [0.0] * 8


def test_a_turn_is_compared_to_the_nearest_beam():
    """A fall of 0.1875 m fits a mirrored turn by one beam well enough, one by two not."""
    assert votes([-0.1875] * 4, turn_beams=1.4)[-1] == 4.0
    assert not any(votes([-0.1875] * 6, turn_beams=1.6))
    assert votes([-0.5] * 4, turn_beams=1.6)[-1] == 4.0


def test_a_turn_of_more_than_a_quarter_between_two_scans_is_taken_as_it_is():
    """Two radians to the left are not 1.1 to the right."""
    assert votes([-2.0] * 4, turn_beams=8.0) == [0.0, 0.0, 0.0, 4.0]
    assert not any(votes([2.0] * 6, turn_beams=8.0))


def test_a_reference_is_compared_for_exactly_a_second():
    assert votes([-0.25] * 5, time_step_s=1.0) == [0.0, 0.0, 0.0, 4.0, 5.0]
    assert votes([-0.25] * 9, time_step_s=1.0625) == [0.0] * 9


def test_turns_smaller_than_the_least_keep_the_reference():
    """A quarter of a radian is compared; with a least turn a little above, every other scan is."""
    assert votes([-0.25] * 9, monitors=MonitorConfig(mirror_turn_rad=0.2500001)) == [0.0] * 7 + [4.0, 0.0]


@pytest.mark.parametrize(("further_m", "is_told"), [(0.0, False), (1e-6, True)])
def test_the_mirrored_comparison_must_be_better_by_more_than_noise(further_m, is_told):
    """A pattern that fits mirrored exactly and is 0.1 m off the right way: half of that, 0.05 m, is not enough yet."""
    monitor, found = ScanMonitor(config(monitors=STEEP)), []
    for k in range(8):
        pattern = np.array([0.1, 0.1, 0.2 + further_m, 0.2 + further_m])[(np.arange(5) - k) % 4]
        monitor.judge(LidarScan(0.125 * k, pattern, -1.0, STEP_RAD, 0.1, 40.0), state(yaw=STEP_RAD * k, time_s=0.125 * k), found)
    assert bool(found) == is_told


@pytest.mark.parametrize("shift", range(-7, 8))
def test_difference_is_the_mean_over_the_beams_that_overlap(shift):
    chance = np.random.default_rng(shift + 7)
    now, before = chance.uniform(0.0, 4.0, 6), chance.uniform(0.0, 4.0, 6)
    both = [abs(now[i] - before[i + shift]) for i in range(6) if 0 <= i + shift < 6]
    assert _difference(now, before, shift) == pytest.approx(sum(both) / len(both) if both else math.inf)


def test_what_is_unknown_or_too_far_counts_as_the_range_of_the_sensor():
    assert _limited(scan([math.nan, math.inf, 4.5, 4.0, 1.5, 0.0])).tolist() == [4.0, 4.0, 4.0, 4.0, 1.5, 0.0]


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
    assert numbered([5, 0]) == numbered([0, -1]) == [[], ["scan_source"]]
    assert not any(numbered([0, 1, 2, 9, 40]))
    assert not any(numbered([0, 0, 0]))


def test_another_geometry_in_flight_is_another_sender():
    """L8: told once, then the new one is the reference."""
    mixed = [np.full(180, 2.0), np.full(180, 2.0), np.full(90, 2.0), np.full(90, 2.0)]
    assert numbered([0, 0, 0, 0], mixed) == [[], [], ["scan_source"], []]


@pytest.mark.parametrize(
    "change",
    [
        {"ranges_m": np.full(181, 2.0)},
        {"ranges_m": np.full(179, 2.0)},
        {"angle_min_rad": 0.01},
        {"angle_min_rad": -3.0},
        {"angle_increment_rad": 0.02},
        {"angle_increment_rad": 0.01},
    ],
)
def test_any_change_of_the_geometry_either_way_is_told_once(change):
    monitor, found = ScanMonitor(CONFIG), []
    for k in range(6):
        one = scan(np.full(180, 2.0), k * 0.0625)
        monitor.judge(dataclasses.replace(one, **change) if k >= 3 else one, state(time_s=one.time_s), found)
        assert [item.rule for item in found] == ["scan_source"] * (k >= 3)


def test_a_scan_seen_before_is_not_judged_again():
    monitor, found = ScanMonitor(CONFIG), []
    one = scan(np.full(180, 2.0), 1.0, sequence=7)
    for _ in range(5):
        monitor.judge(one, state(time_s=1.0), found)
    for time_s in (float("1.0"), 0.9):  # as old, in another object, and older: nor is either
        monitor.judge(scan(np.full(90, 2.0), time_s, sequence=3), state(time_s=1.0), found)
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


TICK_S = 0.0625


def masked_counts(near, v=(0.0, 0.0, 0.0), yaw_rate=0.0, chosen=CONFIG):
    """Masked beams per tick; `near` [ticks]: the beams with a return inside the hull."""
    monitor, result = ScanMonitor(chosen), []
    for k, beams in enumerate(near):
        ranges = np.full(180, 3.0)
        ranges[list(beams)] = 0.2
        one = scan(ranges, 8.0 + k * TICK_S)
        monitor.judge(one, state(v=v, yaw_rate=yaw_rate, time_s=one.time_s), [])
        result.append(int(np.isnan(monitor.masked(one, []).ranges_m).sum()))
    return result


@pytest.mark.parametrize(
    ("v", "yaw_rate"),
    [
        ((0.15, 0.2, 0.0), 0.0), ((-0.25, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 0.25), ((0.0, 0.0, 0.0), -0.25),
        ((0.0, 0.125, 3.0), 0.125),
    ],
)  # fmt: skip
def test_moving_and_turning_either_way_count_as_motion_climbing_does_not(v, yaw_rate):
    """A quarter a second for 16 ticks of 62.5 ms is a quarter, and that is not yet enough."""
    chosen = config(monitors=MonitorConfig(mask_motion_m=0.25))
    assert masked_counts([{90}] * 20, v, yaw_rate, chosen) == [0] * 17 + [1] * 3


def test_each_beam_has_its_own_time_and_motion():
    """At 1 m/s the half second decides: the ninth scan with a return. A beam that was clear for one scan begins anew."""
    near = [{5}] * 4 + [{5, 80}] * 3 + [{80, 81}] + [{5, 80, 81}] * 12
    expected = [0] * 13 + [1] * 3 + [2] + [3] * 3
    assert masked_counts(near, (1.0, 0.0, 0.0)) == expected


def test_motion_is_summed_from_zero_so_that_the_least_counts():
    least = config(monitors=MonitorConfig(mask_motion_m=1e-18))
    assert masked_counts([{90}] * 12, (1e-16, 0.0, 0.0), 0.0, least) == [0] * 9 + [1] * 3
    monitor = ScanMonitor(least)
    for k in range(12):  # what was flown before the first scan is not known and does not count
        one = scan(np.full(180, 0.2), 8.0 + k * TICK_S)
        monitor.judge(one, state(v=(1e-16 if k else 1.0, 0, 0), time_s=one.time_s), [])
    assert monitor.masked(one, []) is not one


def test_motion_before_a_return_came_is_not_counted():
    """2 m flown, then something inside the hull while standing: an obstacle that came there."""
    monitor = ScanMonitor(CONFIG)
    for k in range(60):
        one = scan(np.full(180, 3.0 if k < 20 else 0.2), k * TICK_S)
        monitor.judge(one, state(v=(1.6 if k < 20 else 0.0, 0, 0), time_s=one.time_s), [])
        assert monitor.masked(one, []) is one


def test_a_return_on_the_hull_itself_is_outside():
    """float64 ranges: the radius exactly is no part of the vehicle, the next smaller number is."""
    for range_m, is_masked in ((CONFIG.vehicle_radius_m, False), (math.nextafter(CONFIG.vehicle_radius_m, 0.0), True)):
        monitor = ScanMonitor(CONFIG)
        for k in range(20):
            one = LidarScan(k * TICK_S, np.full(9, range_m), -1.0, STEP_RAD, 0.1, 4.0)
            monitor.judge(one, state(v=(1.0, 0, 0), time_s=one.time_s), [])
        assert (monitor.masked(one, []) is not one) == is_masked


def test_another_geometry_forgets_what_was_masked():
    monitor, leg = ScanMonitor(CONFIG), np.where(np.arange(180) < 3, 0.2, 3.0)
    for k in range(20):
        monitor.judge(scan(leg, k * TICK_S), state(v=(1.0, 0, 0), time_s=k * TICK_S), [])
    assert monitor.masked(scan(leg), []).ranges_m[0] != 0.2
    other = scan(leg[:90], 20 * TICK_S)
    monitor.judge(other, state(v=(1.0, 0, 0), time_s=20 * TICK_S), [])
    assert monitor.masked(other, []) is other


def test_a_monitor_that_was_reset_judges_like_a_new_one():
    def run(monitor):
        found, leg = [], np.where(np.arange(180) < 3, 0.2, 3.0)
        for k in range(12):
            one = scan(np.where(np.arange(180) < 3, leg, view(0.16 * k, k * TICK_S).ranges_m[::-1]), k * TICK_S, sequence=k + 3)
            told = []
            monitor.judge(one, state(v=(1.0, 0, 0), yaw=0.16 * k, time_s=one.time_s), told)
            monitor.masked(one, told)
            found.append([(item.rule, item.value) for item in told])
        return found

    used = ScanMonitor(CONFIG)
    first = run(used)
    used.reset()
    assert any(first)
    assert run(used) == first == run(ScanMonitor(CONFIG))


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
