"""The fence's geometry, what is refused as a fence, and what the filter makes of it: order, place and direction do not matter."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from safety_plant import command, config, scan, state

from safety.config import Fence, SafetyConfig
from safety.fence import PolygonFence, signed_area_m2
from safety.fence_rules import MAX_VERTICES, fence_problem, ring_problem
from safety.filter import SafetyFilter

L_SHAPE = ((0.0, 0.0), (12.0, 0.0), (12.0, 5.0), (5.0, 5.0), (5.0, 12.0), (0.0, 12.0))
PILLAR = ((2.0, 8.0), (3.0, 8.0), (3.0, 9.0), (2.0, 9.0))
SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
quick = settings(max_examples=60, deadline=None)
inside_l = st.tuples(st.floats(0.3, 11.7), st.floats(0.3, 11.7)).filter(lambda p: p[0] < 4.7 or p[1] < 4.7)
velocity = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))  # where braking leads outside, two ways out may be as good
SLACK_M = config().position_error_m + config().braked_drift_m + config().margin_m
FREE = {"max_acceleration_m_s2": 1000.0, "max_jerk_m_s3": 1000.0, "ground_z_m": -100.0}


def polygons(inclusion=L_SHAPE, exclusion=(PILLAR,), low=0.3, high=4.0) -> Fence:
    return Fence(floor_m=low, ceiling_m=high, inclusion=inclusion, exclusion=exclusion)


def sent_in(fence, place, v=(0.0, 0.0), wanted=(0.0, 0.0), yaw=0.0, **changes):
    safety = SafetyFilter(SafetyConfig(fence=fence, **(FREE | changes)))
    pose = state(place[0], place[1], v=(*v, 0.0), yaw=yaw)
    sent, verdict = safety.apply(command(*wanted), pose, scan(beams=360, fov=2.0 * math.pi), 0.0)
    return np.array(dataclasses.astuple(sent.velocity)[:2]), verdict


# ---- geometry


def test_distances_are_to_edges_and_vertices_never_to_their_lines():
    fence = PolygonFence(L_SHAPE, [PILLAR])
    places = [(2.5, 2.5), (6.0, 4.0), (4.0, 4.0), (2.5, 7.5), (2.5, 8.5), (2.4, 8.5), (6.0, 6.0), (-3.0, -4.0), (6.0, 20.0)]
    expected = [2.5, 1.0, math.sqrt(2.0), 0.5, -0.5, -0.4, -1.0, -5.0, -math.hypot(1.0, 8.0)]
    assert fence.signed_margin_m(places) == pytest.approx(expected)


def test_each_polygon_counts_by_its_own_breach():
    fence = PolygonFence(SQUARE, [((3.0, 1.0), (6.0, 1.0), (6.0, 3.0), (3.0, 3.0))])
    assert fence.ring_margins_m([(4.5, 2.0), (3.5, 2.0), (1.0, 2.0)]) == pytest.approx(
        np.array([[-0.5, -1.0], [0.5, -0.5], [1.0, 2.0]])
    )


def test_erosion_grows_with_the_slant_of_an_edge_and_is_whole_at_vertices():
    """What is bounded per axis reaches further across a slanted edge: 0.35 + 0.09 straight, 0.35 + 0.09 * 1.41 at 45 degrees."""
    slanted = PolygonFence(((0.0, -9.0), (9.0, 0.0), (0.0, 9.0), (-9.0, 0.0)), (), 0.35, 0.09)
    straight = PolygonFence(((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 9.0)), [((4.0, 8.0), (5.0, 8.0), (4.5, 8.5))], 0.35, 0.09)
    assert slanted.room_m((0.0, 0.0)) == pytest.approx(9.0 / math.sqrt(2.0) - 0.35 - 0.09 * math.sqrt(2.0))
    assert straight.room_m([(1.0, 4.5), (4.0 - 0.3, 8.0 - 0.4)]) == pytest.approx([0.56, 0.5 - 0.35 - 0.09 * math.sqrt(2.0)])
    assert straight.room_m((-1.0, 4.5)) == pytest.approx(-1.0 - 0.44)


@pytest.mark.parametrize(("width", "room"), [(0.87, False), (0.89, True), (3.0, True)])
def test_a_place_with_room_is_found_wherever_it_is(width, room):
    """The far end of a bent passage is the only place wide enough, or nothing is."""
    ring = ((0.0, 0.0), (30.0, 0.0), (30.0, width), (29.0, width), (29.0, 0.5), (0.0, 0.5))
    found = PolygonFence(ring, (), 0.35, 0.09).roomiest()
    assert (found is not None) == room
    if found is not None:
        assert PolygonFence(ring, (), 0.35, 0.09).room_m(found) > 0.0


def test_parts_on_one_line_do_not_cross():
    """The feet of a comb turned by any angle: their sides of each other's line are rounding."""
    comb = np.array(((0, 0), (5, 0), (5, 1), (4, 1), (4, 3), (3, 3), (3, 1), (2, 1), (2, 3), (1, 3), (1, 1), (0, 1)), dtype=float)
    for turn in np.linspace(0.0, 6.0, 60):
        c, s = math.cos(turn), math.sin(turn)
        assert ring_problem(tuple(map(tuple, comb @ np.array(((c, -s), (s, c)))))) is None


