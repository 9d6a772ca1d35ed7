"""Points of a spinning LiDAR to vehicle-centred scans of its last full turn, on a fixed grid of bearings.

A turn has no fixed number of points, so they are binned by angle, never by index. A beam covers the angle to its
neighbours, so that no bin is empty only because the grid is finer than the device; a bin that no beam covered is unknown. Of
several returns in a bin the nearest counts. A scan is dated by its oldest beam: its age is an upper bound.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flight.lidar.config import LidarSource
from flight.lidar.motion import BodyMotion, seen_later
from flight.lidar.points import Points
from flight.lidar.reduce import in_sectors
from safety.messages import LidarScan

TURN = 2.0 * math.pi
MAX_GAP_S = 0.25
"""Silence after which what came before no longer belongs to the same turn (the angle passed meanwhile is not known)."""

_MAX_POINTS = 20_000
_MAX_SPREAD = math.radians(1.5)  # half a beam's width at most
_QUARTER = 0.5 * math.pi
_EDGE = 1e-6

Floats = NDArray[np.float64]


class BearingGrid:
    """Equal bins of vehicle bearing, all round or, where blind sectors are given, without the largest of them."""

    def __init__(self, width_deg: float, blind_sectors_deg: tuple[tuple[float, float], ...] = ()) -> None:
        self.bins = round(360.0 / width_deg)
        self.angle_increment_rad = TURN / self.bins
        start, self.beams = self._visible(blind_sectors_deg)
        self._first_edge_rad = -math.pi + start * self.angle_increment_rad
        self.angle_min_rad = self._first_edge_rad + 0.5 * self.angle_increment_rad

    def _visible(self, sectors: tuple[tuple[float, float], ...]) -> tuple[int, int]:
        """(first bin, number of bins) of what is left without the longest blind run."""
        centres: Floats = -math.pi + self.angle_increment_rad * (np.arange(self.bins, dtype=np.float64) + 0.5)
        blind = in_sectors(centres, sectors)
        if not blind.any() or blind.all():
            return 0, self.bins
        first_seen = int(np.argmin(blind))
        runs, length = [(0, first_seen)], 0
        for place, hidden in enumerate(np.roll(blind, -first_seen)):
            length = length + 1 if hidden else 0
            runs.append((length, first_seen + place + 1))
        longest, after = max(runs)
        return after % self.bins, self.bins - longest

    def fill(self, bearing_rad: Floats, range_m: NDArray[np.float32], half_width_rad: Floats) -> NDArray[np.float32]:
        """float32 [beams]: per bin the nearest return [n], else `nan` if a beam there knew nothing or none came, else `inf`."""
        turned = np.remainder(bearing_rad - self._first_edge_rad, TURN)
        low = np.floor((turned - half_width_rad) / self.angle_increment_rad + _EDGE).astype(np.intp)
        high = np.ceil((turned + half_width_rad) / self.angle_increment_rad - _EDGE).astype(np.intp) - 1
        nearest = np.full(self.bins, np.inf, dtype=np.float32)
        unknown, clear = np.zeros(self.bins, dtype=bool), np.zeros(self.bins, dtype=bool)
        is_unknown, is_clear = np.isnan(range_m), np.isposinf(range_m)
        hit = ~(is_unknown | is_clear)
        for offset in range(int((high - low).max(initial=-1)) + 1):
            there = low + offset <= high
            index = (low + offset) % self.bins
            np.minimum.at(nearest, index[there & hit], range_m[there & hit])
            unknown[index[there & is_unknown]] = True
            clear[index[there & is_clear]] = True
        nothing = np.isinf(nearest)
        nearest[nothing & (unknown | ~clear)] = np.nan
        return nearest[: self.beams]


@dataclass(frozen=True, slots=True)
class _Piece:
    """Points of one read [n]: device bearing, range, firing time, angle travelled up to each, half the angle to its neighbour."""

    bearing_rad: Floats
    range_m: NDArray[np.float32]
    time_s: Floats
    travel_rad: Floats
    half_width_rad: Floats


class TurnAssembler:
    """Collects points and gives a scan of the last full turn, `scans_per_turn` times a turn.

    `range_min_m`, `range_max_m`: the device's limits; nearer is 0, farther nothing.
    """

    def __init__(self, config: LidarSource, range_min_m: float, range_max_m: float) -> None:
        self._config = config
        self._range_min_m = range_min_m
        self._range_max_m = min(range_max_m, config.range_max_m or math.inf)
        self._grid = BearingGrid(config.grid_deg, config.blind_sectors_deg)
        self._no_return = math.inf if config.no_return == "nothing" else math.nan
        self._pieces: deque[_Piece] = deque()
        self._clear()

    @property
    def points_held(self) -> int:
        """Points kept: about a turn's, never more than 20,000 and one read."""
        return sum(piece.time_s.size for piece in self._pieces)

    def _clear(self) -> None:
        self._pieces.clear()
        self._last_bearing_rad = math.nan
        self._last_time_s = math.nan
        self._travel_rad = 0.0
        self._delivered_rad = 0.0

    def add(self, points: Points, time_s: Floats, motion: BodyMotion | None = None) -> LidarScan | None:
        """Take points with their firing times [n]; a scan if enough of a turn has passed since the last, else None.

        `motion`: the vehicle's, to take out of the scan; None leaves it in.
        """
        if not len(points):
            return None
        if time_s[0] - self._last_time_s > MAX_GAP_S:
            self._clear()
        self._keep(points, time_s)
        whole = self._travel_rad - self._pieces[0].travel_rad[0] >= TURN - _MAX_SPREAD
        pace = TURN / self._config.scans_per_turn
        if not (whole and self._travel_rad - self._delivered_rad >= pace):
            return None
        self._delivered_rad = pace * math.floor(self._travel_rad / pace)  # without slip, however the points come in
        return self._scan(motion)

    def _keep(self, points: Points, time_s: Floats) -> None:
        before = self._last_bearing_rad if math.isfinite(self._last_bearing_rad) else points.bearing_rad[0]
        clockwise = np.concatenate(([before], points.bearing_rad[:-1])) - points.bearing_rad
        step = np.remainder(clockwise + _QUARTER, TURN) - _QUARTER
        travel = self._travel_rad + np.cumsum(step)
        usual = float(np.median(step))
        half_width = np.full(step.shape, min(max(0.5 * usual, 0.0), _MAX_SPREAD))
        self._pieces.append(_Piece(points.bearing_rad, self._judged(points.range_m), time_s, travel, half_width))
        self._last_bearing_rad, self._last_time_s = float(points.bearing_rad[-1]), float(time_s[-1])
        self._travel_rad = float(travel[-1])
        while len(self._pieces) > 1 and (
            self._pieces[0].travel_rad[-1] <= self._travel_rad - TURN or self.points_held > _MAX_POINTS
        ):
            self._pieces.popleft()

    def _judged(self, range_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Ranges with the meaning they have in a scan: 0 too near, inf nothing, nan unknown."""
        judged = np.where(range_m < self._range_min_m, np.float32(0.0), range_m)
        judged = np.where(range_m > self._range_max_m, np.float32(np.inf), judged)
        return np.where(np.isnan(range_m), np.float32(self._no_return), judged).astype(np.float32, copy=False)

    def _scan(self, motion: BodyMotion | None) -> LidarScan:
        pieces, config = self._pieces, self._config
        last_turn = np.concatenate([piece.travel_rad for piece in pieces]) > self._travel_rad - TURN
        device_rad = np.concatenate([piece.bearing_rad for piece in pieces])[last_turn]
        range_m = np.concatenate([piece.range_m for piece in pieces])[last_turn]
        time_s = np.concatenate([piece.time_s for piece in pieces])[last_turn]
        half_width = np.concatenate([piece.half_width_rad for piece in pieces])[last_turn]
        bearing = config.mount_yaw_rad + (-device_rad if config.mirror else device_rad)
        seen = ~in_sectors(bearing, config.blind_sectors_deg)
        bearing, range_m, time_s, half_width = bearing[seen], range_m[seen], time_s[seen], half_width[seen]
        oldest_s = float(time_s.min(initial=self._last_time_s))
        bearing, range_m = self._moved(bearing, range_m, oldest_s - time_s, motion)
        return LidarScan(
            time_s=oldest_s,
            ranges_m=self._grid.fill(bearing, range_m, half_width),
            angle_min_rad=self._grid.angle_min_rad,
            angle_increment_rad=self._grid.angle_increment_rad,
            range_min_m=self._range_min_m,
            range_max_m=self._range_max_m,
        )

    def _moved(
        self, bearing: Floats, range_m: NDArray[np.float32], later_s: Floats, motion: BodyMotion | None
    ) -> tuple[Floats, NDArray[np.float32]]:
        """Returns as seen from the vehicle's centre, at the scan's own time if the vehicle's motion is given.

        Beams without a return only turn with the vehicle: they have no place.
        """
        offset = (self._config.mount_x_m, self._config.mount_y_m)
        if motion is None and offset == (0.0, 0.0):
            return bearing, range_m
        hit = np.isfinite(range_m)
        reach = range_m[hit].astype(np.float64)
        x: Floats = offset[0] + reach * np.cos(bearing[hit])
        y: Floats = offset[1] + reach * np.sin(bearing[hit])
        moved_rad = bearing.copy()
        if motion is not None:
            x, y = seen_later(x, y, later_s[hit], motion)
            moved_rad -= motion.yaw_rate_rad_s * later_s
        moved_rad[hit] = np.arctan2(y, x)
        moved_m = range_m.copy()
        moved_m[hit] = np.hypot(x, y)
        return moved_rad, moved_m
