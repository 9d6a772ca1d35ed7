"""Random fences and points for the oracle: convex, concave, star-shaped, comb-like, with exclusions, turned and far away."""

from __future__ import annotations

import math

import numpy as np

Ring = tuple[tuple[float, float], ...]


def convex(random: np.random.Generator) -> np.ndarray:
    angles = np.sort(random.uniform(0.0, 2.0 * math.pi, random.integers(3, 12)))
    return np.stack((random.uniform(2.0, 9.0) * np.cos(angles), random.uniform(2.0, 9.0) * np.sin(angles)), axis=1)


def star(random: np.random.Generator) -> np.ndarray:
    count = int(random.integers(3, 16))
    angles = 2.0 * math.pi * (np.arange(count) + random.uniform(0.1, 0.9, count)) / count
    radii = random.uniform(1.0, 9.0, count)
    return np.stack((radii * np.cos(angles), radii * np.sin(angles)), axis=1)


def comb(random: np.random.Generator) -> np.ndarray:
    teeth, points = int(random.integers(2, 5)), [(0.0, 0.0)]
    width, depth = random.uniform(0.2, 2.0), random.uniform(1.0, 6.0)
    for k in range(teeth):
        x = 2.0 * k * width
        points += [(x, depth), (x + width, depth * random.uniform(0.6, 1.4)), (x + width, 1.0), (x + 2.0 * width, 1.0)]
    points += [(2.0 * teeth * width, 0.0)]
    return np.array(points)


def step(random: np.random.Generator) -> np.ndarray:
    """An L with whole-number corners: many points are exactly on lines."""
    b, c = sorted(random.choice(np.arange(1.0, 12.0), 2, replace=False))
    d = float(random.integers(1, 10))
    return np.array(((0.0, 0.0), (c, 0.0), (c, d), (b, d), (b, d + 3.0), (0.0, d + 3.0)))


SHAPES = (convex, star, comb, step)


def placed(random: np.random.Generator, shape: np.ndarray) -> Ring:
    """Turned, moved (sometimes 1e5 m away), with any first vertex, in either order."""
    result = np.roll(shape, int(random.integers(0, len(shape))), axis=0)
    if random.random() < 0.5:
        result = result[::-1]
    return tuple((float(x), float(y)) for x, y in result)


def fence(random: np.random.Generator) -> tuple[Ring, tuple[Ring, ...]]:
    """An inclusion polygon and up to three exclusions in or across it; may be no valid fence."""
    turn = random.uniform(0.0, 2.0 * math.pi) if random.random() < 0.7 else 0.0
    rotation = np.array(((math.cos(turn), -math.sin(turn)), (math.sin(turn), math.cos(turn))))
    offset = random.uniform(-1.0, 1.0, 2) * random.choice((0.0, 10.0, 1e5))
    shape = SHAPES[random.integers(len(SHAPES))](random)
    exclusions = []
    for _ in range(int(random.integers(0, 4))):
        small = 0.15 * SHAPES[random.integers(len(SHAPES))](random) + random.uniform(shape.min(axis=0), shape.max(axis=0))
        exclusions.append(placed(random, small @ rotation.T + offset))
    return placed(random, shape @ rotation.T + offset), tuple(exclusions)


def points(random: np.random.Generator, rings: tuple[Ring, ...], count: int) -> np.ndarray:
    """Points all over, on edges and vertices, and a hair beside them."""
    corners = np.concatenate([np.array(ring) for ring in rings])
    low, high = corners.min(axis=0) - 2.0, corners.max(axis=0) + 2.0
    ring = np.array(rings[random.integers(len(rings))])
    which = random.integers(0, len(ring), count)
    share = random.choice((0.0, 0.5, 1.0, -1.0), count)
    share = np.where(share < 0.0, random.uniform(0.0, 1.0, count), share)[:, None]
    on_edge = ring[which] + share * (np.roll(ring, -1, axis=0)[which] - ring[which])
    beside = on_edge + random.standard_normal((count, 2)) * 10.0 ** random.uniform(-9.0, 0.0, (count, 1))
    kind = random.integers(0, 3, count)[:, None]
    return np.where(kind == 0, random.uniform(low, high, (count, 2)), np.where(kind == 1, on_edge, beside))
