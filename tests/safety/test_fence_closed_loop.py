"""Closed loop over convex and concave fences with exclusions: adversaries, estimate errors at their bound. No crossing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import Plant, command
from test_closed_loop import bang, towards

from safety.config import Fence, SafetyConfig
from safety.filter import SafetyFilter

FENCES = {
    "diamond": (((0.0, -3.0), (3.0, 0.0), (0.0, 3.0), (-3.0, 0.0)), ()),
    "bend": (((-2.0, -2.0), (9.0, -2.0), (9.0, 2.5), (3.0, 2.5), (2.0, 9.0), (-2.0, 9.0)), ()),
    "notched": (((-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (0.5, 5.0), (0.2, 1.5), (-0.2, 1.5), (-0.5, 5.0), (-5.0, 5.0)), ()),
    "exclusions": (
        ((-6.0, -5.0), (6.0, -4.0), (5.0, 5.0), (-5.0, 4.0)),
        (((2.0, 1.0), (3.0, 2.0), (2.0, 3.0), (1.0, 2.0)), ((-3.0, -2.0), (-1.5, -2.0), (-2.0, -0.5))),
    ),
}
START = {"diamond": (0.0, 0.0), "bend": (0.0, 0.0), "notched": (0.0, -2.0), "exclusions": (0.0, 0.0)}


class Run:
    """One flight: how near the hull came to the fence (m, negative: crossed), and the way flown."""

    def __init__(self, name: str, policy, ticks: int, error: tuple[float, float] = (0.0, 0.0), lag_s: float = 0.6):
        inclusion, exclusion = FENCES[name]
        self.fence = Fence(floor_m=0.3, ceiling_m=4.0, inclusion=inclusion, exclusion=exclusion)
        x, y = START[name]
        plant, self.way_m, self.faults = Plant(x=x, y=y, lag_s=lag_s), 0.0, set()
        plant.position_error = plant.velocity_error = (*(0.05 * e for e in error), 0.0)
        safety, self.margin = SafetyFilter(SafetyConfig(fence=self.fence)), math.inf
        for k in range(ticks):
            sent, verdict = safety.apply(policy(k, plant), plant.estimate(), plant.scan(), plant.time_s)
            plant.fly(sent)
            self.faults.add(verdict.fault)
            self.margin = min(self.margin, self.fence.margin_m(plant.x, plant.y, plant.z, 0.35, 0.1))
            self.way_m += 0.05 * float(np.hypot(*plant.v[:2]))

    def assert_inside(self):
        assert self.faults == {None}
        assert self.margin > 0.0


def corners(name: str) -> list[tuple[float, float]]:
    inclusion, exclusion = FENCES[name]
    return [vertex for ring in (inclusion, *exclusion) for vertex in ring]


def tour(places, hold: int = 50):
    """From one place to the next as fast as can be, straight through whatever is between."""
    return lambda k, plant: towards(*places[(k // hold) % len(places)], 2.0)(k, plant)


@pytest.mark.parametrize("error", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
@pytest.mark.parametrize("name", FENCES)
def test_aiming_at_every_corner_with_the_estimate_off_by_its_bound(name, error):
    run = Run(name, tour(corners(name)), 50 * len(corners(name)), error)
    run.assert_inside()
    assert run.margin < 0.35  # it does get near: the fence is usable space
    assert run.way_m > 5.0


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("name", FENCES)
def test_bang_bang(name, seed):
    run = Run(name, bang(seed, hold=9), 700, (1, -1) if seed else (-1, -1), lag_s=(0.35, 0.6)[seed])
    run.assert_inside()
    assert run.way_m > 5.0


@pytest.mark.parametrize("name", FENCES)
def test_pressed_against_the_fence_it_slides_round(name):
    """Always outwards and along: round convex, reflex and exclusion corners it keeps going, and never crosses."""

    def pressed(k, plant):
        turn = 0.02 * k
        return command(1.2 * math.cos(turn), 1.2 * math.sin(turn), 0.0, 0.4)

    run = Run(name, pressed, 800)
    run.assert_inside()
    assert run.way_m > 10.0


def test_it_goes_round_an_exclusion_in_its_way():
    """A goal behind the exclusion, a little off the middle: sliding along its slanted edges leads there."""
    run = Run("exclusions", towards(3.6, 3.6, 2.0), 500)
    run.assert_inside()


def test_it_can_fail():
    """A plant 2.5 times slower than assumed comes through the margin."""
    assert Run("diamond", towards(20.0, 20.0, 2.0), 200, lag_s=1.5).margin < 0.0
