"""PX4's outer fence for polygons: never nearer than the overshoot, never cutting into the mission's own."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from flight.fence_outline import clipped, cuts_into, grown, shrunk

BY_M = 2.034
SHAPES = {
    "box": ((0.0, 0.0), (9.0, 0.0), (9.0, 6.0), (0.0, 6.0)),
    "clockwise": ((0.0, 6.0), (9.0, 6.0), (9.0, 0.0), (0.0, 0.0)),
    "bend": ((0.0, 0.0), (12.0, 0.0), (12.0, 5.0), (5.0, 5.0), (5.0, 12.0), (0.0, 12.0)),
    "sharp": ((0.0, 0.0), (20.0, 1.0), (0.0, 2.0)),
    "narrow notch": ((0.0, 0.0), (12.0, 0.0), (12.0, 9.0), (7.0, 9.0), (6.5, 3.0), (6.0, 9.0), (0.0, 9.0)),
    "wide notch": ((0.0, 0.0), (20.0, 0.0), (20.0, 9.0), (15.0, 9.0), (15.0, 3.0), (5.0, 3.0), (5.0, 9.0), (0.0, 9.0)),
}


@pytest.mark.parametrize("name", SHAPES)
def test_grown_lies_around_at_the_distance_and_not_much_further(name: str) -> None:
    ring, outline = SHAPES[name], grown(SHAPES[name], BY_M, 100)
    inner, outer = shapely.Polygon(ring), shapely.Polygon(outline)
    assert outer.is_valid
    assert outer.contains(inner)
    assert outer.exterior.distance(inner) >= BY_M - 1e-6
    hull = inner.convex_hull.buffer(BY_M * np.sqrt(2.0) + 1e-6)
    assert hull.contains(outer)
    assert not cuts_into([outline], (), ring, ())


def test_a_notch_stays_where_it_is_wide_enough_and_is_filled_where_not() -> None:
    wide, narrow = (shapely.Polygon(grown(SHAPES[name], BY_M, 100)) for name in ("wide notch", "narrow notch"))
    assert not wide.contains(shapely.Point(10.0, 7.0))
    assert narrow.contains(shapely.Point(6.5, 8.0))


def test_a_fence_with_too_few_vertices_to_grow_into_is_refused() -> None:
    with pytest.raises(ValueError, match="simplify its inclusion polygon"):
        grown(SHAPES["box"], BY_M, 3)


@pytest.mark.parametrize("name", ["box", "clockwise", "bend", "wide notch"])
def test_shrunk_lies_inside_at_the_distance(name: str) -> None:
    big = tuple((2.0 * x, 2.0 * y) for x, y in SHAPES[name])
    result = shrunk(big, BY_M)
    if name == "wide notch":  # no place sees all its edges
        assert result is None
        return
    assert result is not None
    inner, outer = shapely.Polygon(result), shapely.Polygon(big)
    assert outer.contains(inner)
    assert outer.exterior.distance(inner) >= BY_M - 1e-6


def test_an_exclusion_too_small_for_px4_leaves_nothing() -> None:
    assert shrunk(((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)), BY_M) is None


def test_clipped_takes_one_side_of_a_line() -> None:
    assert clipped(SHAPES["box"], (1.0, 0.0), 4.0) == ((4.0, 0.0), (9.0, 0.0), (9.0, 6.0), (4.0, 6.0))
    assert clipped(SHAPES["box"], (1.0, 0.0), 10.0) == ()


@pytest.mark.parametrize(
    ("inclusions", "exclusions", "cuts"),
    [
        ([((-1, -1), (10, -1), (10, 7), (-1, 7))], [], False),
        ([((1, 1), (10, 1), (10, 7), (1, 7))], [], True),
        ([((20, 20), (30, 20), (30, 30))], [], True),
        ([], [((20, 20), (30, 20), (30, 30))], False),
        ([], [((3, 3), (4, 3), (4, 4))], True),
        ([], [((-9, -9), (30, -9), (30, 30), (-9, 30))], True),
        ([], [((6.2, 2.2), (6.8, 2.2), (6.8, 2.8), (6.2, 2.8))], False),
    ],
)
def test_what_cuts_into_a_mission_is_found(inclusions: list, exclusions: list, cuts: bool) -> None:
    own_exclusion = ((6.0, 2.0), (7.0, 2.0), (7.0, 3.0), (6.0, 3.0))
    assert cuts_into(inclusions, exclusions, SHAPES["box"], [own_exclusion]) == cuts
