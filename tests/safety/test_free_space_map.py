"""When each cell was last seen free: the map against a list of cells that is kept in the plainest way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config

from safety.config import Fence
from safety.free_space import SIDE_CELLS, FreeSpace, _overlap, _sagitta_m, _ViewTemplate
from safety.lidar import SeenScan
from safety.unseen_cells import boxes_within, cells_in

NO_POINTS = np.empty(0)
Cell = tuple[int, int]


def taken(time_s: float, x_m: float, y_m: float, reach: np.ndarray) -> SeenScan:
    """A scan of 40 degrees, ahead."""
    first, step = math.radians(-20.0), math.radians(0.5)
    return SeenScan(time_s, x_m, y_m, 0.0, first, step, NO_POINTS, NO_POINTS, NO_POINTS, reach, reach, None)


class PlainMap:
    """Cells and when they were seen, absolute. Numbers by hand: 0.9 m at engaging, 0.35 m of hull, 0.75 m of vicinity."""

    def __init__(self, memory_s: float, obstacle_speed_m_s: float) -> None:
        self.seen_s: dict[Cell, float] = {}
        self.corner: list[int] | None = None
        self.memory_s, self.speed = memory_s, obstacle_speed_m_s
        self.shrunk_s = 0.0

    def update(self, seen: SeenScan, ahead: set[Cell]) -> None:
        """`ahead`: cells, from the vehicle's own, that the beams show."""
        here = (math.floor(seen.origin_x_m / 0.1), math.floor(seen.origin_y_m / 0.1))
        own_m = 0.35
        if self.corner is None:
            self.corner, own_m, self.shrunk_s = [cell - 64 for cell in here], 0.9, seen.time_s
        self._follow(here)
        now = {(here[0] + i, here[1] + j) for i, j in ahead}
        for i in range(-12, 13):
            for j in range(-12, 13):
                cell, away_m = (here[0] + i, here[1] + j), 0.1 * math.hypot(i, j)
                known = self.seen_s.get(cell, -math.inf) >= seen.time_s - self.memory_s
                if away_m <= own_m or (away_m <= 0.757 and known):
                    now.add(cell)
        if self.speed > 0.0:
            self._shrink(seen.time_s)
        self.seen_s |= dict.fromkeys(now, seen.time_s)

    def _follow(self, here: Cell) -> None:
        """The map moves by steps of eight cells, once its middle is so far behind."""
        assert self.corner is not None
        for axis in (0, 1):
            behind = here[axis] - (self.corner[axis] + 64)
            self.corner[axis] += int(math.copysign(abs(behind) // 8 * 8, behind))
        on_it = self._on_it
        self.seen_s = {cell: s for cell, s in self.seen_s.items() if on_it(cell)}

    def _on_it(self, cell: Cell) -> bool:
        assert self.corner is not None
        return all(0 <= cell[axis] - self.corner[axis] < SIDE_CELLS for axis in (0, 1))

    def _shrink(self, time_s: float) -> None:
        """One cell from all sides per cell that an obstacle can have moved; cells at the very end of the map stay."""
        assert self.corner is not None
        (left, below), step_s = self.corner, 0.1 / self.speed
        while time_s - self.shrunk_s >= step_s - 1e-12:
            self.shrunk_s += step_s
            for axis, first in ((0, left), (1, below)):
                beside = ((-1, 0), (1, 0)) if axis == 0 else ((0, -1), (0, 1))
                self.seen_s = {
                    cell: s if cell[axis] in (first, first + SIDE_CELLS - 1) else min(s, *self._beside(cell, beside))
                    for cell, s in self.seen_s.items()
                }
            self.seen_s = {cell: s for cell, s in self.seen_s.items() if s > -math.inf}

    def _beside(self, cell: Cell, beside: tuple[Cell, Cell]) -> list[float]:
        return [self.seen_s.get((cell[0] + i, cell[1] + j), -math.inf) for i, j in beside]


def kept(free: FreeSpace) -> dict[Cell, float]:
    """The cells that the map has seen, and when, absolute."""
    began_s = free._began_s or 0.0
    found = zip(*np.nonzero(np.isfinite(free._seen_s)), strict=True)
    return {(int(i) + free._corner[0], int(j) + free._corner[1]): float(free._seen_s[i, j]) + began_s for i, j in found}


MOVES = ((0.3, 0.0), (0.0, -0.5), (-0.9, 0.4), (0.8, 0.8), (2.35, -1.7), (-4.0, 0.1), (0.0, 6.2), (-12.75, 0.0), (3.0, 12.85))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("memory_s", "obstacle_speed_m_s"), [(1.0, 0.0), (2.0, 0.4), (3.0, 0.8)])
def test_the_map_is_what_a_plain_list_of_cells_is(seed, memory_s, obstacle_speed_m_s):
    chance = np.random.default_rng(seed)
    c = config(memory_s=memory_s, obstacle_speed_m_s=obstacle_speed_m_s, fov_margin_rad=0.0)
    free, plain, view = FreeSpace(c), PlainMap(memory_s, obstacle_speed_m_s), _ViewTemplate(25)
    time_s, (x, y) = 64.0, chance.uniform(-20.0, 20.0, 2).tolist()
    for _ in range(9):
        seen = taken(time_s, x, y, np.where(chance.random(81) < 0.02, 0.9, chance.choice((0.1, 3.0))))
        ahead = {(int(i) - 25, int(j) - 25) for i, j in zip(*np.nonzero(view.visible(seen, c)), strict=True)}
        free.update(seen)
        plain.update(seen, ahead)
        assert free._corner == tuple(plain.corner or ())
        assert kept(free) == plain.seen_s
        dx, dy = MOVES[chance.integers(len(MOVES))]
        x, y, time_s = x + dx, y + dy, time_s + float(chance.choice((0.125, 0.25, 0.5)))


def blind(time_s: float, x_m: float = 0.05, y_m: float = 0.05) -> SeenScan:
    return taken(time_s, x_m, y_m, np.zeros(81))


@pytest.mark.parametrize(("moved", "corner"), [(0, 0), (7, 0), (8, 8), (15, 8), (16, 16), (-7, 0), (-8, -8), (-9, -8)])
def test_the_map_follows_in_steps_of_eight_cells(moved, corner):
    free = FreeSpace(config())
    free.update(blind(0.0))
    assert free._corner == (-64, -64)
    free.update(blind(0.1, 0.05 + 0.1 * moved))
    assert free._corner == (-64 + corner, -64)
    free.update(blind(0.2, 0.05 + 0.1 * moved, 0.05 - 0.1 * moved))
    assert free._corner == (-64 + corner, -64 - corner)


@pytest.mark.parametrize("steps", [120, 128, 136, -120, -128, -136])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_jump_by_a_whole_map_leaves_nothing_of_it(axis, steps):
    """By 120 cells the last eight rows of the map stay, by 128 none."""
    free = FreeSpace(config())
    free.update(blind(0.0))
    free._seen_s.fill(0.0)
    place = [0.05, 0.05]
    place[axis] += 0.1 * steps
    free.update(blind(0.5, *place))
    assert int(np.count_nonzero(free._seen_s == 0.0)) == (8 * SIDE_CELLS if abs(steps) == 120 else 0)


def test_what_was_known_around_a_standing_vehicle_stays_known_to_the_last_moment():
    """Seen at 0, stood there for ever: within 0.75 m it is seen anew each time, up to exactly `memory_s` after the last time."""
    free = FreeSpace(config(memory_s=1.0))
    for time_s in (0.0, 1.0, 2.0):
        free.update(blind(time_s))
    around = {cell for cell, s in kept(free).items() if s == 2.0}
    assert around == {(i, j) for i in range(-8, 9) for j in range(-8, 9) if math.hypot(i, j) <= 7.5}
    free.update(blind(3.0 + 1e-3))
    assert max(math.hypot(*cell) for cell, s in kept(free).items() if s > 2.5) <= 3.5


@pytest.mark.parametrize(
    ("changes", "hull_m"),
    [
        ({}, 0.35 + 0.05 + 0.05 * 0.85 + 0.014590),  # 0.35 - sqrt(0.35^2 - 0.1^2), and the delay is 0.2 + 0.05 + 0.6 s
        ({"vehicle_radius_m": 0.08}, 0.08 + 0.05 + 0.0425 + 0.08),  # smaller than half a step of discs: all of it is left out
        ({"vehicle_radius_m": 0.1}, 0.1 + 0.05 + 0.0425 + 0.1),
        ({"velocity_error_m_s": 0.3}, 0.35 + 0.05 + 0.3 * 0.85 + 0.014590),
        ({"position_error_m": 0.4, "vehicle_radius_m": 0.9}, 0.9 + 0.4 + 0.0425 + 0.005573),
        ({"position_error_m": 0.0, "velocity_error_m_s": 0.0, "vehicle_radius_m": 2.0}, 2.0 + 0.002502),
    ],
)
def test_the_hull_is_counted_with_its_errors_and_what_lies_between_discs(changes, hull_m):
    free = FreeSpace(config(fence=Fence(min_m=(-30.0, -30.0, 0.3), max_m=(30.0, 30.0, 9.0)), **changes))
    wide, exact = boxes_within(hull_m + 0.1), boxes_within(hull_m)
    assert [boxes.tolist() for boxes in free._kernels] == [wide.tolist(), exact.tolist()]
    assert free._rims == (wide.max(), exact.max())
    assert free._rim == wide.max()
    assert np.array_equal(free._touched, cells_in(exact, int(exact.max())))
    half = max(25, math.floor((hull_m + 0.3) / 0.1))
    assert free._half == half
    away = 0.1 * np.hypot(*np.mgrid[-half : half + 1, -half : half + 1])
    assert np.array_equal(free._vicinity, away <= hull_m + 0.3)
    assert np.array_equal(free._take_off, away <= 0.9)
    assert np.array_equal(free._hull, away <= free._config.vehicle_radius_m)


def test_clearing_begins_anew_and_forgetting_does_not():
    """After `clear` the next scan is the first one, with all that is taken for granted at engaging; after `forget` it is not."""
    c = config(obstacle_speed_m_s=0.5)
    free, fresh = FreeSpace(c), FreeSpace(c)
    free.update(blind(1.0, 3.05))
    free.forget()
    assert kept(free) == {}
    free.update(blind(1.1, 3.05))
    assert len(kept(free)) == 37  # cells whose middle is within three and a half of the middle one's
    free.clear()
    assert (kept(free), free._began_s, free._corner, free._shrunk_s) == ({}, None, (0, 0), 0.0)
    for one in (free, fresh):
        one.update(blind(7.0, -2.05))
    assert kept(free) == kept(fresh)
    assert len(kept(free)) == sum(math.hypot(i, j) <= 9.0 for i in range(-9, 10) for j in range(-9, 10))


def test_a_long_pause_shrinks_by_no_more_than_the_map_is_wide():
    """A thousand seconds at 10 m/s would be 100 000 cells: the loop ends after 128 of them."""
    free = FreeSpace(config(obstacle_speed_m_s=10.0))
    free.update(blind(0.0))
    free._seen_s.fill(0.0)
    free._shrink(1000.0)
    assert free._shrunk_s == pytest.approx(128 * 0.01)
    assert (free._seen_s == 0.0).all()


def test_the_unseen_grows_from_all_sides_and_each_row_at_the_end_stays():
    """One unseen cell in a map that is seen: after k steps a square of 2 k + 1 cells, but for the end rows."""
    free = FreeSpace(config(obstacle_speed_m_s=1.0))
    free.update(blind(0.0))
    free._seen_s.fill(1.0)
    free._seen_s[3, 60] = -np.inf
    free._shrink(0.45)
    unseen = {(int(i), int(j)) for i, j in zip(*np.nonzero(np.isinf(free._seen_s)), strict=True)}
    assert unseen == {(i, j) for i in range(1, 8) for j in range(56, 65)}
    assert free._shrunk_s == pytest.approx(0.4)


def test_a_whole_second_at_a_metre_per_second_is_ten_cells():
    """Although a tenth, as a number, is a little more than a tenth."""
    free = FreeSpace(config(obstacle_speed_m_s=1.0))
    free.update(blind(0.0))
    free._shrink(1.0)
    assert free._shrunk_s == pytest.approx(1.0)


def test_discs_of_half_a_step_leave_all_of_their_radius():
    assert _sagitta_m(config(vehicle_radius_m=0.1)) == 0.1
    assert _sagitta_m(config(vehicle_radius_m=0.02)) == 0.02


@pytest.mark.parametrize("step", [-127, -64, -8, -1, 1, 8, 64, 127])
def test_what_two_maps_share_is_as_long_in_both(step):
    target, source = _overlap(step)
    cells = range(SIDE_CELLS)
    assert [cell + step for cell in cells[target]] == list(cells[source])
    assert len(cells[target]) == SIDE_CELLS - abs(step)
    assert min(target.start, source.start, target.stop, source.stop) >= 0
    assert max(target.stop, source.stop) == SIDE_CELLS


def test_a_scan_drops_what_was_known_of_returns():
    """Patches and returns are of one tick: the next scan makes them anew."""
    free, near_m = FreeSpace(config()), np.array([[0.6], [0.0]])
    free.update(blind(0.0))
    free.unseen(np.array([[0.05], [0.05]]), near_m, 0.0, wide=False)
    assert free._known is not None
    free.update(blind(0.0))
    assert free._known is None
    assert FreeSpace(config())._known is None
    free.unseen(np.array([[0.05], [0.05]]), near_m, 0.0, wide=False)
    free.forget()
    assert free._known is None


def test_scans_are_told_apart_by_time_since_the_first_one():
    """Seconds of a clock that began long ago would be too coarse in single precision."""
    free = FreeSpace(config(memory_s=1.0))
    free.update(blind(1e7))
    free.update(blind(1e7 + 0.125))
    assert set(kept(free).values()) == {1e7, 1e7 + 0.125}
