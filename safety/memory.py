"""A short memory of obstacle points in the corridor frame, in fixed space.

A return is forgotten when a newer scan sees something at its place (the newer return replaces it), when newer scans have looked
past it for longer than one drop-out lasts, when it is older than the memory, or when it is too far away to matter. What left the
field of view, or is hidden behind something nearer, stays.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from safety.config import SafetyConfig
from safety.lidar import SeenScan, scan_offset

Floats = NDArray[np.float64]
CAPACITY = 2048
MOVED_S = (
    1.0  # so long a point spreads at the obstacles' speed; after that the unseen that grows into the map of free space holds
)
ALONG_BOTH_AXES = math.sqrt(2.0)  # bounds of errors are per axis
LEAST_DEPTH_M = 0.1  # nothing is taken to be thinner: a pole seen from one side can be drifted upon from the other
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
            old = old[:, self._kept(seen, reach_m, config)]
        new = _new_points(seen, reach_m)[:, :CAPACITY]
        old = old[:, max(0, old.shape[1] + new.shape[1] - CAPACITY) :]
        split, end = old.shape[1], old.shape[1] + new.shape[1]
        self._points[:, :split] = old.copy()
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
        beam = np.rint(scan_offset(seen, direction_rad - seen.yaw_rad) / seen.angle_increment_rad)
        inside = beam < seen.range_m.shape[0]
        reach: Floats = np.where(inside, seen.range_m[np.where(inside, beam, 0.0).astype(np.intp)], np.nan)
        return reach

    @property
    def places_m(self) -> Floats:
        """Coordinates [2, k] of the points; they change with the next update, m."""
        return self._points[:2, : self._count]

    def points(self, now_s: float, config: SafetyConfig) -> tuple[Floats, Floats, Floats]:
        """Coordinates x, y [k] and the extra radius [k] each point has by beam width, age, drift and own motion, m."""
        x, y, spread, time_s = self._points[:, : self._count]
        age = np.maximum(now_s - time_s, 0.0)
        drift = ALONG_BOTH_AXES * np.minimum(age * config.velocity_error_m_s, 2.0 * config.position_error_m)
        return x, y, spread + drift + np.minimum(age, MOVED_S) * config.obstacle_speed_m_s


def _new_points(seen: SeenScan, reach_m: float) -> Floats:
    """Rows x, y, spread, time of the returns within reach, and of a place behind each that is an edge: its far side is there too."""
    dx, dy = seen.x_m - seen.origin_x_m, seen.y_m - seen.origin_y_m
    distance = np.sqrt(dx * dx + dy * dy)
    near = distance < reach_m
    rows = np.array((seen.x_m, seen.y_m, seen.spread_m, np.full(distance.shape, seen.time_s)))
    edge = near & _edges(seen.range_m)
    behind = rows[:, edge]
    behind[:2] += LEAST_DEPTH_M * np.array((dx[edge], dy[edge])) / np.maximum(distance[edge], LEAST_DEPTH_M)
    new: Floats = np.concatenate((rows[:, near], behind), axis=1)
    return new


def _edges(range_m: Floats) -> NDArray[np.bool_]:
    """Of the beams [n] with a return, in order: whether a beam beside it saw further by more than one thing is deep [k]."""
    padded = np.concatenate((range_m[:1], range_m, range_m[-1:]))
    beyond = np.fmax(padded[:-2], padded[2:]) > range_m + SAME_PLACE_M
    found: NDArray[np.bool_] = beyond[np.isfinite(range_m)]
    return found
