"""Ranges from a point along beams to the first box or to the floor: a compiled kernel and its plain numpy twin.

Method: slab test of a ray against an axis-aligned box (Kay and Kajiya 1986), boxes as the outer loop so that the inner
one, over the beams, has no branch and vectorises; boxes wholly out of range are skipped. Beams lie in the body's x-y plane;
`rotation` turns body into world, so tilt is taken into account. All arithmetic in float64.

A beam that starts inside a box reads 0. A beam that runs within a face counts as a hit: boxes are taken 1 nm larger.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Components smaller than this are replaced by it: no division by zero, and a slab missed by more than 1e-11 m stays missed.
_SMALLEST = 1e-12
_TOUCH_M = 1e-9  # so that a beam exactly within a face, of either side, has an extent to hit


def beam_table(bearings_rad: Array) -> Array:
    """Cosines and sines of the bearings, float64 [2, k]: made once, used by every `cast_beams`."""
    bearings = np.asarray(bearings_rad, dtype=np.float64)
    return np.stack([np.cos(bearings), np.sin(bearings)])


@njit(cache=True)
def _reciprocals(rotation: Array, beams: Array, out: Array) -> None:
    """1 / direction of each beam in the world frame, `out` [3, k]."""
    for axis in range(3):
        ahead, left = rotation[axis, 0], rotation[axis, 1]
        for k in range(beams.shape[1]):
            component = ahead * beams[0, k] + left * beams[1, k]
            guarded = _SMALLEST if component >= 0.0 else -_SMALLEST
            component = guarded if abs(component) < _SMALLEST else component
            out[axis, k] = 1.0 / component


@njit(cache=True)
def _squared_distance(box: Array, origin: Array) -> float:
    total = 0.0
    for axis in range(3):
        below, above = box[axis] - origin[axis], origin[axis] - box[axis + 3]
        gap = max(below, above, 0.0)
        total += gap * gap
    return total


@njit(cache=True)
def cast_beams(boxes: Array, count: int, origin: Array, rotation: Array, beams: Array, range_max_m: float, out: Array) -> None:
    """Write the range of each beam into `out` [k]; `range_max_m` where nothing is nearer.

    Args: `boxes` [>=count, 6], the first `count` rows are used (so padded arrays of many environments fit); `origin` [3],
    world, m; `rotation` [3, 3] body to world; `beams` [2, k] from `beam_table`; `out` float64 [k].
    """
    inverse = np.empty((3, beams.shape[1]))
    _reciprocals(rotation, beams, inverse)
    inv_x, inv_y, inv_z = inverse[0], inverse[1], inverse[2]
    n_beams = beams.shape[1]
    floor = -max(origin[2], 0.0)
    for k in range(n_beams):
        to_floor = floor * inv_z[k]
        hit = (inv_z[k] < 0.0) & (inv_z[k] > -1.0 / _SMALLEST) & (to_floor < range_max_m)
        out[k] = to_floor if hit else range_max_m
    for i in range(count):
        if _squared_distance(boxes[i], origin) > range_max_m * range_max_m:
            continue
        x0, x1 = boxes[i, 0] - origin[0] - _TOUCH_M, boxes[i, 3] - origin[0] + _TOUCH_M
        y0, y1 = boxes[i, 1] - origin[1] - _TOUCH_M, boxes[i, 4] - origin[1] + _TOUCH_M
        z0, z1 = boxes[i, 2] - origin[2] - _TOUCH_M, boxes[i, 5] - origin[2] + _TOUCH_M
        for k in range(n_beams):
            xa, xb = x0 * inv_x[k], x1 * inv_x[k]
            ya, yb = y0 * inv_y[k], y1 * inv_y[k]
            za, zb = z0 * inv_z[k], z1 * inv_z[k]
            near_x, far_x = (xa, xb) if xa < xb else (xb, xa)
            near_y, far_y = (ya, yb) if ya < yb else (yb, ya)
            near_z, far_z = (za, zb) if za < zb else (zb, za)
            near = near_x if near_x > near_y else near_y
            near = near if near > near_z else near_z
            near = near if near > 0.0 else 0.0
            far = far_x if far_x < far_y else far_y
            far = far if far < far_z else far_z
            best = out[k]
            out[k] = near if (near <= far) & (near < best) else best


def cast_rays(boxes: Array, origin: Array, rotation: Array, bearings_rad: Array, range_max_m: float) -> Array:
    """Ranges [k] along `bearings_rad` [k] (0 ahead, positive left), never infinite: `range_max_m` where nothing is nearer.

    `boxes` [m, 6], `origin` [3] world m, `rotation` [3, 3] body to world. Compiled; see `cast_beams` for loops.
    """
    beams = beam_table(bearings_rad)
    out = np.empty(beams.shape[1])
    rows = np.ascontiguousarray(boxes, dtype=np.float64).reshape(-1, 6)
    place = np.ascontiguousarray(origin, dtype=np.float64)
    turn = np.ascontiguousarray(rotation, dtype=np.float64)
    cast_beams(rows, len(rows), place, turn, beams, float(range_max_m), out)
    return out


def cast_rays_numpy(boxes: Array, origin: Array, rotation: Array, bearings_rad: Array, range_max_m: float) -> Array:
    """The readable twin of `cast_rays`: all boxes times all beams at once, parallel rays handled as their own case."""
    origin = np.asarray(origin, dtype=np.float64)
    turn, (ahead, left) = np.asarray(rotation, dtype=np.float64), beam_table(bearings_rad)
    directions = np.outer(ahead, turn[:, 0]) + np.outer(left, turn[:, 1])  # [k, 3]
    parallel = np.abs(directions) < _SMALLEST
    inverse = 1.0 / np.where(parallel, 1.0, directions)
    rows = np.asarray(boxes, dtype=np.float64).reshape(-1, 1, 6)
    low, high = rows[..., :3] - origin - _TOUCH_M, rows[..., 3:] - origin + _TOUCH_M  # [m, 1, 3]
    between = (low <= 0.0) & (high >= 0.0)
    first, second = low * inverse, high * inverse
    near = np.where(parallel, np.where(between, -np.inf, np.inf), np.minimum(first, second)).max(axis=2)
    far = np.where(parallel, np.where(between, np.inf, -np.inf), np.maximum(first, second)).min(axis=2)
    near = np.maximum(near, 0.0)
    hits = np.where(near <= far, near, range_max_m)
    down = (directions[:, 2] < 0.0) & ~parallel[:, 2]
    floor = np.where(down, -max(origin[2], 0.0) * inverse[:, 2], range_max_m)
    nearest = np.minimum(hits.min(axis=0, initial=range_max_m), floor)
    return np.asarray(np.minimum(nearest, range_max_m), dtype=np.float64)
