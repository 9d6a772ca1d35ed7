"""Is there a way for a disc among boxes, and how short can it be? Two answers, each erring on its safe side.

* `path_exists`: search on an inflated grid. True is a proof: a disc of that radius can follow the cells found. False may
  be wrong for a passage that is only just wide enough (narrower than 2 radius + about 2 cells).
* `shortest_path_length`: visibility graph over corners that lie on or inside the true inflated outline. The result is a
  lower bound of the true shortest way (within about 1 %), so that path efficiency = shortest / flown is never flattered.

Both look from above: a box counts if it reaches into the heights between start and goal, widened by the radius.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_GRID_CELLS = 4_000_000
_CORNER_STEPS = 3  # points per rounded corner: both ends of the arc and its middle
_CHORD = math.cos(math.pi / 8.0)  # distance of a chord over 45 degrees from the arc's centre, as a share of the radius
_TOUCH_M = 1e-9


def relevant_boxes(boxes: Array, start: Sequence[float], goal: Sequence[float], radius_m: float) -> Array:
    """The outlines (xmin, ymin, xmax, ymax) [n, 4] of the boxes that reach into the heights flown."""
    rows = np.asarray(boxes, dtype=np.float64).reshape(-1, 6)
    low, high = min(start[2], goal[2]) - radius_m, max(start[2], goal[2]) + radius_m
    inside = (rows[:, 2] < high) & (rows[:, 5] > low)
    return np.ascontiguousarray(rows[inside][:, [0, 1, 3, 4]])


@njit(cache=True)
def _mark_blocked(outlines: Array, low: Array, cell: float, clearance: float, blocked: NDArray[np.bool_]) -> None:
    """Set the cells whose centre is nearer than `clearance` to an outline."""
    columns, rows = blocked.shape
    for b in range(outlines.shape[0]):
        x0, y0, x1, y1 = outlines[b, 0], outlines[b, 1], outlines[b, 2], outlines[b, 3]
        first = max(int((x0 - clearance - low[0]) / cell) - 1, 0)
        last = min(int((x1 + clearance - low[0]) / cell) + 1, columns - 1)
        bottom = max(int((y0 - clearance - low[1]) / cell) - 1, 0)
        top = min(int((y1 + clearance - low[1]) / cell) + 1, rows - 1)
        for i in range(first, last + 1):
            x = low[0] + i * cell
            dx = max(x0 - x, x - x1, 0.0)
            for j in range(bottom, top + 1):
                y = low[1] + j * cell
                dy = max(y0 - y, y - y1, 0.0)
                if dx * dx + dy * dy < clearance * clearance:
                    blocked[i, j] = True


@njit(cache=True)
def _connected(blocked: NDArray[np.bool_], start: tuple[int, int], goal: tuple[int, int]) -> bool:
    """Breadth-first search over eight neighbours; marks what it visits as blocked."""
    columns, rows = blocked.shape
    if blocked[start] or blocked[goal]:
        return False
    queue = np.empty(columns * rows, np.int64)
    queue[0] = start[0] * rows + start[1]
    blocked[start] = True
    head, tail = 0, 1
    while head < tail:
        i, j = queue[head] // rows, queue[head] % rows
        head += 1
        if i == goal[0] and j == goal[1]:
            return True
        for p in range(max(i - 1, 0), min(i + 2, columns)):
            for q in range(max(j - 1, 0), min(j + 2, rows)):
                if not blocked[p, q]:
                    blocked[p, q] = True
                    queue[tail] = p * rows + q
                    tail += 1
    return False


def path_exists(
    boxes: Array,
    start: Sequence[float],
    goal: Sequence[float],
    radius_m: float,
    resolution_m: float = 0.1,
) -> bool:
    """Whether a disc of `radius_m` can go from `start` to `goal` (x, y, z) without touching a box.

    True is a proof: between two free cell centres (at most sqrt(2) cells apart) no point is farther than sqrt(2)/2 cells
    from one of them, so cells are kept that much farther away than the radius. The search stays within the boxes' own
    extent, widened by one metre. Raises `ValueError` if that needs more than `MAX_GRID_CELLS` cells.
    """
    outlines = relevant_boxes(boxes, start, goal, radius_m)
    ends = np.array([start[:2], goal[:2]], dtype=np.float64)
    low = np.minimum(ends.min(axis=0), outlines[:, :2].min(axis=0, initial=np.inf)) - 1.0
    high = np.maximum(ends.max(axis=0), outlines[:, 2:].max(axis=0, initial=-np.inf)) + 1.0
    low = low + np.mod(ends[0] - low, resolution_m)  # the start is a cell centre
    shape = np.ceil((high - low) / resolution_m).astype(int) + 1
    if shape[0] * shape[1] > MAX_GRID_CELLS:
        raise ValueError(f"resolution_m {resolution_m} needs {shape[0]} x {shape[1]} cells; use a coarser grid")
    blocked = np.zeros((int(shape[0]), int(shape[1])), np.bool_)
    slack = resolution_m * math.sqrt(0.5)
    _mark_blocked(outlines, low, resolution_m, radius_m + slack, blocked)
    first, last = (np.rint((end - low) / resolution_m).astype(int) for end in ends)
    return bool(_connected(blocked, (int(first[0]), int(first[1])), (int(last[0]), int(last[1]))))


def _corner_points(outline: Array, radius_m: float) -> Array:
    """Points [12, 2] on the outline widened by the radius: three per rounded corner."""
    centre, half = 0.5 * (outline[:2] + outline[2:]), 0.5 * (outline[2:] - outline[:2])
    angles = np.linspace(0.0, 0.5 * math.pi, _CORNER_STEPS)
    arc = half + radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=np.float64)
    return np.asarray((centre + signs[:, None, :] * arc).reshape(-1, 2), dtype=np.float64)


@njit(cache=True)
def _enters(box: Array, radius: float, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether the segment a-b enters the polygon of `_corner_points` (touching is allowed): Cyrus-Beck clipping."""
    cx, cy = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    hx, hy = 0.5 * (box[2] - box[0]), 0.5 * (box[3] - box[1])
    enter, leave = 0.0, 1.0
    for k in range(16):  # outward normals every 22.5 degrees; the diagonal ones are no edge of the polygon
        if k % 4 == 2:
            continue
        angle = k * math.pi / 8.0
        nx, ny = math.cos(angle), math.sin(angle)
        reach = hx * abs(nx) + hy * abs(ny) + radius * (1.0 if k % 4 == 0 else _CHORD) - _TOUCH_M
        from_a = nx * (ax - cx) + ny * (ay - cy) - reach
        from_b = nx * (bx - cx) + ny * (by - cy) - reach
        if from_a >= 0.0 and from_b >= 0.0:
            return False
        if from_a >= 0.0:
            enter = max(enter, from_a / (from_a - from_b))
        elif from_b >= 0.0:
            leave = min(leave, from_a / (from_a - from_b))
    return enter < leave


