"""What is asked of the map of free space: counts, quick looks, gaps, patches; against looking at every cell of a random map."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config

from safety.free_space import NOWHERE, SIDE_CELLS, FreeSpace
from safety.unseen_cells import boxes_within

HULL_M = 0.35 + 0.05 + 0.05 * 0.85 + 0.014590
WIDE, EXACT = boxes_within(HULL_M + 0.1).tolist(), boxes_within(HULL_M).tolist()
RIM = 6  # cells: 0.557 m reach five cells and a part of the sixth
NOTHING = np.empty((2, 0))
BEGAN_S, MEMORY_S = 3.0, 4.0


def random_map(chance: np.random.Generator, unseen: float) -> FreeSpace:
    """A map somewhere, begun at `BEGAN_S`; its cells were seen up to 8 s later, a share of them never."""
    free = FreeSpace(config(memory_s=MEMORY_S))
    free._began_s = BEGAN_S
    free._corner = (int(chance.integers(-200, 100)), int(chance.integers(-200, 100)))
    free._seen_s[:] = np.where(
        chance.random((SIDE_CELLS, SIDE_CELLS)) < unseen, -np.inf, chance.integers(0, 65, (128, 128)) / 8.0
    )
    return free


def hidden(free: FreeSpace, i: int, j: int, near: np.ndarray, now_s: float) -> bool:
    """Whether a cell of the map was never seen or too long ago, and belongs to no return: those are two cells away at most."""
    row, column = i - free._corner[0], j - free._corner[1]
    if near.shape[1] and (np.abs(np.floor(near / 0.1) - ((i,), (j,))).max(axis=0) <= 2).any():
        return False
    return bool(free._seen_s[row, column] < now_s - BEGAN_S - MEMORY_S)


def places_at(free: FreeSpace, cells: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """Places [2, ...] in cells [2, ...] counted from the map's corner."""
    corner = np.array(free._corner).reshape(2, *[1] * (cells.ndim - 1))
    return 0.1 * (cells + corner + chance.uniform(0.05, 0.95, cells.shape))


def returns_near(places: np.ndarray, chance: np.random.Generator, count: int) -> np.ndarray:
    middle = places.reshape(2, -1).mean(axis=1)
    return middle[:, None] + chance.uniform(-1.0, 1.0, (2, count))


@pytest.mark.parametrize("seed", range(24))
def test_counts_are_weighted_sums_of_the_hidden_cells(seed):
    chance = np.random.default_rng(seed)
    free, wide = random_map(chance, float(chance.choice((0.02, 0.1)))), bool(seed % 2)
    now_s = BEGAN_S + float(chance.choice((2.0, 4.5, 5.0)))
    cells = chance.integers(30, 90, (2, 1, 1)) + chance.integers(-6, 7, (2, 2, 2))
    places = places_at(free, cells, chance)
    near = returns_near(places, chance, int(chance.integers(0, 9)))
    spared = places_at(free, cells[:, 0, :1] + 4, chance) if seed % 3 == 0 else NOTHING
    counts = free.unseen(places, near, now_s, wide, spared)
    assert counts.shape == (2, 2)
    boxes = WIDE if wide else EXACT
    for k in np.ndindex(2, 2):
        i, j = np.floor(places[:, *k] / 0.1).astype(int).tolist()
        total = 0
        for a, b in boxes:
            for p in range(i - a, i + a + 1):
                for q in range(j - b, j + b + 1):
                    total += hidden(free, p, q, near, now_s) and not in_boxes(spared, p, q, boxes)
        assert counts[k] == total


def in_boxes(places: np.ndarray, i: int, j: int, boxes: list[list[int]]) -> bool:
    """Whether a cell lies in the boxes around places [2, n]."""
    apart = np.abs(np.floor(places / 0.1) - ((i,), (j,))).T.tolist()
    return any(p <= a and q <= b for p, q in apart for a, b in boxes)


