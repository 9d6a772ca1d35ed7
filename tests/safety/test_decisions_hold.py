"""What was sent stands up to the filter's own judgement: asked for as a command in the same place, it is sent again."""

from __future__ import annotations

import copy
import dataclasses
import math
import random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_plant import Plant, command, config

from safety.config import Fence
from safety.filter import SafetyFilter
from safety.free_space import TAKE_OFF_M
from safety.messages import VelocityCommand

few = settings(max_examples=20, deadline=None)
PILLARS = np.array([(6.3, -0.4, 6.7, 0.2), (6.0, 1.1, 6.4, 1.5), (4.0, -1.6, 4.4, -1.2)])


def tick(plant: Plant):
    return plant.estimate(), plant.scan(), plant.time_s


@few
@given(st.integers(0, 10_000), st.sampled_from(({}, {"obstacle_speed_m_s": 0.3}, {"max_acceleration_m_s2": 2.0})))
def test_what_was_sent_would_be_sent_again(seed, changes):
    """No rule is applied after another has judged: neither limits after the fence, nor candidates that nobody looked at."""
    chance = random.Random(seed)
    safety, plant = SafetyFilter(config(**changes)), Plant(boxes=PILLARS, seed=seed, y=chance.uniform(-0.6, 0.6))
    bearing = chance.uniform(-0.9, 0.9)
    for _ in range(40):
        if chance.random() < 0.1:
            bearing = chance.uniform(-0.9, 0.9)
        seen = tick(plant)
        before = copy.deepcopy(safety)
        sent, verdict = safety.apply(command(1.2 * math.cos(bearing), 1.2 * math.sin(bearing)), *seen)
        if not {"hold_off", "return_speed"} & {why.rule for why in verdict.interventions}:
            again, _ = before.apply(VelocityCommand(sent.velocity, sent.yaw_rate_rad_s), *seen)
            assert math.dist(dataclasses.astuple(again.velocity), dataclasses.astuple(sent.velocity)) < 1e-6, verdict
        plant.fly(sent)


def told(answer) -> tuple:
    sent, verdict = answer
    return sent, verdict.fault, [why.rule for why in verdict.interventions]


@few
@given(st.integers(4, 12))
def test_after_reset_nothing_of_the_last_flight_is_left(ticks):
    """Commands sent before a reset are no longer in flight: near a wall they would count as way still to come."""
    wall, used, plant = np.array([(5.7, -4.0, 5.9, 4.0)]), SafetyFilter(config()), Plant(x=0.0, time_s=100.0 - 0.05 * ticks)
    for _ in range(ticks):
        sent, _ = used.apply(command(1.2), *tick(plant))
        plant.fly(sent)
    used.reset()
    near_the_wall = tick(Plant(boxes=wall, time_s=plant.time_s))
    assert told(used.apply(command(0.5), *near_the_wall)) == told(SafetyFilter(config()).apply(command(0.5), *near_the_wall))


@few
@given(st.floats(0.05, 0.25), st.floats(0.05, 0.5), st.floats(0.3, 1.2))
def test_outside_one_edge_the_others_hold(out, room, speed):
    """A little beyond the fence on one side, and flown towards another: there it still stops inside."""
    chosen = config(fence=Fence(min_m=(-2.0, -3.0, 0.3), max_m=(8.0, 3.0, 4.0)))
    inside = 3.0 - chosen.vehicle_radius_m - chosen.position_error_m - chosen.braked_drift_m - chosen.margin_m
    safety, plant = SafetyFilter(chosen), Plant(x=5.0 + inside + out, y=inside - room, yaw=math.pi / 2.0)
    for _ in range(60):
        sent, _ = safety.apply(command(0.0, speed), *tick(plant))
        plant.fly(sent)
        assert plant.y <= inside + 0.25 * chosen.margin_m + 1e-3


@few
@given(st.floats(0.2, 1.2), st.floats(-0.9, 0.9))
def test_nothing_is_flown_into_what_no_beam_has_seen(speed, aside):
    """It looks ahead only and flies backwards: no further than what must be free around it when it engages."""
    bearing = math.pi + aside
    safety, plant, rules = SafetyFilter(config()), Plant(), set()
    for _ in range(60):
        sent, verdict = safety.apply(command(speed * math.cos(bearing), speed * math.sin(bearing)), *tick(plant))
        rules |= {why.rule for why in verdict.interventions}
        plant.fly(sent)
        behind = (plant.x - 5.0) < 0.0
        assert not behind or math.hypot(plant.x - 5.0, plant.y) + config().vehicle_radius_m <= TAKE_OFF_M
    assert "unseen" in rules


def refused_from_m(speed: float, wanted: float) -> float:
    """Distance of a wall ahead from which `wanted` is no longer sent as it is, to the millimetre."""
    near, far = 0.4, 3.9
    while far - near > 1e-3:
        middle = 0.5 * (near + far)
        plant = Plant(boxes=np.array([(5.0 + middle, -9.0, 5.0 + middle + 0.2, 9.0)]))
        sent, _ = SafetyFilter(config(obstacle_speed_m_s=speed)).apply(command(wanted), *tick(plant))
        near, far = (near, middle) if sent.velocity.x >= wanted else (middle, far)
    return far


@few
@given(st.floats(0.1, 0.6), st.floats(0.1, 0.35))
def test_from_movers_it_keeps_their_way_until_it_stands(speed, wanted):
    """The distance grows by at least what a mover covers in dead time, tick and the fast vehicle's lag."""
    blind_s = config().dead_time_s + config().tick_s + config().lag_min_s
    assert refused_from_m(speed, wanted) - refused_from_m(0.0, wanted) >= speed * blind_s - 2e-3