def test_area_is_signed():
    assert signed_area_m2(SQUARE) == 16.0
    assert signed_area_m2(SQUARE[::-1]) == -16.0


# ---- what is refused


@pytest.mark.parametrize(
    ("ring", "words"),
    [
        (((0.0, 0.0), (1.0, 0.0)), "2 vertices; a polygon has three"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, math.nan)), r"vertex 3 \(1, nan\) is not finite"),
        (((0.0, 0.0), (math.inf, 0.0), (1.0, 1.0)), r"vertex 2 \(inf, 0\) is not finite"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0)), r"vertex 4 \(0, 0\) repeats vertex 1"),
        (((0.0, 0.0), (1.0, 0.0), (1.0, 0.0005), (0.0, 1.0)), r"vertex 3 \(1, 0.0005\) repeats vertex 2"),
        (((0.0, 0.0), (1.0, 1.0), (2.0, 2.0)), r"up to vertex 3 \(2, 2\), lie on one line"),
        (((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (4.0, -4.0)), r"vertex 3 \(4, 4\) is a spike"),
        (((0.0, 0.0), (4.0, 4.0), (4.0, 0.0), (0.0, 4.0), (-4.0, 2.0)), r"from vertex 1 \(0, 0\) crosses .* vertex 3 \(4, 0\)"),
        (((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 0.0005), (0.0, 4.0)), r"from vertex 1 \(0, 0\) crosses or touches"),
    ],
)  # fmt: skip
def test_no_polygon_is_refused_and_the_vertex_named(ring, words):
    problem = ring_problem(ring)
    assert problem is not None
    assert re.search(words, problem), problem
    assert "\n" not in problem


