"""The fence's geometry where a place is right on it, and the search for a place with room: where it looks, and when it stops."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from safety.fence import Measured, PolygonFence, Ring, Segments, signed_area_m2

SQUARE: Ring = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))


def test_the_area_is_measured_from_the_first_vertex():
    """Base 2^-20, height 3; seen from the far vertex the base would be lost in rounding."""
    assert signed_area_m2(((0.0, 0.0), (2.0**-20, 0.0), (2.0**53, 3.0))) == 1.5 * 2.0**-20


@pytest.mark.parametrize("x", [0.5, 1.0, 2.0, 3.0, 3.5])
@pytest.mark.parametrize("y", [0.5, 1.0, 2.0, 3.0, 3.5])
def test_inside_a_square_the_margin_is_to_the_nearest_wall(x, y):
    """Also where it is a metre exactly, and level with nothing."""
    wanted = min(x, y, 4.0 - x, 4.0 - y)
    assert PolygonFence(SQUARE, ()).signed_margin_m(np.array((x, y))) == wanted
    assert PolygonFence(SQUARE, ()).signed_margin_m(np.array((x + 4.0, y))) == -x
    assert PolygonFence(SQUARE, ()).signed_margin_m(np.array((x - 4.0, y))) == x - 4.0


@pytest.mark.parametrize(
    "place", [(4.0, 2.0), (0.0, 2.0), (2.0, 0.0), (2.0, 4.0), (0.0, 0.0), (4.0, 4.0), (4.0, 0.0), (0.0, 4.0)]
)
def test_right_on_an_edge_there_is_no_margin_and_nothing_is_divided_by_it(place):
    with np.errstate(all="raise"):
        assert PolygonFence(SQUARE, ()).signed_margin_m(np.array(place)) == 0.0


def exactly_inside(place: tuple[float, float], ring: Ring) -> bool:
    """In rational numbers: an odd number of edges lies to the east."""
    x, y = map(Fraction, place)
    corners = [tuple(map(Fraction, vertex)) for vertex in ring]
    edges = zip(corners, (*corners[1:], corners[0]), strict=True)
    return sum((ay <= y) != (by <= y) and x < ax + (bx - ax) * (y - ay) / (by - ay) for (ax, ay), (bx, by) in edges) % 2 == 1


@pytest.mark.parametrize(
    ("ring", "place"),
    [
        (((-0.8, -4.1), (-0.8, -5.3), (5.4, -3.9)), (math.nextafter(-0.8, 0.0), -4.1)),
        (((-3.6, -1.2), (-0.3, 2.9), (-2.2, -3.4)), (math.nextafter(-3.6, 0.0), -1.2)),
        (((-1.5, -3.6), (-3.3, -2.2), (4.8, -1.5)), (math.nextafter(-1.5, 0.0), -3.6)),
        (((5.0, 2.4), (0.8, 2.9), (1.0, -5.8)), (5.0, math.nextafter(2.4, 0.0))),
    ],
)
def test_the_last_bit_beside_a_corner_tells_the_side(ring, place):
    """Rounding puts these right on the line of one edge; the others to the east still tell."""
    margin_m = float(PolygonFence(ring, ()).signed_margin_m(np.array(place)))
    assert (margin_m > 0.0) == exactly_inside(place, ring)
    assert 0.0 < abs(margin_m) < 1e-15


def test_right_on_a_slanted_edge_its_own_erosion_is_missing():
    """0.25 for the vehicle, 0.5 per axis: 0.707 across the edge at 45 degrees, 0.5 across the straight ones."""
    fence = PolygonFence(((0.0, 0.0), (4.0, 0.0), (0.0, 4.0)), (), 0.25, 0.5)
    assert fence.signed_margin_m(np.array((2.0, 2.0))) == 0.0
    assert fence.room_m(np.array((2.0, 2.0))) == pytest.approx(-0.25 - 0.5 * math.sqrt(2.0))
    assert fence.room_m(np.array((2.0, 0.0))) == pytest.approx(-0.75)


def test_segments_are_chosen_and_joined_column_by_column():
    edges = PolygonFence(SQUARE, ()).edges
    few = edges.taken(np.array((False, True, False, True)))
    assert [getattr(few, name).tolist() for name in Segments.__slots__] == [
        [4.0, 0.0],
        [0.0, 4.0],
        [0.0, 0.0],
        [1.0, -1.0],
        [4.0, 4.0],
        [0, 0],
        [0.0, 0.0],
    ]
    assert few.followed_by(edges).x_m.tolist() == [4.0, 0.0, 0.0, 4.0, 4.0, 0.0]


class Counted(PolygonFence):
    """Counts the places that are looked at, and refuses to look at too many."""

    most = 1000
    looked_at = 0

    def measured(self, points: np.ndarray) -> Measured:
        self.looked_at += points.size // 2
        assert self.looked_at <= self.most, "the search does not narrow"
        return super().measured(points)


def search(ring: Ring, radius_m: float, *holes: Ring) -> tuple[tuple[float, float] | None, int]:
    """The place found, and how many were looked at."""
    fence = Counted(ring, holes, radius_m, 0.0)
    return fence.roomiest(), fence.looked_at


def keyhole(x: float, y: float) -> Ring:
    """A chamber of 1 m at a place, reached through passages of 0.2 m from two sides of a square of 8 m."""
    chamber = ((x + 0.5, y - 0.5), (x + 0.5, y + 0.5), (x - 0.5, y + 0.5), (x - 0.5, y - 0.5))
    stem = ((x - 0.1, y - 0.5), (x - 0.1, 0.2), (0.2, 0.2), (0.2, 8.0), (0.0, 8.0))
    return ((0.0, 0.0), (8.0, 0.0), (8.0, 0.2), (x + 0.1, 0.2), (x + 0.1, y - 0.5), *chamber, *stem)


@pytest.mark.parametrize("x", [1.1, 2.7, 3.4, 4.9, 5.2, 7.3])
@pytest.mark.parametrize("y", [1.3, 2.2, 3.8, 4.6, 6.9, 7.4])
def test_a_chamber_is_found_wherever_it_is(x, y):
    """Room for a vehicle of 0.4 m: up to 0.1 m from the middle."""
    found, _ = search(keyhole(x, y), 0.4)
    assert found is not None
    assert max(abs(found[0] - x), abs(found[1] - y)) < 0.1


@pytest.mark.parametrize(
    ("ring", "hole", "place"),
    [
        (((0.0, 0.0), (2.0, 0.0), (2.0, 6.0), (0.0, 6.0)), ((0.1, 0.1), (1.9, 0.1), (1.9, 3.9), (0.1, 3.9)), (1.0, 5.0)),
        (((0.0, 0.0), (6.0, 0.0), (6.0, 2.0), (0.0, 2.0)), ((0.1, 0.1), (3.9, 0.1), (3.9, 1.9), (0.1, 1.9)), (5.0, 1.0)),
    ],
)
def test_long_fences_are_looked_at_in_squares(ring, hole, place):
    """Three squares of 2 m: only the middle of the last has room, and is found at once."""
    assert search(ring, 0.5, hole) == (place, 3)


def test_where_a_circle_fits_exactly_there_is_no_room():
    assert search(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)), 0.5)[0] is None


def test_only_cells_in_which_room_may_hide_are_halved():
    """A square of 1 m lacks 5 mm: what is looked at stays near its middle, ever finer. All cells would be 87,381."""
    found, looked_at = search(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)), 0.505)
    assert found is None
    assert looked_at <= 200


def test_a_cell_that_room_could_only_touch_is_not_halved():
    """4.5 m by 3 m in two cells, 2.25 m by 3 m: half their diagonal is 1.875 m, and so much is missing in the middle of each."""
    assert search(((0.0, 0.0), (4.5, 0.0), (4.5, 3.0), (0.0, 3.0)), 3.0) == (None, 2)


def passage(length_m: float, width_m: float) -> Ring:
    """A straight passage with a niche of 0.2 m by its begin that ends at y = 1: its middle is in the middle of no coarse cell."""
    return ((0.0, 0.0), (length_m, 0.0), (length_m, width_m), (0.2, width_m), (0.2, 1.0), (0.0, 1.0))


@pytest.mark.parametrize("length_m", [1000.0, 1024.0])
@pytest.mark.parametrize(
    ("width_m", "radius_m", "found"),
    [
        (0.9, 0.43, True),  # y from 0.43 to 0.47: 0.4375 is a middle where cells are 1 / 8 m high
        (0.93, 0.455, True),  # from 0.455 to 0.475: 0.46875 is one where they are 1 / 16 m high
        (0.907, 0.4515, False),  # from 0.4515 to 0.4555: 0.453125 would be one where they are 1 / 32 m high
    ],
)
def test_in_a_long_fence_no_place_smaller_than_its_share_is_looked_for(length_m, width_m, radius_m, found):
    """Cells begin with 1 / 256 of the length and 1 m. Of 2^-11 of the length they are still halved, and then no more."""
    fence = PolygonFence(passage(length_m, width_m), (), radius_m, 0.0)
    assert (fence.roomiest() is not None) == found
