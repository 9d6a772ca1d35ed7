"""Acceleration and jerk of the command, as vectors, relative to the command last sent; slowing down and easing off are free."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import command, config

from safety.config import speed_cap_m_s
from safety.frames import CorridorVector
from safety.limits import AT_REST, LastSent, _towards, limit_command, sent_after, within_limits

DT_S = 0.05
part = st.floats(-0.8, 0.8)  # below the speed limit, which would come first
vector = st.tuples(part, part, st.floats(-0.5, 0.5))


def v(x=0.0, y=0.0, z=0.0) -> CorridorVector:
    return CorridorVector(x, y, z)


def limited(wanted, last, **changes):
    result, found = limit_command(command(*wanted), last, DT_S, 4.0, config(**changes))
    return np.array((result.velocity.x, result.velocity.y, result.velocity.z)), {i.rule for i in found}


def distance_to_way(p, end) -> float:
    """Distance of a point from the straight way between zero and `end`."""
    share = np.clip(p @ end / max(end @ end, 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(p - share * end))


def test_a_length_beyond_all_numbers_is_shortened_to_the_limit():
    """Either part is finite, their length is not."""
    sent, rules = limited((1.7e308, -1.7e308, 0.0), AT_REST, max_acceleration_m_s2=100.0, max_jerk_m_s3=1000.0)
    assert sent == pytest.approx((1.2 / math.sqrt(2.0), -1.2 / math.sqrt(2.0), 0.0))
    assert rules == {"speed_limit"}


def test_the_speed_limit_falls_with_the_range_of_the_sensor():
    chosen = config(max_acceleration_m_s2=100.0, max_jerk_m_s3=1000.0)
    for sight in (0.5, 1.0, 2.0):
        sent = limit_command(command(1.2), AT_REST, DT_S, sight, chosen)[0].velocity.x
        assert sent == pytest.approx(speed_cap_m_s(sight - chosen.keep_out_m, chosen.delay_s, chosen.braking_m_s2))
        assert chosen.stop_distance_m(sent) < sight


def test_growth_takes_two_ticks_from_rest():
    first, rules = limited((1.0, 0.0), AT_REST)
    assert first == pytest.approx((0.375, 0.0, 0.0))  # 150 m/s^3 for one tick
    assert rules == {"acceleration_limit", "jerk_limit"}
    last = sent_after(AT_REST, v(0.375), DT_S)
    assert last.acceleration.x == pytest.approx(7.5)
    second, rules = limited((1.0, 0.0), last)
    assert second == pytest.approx((0.875, 0.0, 0.0))
    assert rules == {"acceleration_limit"}


@pytest.mark.parametrize("wanted", [(0.0, 0.0), (0.3, 0.0), (0.8, 0.0), (0.9, 0.0)])
def test_braking_and_easing_off_are_free(wanted):
    sent, rules = limited(wanted, LastSent(v(0.8), v(10.0)))
    assert rules == set()
    assert sent[0] == wanted[0]


def test_a_turn_of_the_growth_is_limited_beside_the_way_and_beyond_its_end():
    """10 m/s^2 ahead, then across: 0.375 m/s a tick beside the way that growth may shrink along, none of it slanted."""
    fast = LastSent(v(), v(10.0))
    across, rules = limited((0.0, 0.5), fast)
    assert rules == {"jerk_limit"}
    assert across == pytest.approx((0.0, 0.375, 0.0))
    slanted, _ = limited((0.3, 0.4), fast, max_jerk_m_s3=100.0)
    assert slanted == pytest.approx(np.array((0.75, 1.0, 0.0)) * 0.25)
    beyond, _ = limited((0.6, 0.3), LastSent(v(), v(4.0)), max_jerk_m_s3=100.0)
    assert np.linalg.norm(beyond - (0.2, 0.0, 0.0)) == pytest.approx(0.25)
    assert beyond[1] / beyond[0] == pytest.approx(0.5)


def slack_m_s(wanted, last, dt_s, c):
    """By how much a command keeps to its tightest limit, negative where it breaks it."""
    wanted, old, growth = (np.array((p.x, p.y, p.z)) for p in (wanted, last.velocity, last.acceleration))
    added = wanted - min(max(wanted @ old / max(old @ old, 1e-300), 0.0), 1.0) * old
    return min(
        c.max_horizontal_speed_m_s - math.hypot(wanted[0], wanted[1]),
        c.max_vertical_speed_m_s - abs(wanted[2]),
        c.max_acceleration_m_s2 * dt_s - float(np.linalg.norm(added)),
        c.max_jerk_m_s3 * dt_s * dt_s - distance_to_way(added, growth * dt_s),
    )


@pytest.mark.parametrize("seed", range(40))
def test_what_evades_keeps_to_the_very_limits_of_what_is_wanted(seed):
    """Candidates at every distance from their tightest limit, each judged by itself."""
    random = np.random.default_rng(seed)
    c = config(max_acceleration_m_s2=float(random.choice([2.0, 10.0])), max_jerk_m_s3=float(random.choice([30.0, 150.0])))
    last = LastSent(v(*random.uniform(-0.6, 0.6, 3)), v(*(random.choice([0.0, 8.0]) * random.uniform(-1, 1, 3))))
    dt_s = float(random.choice([0.05, 0.1]))
    velocities = [v(*(random.choice([0.3, 0.7, 1.3]) * random.uniform(-1, 1, 3))) for _ in range(60)]
    slack = np.array([slack_m_s(one, last, dt_s, c) for one in velocities])
    found = within_limits(np.array([(one.x, one.y, one.z) for one in velocities]), last, dt_s, c)
    clear = np.abs(slack) > 1e-6
    assert found[clear].tolist() == (slack > 0.0)[clear].tolist()


QUICK = {"max_horizontal_speed_m_s": 4.0, "max_acceleration_m_s2": 900.0, "max_jerk_m_s3": 8.0}  # half a metre per second a tick


@pytest.mark.parametrize("growth_m_s", [1.0, 0.5])
@pytest.mark.parametrize("share", [-0.5, 0.0, 0.25, 0.5, 1.0, 1.5])
def test_a_change_of_the_growth_that_is_exceeded_by_rounding_alone_is_free(share, growth_m_s):
    """After a growth ahead: half a billionth further than the change allows, behind its begin, beside it and beyond its end."""
    nearest = min(max(share, 0.0), 1.0) * growth_m_s
    off = np.array((math.copysign(0.5, share), 0.0) if nearest != share * growth_m_s else (0.0, 0.5))
    for further_m_s, rules in ((0.5e-9, ()), (2e-9, ("jerk_limit",))):
        x, y = np.array((nearest, 0.0)) + off * (0.5 + further_m_s) / 0.5
        found = limit_command(command(x, y), LastSent(v(), v(4.0 * growth_m_s)), 0.25, 40.0, config(**QUICK))[1]
        assert tuple(item.rule for item in found) == rules


def test_growth_straight_on_is_cut_where_the_change_ends():
    sent, _ = limit_command(command(2.0), LastSent(v(), v(4.0)), 0.25, 40.0, config(**QUICK))
    assert sent.velocity.x == pytest.approx(1.5)


def test_a_root_that_rounding_puts_below_zero_counts_as_zero():
    """Nearly seven times the growth before, and a change so small that 2e-19 are missing under the root."""
    before = v(0.04279656521709558, -0.046302189806385376, 0.03908254659025412)
    stiff = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=900.0, max_jerk_m_s3=2.9615530964106104e-13)
    wanted = command(0.300678262358965, -0.32530792845831247, 0.2745844710160662)
    sent = limit_command(wanted, LastSent(v(), before), 1.0, 40.0, stiff)[0].velocity
    assert (sent.x, sent.y, sent.z) == pytest.approx((before.x, before.y, before.z), rel=1e-3)


def test_a_change_far_below_rounding_never_leads_beyond_the_growth_before():
    """Twice that growth is wanted, and no change of it is allowed: whichever way numbers are rounded."""
    random = np.random.default_rng(0)
    stiff = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=900.0, max_jerk_m_s3=1e-9)
    for _ in range(200):
        before = random.uniform(-0.2, 0.2, 3)
        sent, _ = limit_command(command(*(2.0 * before)), LastSent(v(), v(*before)), 1.0, 40.0, stiff)
        assert distance_to_way(np.array((sent.velocity.x, sent.velocity.y, sent.velocity.z)), before) < 1e-7


@pytest.mark.parametrize("length_m_s", [1.0, 1e-3, 1e-5, 1e-8, 0.0])
def test_the_nearest_place_on_a_way_however_short(length_m_s):
    end = length_m_s * np.array((0.6, -0.8, 0.0))
    aside = length_m_s * np.array((0.8, 0.6, 2.0))
    for share, nearest in ((-0.5, 0.0), (0.25, 0.25), (1.0, 1.0), (1.5, 1.0)):
        for scale in (1.0, 0.1):
            found = _towards(np.array([scale * (share * end + aside)]), v(*end), scale)
            assert found[0] == pytest.approx(scale * nearest * end, rel=1e-9, abs=1e-7 * length_m_s)


def test_of_a_way_shorter_than_rounding_next_to_nothing_is_kept():
    assert abs(_towards(np.array([(1e-10, 0.0, 0.0)]), v(1e-10), 1.0)).max() < 1e-11


def test_limits_met_exactly_by_what_evades_are_kept():
    """A billionth of slack for what is computed; none for climbing, which is compared as it is."""
    wide = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=8.0, max_jerk_m_s3=1000.0)
    jerky = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=900.0, max_jerk_m_s3=32.0)
    free = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=900.0, max_jerk_m_s3=1000.0)
    for chosen, speed_m_s in ((wide, 2.0 + 1e-9), (jerky, 2.0 + 1e-9), (free, 4.0 + 1e-9)):
        at_limit = np.array([(speed_m_s, 0, 0), (math.nextafter(speed_m_s, 9.0), 0, 0), (0, -speed_m_s, 0)])
        assert within_limits(at_limit, AT_REST, 0.25, chosen).tolist() == [True, False, True]
    climbs = np.array([(0, 0, 0.5), (0, 0, -0.5), (0, 0, math.nextafter(0.5, 1.0)), (0, 0, math.nextafter(-0.5, -1.0))])
    assert within_limits(climbs, AT_REST, 0.25, free).tolist() == [True, True, False, False]


def test_a_growth_too_small_to_be_squared_counts_as_none():
    tiny = v(1e-170, 1e-170, 1e-170)
    assert limited((0.8, 0.1, -0.2), LastSent(v(), tiny))[0] == pytest.approx(limited((0.8, 0.1, -0.2), AT_REST)[0], rel=1e-12)


@given(vector, vector, vector, st.floats(1.0, 300.0), st.floats(1.0, 15.0))
@settings(max_examples=300, deadline=None)
def test_growth_never_jumps_by_more_than_the_jerk(wanted, last, growth, jerk, acceleration):
    growth = np.array(growth) * acceleration
    sent, _ = limited(wanted, LastSent(v(*last), v(*growth)), max_jerk_m_s3=jerk, max_acceleration_m_s2=acceleration)
    wanted, last = np.array(wanted), np.array(last)
    keep = np.clip(wanted @ last / max(last @ last, 1e-300), 0.0, 1.0)
    added = sent - keep * last
    assert distance_to_way(added, growth * DT_S) <= jerk * DT_S**2 + 1e-6
    assert np.linalg.norm(added) <= acceleration * DT_S + 1e-6
    assert np.linalg.norm(np.cross(added, wanted - keep * last)) < 1e-9  # shorter, never turned
    assert math.hypot(*sent[:2]) <= 1.2 + 1e-9
