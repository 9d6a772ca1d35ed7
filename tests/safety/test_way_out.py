"""Pressed into one margin, the way out may use up some of another: else noise in a side wall keeps it at the one ahead."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import ZERO, config, scan, state

from safety.braking import Start
from safety.frames import CorridorVector
from safety.free_space import FreeSpace
from safety.lidar import BeamTable, see
from safety.shield import Shield, Surroundings
from safety.sight import View

C = config()
X, Y = 15.05, 0.05
KEPT_M = C.keep_out_m + C.velocity_error_m_s * (C.dead_time_s + C.tick_s)  # at rest, of a point seen just now


def sent_at_rest(*points: tuple[float, float], within=lambda few: np.ones(len(few), dtype=bool)) -> CorridorVector:
    """What is sent for a command of zero by a vehicle at rest, all seen around it; points by distance and bearing."""
    free, x, y = FreeSpace(C), X, Y
    free.update(see(scan(beams=360, fov=2.0 * math.pi), state(x=x, y=y), BeamTable(), C))
    at = np.array([(x + d * math.cos(bearing), y + d * math.sin(bearing)) for d, bearing in points]).T
    start = Start(np.array([(x, y, 2.0)] * 2), np.zeros((2, 3)))
    around = Surroundings(at[0], at[1], np.zeros(len(points)), View(free, at, 0.0), CorridorVector(x, y, 2.0), start)
    return Shield(C).choose(ZERO, around, within).velocity


@pytest.mark.parametrize("bearing", [-1.7, -1.9, 1.7, 2.1])
@pytest.mark.parametrize("spare_m", [0.003, 0.01, 0.02])
def test_a_return_at_the_side_does_not_keep_it_at_the_wall_ahead(bearing, spare_m):
    """The wall ahead touches the hull; a return of the side wall has next to no room left."""
    assert sent_at_rest((C.vehicle_radius_m, 0.0), (KEPT_M + spare_m, bearing)).x < -0.2


@pytest.mark.parametrize("ahead_m", [0.35, 0.36, 0.37])
def test_but_the_way_out_never_leads_into_the_errors_or_nearer_than_the_worst(ahead_m):
    """Right behind it something just as near: out of one is into the other, and it stays."""
    assert sent_at_rest((ahead_m, 0.0), (ahead_m, math.pi)) == ZERO


def test_what_is_permitted_on_the_way_out_stays_within_the_margin():
    sent = sent_at_rest((C.vehicle_radius_m, 0.0), (KEPT_M - 0.03, math.pi))
    assert sent.x > -0.05


def test_the_way_out_keeps_to_the_limits():
    """Only as much of it as may be sent after the last command; nothing when not even that."""
    full = sent_at_rest((C.vehicle_radius_m, 0.0))
    for longest in (0.2, 0.1, 0.0):
        sent = sent_at_rest((C.vehicle_radius_m, 0.0), within=lambda few, most=longest: np.hypot(few[:, 0], few[:, 1]) <= most)
        assert full.x * (1.0 if longest else 0.0) <= sent.x <= 0.0
        assert -longest <= sent.x
        assert longest == 0.0 or sent.x < -0.25 * longest