@njit(cache=True)
def _visible(outlines: Array, radius: float, a: Array, b: Array) -> bool:
    low_x, high_x = min(a[0], b[0]) - radius, max(a[0], b[0]) + radius
    low_y, high_y = min(a[1], b[1]) - radius, max(a[1], b[1]) + radius
    for k in range(outlines.shape[0]):
        box = outlines[k]
        if box[2] < low_x or box[0] > high_x or box[3] < low_y or box[1] > high_y:
            continue
        if _enters(box, radius, a[0], a[1], b[0], b[1]):
            return False
    return True


@njit(cache=True)
def _dijkstra(points: Array, outlines: Array, radius: float) -> float:
    """Length of the shortest way from point 0 to point 1 over straight, unobstructed legs; inf if there is none.

    A leg is only tested for obstruction when it would shorten the way, and nodes farther than the goal are never expanded.
    """
    count = points.shape[0]
    best = np.full(count, np.inf)
    done = np.zeros(count, np.bool_)
    best[0] = 0.0
    for _ in range(count):
        node, least = -1, np.inf
        for i in range(count):
            if not done[i]:
                estimate = best[i] + math.hypot(points[i, 0] - points[1, 0], points[i, 1] - points[1, 1])
                if estimate < least:
                    node, least = i, estimate
        if node < 0 or node == 1:
            break
        done[node] = True
        for i in range(count):
            leg = math.hypot(points[i, 0] - points[node, 0], points[i, 1] - points[node, 1])
            if not done[i] and best[node] + leg < best[i] and _visible(outlines, radius, points[node], points[i]):
                best[i] = best[node] + leg
    return float(best[1])


def shortest_path_length(boxes: Array, start: Sequence[float], goal: Sequence[float], radius_m: float) -> float:
    """Length, m, of the shortest way of a disc of `radius_m` from `start` to `goal` (x, y, z); inf if there is none.

    A lower bound: rounded corners are cut by two chords each (at most 2.6 % of the arc flown around a corner), and the
    height difference is spread over the whole way. Any start or goal inside a widened box gives inf.
    """
    outlines = relevant_boxes(boxes, start, goal, radius_m)
    corners = [_corner_points(outline, radius_m) for outline in outlines]
    ends = np.array([start[:2], goal[:2]], dtype=np.float64)
    points = np.concatenate([ends, *corners]) if corners else ends
    flat = _dijkstra(np.ascontiguousarray(points), outlines, float(radius_m))
    return math.hypot(flat, goal[2] - start[2])
