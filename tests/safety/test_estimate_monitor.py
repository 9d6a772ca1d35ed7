"""What the estimate must not do: every limit met exactly, and passed by a little."""

from __future__ import annotations

import dataclasses
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import state

from safety.estimate_monitor import EstimateMonitor
from safety.frames import CorridorVector
from safety.messages import Health
from safety.monitor_config import MonitorConfig

C = MonitorConfig()
UNKNOWN = Health()
STEP = 0.0625  # exact in binary, so that limits can be met exactly


def rules(states, healths=None, commanded=0.0, config=C):
    """Rules of each sample of a run."""
    monitor, result = EstimateMonitor(config), []
    for k, sample in enumerate(states):
        found = []
        monitor.judge(sample, healths[k] if healths else UNKNOWN, commanded, sample.time_s, found)
        result.append([item.rule for item in found])
    return result


def cruise(ticks, v=(0.5, 0.0, 0.0), shift=(0.0, 0.0, 0.0), at=None, step_s=STEP, **parts):
    """A flight at constant velocity; from tick `at` on displaced by `shift`."""
    result = []
    for k in range(ticks):
        t = k * step_s
        moved = [v[i] * t + (shift[i] if at is not None and k >= at else 0.0) for i in range(3)]
        result.append(state(5.0 + moved[0], moved[1], 2.0 + moved[2], v=v, time_s=t, **parts))
    return result


LIMIT = C.position_jump_m + C.velocity_mismatch_m_s * STEP


@pytest.mark.parametrize("axis", [(1, 0), (0, -1), (0.6, 0.8)])
def test_jump_limit_is_exact(axis):
    """E1, in any horizontal direction: the limit is still accepted, a little more is a jump, once."""
    just, more = LIMIT - 1e-9, LIMIT + 1e-6
    assert not any(rules(cruise(8, shift=(axis[0] * just, axis[1] * just, 0), at=5)))
    assert rules(cruise(8, shift=(axis[0] * more, axis[1] * more, 0), at=5)) == [[]] * 5 + [["estimate_jump"]] + [[]] * 2


def test_jump_allowance_grows_with_the_time_between_samples():
    """After a gap of 0.2 s more noise is natural than after one tick."""
    size = C.position_jump_m + 0.2 * C.velocity_mismatch_m_s - 1e-6
    assert not any(rules(cruise(3, shift=(size, 0, 0), at=2, step_s=0.2)))
    assert any(rules(cruise(3, shift=(size, 0, 0), at=2, step_s=0.1)))


def test_a_second_jump_soon_is_worse():
    """E1: a jump and back within 5 s is HOLD; later it is a first one again."""
    there = cruise(4, shift=(1, 0, 0), at=2)
    back = state(5.0 + 0.5 * 4 * STEP, v=(0.5, 0, 0), time_s=4 * STEP)
    assert rules([*there, back])[-1] == ["estimate_jump_again"]
    long = [*cruise(160, shift=(1, 0, 0), at=2), state(5.0 + 0.5 * 160 * STEP, v=(0.5, 0, 0), time_s=160 * STEP)]
    assert rules(long)[-1] == ["estimate_jump"]


@pytest.mark.parametrize("sign", [1, -1])
def test_altitude_jump_limit_is_exact(sign):
    limit = C.altitude_jump_m + C.velocity_mismatch_m_s * STEP
    assert not any(rules(cruise(8, shift=(0, 0, sign * (limit - 1e-9)), at=5)))
    assert rules(cruise(8, shift=(0, 0, sign * (limit + 1e-6)), at=5))[5] == ["altitude_jump"]


def test_reset_counter():
    """E8: a change is named at once, also when the position happens to stay; unknown counters say nothing."""

    def counted(values):
        return [dataclasses.replace(s, reset_counter=c) for s, c in zip(cruise(len(values)), values, strict=True)]

    assert rules(counted([3, 3, 4, 4, 3])) == [[], [], ["estimate_reset"], [], ["estimate_reset"]]
    assert not any(rules(counted([int("1000"), int("1000")])))  # equal, though not one object
    assert rules(counted([255, 0])) == [[], ["estimate_reset"]]
    assert not any(rules(counted([None, 3, 3, None, 4])))


def test_reset_with_a_jump_is_both_and_starts_anew():
    jumped = [dataclasses.replace(s, reset_counter=int(k >= 3)) for k, s in enumerate(cruise(12, shift=(2, 0, 0), at=3))]
    assert rules(jumped) == [[]] * 3 + [["estimate_reset", "estimate_jump"]] + [[]] * 8


