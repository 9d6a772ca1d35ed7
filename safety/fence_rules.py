"""Which polygons make a fence. Each refusal is one line that names polygon, vertex (counted from 1) and place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from safety.fence import PolygonFence, Ring, Vertex, signed_area_m2

MAX_VERTICES = 64
LEAST_GAP_M = 1e-3  # vertices and edges that come nearer to each other count as the same or as touching
LEAST_AREA_M2 = 1e-6


def fence_problem(inclusion: Ring, exclusions: Sequence[Ring]) -> str | None:
    """Why these polygons are no fence, or None."""
    rings = [("inclusion", inclusion)] + [(f"exclusion {k + 1}", ring) for k, ring in enumerate(exclusions)]
    count = sum(len(ring) for _, ring in rings)
    if count > MAX_VERTICES:
        return f"{count} vertices in all, more than {MAX_VERTICES}; simplify the polygons"
    for name, ring in rings:
        problem = ring_problem(ring)
        if problem is not None:
            return f"{name}: {problem}"
    for name, ring in rings[1:]:
        if not _overlap(inclusion, ring):
            return f"{name}: lies outside the inclusion polygon and forbids nothing; move or remove it"
    return None


def ring_problem(ring: Ring) -> str | None:
    """Why this is no simple polygon, or None."""
    if len(ring) < 3:
        return f"{len(ring)} vertices; a polygon has three or more"
    for k, (x, y) in enumerate(ring):
        if not (math.isfinite(x) and math.isfinite(y)):
            return f"{_named(ring, k)} is not finite"
    return _repeated(ring) or _flat(ring) or _doubled_back(ring) or _crossed(ring)


def _repeated(ring: Ring) -> str | None:
    for a, b in combinations(range(len(ring)), 2):
        if math.dist(ring[a], ring[b]) < LEAST_GAP_M:
            return f"{_named(ring, b)} repeats vertex {a + 1}; remove it"
    return None


def _flat(ring: Ring) -> str | None:
    if abs(signed_area_m2(ring)) < LEAST_AREA_M2:
        return f"all vertices, up to {_named(ring, len(ring) - 1)}, lie on one line; it encloses nothing"
    return None


def _doubled_back(ring: Ring) -> str | None:
    for k in range(len(ring)):
        a, b, c = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
        if min(_gap_m(a, b, c), _gap_m(c, b, a)) < LEAST_GAP_M:
            return f"{_named(ring, k)} is a spike: the edge doubles back; remove it"
    return None


def _gap_m(a: Vertex, b: Vertex, c: Vertex) -> float:
    """Distance of the point a from the segment b - c."""
    dx, dy = c[0] - b[0], c[1] - b[1]
    share = min(max(((a[0] - b[0]) * dx + (a[1] - b[1]) * dy) / (dx * dx + dy * dy), 0.0), 1.0)
    return math.dist(a, (b[0] + share * dx, b[1] + share * dy))


def _crossed(ring: Ring) -> str | None:
    count = len(ring)
    for a, b in combinations(range(count), 2):
        if b - a in (1, count - 1):
            continue
        first, second = (ring[a], ring[a + 1]), (ring[b], ring[(b + 1) % count])
        if segments_touch(first, second):
            return f"the edge from {_named(ring, a)} crosses or touches the edge from {_named(ring, b)}"
    return None


def segments_touch(first: tuple[Vertex, Vertex], second: tuple[Vertex, Vertex]) -> bool:
    """Whether two segments cross or come nearer than `LEAST_GAP_M`."""
    (a, b), (c, d) = first, second
    if _parts(a, b, c, d) and _parts(c, d, a, b):
        return True
    return min(_gap_m(a, c, d), _gap_m(b, c, d), _gap_m(c, a, b), _gap_m(d, a, b)) < LEAST_GAP_M


def _parts(a: Vertex, b: Vertex, c: Vertex, d: Vertex) -> bool:
    """Whether c and d lie clearly on different sides of the line a - b; on it, rounding would decide and the gap must."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    far = 0.5 * LEAST_GAP_M * math.hypot(dx, dy)
    first, second = (dx * (p[1] - a[1]) - dy * (p[0] - a[0]) for p in (c, d))
    return min(first, second) < -far and max(first, second) > far


def _overlap(inclusion: Ring, exclusion: Ring) -> bool:
    """Whether an exclusion takes anything away."""
    edges = [list(zip(ring, (*ring[1:], ring[0]), strict=True)) for ring in (inclusion, exclusion)]
    if any(segments_touch(first, second) for first in edges[0] for second in edges[1]):
        return True
    around = PolygonFence(exclusion, ()).signed_margin_m(np.array(inclusion[0]))
    inside = PolygonFence(inclusion, ()).signed_margin_m(np.array(exclusion[0]))
    return bool(around > 0.0 or inside > 0.0)


def _named(ring: Ring, index: int) -> str:
    x, y = ring[index]
    return f"vertex {index + 1} ({x:g}, {y:g})"