@pytest.mark.parametrize("wide", [False, True])
def test_two_spared_places_spare_both(wide):
    """Their cells only, whatever their number: one place spared leaves what two spare."""
    free, here = random_map(np.random.default_rng(0), 1.0), 0.1 * (np.array([[60, 80], [60, 60]]) + 0.5)
    places = here + 0.1 * np.array(free._corner)[:, None]
    first = free.unseen(places, NOTHING, BEGAN_S, wide, places[:, :1]).tolist()
    assert first[0] == 0
    assert first[1] == sum((2 * a + 1) * (2 * b + 1) for a, b in (WIDE if wide else EXACT))
    assert free.unseen(places, NOTHING, BEGAN_S, wide, places).tolist() == [0, 0]
    assert free.unseen(places, NOTHING, BEGAN_S, wide, places[:, :0]).tolist() == [first[1]] * 2


def test_sums_are_kept_for_the_next_question_where_nothing_is_spared():
    free = random_map(np.random.default_rng(0), 1.0)
    places = places_at(free, np.full((2, 1), 60), np.random.default_rng(1))
    assert NOWHERE.shape == (2, 0)
    free.unseen(places, NOTHING, BEGAN_S, wide=True, spared_m=places)
    assert not free._patches[BEGAN_S].counts
    free.unseen(places, NOTHING, BEGAN_S, wide=True)
    assert list(free._patches[BEGAN_S].counts) == [True]


def test_a_seen_map_counts_nothing_in_the_shape_of_the_places():
    free = random_map(np.random.default_rng(1), 0.0)
    places = places_at(free, np.full((2, 3, 4), 50), np.random.default_rng(2))
    assert np.array_equal(free.unseen(places, NOTHING, BEGAN_S, wide=True), np.zeros((3, 4)))


ENDS = [(RIM, True), (RIM - 1, False), (2, False), (SIDE_CELLS - 1 - RIM, True), (SIDE_CELLS - RIM, False), (125, False)]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("cell", "on_the_map"), ENDS)
def test_a_hull_that_leaves_the_map_touches_the_unseen(axis, cell, on_the_map):
    """All is seen; the hull's rim of six cells ends with the map, or one cell beyond it."""
    chance = np.random.default_rng(5)
    free, cells = random_map(chance, 0.0), np.full((2, 3), 64)
    cells[axis, 1] = cell
    places = places_at(free, cells, chance)
    x, y = places[:, 1].tolist()
    low, high = places.min(axis=1).tolist(), places.max(axis=1).tolist()
    assert free.unseen(places, NOTHING, BEGAN_S, wide=True).tolist() == ([0] * 3 if on_the_map else [SIDE_CELLS**2] * 3)
    assert free.all_seen_around(x, y, BEGAN_S) == on_the_map
    assert free.all_seen_between(low, high, BEGAN_S) == on_the_map
    assert free.none_hidden(low, high, NOTHING, BEGAN_S) == on_the_map
    gaps = free.gap_m(places, NOTHING, BEGAN_S).tolist()
    assert gaps == (pytest.approx([0.1 * RIM] * 3) if on_the_map else [0.0] * 3)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("cell", "touches"), [(5, False), (4, True), (122, False), (123, True)])
def test_the_exact_hull_has_a_rim_of_five_cells(axis, cell, touches):
    chance = np.random.default_rng(6)
    free, cells = random_map(chance, 0.0), np.full((2, 1), 64)
    cells[axis] = cell
    x, y = places_at(free, cells, chance)[:, 0].tolist()
    assert free.hull_touches(x, y, NOTHING, BEGAN_S) == touches
    assert free.unseen(np.array([[x], [y]]), NOTHING, BEGAN_S, wide=False)[0] == (SIDE_CELLS**2 if touches else 0)


