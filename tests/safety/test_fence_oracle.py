"""The fence against an independent slow oracle. The run of 100,000 cases: `python tests/safety/fence_oracle.py`."""

from __future__ import annotations

import numpy as np
import pytest
from fence_oracle import check, exact_side, leg_disagreements, point_disagreements, validity_disagreement

from safety.fence import PolygonFence, Segments

SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
NOTCHED = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 1.0), (0.0, 4.0))


@pytest.mark.parametrize("seed", [2, 3])
def test_the_oracle_agrees_on_random_fences(seed):
    result = check(1600, seed)
    assert result["first"] == []
    assert result["cases"] >= 1600
    assert result["concave or with exclusions"] > 20


def test_sides_are_exact_on_edges_vertices_and_a_hair_beside():
    assert [exact_side(p, SQUARE) for p in ((0.0, 0.0), (4.0, 1.0), (2.0, 4.0))] == [0, 0, 0]
    assert [exact_side(p, SQUARE) for p in ((1e-300, 1.0), (-1e-300, 1.0), (4.0, 5.0), (-1.0, 0.0))] == [1, -1, -1, -1]


def test_the_oracle_sees_a_wrong_distance(monkeypatch):
    """Lines instead of segments: wrong at concave corners only."""
    monkeypatch.setattr(Segments, "distances_m", lambda self, along, across: np.abs(across))
    assert point_disagreements(NOTCHED, (), np.array(((2.0, 0.6), (0.5, 2.0))))
    assert not point_disagreements(SQUARE, (), np.array(((1.0, 2.0),)))


def test_the_oracle_sees_a_wrong_side(monkeypatch):
    monkeypatch.setattr(PolygonFence, "signed_margin_m", lambda self, p: np.abs(self.ring_margins_m(p)).min(axis=-1))
    assert point_disagreements(SQUARE, (), np.array(((5.0, 1.0),)))


def test_the_oracle_sees_a_leg_judged_at_its_ends_only(monkeypatch):
    monkeypatch.setattr("safety.fence_tube._leg_to_vertices_m", lambda ends, vertices: np.full((2, 1, len(vertices.x_m)), 9.0))
    monkeypatch.setattr("safety.fence_tube._crossed", lambda edges, along, across, start: np.zeros(across.shape[1:], bool))
    assert leg_disagreements(NOTCHED, (), np.random.default_rng(1), 200)


def test_the_oracle_sees_a_polygon_let_through():
    assert validity_disagreement(((0.0, 0.0), (4.0, 4.0), (4.0, 0.0), (0.0, 4.0)), ()) is None
    assert validity_disagreement(SQUARE, (NOTCHED,)) is None