def drifting(rate, ticks=8):
    """The velocity says 0.5 m/s, the position moves at 0.5 + rate."""
    return [state(5.0 + (0.5 + rate) * k * STEP, v=(0.5, 0, 0), time_s=k * STEP) for k in range(ticks)]


def test_velocity_mismatch_needs_the_whole_window_and_the_limit():
    """E6: 7 samples of 62.5 ms are the first window of at least 0.4 s."""
    assert not any(rules(drifting(C.velocity_mismatch_m_s - 1e-6)))
    assert rules(drifting(C.velocity_mismatch_m_s + 1e-6)) == [[]] * 7 + [["velocity_mismatch"]]
    assert rules(drifting(-C.velocity_mismatch_m_s - 1e-6))[7] == ["velocity_mismatch"]


@pytest.mark.parametrize("rate_m_s", [(1.2, 0, 0), (0, 1.2, 0), (0, 0, 1.2), (-0.9, 0.7, -1.2), (0.9, -0.7, 1.2)])
def test_a_drift_below_the_limit_is_never_accused_however_far_it_leads(rate_m_s):
    """Ten seconds: what counts is the mean over the window, not what has added up since the start."""
    drift = [
        state(5.0 + rate_m_s[0] * t, rate_m_s[1] * t, 2.0 + rate_m_s[2] * t, time_s=t) for t in (k * STEP for k in range(160))
    ]
    assert not any(rules(drift))


def told(states, commanded=0.0, config=C):
    """What each sample of a run makes the monitor tell: rule and value."""
    monitor, result = EstimateMonitor(config), []
    for sample in states:
        found = []
        monitor.judge(sample, UNKNOWN, commanded, sample.time_s, found)
        result.append([(item.rule, item.value) for item in found])
    return result


def wandering(chance, size_m_s, ticks=40):
    """Samples at uneven times whose velocity changes, and whose position moves on by its mean and by a drift besides."""
    p, v, t, result, drifts = [5.0, 0.0, 2.0], [0.3, -0.2, 0.1], 8.0, [], []
    for _ in range(ticks):
        result.append(state(*p, v=tuple(v), time_s=t))
        dt = chance.choice((0.03, 0.05, 0.08))
        w = [part + chance.uniform(-0.2, 0.2) for part in v]
        drift = [size_m_s * dt * chance.uniform(-0.6, 1.0) for _ in range(3)]
        drifts.append((t + dt, *drift))
        p = [a + 0.5 * (b + c) * dt + d for a, b, c, d in zip(p, v, w, drift, strict=True)]
        v, t = w, t + dt
    return result, drifts


@pytest.mark.parametrize("seed", range(20))
def test_mismatch_is_the_drift_over_the_shortest_window_that_is_long_enough(seed):
    sharp = MonitorConfig(velocity_mismatch_m_s=0.3, position_jump_m=1.0, altitude_jump_m=1.0)
    states, drifts = wandering(random.Random(seed), 1.2)
    found = told(states, config=sharp)
    assert any(found)
    for k, sample in enumerate(states):
        begins = [s.time_s for s in states[: k + 1] if s.time_s <= sample.time_s - C.velocity_window_s + 1e-6]
        since = [d for d in drifts if begins and begins[-1] + 1e-9 < d[0] <= sample.time_s + 1e-9]
        span = sample.time_s - begins[-1] if begins else math.inf
        x, y, z = (sum(d[axis] for d in since) / span for axis in (1, 2, 3))
        worst = max(math.hypot(x, y), abs(z))
        assert found[k] == ([("velocity_mismatch", pytest.approx(worst))] if worst > sharp.velocity_mismatch_m_s else [])


@pytest.mark.parametrize("seed", range(20))
def test_what_the_mean_of_both_velocities_leaves_is_the_jump(seed):
    """E1, E9: horizontally and vertically by themselves, from any place and time on, at any speeds."""
    chance = random.Random(seed)
    for across_m, up_m in ((0.7, 0.0), (0.0, 0.7), (0.0, -0.7)):
        place, v, w = ([chance.uniform(-2.0, 2.0) for _ in range(3)] for _ in range(3))
        dt, angle = chance.choice((0.05, 0.2)), chance.uniform(-math.pi, math.pi)
        jump = (across_m * math.cos(angle), across_m * math.sin(angle), up_m)
        then = [a + 0.5 * (b + c) * dt + d for a, b, c, d in zip(place, v, w, jump, strict=True)]
        pair = [state(*place, v=tuple(v), time_s=8.0), state(*then, v=tuple(w), time_s=8.0 + dt)]
        rule = "altitude_jump" if up_m else "estimate_jump"
        assert told(pair) == [[], [(rule, pytest.approx(0.7))]]


