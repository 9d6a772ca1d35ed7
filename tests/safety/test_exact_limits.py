"""Limits met exactly, and passed by the least there is: what a wrong comparison would get away with."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from pydantic import ValidationError
from safety_plant import command, config, scan, state

from safety.braking import Start, tubes
from safety.config import Fence, braking_distance_m
from safety.fence import PolygonFence, polygon_fence, signed_area_m2
from safety.filter import SafetyFilter, gate_problem
from safety.frames import CorridorFrame, CorridorVector, NedVector
from safety.limits import AT_REST, LastSent, limit_command, sent_after
from safety.messages import SafeCommand, VelocityCommand
from safety.shield import Decision


def test_frames_can_be_asked_through_an_object_too():
    frame = CorridorFrame(NedVector(3.0, 4.0, -1.0), 0.7)
    there, here = NedVector(1.0, -2.0, -3.0), CorridorVector(2.0, 1.0, 3.0)
    assert frame.anchored(there, here, 0.7) == CorridorFrame.anchored(there, here, 0.7)
    assert frame.yaw_rate_to_ned(0.25) == -0.25


TRIANGLE = ((0.1, 0.1), (0.4, 0.1), (0.1, 0.4))
SMALL = ((0.15, 0.15), (0.2, 0.15), (0.15, 0.2))


@pytest.mark.parametrize("outer", [TRIANGLE, TRIANGLE[::-1]])
@pytest.mark.parametrize("inner", [SMALL, SMALL[::-1]])
def test_allowed_space_is_on_the_left_of_every_edge_however_small(outer, inner):
    fence = PolygonFence(outer, (inner,))
    areas = []
    for number in (0, 1):
        own = fence.edges.ring == number
        areas.append(signed_area_m2(list(zip(fence.edges.x_m[own], fence.edges.y_m[own], strict=True))))
    assert areas == pytest.approx([0.045, -0.00125])


def test_a_fence_without_a_vehicle_is_not_eroded():
    place = np.array((0.2, 0.14))
    for fence in (polygon_fence(TRIANGLE, ()), PolygonFence(TRIANGLE, ())):
        assert fence.room_m(place) == pytest.approx(0.04)
    assert polygon_fence(TRIANGLE, (), 0.01, 0.02).room_m(place) == pytest.approx(0.01)


def vector(chance, size):
    return CorridorVector(*(chance.uniform(-size, size) for _ in range(3)))


def distance_to_way(p, end) -> float:
    share = np.clip(p @ end / max(end @ end, 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(p - share * end))


@pytest.mark.parametrize("seed", range(200))
def test_growth_is_cut_where_a_search_by_halves_cuts_it(seed):
    """Acceleration first, then jerk: the largest share of what is left that stays near enough to the growth before."""
    chance = random.Random(seed)
    last = LastSent(vector(chance, 0.4), vector(chance, chance.choice((0.0, 1.0, 4.0, 9.0))))
    wanted, dt = vector(chance, chance.choice((0.1, 0.45))), chance.choice((0.05, 0.1))
    limits = {"max_acceleration_m_s2": chance.choice((1.0, 5.0, 50.0)), "max_jerk_m_s3": chance.choice((5.0, 60.0, 400.0))}
    sent, found = limit_command(command(wanted.x, wanted.y, wanted.z), last, dt, 4.0, config(**limits))
    old, new, before = (np.array((p.x, p.y, p.z)) for p in (last.velocity, wanted, last.acceleration))
    before = before * dt
    kept = old * min(max(float(new @ old) / float(old @ old), 0.0), 1.0)
    added = new - kept
    rules = []
    if np.linalg.norm(added) > limits["max_acceleration_m_s2"] * dt + 1e-9:
        rules.append("acceleration_limit")
        added = added * limits["max_acceleration_m_s2"] * dt / np.linalg.norm(added)
    change, share = limits["max_jerk_m_s3"] * dt * dt, 1.0
    if distance_to_way(added, before) > change + 1e-9:
        rules.append("jerk_limit")
        low, share = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + share)
            low, share = (middle, share) if distance_to_way(middle * added, before) <= change else (low, middle)
    assert [item.rule for item in found] == rules
    result = np.array((sent.velocity.x, sent.velocity.y, sent.velocity.z))
    assert result == pytest.approx(kept + share * added, abs=1e-8)
    for item in found:
        if item.rule == "jerk_limit":
            assert (item.value, item.limit) == pytest.approx((np.linalg.norm(added), share * np.linalg.norm(added)), abs=1e-8)
    after = sent_after(last, sent.velocity, dt).acceleration
    again = result - old * min(max(float(result @ old) / float(old @ old), 0.0), 1.0)
    assert (after.x, after.y, after.z) == pytest.approx(again / dt, abs=1e-7)


@pytest.mark.parametrize("seed", range(30))
def test_a_velocity_that_fits_is_sent_bit_for_bit_though_the_yaw_rate_is_cut(seed):
    chance = random.Random(seed)
    last, wanted = LastSent(vector(chance, 0.3), CorridorVector(0.0, 0.0, 0.0)), vector(chance, 0.3)
    sent, found = limit_command(
        command(wanted.x, wanted.y, wanted.z, 2.0), last, 0.05, 4.0, config(max_acceleration_m_s2=900.0, max_jerk_m_s3=1000.0)
    )
    free = math.dist((wanted.x, wanted.y, wanted.z), (last.velocity.x, last.velocity.y, last.velocity.z)) < 1.0
    assert free
    assert [item.rule for item in found] == ["yaw_rate_limit"]
    assert (sent.velocity, sent.yaw_rate_rad_s) == (wanted, 1.0)


def test_acceleration_and_jerk_met_exactly_are_free():
    wide = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=8.0, max_jerk_m_s3=1000.0, lag_s=0.6)
    just, more = 2.0 + 1e-9, math.nextafter(2.0 + 1e-9, 3.0)
    assert limit_command(command(just), AT_REST, 0.25, 40.0, wide)[1] == ()
    assert [item.rule for item in limit_command(command(more), AT_REST, 0.25, 40.0, wide)[1]] == ["acceleration_limit"]
    jerky = config(max_horizontal_speed_m_s=4.0, max_acceleration_m_s2=900.0, max_jerk_m_s3=32.0)
    assert limit_command(command(just), AT_REST, 0.25, 40.0, jerky)[1] == ()
    assert [item.rule for item in limit_command(command(more), AT_REST, 0.25, 40.0, jerky)[1]] == ["jerk_limit"]


def test_speed_yaw_and_climb_met_exactly_are_free():
    exact = command(1.25, 0.0, -0.5, -1.0)
    wide = config(max_horizontal_speed_m_s=1.25, max_acceleration_m_s2=900.0, max_jerk_m_s3=1000.0)
    assert limit_command(exact, AT_REST, 0.25, 40.0, wide) == (exact, ())
    above = command(math.nextafter(1.25, 2.0), 0.0, math.nextafter(-0.5, -1.0), math.nextafter(-1.0, -2.0))
    sent, found = limit_command(above, AT_REST, 0.25, 40.0, wide)
    assert [item.rule for item in found] == ["speed_limit", "vertical_speed_limit", "yaw_rate_limit"]
    assert sent == exact
    assert [(item.value, item.limit) for item in found] == [
        (above.velocity.x, 1.25),
        (-above.velocity.z, 0.5),
        (-above.yaw_rate_rad_s, 1.0),
    ]


@pytest.mark.parametrize("speed", [0.3, 0.6, 0.61, 1.5, 4.0])
def test_a_tube_is_as_long_as_the_braking_distance(speed):
    """Below and above the speed at which the deceleration limit binds (b tau = 0.6 m/s here)."""
    c = config(braking_m_s2=1.0, lag_s=0.6)
    start = Start(np.zeros((2, 3)), np.tile((0.0, speed, 0.0), (2, 1)))
    tube = tubes(start, np.array([[0.0, speed, 0.0]]), c)
    assert (tube.stop_m - tube.turn_m)[..., 1] == pytest.approx(braking_distance_m(speed, 0.6, 1.0))


def test_a_figure_of_eight_is_no_fence():
    eight = ((0.0, 0.0), (20.0, 10.0), (20.0, 0.0), (0.0, 6.0))
    with pytest.raises(ValidationError, match="crosses"):
        Fence(floor_m=0.0, ceiling_m=4.0, inclusion=eight)


def test_yaw_is_told_within_half_a_turn():
    frame = CorridorFrame(NedVector(0.0, 0.0, 0.0), 3.0)
    assert frame.yaw_to_ned(-3.0) == pytest.approx(6.0 - 2.0 * math.pi)
    assert frame.yaw_to_corridor(-3.0) == pytest.approx(6.0 - 2.0 * math.pi)


@pytest.mark.parametrize("heading", [-3.1, 0.0, 3.1])
@pytest.mark.parametrize("yaw", [-9.0, -3.1, 0.2, 3.1, 9.0])
def test_yaw_there_and_back_is_the_same_direction(heading, yaw):
    frame = CorridorFrame(NedVector(0.0, 0.0, 0.0), heading)
    assert abs(frame.yaw_to_ned(yaw)) <= math.pi
    assert math.remainder(frame.yaw_to_corridor(frame.yaw_to_ned(yaw)) - yaw, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


def flown(**changes):
    """A filter that has flown forward for a while, and its time."""
    safety = SafetyFilter(config(**changes))
    for k in range(6):
        safety.apply(command(0.2), state(time_s=0.05 * k), scan(time_s=0.05 * k), 0.05 * k)
    return safety, 0.3


def test_nothing_is_in_flight_after_reset():
    safety, now = flown()
    assert safety._history.newest().x == 0.2
    safety.reset()
    before = CorridorVector(0.1, 0.0, 0.0)
    assert [part[1] for part in safety._history.phases(now - 0.2, now, before)] == [before]


def test_commands_of_another_flight_shorten_nothing():
    """Just after reset the filter decides as a new one does, at the same times."""
    used, now = flown()
    used.reset()
    wall = np.where(np.abs(np.arange(180) - 89.5) < 20, 1.35, np.inf)
    pose, seen = state(v=(0.4, 0.0, 0.0), time_s=now), scan(wall, now)
    sent, verdict = used.apply(command(0.5), pose, seen, now)
    fresh, wanted = SafetyFilter(config()).apply(command(0.5), pose, seen, now)
    assert (sent, repr(verdict)) == (fresh, repr(wanted))


def test_a_pause_counts_as_two_ticks_at_most():
    safety, now = flown()
    assert safety._dt_s(now) == pytest.approx(0.05)
    assert safety._dt_s(now + 60.0) == 0.1


def test_after_a_pause_the_command_grows_as_after_two_ticks():
    safety = SafetyFilter(config(max_acceleration_m_s2=2.0, max_jerk_m_s3=1000.0))
    safety.apply(command(), state(), scan(), 0.0)
    sent, _ = safety.apply(command(0.9), state(time_s=0.24), scan(time_s=0.24), 0.24)
    assert sent.velocity.x == pytest.approx(0.2)


def gate(x=0.0, y=0.0, z=0.0, rate=0.0):
    found = gate_problem(SafeCommand(CorridorVector(x, y, z), rate), config())
    return None if found is None else found.rule


def test_the_gate_is_exact_for_each_number_and_for_the_vector():
    slack = 1.0 + 1e-9
    assert gate(x=1.2 * slack) == gate(z=0.5 * slack) == gate(z=-0.5 * slack) == gate(rate=-slack) is None
    assert gate(x=1.2 * slack**2) == gate(z=0.5 * slack**2) == gate(z=-0.5 * slack**2) == gate(rate=-(slack**2)) == "gate_limit"
    assert gate(x=0.9, y=-0.9) == "gate_limit"
    assert {gate(**{name: value}) for name in ("x", "y", "z", "rate") for value in (math.nan, math.inf)} == {"gate_not_finite"}


@pytest.mark.parametrize("bad", [(math.nan, 0.0, 0.0), (0.0, 0.0, 0.6), (0.9, 0.9, 0.0)])
def test_what_a_stage_lets_through_ends_at_the_gate(monkeypatch, bad):
    wrong = VelocityCommand(CorridorVector(*bad), 0.0)
    monkeypatch.setattr("safety.filter.limit_command", lambda *_: (wrong, ()))
    monkeypatch.setattr("safety.shield.Shield.choose", lambda _self, wanted, *_: Decision(wanted, (), 1.0, 1.0))
    sent, verdict = SafetyFilter(config()).apply(command(0.1), state(), scan(), 0.0)
    assert sent.velocity == CorridorVector(0.0, 0.0, 0.0)
    assert verdict.fault in {"gate_not_finite", "gate_limit"}