def test_before_the_first_scan_nothing_is_known():
    free, here = FreeSpace(config()), (6.4, 6.4)
    free._seen_s.fill(0.0)
    assert not free.all_seen_between(here, here, 0.0)
    assert not free.none_hidden(here, here, NOTHING, 0.0)
    assert free.hull_touches(*here, NOTHING, 0.0)
    assert free.unseen(np.array([[6.4], [6.4]]), NOTHING, 0.0, wide=False)[0] == SIDE_CELLS**2


@pytest.mark.parametrize("seed", range(60))
def test_quick_looks_agree_with_every_cell(seed):
    """One unseen cell, or one seen earlier than all others, somewhere about the rectangle: inside its rim it is noticed."""
    chance = np.random.default_rng(seed)
    free = random_map(chance, 0.0)
    free._seen_s.fill(6.0)
    low = chance.integers(20, 100, 2)
    high = low + chance.integers(0, 6, 2)
    odd = low + chance.integers(-RIM - 1, RIM + 8, 2)
    free._seen_s[*odd] = 5.0
    corners = places_at(free, np.stack((low, high), axis=1), chance)
    begin, end = corners[:, 0].tolist(), np.maximum(corners[:, 0], corners[:, 1]).tolist()
    inside = bool((odd >= low - RIM).all() and (odd <= high + RIM).all())
    for now_s, noticed in ((BEGAN_S + 9.0, False), (BEGAN_S + 9.01, inside), (BEGAN_S + 10.0, inside), (BEGAN_S + 10.01, True)):
        assert free.all_seen_between(begin, end, now_s) != noticed
        assert free.none_hidden(begin, end, NOTHING, now_s) != noticed
    at_odd = places_at(free, odd[:, None], chance)
    assert free.none_hidden(begin, end, at_odd, BEGAN_S + 9.5)
    assert free.all_seen_between(begin, end, BEGAN_S + 9.5) != inside


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("end", "inside"), [(-RIM, True), (-RIM - 1, False), (RIM, True), (RIM + 1, False)])
@pytest.mark.parametrize("cell", [50, 61])
def test_quick_looks_end_with_the_rim(axis, end, inside, cell):
    free = random_map(np.random.default_rng(4), 0.0)
    free._seen_s.fill(6.0)
    odd = [cell, cell]
    odd[axis] += end
    free._seen_s[*odd] = -np.inf
    place = [0.1 * (corner + cell + 0.5) for corner in free._corner]
    assert free.all_seen_around(*place, BEGAN_S) != inside
    assert free.none_hidden((*place, 1.0), (*place, 2.0), NOTHING, BEGAN_S) != inside


@pytest.mark.parametrize("seed", range(60))
def test_the_hull_touches_an_unseen_cell_of_its_circle(seed):
    """One unseen cell: touched when it is within the radius of a point of the middle cell, and belongs to no return."""
    chance = np.random.default_rng(seed)
    free, here, off = random_map(chance, 0.0), chance.integers(20, 100, 2), chance.integers(-RIM, RIM + 1, 2)
    free._seen_s[*(here + off)] = -np.inf
    x, y = places_at(free, here[:, None], chance)[:, 0].tolist()
    touched = math.hypot(*(np.maximum(np.abs(off) - 1, 0))) <= HULL_M / 0.1
    assert free.hull_touches(x, y, NOTHING, BEGAN_S) == touched
    assert not free.hull_touches(x, y, places_at(free, (here + off)[:, None], chance), BEGAN_S)


@pytest.mark.parametrize("seed", range(30))
def test_gaps_are_distances_to_the_nearest_hidden_cell(seed):
    """To its border, not its middle; what is further than 0.6 m reads as that."""
    chance = np.random.default_rng(seed)
    free = random_map(chance, float(chance.choice((0.005, 0.02, 0.2))))
    places = places_at(free, chance.integers(30, 90, (2, 1)) + chance.integers(-4, 5, (2, 3)), chance)
    near = returns_near(places, chance, int(chance.integers(0, 3)))
    now_s = BEGAN_S + 3.0
    for (x, y), gap in zip(places.T.tolist(), free.gap_m(places, near, now_s).tolist(), strict=True):
        expected, middle = 0.6, (math.floor(x / 0.1), math.floor(y / 0.1))
        for i in range(middle[0] - 8, middle[0] + 9):
            for j in range(middle[1] - 8, middle[1] + 9):
                if hidden(free, i, j, near, now_s):
                    across = max(0.1 * i - x, x - 0.1 * (i + 1), 0.0), max(0.1 * j - y, y - 0.1 * (j + 1), 0.0)
                    expected = min(expected, math.hypot(*across))
        assert gap == pytest.approx(expected, abs=1e-9)


