"""Far inside the fence: which pieces are kept, to the micrometre, and when a place counts as clear."""

from __future__ import annotations

import numpy as np
import pytest

from safety.fence import Measured, PolygonFence
from safety.fence_far import FarInside

ROUNDING_M = 1e-6
HALL = PolygonFence(((0.0, 0.0), (40.0, 0.0), (40.0, 4.0), (0.0, 4.0)), ())


def kept(edges_m: tuple[float, ...], vertices_m: tuple[float, ...] = (50.0,) * 4) -> list[bool]:
    """Of the hall's edges and vertices, measured at these distances: whether each piece kept is a vertex."""
    measured = Measured(np.ones((1, 1)), np.array([edges_m]), np.array([vertices_m]))
    return [piece.vertex for piece in FarInside.at((20.0, 2.0), measured, 0, HALL).pieces]


@pytest.mark.parametrize(
    ("further_m", "pieces"),
    [
        (0.0, 2),
        (0.9, 2),
        (1.0 + ROUNDING_M, 2),
        (1.0 + 2.0 * ROUNDING_M, 1),
        (1.1, 1),
        (2.0, 1),
    ],
)
def test_what_is_a_metre_further_than_the_nearest_piece_can_be_as_near_half_a_metre_on(further_m, pieces):
    """Half a metre towards the one is half a metre away from the other: a metre of difference, and what rounding may add."""
    assert kept((1.0, 1.0 + further_m, 30.0, 30.0)) == [False] * pieces
    assert kept((30.0, 30.0, 30.0, 30.0), (1.0, 30.0, 30.0, 1.0 + further_m)) == [True] * pieces


def test_edges_and_vertices_are_measured_against_each_other():
    assert kept((1.0, 9.0, 9.0, 9.0), (1.5, 9.0, 9.0, 9.0)) == [False, True]
    assert kept((3.0, 9.0, 9.0, 9.0), (1.5, 9.0, 9.0, 9.0)) == [True]


@pytest.mark.parametrize(("edge_m", "clear"), [(1.0 + ROUNDING_M, False), (1.0 + 1.5 * ROUNDING_M, True), (1.0, False)])
def test_a_place_is_clear_by_more_than_rounding(edge_m, clear):
    assert FarInside(0.0, 0.0, edge_m, ()).clear_of(1.0, (0.0, 0.0)) == clear


def test_one_kept_place_can_make_the_next():
    first = FarInside.at((20.0, 2.0), HALL.measured(np.array([[20.0, 2.0]])), 0, HALL)
    assert first.at((20.0, 2.0), HALL.measured(np.array([[20.0, 2.0]])), 0, HALL) == first