def jumps_at(times_s):
    """Rules of a vehicle that stands, and is a metre to the side from each of these times on, back from the next."""
    standing = [k * STEP for k in range(round(8.0 / STEP))]
    samples = [state(y=float(sum(at <= t for at in times_s) % 2), time_s=20.0 + t) for t in standing]
    return [rule for found in rules(samples) for rule in found]


def test_a_second_jump_within_exactly_five_seconds_is_worse():
    assert jumps_at((1.0, 6.0)) == ["estimate_jump", "estimate_jump_again"]
    assert jumps_at((1.0, 6.0 + STEP)) == ["estimate_jump", "estimate_jump"]
    assert jumps_at((1.0, 3.0, 7.5)) == ["estimate_jump", "estimate_jump_again", "estimate_jump_again"]


@pytest.mark.parametrize("rule", ["position", "altitude"])
def test_after_a_step_velocity_and_position_are_compared_anew(rule):
    """1.5 m/s unexplained is accepted; with a step of a metre inside the window it would be too much."""
    shift = (1.0, 0.0, 0.0) if rule == "position" else (0.0, 0.0, 1.0)
    samples = cruise(30, shift=shift, at=15)
    drifting = [dataclasses.replace(s, velocity=CorridorVector(-1.0, 0.0, 0.0)) for s in samples]
    assert [len(found) for found in rules(drifting)] == [int(k == 15) for k in range(30)]


def test_the_longest_window_allowed_still_fills():
    """Longer ones need more samples than are kept, and would never tell anything."""
    longest = MonitorConfig(velocity_window_s=3.0, position_jump_m=5.0)
    drift = [state(5.0 + 2.0 * k * STEP, time_s=8.0 + k * STEP) for k in range(70)]
    assert rules(drift, config=longest)[-1] == ["velocity_mismatch"]


def test_a_step_of_exactly_the_limit_is_accepted():
    """Numbers that are exact in binary."""
    exact = MonitorConfig(position_jump_m=0.25, altitude_jump_m=0.25, velocity_mismatch_m_s=1.0, velocity_window_s=3.0)
    limit = 0.25 + STEP
    for shift in ((limit, 0, 0), (0, -limit, 0), (0, 0, limit), (0, 0, -limit)):
        pair = [state(4.0, 0.0, 2.0), state(4.0 + shift[0], shift[1], 2.0 + shift[2], time_s=STEP)]
        assert not any(rules(pair, config=exact))


def test_the_window_begins_with_the_newest_sample_that_makes_it_long_enough():
    """A sample at the very time from which on the window is too short is still used, and nothing before it counts."""
    newest_s = 0.5
    begin_s = newest_s - C.velocity_window_s + 1e-6
    places = {0.05: 4.8, begin_s: 5.0, 0.3: 5.3, newest_s: 5.0 + 2.0 * (newest_s - begin_s)}
    assert told([state(x, time_s=t) for t, x in places.items()])[-1] == [("velocity_mismatch", pytest.approx(2.0))]
    late = {(math.nextafter(t, 1.0) if t == begin_s else t): x for t, x in places.items() if t > 0.05}
    assert not any(told([state(x, time_s=t) for t, x in late.items()]))


@pytest.mark.parametrize("axis", range(3))
def test_the_drift_is_summed_from_zero_so_that_the_least_counts(axis):
    least = MonitorConfig(velocity_mismatch_m_s=1e-18)
    samples = [state(*(1e-17 * k * (i == axis) for i in range(3)), time_s=k * STEP) for k in range(10)]
    assert any(rules(samples, config=least))


@pytest.mark.parametrize("time_s", [0.9, float("1.0")])
def test_a_sample_no_newer_than_the_last_says_nothing(time_s):
    assert not any(rules([state(time_s=1.0), state(x=7.0, z=3.0, time_s=time_s)], commanded=1.0))


def test_tilt_of_exactly_a_limit_is_accepted():
    tilt = math.acos(math.cos(1.0))
    assert rules([state(roll=1.0)], config=MonitorConfig(tilt_rad=tilt)) == [[]]
    assert rules([state(pitch=-1.0)], config=MonitorConfig(tilt_rad=0.5, tumbling_rad=tilt)) == [["tilt"]]


