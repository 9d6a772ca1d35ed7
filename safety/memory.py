"""A short memory of obstacle points in the corridor frame, in fixed space.

A return is forgotten when a newer scan sees something at its place (the newer return replaces it), when newer scans have looked
past it for longer than one drop-out lasts, when it is older than the memory, or when it is too far away to matter. What left the
field of view, or is hidden behind something nearer, stays. Returns at an edge are kept with a place behind them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.lidar import SeenScan, scan_offset

Floats = NDArray[np.float64]
CAPACITY = 2048
MOVED_S = (
    1.0  # so long a point spreads at the obstacles' speed; after that the unseen that grows into the map of free space holds
)
LEAST_DEPTH_M = 0.15  # nothing is taken to be thinner: a pole seen from one side can be drifted upon from the other
NOTHING_M = 1e6  # in place of the distance where a beam met nothing
SAME_PLACE_M = 0.2  # a return this close to a remembered one, along its beam, is the same thing seen again


class ObstacleMemory:
    """At most `CAPACITY` points, oldest first; when full the oldest go."""

    def __init__(self) -> None:
        self._points = np.empty((4, CAPACITY))  # rows: x, y, spread, time of sight
        self._count = 0

    def clear(self) -> None:
        """Forget all points."""
        self._count = 0

    @property
    def count(self) -> int:
        """Number of points held."""
        return self._count

    def update(self, seen: SeenScan, reach_m: float, config: SafetyConfig) -> None:
        """Take in a new scan: drop what it looked at again or what is old or out of reach, add its returns."""
        old = self._points[:, : self._count]
        if self._count:
            old = old.take(self._kept(seen, reach_m, config).nonzero()[0], axis=1)
        new = _new_points(seen, reach_m)[:, -CAPACITY:]
        split = min(old.shape[1], CAPACITY - new.shape[1])
        end = split + new.shape[1]
        self._points[:, :split] = old[:, old.shape[1] - split :]
        self._points[:, split:end] = new
        self._count = end

    def _kept(self, seen: SeenScan, reach_m: float, config: SafetyConfig) -> NDArray[np.bool_]:
        x, y, _, time_s = self._points[:, : self._count]
        dx, dy = x - seen.origin_x_m, y - seen.origin_y_m
        distance = np.sqrt(dx * dx + dy * dy)
        young = time_s >= seen.time_s - config.memory_s
        held = time_s >= seen.time_s - config.memory_hold_s
        reach = self._reach(seen, np.arctan2(dy, dx))
        replaced = np.abs(reach - distance) <= SAME_PLACE_M
        passed = reach > distance
        kept: NDArray[np.bool_] = young & (distance < reach_m) & ~replaced & (held | ~passed)
        return kept

    @staticmethod
    def _reach(seen: SeenScan, direction_rad: Floats) -> Floats:
        """How far the beam in each direction [k] saw: inf = nothing there, nan = no beam or an unknown one, m."""
        beams = seen.range_m.shape[0]
        saw = np.empty(beams + 1)
        saw[:beams], saw[beams] = seen.range_m, np.nan  # beyond the last beam nothing is seen
        beam = np.rint(scan_offset(seen, direction_rad - seen.yaw_rad) / seen.angle_increment_rad)
        reach: Floats = saw.take(np.minimum(beam, beams).astype(np.intp))
        return reach

    @property
    def places_m(self) -> Floats:
        """Coordinates [2, k] of the points; they change with the next update, m."""
        return self._points[:2, : self._count]

    def points(self, now_s: float, config: SafetyConfig) -> tuple[Floats, Floats, Floats]:
        """Coordinates x, y [k] and the extra radius [k] each point has by beam width, age, drift and own motion, m."""
        x, y, spread, time_s = self._points[:, : self._count]
        age = np.maximum(now_s - time_s, 0.0)
        # the estimate may have erred the other way when the point was seen
        drift = np.minimum(age * config.velocity_error_m_s, 2.0 * config.position_error_m)
        if config.obstacle_speed_m_s == 0.0:
            return x, y, spread + drift
        return x, y, spread + drift + np.minimum(age, MOVED_S) * config.obstacle_speed_m_s


def _new_points(seen: SeenScan, reach_m: float) -> Floats:
    """Rows x, y, spread, time of a place behind each return within reach at an edge, its far side, then of all those returns."""
    dx, dy = seen.x_m - seen.origin_x_m, seen.y_m - seen.origin_y_m
    distance = np.sqrt(dx * dx + dy * dy)
    near = distance < reach_m
    plain, edge = near.nonzero()[0], (near & _edges(seen.range_m)).nonzero()[0]
    which = np.concatenate((edge, plain))
    rows = np.empty((4, which.shape[0]))
    rows[0], rows[1], rows[2], rows[3] = seen.x_m.take(which), seen.y_m.take(which), seen.spread_m.take(which), seen.time_s
    if edge.shape[0]:
        depth = LEAST_DEPTH_M / np.maximum(distance.take(edge), LEAST_DEPTH_M)
        rows[0, : edge.shape[0]] += depth * dx.take(edge)
        rows[1, : edge.shape[0]] += depth * dy.take(edge)
    return rows


def _edges(range_m: Floats) -> NDArray[np.bool_]:
    """Of the beams [n] with a return, in order: whether a beam beside it saw clearly further [k]."""
    further = np.zeros(range_m.shape[0] + 1)  # from beam to beam, none before the first and after the last
    finite_m = np.minimum(range_m, NOTHING_M)
    further[1:-1] = finite_m[1:] - finite_m[:-1]
    edge = (further[1:] > SAME_PLACE_M) | (further[:-1] < -SAME_PLACE_M)
    found: NDArray[np.bool_] = edge[np.isfinite(range_m)]
    return found
