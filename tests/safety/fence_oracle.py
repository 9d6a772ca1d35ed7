"""An independent slow oracle for the fence: inside, outside and on by exact fractions, distances by shapely.

python tests/safety/fence_oracle.py --cases 100000 --out results/fence_oracle.json
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from fractions import Fraction
from pathlib import Path

import numpy as np
import shapely
from fence_cases import Ring, fence, points

from safety.braking import Start, Tubes
from safety.fence import PolygonFence
from safety.fence_rules import LEAST_GAP_M, fence_problem, ring_problem
from safety.fence_tube import FenceGuard
from safety.frames import CorridorVector

POINTS_PER_FENCE, LEGS_PER_FENCE = 30, 10
ROUNDING_M = 1e-9  # a sign may be wrong this near to an edge: 1e5 m away a float has steps of 1.5e-11 m
SHAPELY_M = 1e-7  # shapely's own rounding that far away
LEG_M = 2.0  # no brake tube of the shipped limits is longer


def exact_side(point: tuple[float, float], ring: Ring) -> int:
    """1 inside, 0 on an edge or vertex, -1 outside, by even-odd with fractions: exact for any floats."""
    x, y = Fraction(point[0]), Fraction(point[1])
    inside = False
    corners = [(Fraction(cx), Fraction(cy)) for cx, cy in ring]
    for (ax, ay), (bx, by) in zip(corners, (*corners[1:], corners[0]), strict=True):
        across = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        if across == 0 and min(ax, bx) <= x <= max(ax, bx) and min(ay, by) <= y <= max(ay, by):
            return 0
        if (ay > y) != (by > y) and (across > 0) == (by > ay):
            inside = not inside
    return 1 if inside else -1


def expected_margin_m(point: tuple[float, float], inclusion: Ring, exclusions: tuple[Ring, ...]) -> tuple[int, float]:
    """(exact side: 1 allowed, 0 on the fence, -1 forbidden; signed distance to the nearest edge, m)."""
    sides = [exact_side(point, inclusion), *(-exact_side(point, ring) for ring in exclusions)]
    place = shapely.Point(point)
    distances = [shapely.LinearRing(ring).distance(place) for ring in (inclusion, *exclusions)]
    return min(sides), min(side * distance for side, distance in zip(sides, distances, strict=True))


def point_disagreements(inclusion: Ring, exclusions: tuple[Ring, ...], places: np.ndarray) -> list[str]:
    """What the fence says differently from the oracle about points [n, 2]."""
    margins, found = PolygonFence(inclusion, exclusions).signed_margin_m(places), []
    for place, margin in zip(places, margins, strict=True):
        side, expected = expected_margin_m((float(place[0]), float(place[1])), inclusion, exclusions)
        if abs(margin - expected) > SHAPELY_M:
            found.append(f"distance {margin} is {expected} at {place} of {inclusion} {exclusions}")
        elif abs(margin) > ROUNDING_M and np.sign(margin) != side:
            found.append(f"side {margin} is {side} at {place} of {inclusion} {exclusions}")
    return found


def leg_disagreements(inclusion: Ring, exclusions: tuple[Ring, ...], random: np.random.Generator, count: int) -> list[str]:
    """Straight tubes between allowed points: least distance to the fence, by shapely, or a crossing."""
    allowed = PolygonFence(inclusion, exclusions)
    places = points(random, (inclusion, *exclusions), 4 * count)
    places = places[allowed.signed_margin_m(places) > ROUNDING_M]
    walls = shapely.MultiLineString([(*ring, ring[0]) for ring in (inclusion, *exclusions)])
    found = []
    for begin, target in zip(places[0::2], places[1::2], strict=False):
        end = begin + min(1.0, LEG_M / max(float(np.hypot(*(target - begin))), ROUNDING_M)) * (target - begin)
        expected, room = shapely.LineString((begin, end)).distance(walls), _leg_room_m(allowed, begin, end)
        good = room <= 0.0 if expected == 0.0 else abs(room - expected) < SHAPELY_M
        if not good:
            found.append(f"leg {begin} {end}: {room} is {expected} in {inclusion} {exclusions}")
    return found


def _leg_room_m(fence_: PolygonFence, begin: np.ndarray, end: np.ndarray) -> float:
    places = [np.broadcast_to(np.array((*place, 0.0)), (2, 1, 3)) for place in (begin, end)]
    guard, start = FenceGuard(fence_, -1.0, 1.0), Start(places[0][:, 0], np.zeros((2, 3)))
    near = guard.look(CorridorVector(float(begin[0]), float(begin[1]), 0.0), start, 1e6)
    return float(guard.rooms_m(Tubes(*places), start, near)[0, :-2].min())


def validity_disagreement(inclusion: Ring, exclusions: tuple[Ring, ...]) -> str | None:
    """A polygon is refused when shapely calls it invalid or when something in it comes nearer than the least gap, else not."""
    for ring in (inclusion, *exclusions):
        polygon = shapely.Polygon(ring)
        narrow = not polygon.is_valid or polygon.minimum_clearance < LEAST_GAP_M
        refused = ring_problem(ring) is not None
        if refused != narrow and not (polygon.is_valid and abs(polygon.minimum_clearance - LEAST_GAP_M) < SHAPELY_M):
            return f"{ring}: refused {refused}, shapely valid {polygon.is_valid}, clearance {polygon.minimum_clearance}"
    return None


def check(cases: int, seed: int = 1) -> dict[str, object]:
    """Draw fences until so many cases (points and legs) are compared; every disagreement in words."""
    random, counts, found = np.random.default_rng(seed), Counter[str](), list[str]()
    while counts["cases"] < cases:
        inclusion, exclusions = fence(random)
        counts["fences"] += 1
        wrong = validity_disagreement(inclusion, exclusions)
        found += [wrong] if wrong else []
        if fence_problem(inclusion, exclusions) is not None:
            counts["refused fences"] += 1
            continue
        counts["concave or with exclusions"] += bool(exclusions) or not shapely.Polygon(inclusion).equals(
            shapely.Polygon(inclusion).convex_hull
        )
        places = points(random, (inclusion, *exclusions), POINTS_PER_FENCE)
        found += point_disagreements(inclusion, exclusions, places)
        found += leg_disagreements(inclusion, exclusions, random, LEGS_PER_FENCE)
        counts["cases"] += POINTS_PER_FENCE + LEGS_PER_FENCE
    return {**counts, "seed": seed, "shapely": shapely.__version__, "disagreements": len(found), "first": found[:5]}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    text = json.dumps(check(options.cases), indent=2) + "\n"
    print(text)
    if options.out is not None:
        options.out.write_text(text)
