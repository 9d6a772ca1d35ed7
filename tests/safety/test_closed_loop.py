"""Closed loop on a point mass: adversaries against the filter, the assumptions held at their bounds. No crossing, no contact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import Plant, command, config

from safety.filter import SafetyFilter

WALLS = [(-3.0, 4.0, 40.0, 5.0), (-3.0, -5.0, 40.0, -4.0)]
GAP = [(8.0, -4.0, 8.7, -0.5), (8.0, 0.5, 8.7, 4.0)]


def pillars(seed: int) -> list[tuple[float, float, float, float]]:
    random = np.random.default_rng(seed)
    return [(x, y, x + 0.6, y + 0.6) for x, y in zip(random.uniform(4, 30, 12), random.uniform(-4, 3.4, 12), strict=True)]


class Run:
    """One flight: what came nearest, how far out of the fence, what was sent."""

    def __init__(self, policy, plant: Plant, ticks: int, before: Run | None = None, **changes):
        self.plant, self.config = plant, config(**changes)
        self.gap, self.out, self.faults, self.changed, self.top = math.inf, -math.inf, set(), 0, 0.0
        self.safety = safety = before.safety if before else SafetyFilter(self.config)
        low, high = self.config.fence.min_m, self.config.fence.max_m
        for k in range(ticks):
            wanted = policy(k, plant)
            sent, verdict = safety.apply(wanted, plant.estimate(), plant.scan(), plant.time_s)
            plant.fly(sent)
            self.faults.add(verdict.fault)
            self.changed += sent.velocity != wanted.velocity
            self.gap = min(self.gap, plant.gap)
            place, hull = (plant.x, plant.y, plant.z), (0.35, 0.35, 0.1)
            self.out = max(self.out, *(max(low[i] + hull[i] - place[i], place[i] + hull[i] - high[i]) for i in range(3)))
            self.top = max(self.top, math.hypot(sent.velocity.x, sent.velocity.y))

    def assert_safe(self):
        assert self.faults == {None}
        assert self.gap > 0.0
        assert self.out < 0.0
        assert self.top <= 1.2 * (1 + 1e-9)


def heading(plant: Plant, x: float, y: float, z: float, rate: float):
    c, s = math.cos(plant.yaw), math.sin(plant.yaw)
    return command(c * x - s * y, s * x + c * y, z, rate)


def bang(seed: int, hold: int = 15):
    """Corner of the action box, redrawn every `hold` ticks."""
    random, corner = np.random.default_rng(1000 + seed), [0.0] * 4

    def policy(k, plant):
        if k % hold == 0:
            corner[:] = random.choice([-0.5, 1.0]), random.choice([-0.5, 0.5]), random.choice([-0.5, 0.5]), random.choice([-1, 1])
        return heading(plant, *corner)

    return policy


def noise(seed: int):
    random = np.random.default_rng(2000 + seed)
    return lambda k, plant: heading(plant, *random.uniform((-0.5, -0.5, -0.5, -1), (1.0, 0.5, 0.5, 1)))


def aim(k, plant):
    """Straight at the nearest box, as fast as can be, looking at it."""
    b = plant.boxes
    x, y = np.clip(plant.x, b[:, 0], b[:, 2]), np.clip(plant.y, b[:, 1], b[:, 3])
    i = int(np.argmin(np.hypot(x - plant.x, y - plant.y)))
    bearing = math.atan2(y[i] - plant.y, x[i] - plant.x)
    turn = max(-1.0, min(1.0, 4 * math.remainder(bearing - plant.yaw, 2 * math.pi)))
    return command(1.2 * math.cos(bearing), 1.2 * math.sin(bearing), 0.0, turn)


def towards(x, y, z):
    def policy(k, plant):
        d = np.array((x - plant.x, y - plant.y, z - plant.z))
        d = d / max(float(np.abs(d).max()), 1e-6)
        turn = max(-1.0, min(1.0, 4 * math.remainder(math.atan2(d[1], d[0]) - plant.yaw, 2 * math.pi)))
        return command(*(2.0 * d), turn)

    return policy


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("adversary", [bang, noise])
def test_random_adversaries_among_pillars(adversary, seed):
    plant = Plant(x=1.0, boxes=np.array(WALLS + pillars(seed)), noise_m=0.01, seed=seed, lag_s=(0.35, 0.45, 0.6)[seed % 3])
    Run(adversary(seed), plant, 900).assert_safe()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_aiming_at_pillars_with_estimate_errors_at_their_bound(seed, sign):
    plant = Plant(
        x=1.0, boxes=np.array(WALLS + pillars(seed)), noise_m=0.01, seed=seed, lag_s=0.6, velocity_error=(sign * 0.05, 0, 0)
    )
    plant.position_error = (sign * 0.05, -sign * 0.05, 0.05)
    Run(aim, plant, 500).assert_safe()


@pytest.mark.parametrize("corner", [(x, y, z) for x in (-9, 60) for y in (-20, 20) for z in (-5, 20)])
@pytest.mark.parametrize("error", [-0.05, 0.05])
def test_corners_of_the_fence_with_errors_pushed_outwards(corner, error):
    """Edges 1, 2, 5, 8, 10, 17: full speed into a corner of the box, the estimate off by its bound on every axis."""
    place = {"x": 2.0 if corner[0] < 0 else 33.0, "y": 3.0 * np.sign(corner[1]), "z": 2.0}
    plant = Plant(**place, lag_s=0.6, position_error=(error,) * 3, velocity_error=(error,) * 3)
    run = Run(towards(*corner), plant, 300, ground_z_m=-100.0)
    run.assert_safe()
    assert run.out > -0.8  # it does get near: the fence is usable space


@pytest.mark.parametrize("seed", range(3))
def test_bang_bang_against_the_fence_alone(seed):
    plant = Plant(x=0.0, y=4.0, lag_s=0.6, seed=seed, position_error=(0.05, 0.05, -0.05), velocity_error=(-0.05, 0.05, 0.05))
    Run(bang(seed, hold=9), plant, 900, ground_z_m=-100.0).assert_safe()


def test_model_too_optimistic_is_what_breaks_it():
    """The test can fail: a plant 2.5 times slower than assumed, flown at a wall, comes through the margin."""
    plant = Plant(x=1.0, boxes=np.array([(6.0, -4.0, 7.0, 4.0)]), lag_s=1.5)
    run = Run(lambda k, p: command(1.2), plant, 300)
    assert run.gap < 0.0


@pytest.mark.parametrize("offset", [-0.3, -0.1, 0.0, 0.2, 0.4])
def test_a_gap_of_one_metre_is_flown_through(offset):
    """Liveness: 0.15 m on each side, arriving up to 0.4 m off the middle."""
    plant = Plant(x=2.0, y=offset, boxes=np.array(WALLS + GAP), noise_m=0.01)
    run = Run(lambda k, p: command(1.0, 0.5 * max(-1, min(1, -p.y / 0.5)) if p.x < 6.5 else 0.0), plant, 300)
    run.assert_safe()
    assert plant.x > 12.0


def test_free_flight_is_not_touched():
    plant = Plant(x=0.0, boxes=np.array(WALLS), noise_m=0.01)
    run = Run(lambda k, p: command(1.0, 0.1 * math.sin(0.1 * k)), plant, 400)
    assert run.changed == 0
    assert plant.x > 18.0


def test_it_slides_along_a_wall_and_keeps_its_speed():
    plant = Plant(x=0.0, y=2.0, boxes=np.array(WALLS), noise_m=0.01)
    run = Run(lambda k, p: command(0.9, 0.4), plant, 400)
    run.assert_safe()
    assert plant.x > 14.0
    assert plant.y > 3.3


DEAD_END = [(12.0, -4.0, 13.0, 4.0), *WALLS]


def test_it_leaves_a_dead_end_backwards_the_way_it_came():
    """Edges 27, 28: facing the wall it backs out, unseen behind but flown through, at the speed it is asked for."""
    plant = Plant(x=5.0, boxes=np.array(DEAD_END), noise_m=0.01)
    into = Run(lambda k, p: command(1.0), plant, 250)
    into.assert_safe()
    reached = plant.x
    assert reached > 12.0 - 0.35 - 0.25
    run = Run(lambda k, p: command(-0.5), plant, 160, before=into)
    run.assert_safe()
    assert plant.x < reached - 3.0


@pytest.mark.parametrize("sideways", [-0.25, 0.25])
def test_the_way_back_through_a_gap_stays_open(sideways):
    """Through a gap of 1.2 m and backwards out of it again, on the same way, arriving a little off the middle."""
    gap = [(8.0, -4.0, 8.7, -0.6), (8.0, 0.6, 8.7, 4.0)]
    plant = Plant(x=6.0, y=sideways, boxes=np.array(WALLS + gap), noise_m=0.01)
    centred = lambda x: lambda k, p: command(x, max(-0.3, min(0.3, -p.y)))  # noqa: E731
    there = Run(centred(0.8), plant, 110)
    assert plant.x > 9.0
    back = Run(centred(-0.5), plant, 160, before=there)
    back.assert_safe()
    assert plant.x < 7.0


@pytest.mark.parametrize(("vx", "vy"), [(-0.5, 0.0), (0.0, 0.5), (0.0, -0.5), (-0.4, 0.4)])
def test_never_seen_is_not_free(vx, vy):
    """Just engaged, it does not fly backwards or sideways behind its view further than the take-off site is clear."""
    plant = Plant(x=10.0, boxes=np.array(WALLS), noise_m=0.01)
    Run(lambda k, p: command(vx, vy), plant, 200).assert_safe()
    assert math.hypot(plant.x - 10.0, plant.y) < 0.4


def test_it_may_fly_backwards_once_it_has_looked_there():
    plant = Plant(x=10.0, boxes=np.array(WALLS), noise_m=0.01)
    looked = Run(lambda k, p: command(yaw_rate=1.0), plant, 130)
    run = Run(lambda k, p: command(-0.5 if p.x > 8.0 else 0.0), plant, 200, before=looked)
    run.assert_safe()
    assert plant.x < 8.7


@pytest.mark.parametrize("seed", range(3))
def test_hidden_beside_and_behind_is_not_touched(seed):
    """Engaged facing away from boxes 0.6 m beside and behind the hull; a policy that flies into what it does not see."""
    boxes = np.array([(8.4, -0.5, 8.9, 0.5), (9.2, 1.0, 9.9, 1.4), (9.2, -1.4, 9.9, -1.0)])
    plant, random = Plant(x=10.0, boxes=boxes, noise_m=0.01, seed=seed), np.random.default_rng(seed)
    headings = random.uniform(0.5 * math.pi, 1.5 * math.pi, 40)
    Run(lambda k, p: command(math.cos(headings[k // 10]), math.sin(headings[k // 10])), plant, 400).assert_safe()


def flank(k, plant):
    """Fly up beside a pillar on the left, look away to the right, then hard left into it."""
    if plant.x < 7.0:
        return command(1.0)
    return command(0.0, 0.0, 0.0, -1.0) if plant.yaw > -1.2 else command(0.0, 0.5)


def test_pillar_that_left_the_view_sideways_is_still_avoided():
    """With memory it nears what it saw; without, what is out of view is unseen and it stays where it is."""
    boxes = np.array([(6.6, 1.2, 9.0, 2.2)])
    remembering, forgetting = (Plant(x=5.0, y=0.0, boxes=boxes, noise_m=0.01) for _ in range(2))
    Run(flank, remembering, 250).assert_safe()
    assert remembering.yaw < -1.0
    assert remembering.y > 0.3
    Run(flank, forgetting, 250, memory_s=0.0, memory_hold_s=0.0).assert_safe()
    assert forgetting.y < 0.2


def test_phantom_near_the_vehicle_does_not_trap_it():
    """L12: a return that no object causes, right ahead; the vehicle backs away from it on the way it came."""
    plant = Plant(x=8.0, boxes=np.array(WALLS))
    safety = Run(lambda k, p: command(0.5), plant, 100).safety
    here = plant.x
    for _ in range(90):
        seen = plant.scan()
        seen.ranges_m[85:95] = 0.3
        sent, _ = safety.apply(command(-0.4), plant.estimate(), seen, plant.time_s)
        plant.fly(sent)
    assert plant.x < here - 0.4