def test_a_mismatch_of_exactly_the_limit_is_accepted():
    exact = MonitorConfig(velocity_mismatch_m_s=1.5, velocity_window_s=0.5)
    for axis in range(3):
        samples = [state(*(1.5 * k * STEP * (i == axis) for i in range(3)), time_s=8.0 + k * STEP) for k in range(20)]
        assert not any(rules(samples, config=exact))
        assert any(rules(samples, config=MonitorConfig(velocity_mismatch_m_s=1.4999, velocity_window_s=0.5)))


def test_velocity_that_turns_its_sign_is_seen_in_time():
    """E6: flying at 1 m/s while the estimate says -1 m/s, at 20 Hz: within the bound."""
    good = cruise(20, v=(1.0, 0, 0), step_s=0.05)
    bad = [state(5.0 + 0.05 * k, v=(-1.0, 0, 0), time_s=0.05 * k) for k in range(20, 40)]
    first = next(k for k, found in enumerate(rules(good + bad)) if found)
    assert 0.05 * (first - 20) <= 0.35


@pytest.mark.parametrize("over", [-1e-6, 1e-6])
def test_vertical_mismatch_has_the_same_limit(over):
    climb = [state(z=2.0 + (C.velocity_mismatch_m_s + over) * k * STEP, time_s=k * STEP) for k in range(8)]
    assert any(rules(climb)) == (over > 0)


def standing(ticks, step_s=0.05):
    return [state(v=(0.2, 0, 0), time_s=k * step_s) for k in range(ticks)]


def test_frozen_estimate_while_commanded():
    """E2: at 20 Hz 0.2 s is accepted, the fifth repeat is not; slower commands and any new bit clear it."""
    assert rules(standing(7), commanded=0.3) == [[]] * 5 + [["estimate_frozen"]] * 2
    assert not any(rules(standing(20), commanded=0.29))
    moved = standing(20)
    moved[4] = dataclasses.replace(moved[4], velocity=CorridorVector(0.2, 1e-12, 0.0))
    assert rules(moved, commanded=0.5)[:9] == [[]] * 9 or rules(moved, commanded=0.5)[9] == []
    assert rules(moved, commanded=0.5)[11] == ["estimate_frozen"]


def test_a_frozen_estimate_stays_one_when_nothing_is_commanded_any_more():
    """E2: braking must not make it look healthy; the first new bit does."""
    monitor, faults = EstimateMonitor(C), []
    for k in range(30):
        found = []
        sample = state(v=(0.2, 0, 0) if k < 20 else (0.2, 1e-12, 0), time_s=k * 0.05)
        monitor.judge(sample, Health(), 0.5 if k < 8 else 0.0, k * 0.05, found)
        faults.append([item.rule for item in found])
    assert faults == [[]] * 5 + [["estimate_frozen"]] * 15 + [[]] * 10


def test_a_microsecond_of_rounding_is_forgiven():
    """From time zero on, so that every difference is exact: the last sample just completes the window, or just does not."""
    rate = 2.0 * C.velocity_mismatch_m_s
    for short_s, is_told in ((1e-6, True), (2e-6, False)):
        last_s = C.velocity_window_s - short_s
        drift = [state(5.0 + rate * t, time_s=t) for t in (0.0, 0.1, 0.2, 0.3, last_s)]
        assert (rules(drift)[-1] == ["velocity_mismatch"]) == is_told
    for long_s, is_told in ((1e-6, False), (2e-6, True)):
        still = [state(v=(0.2, 0, 0), time_s=t) for t in (0.0, 0.1, C.frozen_state_s + long_s)]
        assert (rules(still, commanded=0.5)[-1] == ["estimate_frozen"]) == is_told


@pytest.mark.parametrize("changed", ["position", "velocity"])
@pytest.mark.parametrize("axis", "xyz")
def test_one_bit_of_position_or_velocity_is_enough_to_be_alive(changed, axis):
    samples = []
    for k, one in enumerate(standing(20)):
        vector = getattr(one, changed)
        moved = dataclasses.replace(vector, **{axis: getattr(vector, axis) + 1e-12 * k})
        samples.append(dataclasses.replace(one, **{changed: moved}))
    assert not any(rules(samples, commanded=0.5))


def test_a_still_estimate_is_counted_from_its_last_new_bit():
    """Times far from zero; moving first, then still for 0.25 s and more."""
    moving = [state(5.0 + 0.2 * k * STEP, v=(0.2, 0, 0), time_s=8.0 + k * STEP) for k in range(6)]
    still = [dataclasses.replace(moving[-1], time_s=8.0 + k * STEP) for k in range(6, 12)]
    wanted = [[("estimate_frozen", k * STEP)] if k * STEP > C.frozen_state_s else [] for k in range(1, 7)]
    assert told(moving + still, 0.5) == [[]] * 6 + wanted
    assert told([*standing(6, STEP)], 0.5) == [[]] * 4 + [[("estimate_frozen", k * STEP)] for k in (4, 5)]


