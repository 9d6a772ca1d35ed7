"""The bounds of braking at the very numbers where they turn, worked out by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from safety_plant import config

from safety.allowance import Allowance, Floats, _fence_due_m_s, _outward, _way_out_m_s, allowance
from safety.braking import Tubes, stop_gain_s
from safety.fence_tube import WaysOut

# A quarter of the margin is 1/16 m here, the keep-out 0.625 m: exact in binary, as are the clearances below.
C = config(margin_m=0.25, vehicle_radius_m=0.375)
GAIN_S = stop_gain_s(C)
HOLD_OFF_M_S = 0.25
AT_REST = Tubes(np.zeros((2, 1, 3)), np.zeros((2, 1, 3)))
EAST, NORTH, WEST = (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)


def outward(clear_m: float, point: tuple[float, float], tube: Tubes = AT_REST, fenced: bool = False) -> tuple[Floats, Floats]:
    """Directions and speeds due for one point, with the vehicle at the origin."""
    return _outward(tube, np.array([clear_m]), np.array([point]).T, np.zeros(2), fenced, C)


def leg(begin: tuple[float, float], stop: tuple[float, float]) -> Tubes:
    """A brake tube of which both models fly the same leg."""
    return Tubes(np.tile((*begin, 1.0), (2, 1, 1)), np.tile((*stop, 1.0), (2, 1, 1)))


def permissive(**parts: Any) -> Allowance:
    """An allowance that permits everything at rest but for `parts`."""
    free: dict[str, Any] = {"clearance_m": np.zeros(1), "fence_m": np.zeros(3), "normals": np.empty((2, 0))}
    free |= {"outward_m_s": np.empty(0), "push_m_s": np.zeros(2), "brake_stop_m": np.zeros((2, 3))}
    return Allowance(**(free | {"sink_m_s": -1.0, "climb_m_s": 1.0} | parts))


def test_what_is_permitted_selects_as_a_mask():
    """A mask of numbers would pick the first rows instead."""
    rooms = np.array([[0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = permissive().permits(np.zeros((3, 3)), np.array([[-1.0], [0.0], [0.0]]), rooms)
    assert found.dtype == np.bool_
    assert found.tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("clearances", "allowed"),
    [
        ((0.5, 0.125), (0.0, 0.0)),  # nothing is too near: everything may be neared to its keep-out, no further
        ((-0.125, 0.5), (-0.125, -0.125)),  # as far as the worst is
        ((-0.125, -0.0625), (-0.125, -0.125)),
        ((-0.75, 0.5), (-0.75, -0.25)),  # by no more than the margin
    ],
)
def test_what_leads_out_may_near_other_points_as_far_as_the_worst_is(clearances, allowed):
    assert permissive(clearance_m=np.array(clearances)).for_the_way_out(C).clearance_m.tolist() == list(allowed)


def test_a_point_neared_to_a_quarter_of_the_margin_asks_for_nothing_yet():
    normals, due = outward(-0.0625, (5.0, 0.0))
    assert (normals.shape, due.shape) == ((2, 0), (0,))
    deeper, due = outward(-0.0625 - 2.0**-10, (5.0, 0.0))  # ten times the depth: 10 / 1024 m/s
    assert deeper.T.tolist() == [list(WEST)]
    assert due.tolist() == [pytest.approx(10.0 * 2.0**-10)]


@pytest.mark.parametrize(("clear_m", "bounds"), [(0.05, 0), (math.nextafter(0.05, 0.0), 1)])
def test_the_way_out_of_the_fence_is_bounded_by_points_within_five_centimetres(clear_m, bounds):
    """Without a margin the clearance is the depth itself; five centimetres exactly are room enough."""
    bare = config(margin_m=0.0, vehicle_radius_m=0.625)
    _, due = _outward(AT_REST, np.array([clear_m]), np.array([[5.0], [0.0]]), np.zeros(2), True, bare)
    assert due.tolist() == [pytest.approx(-0.05 / stop_gain_s(bare))] * bounds


def test_a_way_out_of_the_fence_takes_no_more_room_than_a_point_has():
    """Fence: out to the east at full speed. A point there leaves 0.01 m of room: the stop point may move that far."""
    ways = WaysOut(np.array([EAST]).T, np.array([-0.3]))  # 0.3 less a quarter of the margin and 0.0575: deep enough for 0.25 m/s
    tight, free = (
        allowance(AT_REST, np.array([clear_m]), np.zeros(3), np.array([[0.7], [0.0]]), np.zeros(2), ways, C)
        for clear_m in (-0.0525, 1.0)
    )
    assert free.push_m_s == pytest.approx((HOLD_OFF_M_S, 0.0), abs=1e-6)
    assert tight.push_m_s == pytest.approx((0.01 / GAIN_S, 0.0), abs=1e-4)


def test_without_a_breached_fence_a_point_with_room_asks_for_nothing():
    """Just at the depth where holding off begins: no direction is bounded."""
    found = allowance(AT_REST, np.array([-0.0625]), np.zeros(3), np.array([[5.0], [0.0]]), np.zeros(2), None, C)
    assert (found.normals.shape, found.outward_m_s.shape) == ((2, 0), (0,))


@pytest.mark.parametrize(("deeper_m", "away"), [(0.0, NORTH), (2.0**-40, WEST)])
def test_deeper_than_the_margin_the_side_is_that_of_the_vehicle(deeper_m, away):
    """The tube ends north of the point, the vehicle stands west of it. A margin deep, exactly, the tube still tells the side."""
    tube = leg((5.0, 0.5), (5.0, 0.5))
    normals, _ = outward(-0.0625 - 0.25 - deeper_m, (5.0, 0.0), tube)
    assert normals.T.tolist() == [list(away)]


@pytest.mark.parametrize("length_m", [1e-3, 5e-4, 1e-5, 2e-6])
def test_the_side_is_told_by_the_nearest_place_of_a_leg_however_short(length_m):
    """The point is abreast of the end of the leg: straight north of it."""
    tube = leg((0.0, 0.0), (length_m, 0.0))
    normals, _ = outward(-0.125, (length_m, -0.75), tube)
    assert normals[:, 0] == pytest.approx(NORTH, abs=1e-9)


def test_a_leg_shorter_than_a_micrometre_counts_as_its_begin():
    """A tenth of one: the share of the way is a hundredth of 0.5, the point stays 0.0495 um aside, at 0.75 m."""
    tube = leg((0.0, 0.0), (1e-7, 0.0))
    normals, _ = outward(-0.125, (0.5e-7, -0.75), tube)
    assert normals[0, 0] == pytest.approx(-0.495e-7 / 0.75, rel=1e-3)


def way_out(*demands: tuple[tuple[float, float], float]) -> Floats:
    return _way_out_m_s(np.array([n for n, _ in demands]).T, np.array([due for _, due in demands]), C)


def test_a_bound_weighs_ten_thousand_times_a_demand():
    """Least squares of x = 0.2 once and x = 0.15 ten thousand times: 1500.2 / 10001."""
    assert way_out((EAST, 0.2), (WEST, -0.15))[0] == pytest.approx(1500.2 / 10001.0, abs=1e-9)


def test_a_bound_that_is_kept_is_no_demand():
    """North-east is due, and nothing forbids to go east: only what is unmet is fitted."""
    half = math.sqrt(0.5)
    assert way_out(((half, half), 0.2), (EAST, 0.0)) == pytest.approx((0.2 * half, 0.2 * half), abs=1e-6)


def test_a_bound_met_by_standing_still_does_not_come_first():
    """West and north are due: (-0.1, 0.2) does both, and keeps 0.6 x + 0.8 y >= 0 and -0.8 x - 0.6 y >= -0.1 besides."""
    found = way_out((NORTH, 0.2), (WEST, 0.1), ((0.6, 0.8), 0.0), ((-0.8, -0.6), -0.1))
    assert found == pytest.approx((-0.1, 0.2), abs=1e-6)


def test_the_way_out_is_never_faster_than_the_return_speed():
    """0.25 m/s east and north would be 0.354 m/s: cut to 0.3 m/s, and to no more for rounding."""
    speed = float(np.hypot(*way_out((EAST, 0.25), (NORTH, 0.25))))
    assert 0.3 - 1e-8 < speed <= 0.3


@pytest.mark.parametrize(
    ("room_m", "due_m_s"),
    [
        (-0.4, HOLD_OFF_M_S),
        (-0.13, 0.1),  # 0.13 less 0.0625 for the quarter of the margin, 0.0575 for the fault: 0.01 m deep, ten times that per s
        (-0.12, 0.0),
        (-0.05, 0.0),
        (0.05, -0.05 / GAIN_S),
    ],
)
def test_the_fence_asks_back_what_is_deeper_than_slide_and_fault(room_m, due_m_s):
    """A fault's share: velocity error 0.05 m/s over the 1.15 s by which HOLD comes later than standstill."""
    assert C.fault_room_m == pytest.approx(0.0575)
    assert _fence_due_m_s(WaysOut(np.array([EAST]).T, np.array([room_m])), C) == pytest.approx([due_m_s], abs=1e-9)