def test_a_vertex_on_the_line_between_its_neighbours_is_fine():
    ring = ((0.0, 0.0), (2.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
    assert ring_problem(ring) is None
    assert PolygonFence(ring, ()).signed_margin_m([(2.0, 1.0), (2.0, -1.0)]) == pytest.approx([1.0, -1.0])


def test_number_of_vertices_is_bounded():
    ring = tuple((9.0 * math.cos(k * math.tau / 32), 9.0 * math.sin(k * math.tau / 32)) for k in range(32))
    small = tuple((0.1 * x, 0.1 * y) for x, y in ring)
    assert fence_problem(ring, [small]) is None
    assert MAX_VERTICES == 64
    problem = fence_problem(ring, [small, ((5.0, 5.0), (5.1, 5.0), (5.0, 5.1))])
    assert problem is not None
    assert "67 vertices in all, more than 64" in problem


@pytest.mark.parametrize(
    ("exclusion", "accepted"),
    [
        (((6.0, 6.0), (7.0, 6.0), (7.0, 7.0)), False),
        (((3.0, 3.0), (7.0, 3.0), (7.0, 7.0)), True),
        (((1.0, 1.0), (2.0, 1.0), (2.0, 2.0)), True),
        (((-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)), True),
    ],
)
def test_an_exclusion_that_forbids_nothing_is_refused(exclusion, accepted):
    problem = (
        fence_problem(SQUARE, [PILLAR[:3] if accepted else exclusion]) if not accepted else fence_problem(SQUARE, [exclusion])
    )
    assert (problem is None) == accepted
    assert accepted or "exclusion 1: lies outside the inclusion polygon" in str(problem)


@pytest.mark.parametrize(
    ("fence", "words"),
    [
        ({"inclusion": SQUARE}, "give min_m and max_m, or floor_m, ceiling_m and inclusion"),
        ({"floor_m": 0.0, "ceiling_m": 3.0}, "give min_m and max_m"),
        ({}, "give min_m and max_m"),
        ({"min_m": (0, 0, 0)}, "give min_m and max_m"),
        ({"min_m": (0, 0, 0), "max_m": (4, 4, 3), "floor_m": 0.0}, "not some of both"),
        ({"min_m": (0, 0, 0), "max_m": (4, 4, 3), "exclusion": (PILLAR,)}, "not some of both"),
        ({"floor_m": 3.0, "ceiling_m": 2.0, "inclusion": SQUARE}, "fence z: floor_m 3.0 must be smaller than ceiling_m 2.0"),
        ({"floor_m": 0.0, "ceiling_m": 3.0, "inclusion": (*SQUARE, (0.0, 0.0))}, "fence inclusion: vertex 5"),
        ({"floor_m": 0.0, "ceiling_m": 3.0, "inclusion": L_SHAPE, "exclusion": (SQUARE[:2],)}, "fence exclusion 1: 2 vertices"),
        ({"floor_m": 0.0, "ceiling_m": 3.0, "inclusion": ((0, 0), (1, math.nan), (2, 2))}, "finite"),
        ({"floor_m": 0.0, "ceiling_m": 3.0, "inclusion": ((0, 0), (30, 0), (30, 0.87), (0, 0.87))}, "no place is left"),
    ],
)
def test_a_contradictory_fence_is_refused(fence, words):
    with pytest.raises(ValidationError, match=words):
        SafetyConfig(fence=fence)


def test_a_box_is_the_polygon_of_its_corners():
    box = Fence(min_m=(-1.0, -2.0, 0.3), max_m=(9.0, 3.0, 4.0))
    same = polygons(((-1.0, -2.0), (9.0, -2.0), (9.0, 3.0), (-1.0, 3.0)), ())
    assert box.polygon == same.polygon
    assert (box.low_m, box.high_m) == (same.low_m, same.high_m) == ((-1.0, -2.0, 0.3), (9.0, 3.0, 4.0))
    assert [box.margin_m(*p) for p in ((0.0, 0.0, 2.0), (10.0, 0.0, 2.0), (3.0, 0.0, 3.9))] == pytest.approx([1.0, -1.0, 0.1])
    assert box.margin_m(0.0, 0.0, 2.0, 0.35, 0.1) == pytest.approx(0.65)
    assert box.margin_m(3.0, 0.0, 0.6, 0.35, 0.1) == pytest.approx(0.2)
    assert SafetyConfig(fence=box).eroded_fence() is SafetyConfig(fence=same).eroded_fence()


# ---- what the filter makes of it


@given(inside_l, velocity, velocity, st.integers(0, 5), st.integers(0, 3), st.booleans())
@quick
def test_order_and_first_vertex_do_not_matter(place, v, wanted, first, second, back):
    other = L_SHAPE[first:] + L_SHAPE[:first], PILLAR[second:] + PILLAR[:second]
    if back:
        other = other[0][::-1], other[1][::-1]
    here, verdict = sent_in(polygons(), place, v, wanted)
    there, same = sent_in(polygons(other[0], (other[1],)), place, v, wanted)
    assert there == pytest.approx(here, abs=1e-5)
    assert same.fence_margin_m == pytest.approx(verdict.fence_margin_m, abs=1e-9)


@given(inside_l, velocity, velocity, st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
@quick
def test_a_moved_fence_gives_the_same_command(place, v, wanted, dx, dy):
    moved = [tuple((x + dx, y + dy) for x, y in ring) for ring in (L_SHAPE, PILLAR)]
    here, _ = sent_in(polygons(), place, v, wanted)
    there, _ = sent_in(polygons(moved[0], (moved[1],)), (place[0] + dx, place[1] + dy), v, wanted)
    assert there == pytest.approx(here, abs=1e-6)


@given(inside_l, st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)), velocity, st.floats(-math.pi, math.pi))
@quick
def test_a_turned_fence_gives_the_turned_command(place, v, wanted, turn):
    """Without what is bounded per axis, which a turn makes longer or shorter across an edge."""
    free = {"margin_m": 0.0, "position_error_m": 0.0}
    assume(PolygonFence(L_SHAPE, (PILLAR,)).signed_margin_m(place) > 0.8)  # outside, two ways out may be equally near
    c, s = math.cos(turn), math.sin(turn)

    def turned(p):
        return c * p[0] - s * p[1], s * p[0] + c * p[1]

    here, judged = sent_in(polygons(), place, v, wanted, **free)
    other = polygons(tuple(map(turned, L_SHAPE)), (tuple(map(turned, PILLAR)),))
    there, judged_there = sent_in(other, turned(place), turned(v), turned(wanted), yaw=turn, **free)
    assume("unseen" not in {why.rule for verdict in (judged, judged_there) for why in verdict.interventions})  # its grid stays
    assert there == pytest.approx(turned(here), abs=1e-6)


@given(st.floats(0.5, 4.5), st.floats(0.5, 11.5), st.floats(-0.4, 0.4), st.floats(0.1, 1.0), st.floats(0.0, 2.0))
@quick
def test_a_smaller_fence_never_allows_more(x, y, v, wanted, smaller):
    """Straight at a slanted wall that comes nearer, from places inside both."""
    wide, tight = (((0.0, 0.0), (12.0 - d, 0.0), (7.0 - d, 12.0), (0.0, 12.0)) for d in (0.0, smaller))
    normal = np.array((12.0, 5.0)) / 13.0
    place = (x + 0.5, y)
    assume(PolygonFence(tight, (), 0.35, 0.09).room_m(place) >= 0.0)
    more, _ = sent_in(polygons(wide, ()), place, v * normal, wanted * normal)
    less, _ = sent_in(polygons(tight, ()), place, v * normal, wanted * normal)
    assert less @ normal <= max(float(more @ normal), 0.0) + 1e-9


@given(st.floats(0.2, 0.8), st.floats(-0.3, 0.3))
@quick
def test_it_slides_along_a_slanted_wall(along, v):
    """Half into a wall at 45 degrees: what leads along it stays."""
    diamond = ((0.0, -9.0), (9.0, 0.0), (0.0, 9.0), (-9.0, 0.0))
    out, side = np.array((1.0, 1.0)) / math.sqrt(2.0), np.array((-1.0, 1.0)) / math.sqrt(2.0)
    place = out * (9.0 / math.sqrt(2.0) - 0.35 - SLACK_M * math.sqrt(2.0) - 0.001)
    sent, verdict = sent_in(polygons(diamond, ()), place, v * side, along * side + 0.5 * out, yaw=math.atan2(*side[::-1]))
    assert sent @ side > 0.9 * along
    assert sent @ out < 0.05
    assert {found.rule for found in verdict.interventions} == {"fence"}


@given(st.floats(0.01, 0.3), st.floats(0.0, 2.0 * math.pi))
@quick
def test_from_a_margin_only_the_way_back_is_open(depth, heading):
    """Inside the margin of the reflex corner: no part of any command leads towards it, and away from it is open."""
    corner, away = np.array((5.0, 5.0)), -np.array((math.cos(math.pi / 4), math.sin(math.pi / 4)))
    place = corner + away * (0.35 + SLACK_M * math.sqrt(2.0) - depth)
    sent, verdict = sent_in(polygons(exclusion=()), place, wanted=(math.cos(heading), math.sin(heading)), yaw=heading)
    assert sent @ away >= -1e-9
    assert verdict.fence_margin_m == pytest.approx(-depth)
    home, _ = sent_in(polygons(exclusion=()), place, wanted=tuple(0.3 * away), yaw=math.atan2(away[1], away[0]))
    assert home @ away > 0.0


@pytest.mark.parametrize("place", [(2.5, 8.5), (2.05, 8.5), (2.9, 8.9), (6.0, 6.0), (5.2, 5.2), (-0.5, 3.0), (12.5, 5.5)])
@pytest.mark.parametrize("heading", range(8))
def test_from_a_forbidden_place_no_command_leads_further_in(place, heading):
    """In an exclusion, beyond a reflex corner, outside a wall and a corner: every part is towards the nearest way out."""
    wanted, fence = (math.cos(heading * math.pi / 4), math.sin(heading * math.pi / 4)), polygons()
    geometry = PolygonFence(fence.polygon, fence.exclusion)
    depth = float(geometry.signed_margin_m(place))
    sent, _ = sent_in(fence, place, wanted=wanted, yaw=math.atan2(wanted[1], wanted[0]))
    after = float(geometry.signed_margin_m(np.array(place) + 0.01 * sent))
    assert depth < 0.0
    assert after >= depth - 1e-9


def test_there_is_a_way_out_of_an_exclusion():
    sent, verdict = sent_in(polygons(), (2.1, 8.5), wanted=(-0.3, 0.0), yaw=math.pi)
    assert sent[0] < -0.2
    assert verdict.fence_margin_m == pytest.approx(-0.1 - 0.35 - SLACK_M)


def test_the_way_back_into_the_fence_is_slow():
    sent, verdict = sent_in(polygons(), (-0.1, 6.0), wanted=(1.0, 0.0))
    assert 0.1 < sent[0] <= 0.3
    assert verdict.interventions[0].rule == "return_speed"


def test_no_leg_goes_through_a_thin_exclusion():
    """Both ends of the brake tube would be clear of a wall of 1 cm: the way between counts."""
    wall = ((6.0, 1.0), (6.01, 1.0), (6.01, 4.0), (6.0, 4.0))
    small = {"vehicle_radius_m": 0.05, "margin_m": 0.0, "position_error_m": 0.0, "fault_hold_s": 0.0}
    sent, verdict = sent_in(polygons(exclusion=(wall,)), (5.9, 2.5), v=(0.1, 0.0), wanted=(1.2, 0.0), **small)
    assert sent[0] < 0.5
    assert verdict.interventions[0].rule == "fence"
