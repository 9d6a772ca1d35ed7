"""Where a fence ends, and what each GF_ACTION does about leaving it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mav

from sim_gateway.conformance.bench import Bench
from sim_gateway.fence import Item, shapes
from sim_gateway.geofence_monitor import OUTSIDE_SHAPES, TOO_FAR, TOO_HIGH, Circle, GeofenceMonitor, Polygon
from sim_gateway.local_frame import LocalFrame
from sim_gateway.parameters import ParameterStore

HOME = (0.0, 0.0, 0.0)
SQUARE = Polygon(True, ((10.0, 10.0), (10.0, -10.0), (-10.0, -10.0), (-10.0, 10.0)))
ANYWHERE = st.floats(-20.0, 20.0)


def monitor(*fence: Polygon | Circle, **parameters: float) -> GeofenceMonitor:
    found = GeofenceMonitor(ParameterStore(parameters))
    found.set_shapes(fence)
    return found


@given(ANYWHERE, ANYWHERE)
def test_a_square_contains_what_is_between_its_sides(north: float, east: float) -> None:
    assert SQUARE.contains(north, east) == (-10.0 < north <= 10.0 and -10.0 < east <= 10.0) or 10.0 in (abs(north), abs(east))


def test_a_notch_is_outside() -> None:
    notched = Polygon(True, ((0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (5.0, 2.0), (0.0, 10.0)))
    assert notched.contains(5.0, 1.0)
    assert not notched.contains(5.0, 5.0)


def test_inside_one_inclusion_and_outside_every_exclusion() -> None:
    fence = monitor(SQUARE, Circle(True, (15.0, 0.0), 8.0), Circle(False, (0.0, 0.0), 2.0))
    assert fence.problem((5.0, 0.0, -2.0), HOME) is None
    assert fence.problem((20.0, 0.0, -2.0), HOME) is None
    assert fence.problem((1.0, 0.0, -2.0), HOME) == OUTSIDE_SHAPES
    assert fence.problem((0.0, 12.0, -2.0), HOME) == OUTSIDE_SHAPES


def test_distance_and_height_count_from_home() -> None:
    fence = monitor(GF_MAX_HOR_DIST=10.0, GF_MAX_VER_DIST=8.0)
    assert fence.problem((19.0, 0.0, -17.0), (10.0, 0.0, -10.0)) is None
    assert fence.problem((19.0, 0.0, -1.0), HOME) == TOO_FAR
    assert fence.problem((0.0, 0.0, -8.1), HOME) == TOO_HIGH


def test_a_breach_is_told_once_and_again_after_having_been_inside() -> None:
    fence, told = monitor(SQUARE), []
    for step, north in enumerate((0.0, 11.0, 12.0, 5.0, 11.0)):
        told.append(fence.new_breach(float(step), (north, 0.0, -2.0), HOME))
    assert told == [None, OUTSIDE_SHAPES, None, None, OUTSIDE_SHAPES]


def test_items_become_polygons_and_circles() -> None:
    frame = LocalFrame()

    def item(command: int, first: float, north: float, east: float) -> Item:
        latitude, longitude, _ = frame.to_global((north, east, 0.0))
        return Item(command, 0, (first, 0.0, 0.0, 0.0), round(latitude * 1e7), round(longitude * 1e7))

    corners = [item(mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION, 3, *place) for place in ((0, 0), (4, 0), (0, 4))]
    circle = item(mav.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, 7.5, 3.0, -2.0)
    polygon, disc = shapes((*corners, circle), frame)
    assert isinstance(polygon, Polygon)
    assert (polygon.inclusion, len(polygon.corners)) == (False, 3)
    assert isinstance(disc, Circle)
    assert (disc.inclusion, disc.radius_m) == (True, 7.5)
    assert disc.centre == pytest.approx((3.0, -2.0), abs=0.02)


@pytest.mark.parametrize(
    ("action", "modes", "armed"),
    [(0, [], True), (1, [], True), (2, ["AUTO.LOITER"], True), (3, ["AUTO.LOITER", "AUTO.RTL"], True),
     (4, [], False), (5, ["AUTO.LOITER", "AUTO.LAND"], True)],
)  # fmt: skip
def test_what_is_done_about_a_breach(action: int, modes: list[str], armed: bool) -> None:
    bench = Bench(5.0, parameters={"GF_ACTION": action, "GF_MAX_HOR_DIST": 3.0}).offboard(2.0)
    since_s = bench.time_s
    bench.run(9.0)
    assert [m[1] for m in bench.modes(since_s)] == modes
    assert bench.pilot.armed == armed
    assert (TOO_FAR in [text for _, _, text in bench.texts(since_s)]) == (action != 0)


def test_hold_comes_back_to_where_the_breach_was_found() -> None:
    bench = Bench(5.0, parameters={"GF_ACTION": 2, "GF_MAX_HOR_DIST": 6.0}).offboard(2.0)
    bench.run(15.0, until=lambda: bench.mode == "AUTO.LOITER")
    found_m = bench.pilot.state.position[0]
    assert 6.0 < found_m < 6.6
    furthest_m = 0.0
    for _ in range(100):
        furthest_m = max(furthest_m, bench.run(0.1).pilot.state.position[0])
    assert furthest_m > found_m + 0.5
    assert bench.pilot.state.position[0] == pytest.approx(found_m, abs=0.2)