def test_a_monitor_that_was_reset_judges_like_a_new_one():
    """Also just after a jump, a frozen estimate and a bad accuracy."""

    def run(monitor):
        result = []
        for k in range(24):
            y = 1.0 if 6 <= k < 9 else 0.0
            found = []
            sample = state(y=y, v=(0.2, 0, 0) if k < 12 else (0.2, 1e-9, 0), time_s=8.0 + k * STEP, roll=1.0 * (k == 3))
            monitor.judge(sample, Health(accuracy_m=3.0), 0.5 if k >= 2 else 0.0, sample.time_s, found)
            result.append([(item.rule, item.value) for item in found])
        return result

    used = EstimateMonitor(C)
    first = run(used)
    assert {rule for found in first for rule, _ in found} >= {"estimate_jump_again", "estimate_frozen", "estimate_inaccurate"}
    used.reset()
    assert run(used) == first == run(EstimateMonitor(C))


def test_the_same_sample_twice_is_neither_frozen_nor_a_jump():
    one = state(v=(0.2, 0, 0), time_s=1.0)
    assert not any(rules([one] * 20, commanded=1.0))


@pytest.mark.parametrize(
    ("roll", "pitch", "rule"),
    [
        (C.tilt_rad - 1e-9, 0, None), (0, -C.tilt_rad - 1e-6, "tilt"), (C.tumbling_rad - 1e-6, 0, "tilt"),
        (0, C.tumbling_rad + 1e-6, "tumbling"), (math.pi, 0, "tumbling"), (0.8, 0.8, "tilt"), (0.6, 0.6, None),
    ],
)  # fmt: skip
def test_tilt_limits_are_exact(roll, pitch, rule):
    """V9: both angles together make the tilt."""
    assert rules([state(roll=roll, pitch=pitch)]) == [[rule] if rule else []]


def test_what_the_estimator_says_of_itself():
    """E11 at once; E5 when it lasts longer than a second; unknown accuses nobody."""
    ticks = cruise(25)
    assert rules(ticks[:2], [Health(estimate_valid=True), Health(estimate_valid=False)]) == [[], ["estimate_invalid"]]
    poor = rules(ticks, [Health(accuracy_m=C.accuracy_m + 1e-9)] * 25)
    assert poor == [[]] * 17 + [["estimate_inaccurate"]] * 8
    assert not any(rules(ticks, [Health(accuracy_m=C.accuracy_m)] * 25))
    assert not any(rules(ticks, [Health(accuracy_m=2.0 if k % 16 else math.nan) for k in range(25)]))


@settings(deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-3.0, 3.0)] * 3), min_size=2, max_size=40),
    st.tuples(*[st.floats(-0.015, 0.015)] * 3),
)
def test_consistent_motion_is_never_accused(accelerations, bias):
    """Any motion with bounded acceleration whose velocity is off by a centimetre per second."""
    p, v, states = [5.0, 0.0, 2.0], [0.0, 0.0, 0.0], []
    for k, a in enumerate(accelerations):
        states.append(state(*p, v=tuple(v[i] + bias[i] for i in range(3)), time_s=0.05 * k))
        p = [p[i] + v[i] * 0.05 + a[i] * 0.00125 for i in range(3)]
        v = [v[i] + a[i] * 0.05 for i in range(3)]
    assert not any(rules(states, commanded=0.0))


@settings(deadline=None)
@given(st.floats(0.36, 50.0), st.floats(0, 2 * math.pi), st.floats(-1.2, 1.2), st.floats(-1.2, 1.2))
def test_any_larger_step_is_a_jump(size, angle, vx, vy):
    shift = (size * math.cos(angle), size * math.sin(angle), 0.0)
    assert rules(cruise(4, v=(vx, vy, 0), shift=shift, at=3))[3] == ["estimate_jump"]


@settings(deadline=None)
@given(st.integers(0, 255), st.integers(0, 255))
def test_reset_is_seen_if_and_only_if_the_counter_changed(a, b):
    pair = [dataclasses.replace(s, reset_counter=c) for s, c in zip(cruise(2), (a, b), strict=True)]
    assert (rules(pair)[1] == ["estimate_reset"]) == (a != b)