def window(free: FreeSpace, low: tuple[int, int], high: tuple[int, int]) -> tuple[int, int, int, int]:
    """A window by its first cells and those after its last, counted from the map's corner."""
    (left, below), (x, y), (u, v) = free._corner, low, high
    return left + x, below + y, left + u, below + v


def test_a_patch_is_twelve_cells_wider_than_what_is_asked_first():
    free = random_map(np.random.default_rng(9), 0.3)
    patch = free._patch_of(window(free, (50, 60), (58, 63)), NOTHING, BEGAN_S)
    assert patch is not None
    left, below = free._corner
    assert (patch.known.low_x, patch.known.low_y, patch.hidden.shape) == (left + 38, below + 48, (32, 27))
    assert patch.known.mask.shape == patch.hidden.shape
    assert patch.hidden.dtype == np.bool_
    assert free._patch_of(window(free, (38, 48), (70, 75)), NOTHING, BEGAN_S) is patch
    again = free._patch_of(window(free, (37, 48), (70, 75)), NOTHING, BEGAN_S)
    assert again is not patch


@pytest.mark.parametrize(
    ("low", "high"), [((3, 90), (20, 120)), ((0, 0), (5, 128)), ((100, 12), (117, 14)), ((60, 11), (128, 30))]
)
def test_a_patch_ends_with_the_map(low, high):
    free = random_map(np.random.default_rng(10), 0.3)
    patch = free._patch_of(window(free, low, high), NOTHING, BEGAN_S)
    assert patch is not None
    begin, end = [max(cell - 12, 0) for cell in low], [min(cell + 12, SIDE_CELLS) for cell in high]
    assert (patch.known.low_x, patch.known.low_y) == (free._corner[0] + begin[0], free._corner[1] + begin[1])
    expected = ~np.isfinite(free._seen_s[begin[0] : end[0], begin[1] : end[1]])
    assert np.array_equal(patch.hidden, expected)


@pytest.mark.parametrize(("low", "high"), [((-1, 5), (9, 9)), ((5, -1), (9, 9)), ((5, 5), (129, 9)), ((5, 5), (9, 129))])
def test_there_is_no_patch_of_what_is_not_on_the_map(low, high):
    free = random_map(np.random.default_rng(11), 0.3)
    assert free._patch_of(window(free, low, high), NOTHING, BEGAN_S) is None


def test_patches_are_made_once_for_each_time_and_anew_for_other_returns():
    free = random_map(np.random.default_rng(12), 0.3)
    asked, near = window(free, (50, 60), (58, 63)), 0.1 * (np.array(free._corner)[:, None] + 55.0)
    now, then = free._patch_of(asked, NOTHING, BEGAN_S), free._patch_of(asked, NOTHING, BEGAN_S + 6.0)
    assert now is not None
    assert then is not None
    assert now.known is then.known
    assert np.count_nonzero(now.hidden) < np.count_nonzero(then.hidden)
    assert (free._patch_of(asked, NOTHING, BEGAN_S), free._patch_of(asked, NOTHING, BEGAN_S + 6.0)) == (now, then)
    other = free._patch_of(asked, near, BEGAN_S)
    assert other is not None
    assert other.known is not now.known
    assert np.count_nonzero(other.known.mask) == 25
    assert list(free._patches) == [BEGAN_S]
