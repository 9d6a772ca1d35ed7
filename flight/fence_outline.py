"""Polygons moved outwards or inwards by a distance, always on the safe side, and whether one fence cuts into another.

Outwards the result lies at least the distance away everywhere: notches too narrow for that are filled, one vertex at a time.
Inwards it lies at least the distance inside: the part seen from every edge, cut back by the distance; None when nothing is left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from safety.fence import PolygonFence, Ring, Vertex, signed_area_m2
from safety.fence_rules import LEAST_GAP_M, ring_problem, segments_touch

ROUNDING_M = 1e-6
SHARPEST_RAD = math.pi / 2.0  # a sharper corner gets more than one vertex, so that it does not reach far out


def grown(ring: Ring, by_m: float, most_vertices: int) -> Ring:
    """A polygon around `ring`, at least `by_m` away from it. Raises `ValueError` when there is none with so few vertices."""
    inner = _counter_clockwise(ring)
    while True:
        outline = _moved_out(inner, by_m)
        if len(outline) <= most_vertices and _surrounds(outline, inner, by_m):
            return outline
        inner = _with_a_notch_less(inner)


def shrunk(ring: Ring, by_m: float) -> Ring | None:
    """A convex polygon inside `ring`, at least `by_m` away from its edges, or None."""
    inner = _counter_clockwise(ring)
    xs, ys = zip(*inner, strict=True)
    left: Ring = ((min(xs), min(ys)), (max(xs), min(ys)), (max(xs), max(ys)), (min(xs), max(ys)))
    for a, b in _edges(inner):
        length = math.dist(a, b)
        normal = ((a[1] - b[1]) / length, (b[0] - a[0]) / length)
        left = clipped(left, normal, normal[0] * a[0] + normal[1] * a[1] + by_m)
    return left if ring_problem(left) is None else None


def clipped(ring: Ring, normal: Vertex, least: float) -> Ring:
    """The part of a polygon where `normal` . p >= `least`; empty when there is none (Sutherland and Hodgman's way)."""
    kept: list[Vertex] = []
    for a, b in _edges(ring):
        room_a, room_b = (normal[0] * p[0] + normal[1] * p[1] - least for p in (a, b))
        if room_a >= 0.0:
            kept.append(a)
        if (room_a >= 0.0) != (room_b >= 0.0):
            share = room_a / (room_a - room_b)
            kept.append((a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])))
    return tuple(p for k, p in enumerate(kept) if math.dist(p, kept[k - 1]) >= LEAST_GAP_M)


def cuts_into(inclusions: Sequence[Ring], exclusions: Sequence[Ring], inner: Ring, inner_exclusions: Sequence[Ring]) -> bool:
    """Whether an outer fence forbids any place that the inner fence allows."""
    allowed = PolygonFence(inner, inner_exclusions)
    if any(_crosses(outer, inner) or _inside(outer, inner[0]) < 0.0 for outer in inclusions):
        return True
    for outer in exclusions:
        if any(_crosses(outer, ring) for ring in (inner, *inner_exclusions)) or _inside(outer, inner[0]) > 0.0:
            return True
        if float(allowed.signed_margin_m(np.array(outer[0]))) > 0.0:
            return True
    return False


def _crosses(a: Ring, b: Ring) -> bool:
    return any(segments_touch(first, second) for first in _edges(a) for second in _edges(b))


def _inside(ring: Ring, point: Vertex) -> float:
    return float(PolygonFence(ring, ()).signed_margin_m(np.array(point)))


def _moved_out(ring: Ring, by_m: float) -> Ring:
    """Each edge of a counter-clockwise polygon moved out; where they turn by more than a right angle, with more vertices."""
    result: list[Vertex] = []
    for k, vertex in enumerate(ring):
        before, after = ring[k - 1], ring[(k + 1) % len(ring)]
        heading = math.atan2(vertex[1] - before[1], vertex[0] - before[0])
        turn = math.remainder(math.atan2(after[1] - vertex[1], after[0] - vertex[0]) - heading, 2.0 * math.pi)
        count = max(1, math.ceil(turn / SHARPEST_RAD - ROUNDING_M))
        reach = by_m / math.cos(0.5 * turn / count)
        for part in range(count):
            angle = heading - 0.5 * math.pi + turn * (part + 0.5) / count
            result.append((vertex[0] + reach * math.cos(angle), vertex[1] + reach * math.sin(angle)))
    return tuple(result)


def _surrounds(outline: Ring, inner: Ring, by_m: float) -> bool:
    if ring_problem(outline) is not None:
        return False
    least = by_m - ROUNDING_M
    inside = PolygonFence(outline, ()).signed_margin_m(np.array(inner)).min() >= least
    return bool(inside and PolygonFence(inner, ()).signed_margin_m(np.array(outline)).max() <= -least)


def _with_a_notch_less(ring: Ring) -> Ring:
    """The polygon without the inward vertex that fills least when it goes."""
    fillings: list[tuple[float, Ring]] = []
    for k in range(len(ring)):
        filled = ring[:k] + ring[k + 1 :]
        added = signed_area_m2(filled) - signed_area_m2(ring)
        if added > 0.0 and ring_problem(filled) is None:
            fillings.append((added, filled))
    if not fillings:
        raise ValueError("no polygon lies far enough around the fence; simplify its inclusion polygon")
    return min(fillings)[1]


def _counter_clockwise(ring: Ring) -> Ring:
    return ring if signed_area_m2(ring) > 0.0 else ring[::-1]


def _edges(ring: Ring) -> Iterator[tuple[Vertex, Vertex]]:
    return zip(ring, (*ring[1:], *ring[:1]), strict=True)
