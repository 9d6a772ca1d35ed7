"""Cells, windows, boxes and sums of the map of free space, each against looking at every single cell."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from safety.unseen_cells import Known, Patch, _clear, boxes_within, cells_in, cells_of, surfaces, window_around

# Radii whose circles go exactly through corners of cells (5 cells: 3-4-5) and such that do not, m.
RADII = (0.02, 0.1, 0.35, 0.43, 0.5, 0.557, 1.0, 1.3)
NOTHING = np.empty((2, 0))


def within(radius_m: float, i: int, j: int) -> bool:
    """Whether the cell i, j from the middle one has a point within the radius of a point of the middle one."""
    return math.hypot(max(abs(i) - 1, 0), max(abs(j) - 1, 0)) <= radius_m / 0.1


@pytest.mark.parametrize("radius_m", RADII)
def test_boxes_together_are_all_cells_within_the_radius(radius_m):
    boxes, rim = boxes_within(radius_m), math.floor(radius_m / 0.1) + 1
    assert boxes.max() == rim
    inside = cells_in(boxes, rim + 2)
    for i, j in itertools.product(range(-rim - 2, rim + 3), repeat=2):
        assert inside[i + rim + 2, j + rim + 2] == within(radius_m, i, j)


def test_no_box_lies_in_another():
    """Half a metre is five cells: columns 0 and 1 reach 6 rows, 2 to 4 reach 5 (3-4-5), 5 reaches 4, 6 its corner alone."""
    assert boxes_within(0.5).tolist() == [[1, 6], [4, 5], [5, 4], [6, 1]]
    for radius_m in (*RADII, 30.0):
        wide, high = boxes_within(radius_m).T.tolist()
        assert wide == sorted(set(wide))
        assert high == sorted(set(high), reverse=True)


def test_cells_of_a_square_that_lie_in_a_box():
    found = cells_in(np.array([[0, 2], [1, 0]]), 3)
    assert found.shape == (7, 7)
    assert sorted(zip(*np.nonzero(found), strict=True)) == [(2, 3), (3, 1), (3, 2), (3, 3), (3, 4), (3, 5), (4, 3)]


def test_places_lie_in_the_cell_that_begins_below_them():
    places = np.array([[0.05, -0.05, 1.25], [-0.31, 0.0, 12.79]])
    assert cells_of(places).tolist() == [[0, -1, 12], [-4, 0, 127]]
    assert cells_of(places[:, :, None]).shape == (2, 3, 1)
    assert cells_of(np.array([[1.0], [-1.0]])).tolist() == [[10], [-10]]


def test_window_is_all_that_lies_within_the_rim():
    """Of cells (-3, 7), (2, 5) and (0, 9) with a rim of 4: from -7 to 6 and from 1 to 13, the end being the cell after."""
    cells = np.array([[[-3, 2, 0]], [[7, 5, 9]]])
    assert window_around(cells, 4) == (-7, 1, 7, 14)
    assert window_around(cells[:, 0, :1], 0) == (-3, 7, -2, 8)


@pytest.mark.parametrize("seed", range(10))
def test_window_around_one_cell_is_a_square_around_it(seed):
    i, j, rim = np.random.default_rng(seed).integers((-50, -50, 1), (50, 50, 8)).tolist()
    assert window_around(np.array([[i], [j]]), rim) == (i - rim, j - rim, i + rim + 1, j + rim + 1)


@pytest.mark.parametrize("seed", range(40))
def test_cells_within_two_of_a_return_belong_to_it(seed):
    chance = np.random.default_rng(seed)
    low, shape, count = chance.integers(-40, 40, 2), chance.integers(1, 12, 2), int(chance.integers(0, 4))
    cells = low[:, None] + np.array([chance.integers(-5, shape[axis] + 5, count) for axis in (0, 1)])
    near_m = 0.1 * (cells + chance.uniform(0.1, 0.9, (2, count)))
    mask = surfaces(near_m, int(low[0]), int(low[1]), tuple(shape.tolist()))
    assert mask.shape == tuple(shape)
    for i, j in itertools.product(range(shape[0]), range(shape[1])):
        apart = np.abs(cells - low[:, None] - np.array([[i], [j]])).max(axis=0)
        assert mask[i, j] == bool((apart <= 2).any()), (i, j)


@pytest.mark.parametrize("far", [-1e6, -0.35, 0.75, 1e6])
def test_returns_far_outside_mark_nothing(far):
    """Four cells: three or more beyond an end they reach no cell of the window."""
    for place in ((far, 0.15), (0.15, far)):
        assert not surfaces(np.array([[place[0]], [place[1]]]), 0, 0, (4, 4)).any()


def made_for(near_m: np.ndarray = NOTHING) -> Known:
    """Cells 10 to 14 by -3 to 3."""
    return Known(near_m, 10, -3, np.zeros((5, 7), dtype=bool))


@pytest.mark.parametrize(
    ("window", "held"),
    [
        ((10, -3, 15, 4), True), ((11, -2, 14, 3), True), ((9, -3, 15, 4), False), ((10, -4, 15, 4), False),
        ((10, -3, 16, 4), False), ((10, -3, 15, 5), False), ((14, 3, 15, 4), True), ((11, -2, 15, 4), True),
    ],
)  # fmt: skip
def test_a_window_is_held_when_all_of_it_is_inside(window, held):
    assert made_for().holds(*window, NOTHING) == held


@pytest.mark.parametrize("seed", range(20))
def test_a_window_is_held_up_to_the_last_cell_and_no_further(seed):
    x, y, rows, columns = np.random.default_rng(seed).integers((-60, -60, 1, 1), (60, 60, 40, 40)).tolist()
    known, window = Known(NOTHING, x, y, np.zeros((rows, columns), dtype=bool)), (x, y, x + rows, y + columns)
    assert known.holds(*window, NOTHING)
    for side, further in enumerate((-1, -1, 1, 1)):
        assert not known.holds(*(end + further * (side == k) for k, end in enumerate(window)), NOTHING)


def test_what_was_made_for_other_returns_is_not_held():
    assert not made_for().holds(10, -3, 15, 4, np.empty((2, 0)))
    same = np.array([[1.0], [2.0]])
    assert made_for(same).holds(10, -3, 15, 4, same)
    assert not made_for(same).holds(10, -3, 15, 4, same.copy())


def random_patch(chance: np.random.Generator) -> Patch:
    low, shape = chance.integers(-30, 30, 2), tuple(chance.integers(14, 22, 2).tolist())
    hidden = chance.random(shape) < chance.choice((0.05, 0.5))
    return Patch(Known(NOTHING, int(low[0]), int(low[1]), np.zeros(shape, dtype=bool)), hidden)


def hidden_at(patch: Patch, i: int, j: int) -> bool:
    """Whether the cell i, j of the map is hidden; False outside the patch."""
    row, column = i - patch.known.low_x, j - patch.known.low_y
    inside = 0 <= row < patch.hidden.shape[0] and 0 <= column < patch.hidden.shape[1]
    return inside and bool(patch.hidden[row, column])


@pytest.mark.parametrize("seed", range(12))
def test_counts_are_the_sums_over_the_boxes(seed):
    chance = np.random.default_rng(seed)
    patch, boxes = random_patch(chance), boxes_within(float(chance.choice((0.12, 0.35, 0.5))))
    rim, (low_x, low_y), (rows, columns) = int(boxes.max()), (patch.known.low_x, patch.known.low_y), patch.hidden.shape
    cells = np.array(
        [chance.integers(low_x + rim, low_x + rows - rim, (2, 3)), chance.integers(low_y + rim, low_y + columns - rim, (2, 3))]
    )
    cells[:, 0, 0], cells[:, 0, 1] = (low_x + rim, low_y + rim), (low_x + rows - rim - 1, low_y + columns - rim - 1)
    counts = patch.counted(cells, boxes, rim, wide=True)
    assert counts.shape == (2, 3)
    for k in np.ndindex(2, 3):
        i, j = cells[:, *k].tolist()
        expected = sum(
            hidden_at(patch, i + p, j + q) for a, b in boxes.tolist() for p in range(-a, a + 1) for q in range(-b, b + 1)
        )
        assert counts[k] == expected


def test_sums_are_made_once_for_each_kernel():
    patch, (wide, narrow) = random_patch(np.random.default_rng(3)), (boxes_within(0.35), boxes_within(0.2))
    middle = np.array([[patch.known.low_x + 6], [patch.known.low_y + 6]])
    patch.hidden[:] = True
    first = patch.counted(middle, wide, 4, wide=True)
    table = patch.counts[True]
    assert (patch.counted(middle, wide, 4, wide=True), patch.counts[True] is table) == (first, True)
    assert patch.counted(middle, narrow, 3, wide=False) < first
    assert set(patch.counts) == {True, False}


@pytest.mark.parametrize("seed", range(12))
def test_spared_cells_are_those_of_the_boxes_around_the_places(seed):
    """Places may lie outside the patch, their boxes half or wholly."""
    chance = np.random.default_rng(seed)
    patch, boxes = random_patch(chance), np.array([[0, 3], [2, 1]])
    patch.hidden[:] = True
    low, shape = np.array([[patch.known.low_x], [patch.known.low_y]]), np.array(patch.hidden.shape)[:, None]
    cells = low + chance.integers(-6, shape + 6, (2, int(chance.integers(1, 5))))
    sparing = patch.sparing(0.1 * (cells + 0.5), boxes)
    assert sparing.known is patch.known
    assert patch.hidden.all()
    for i, j in np.ndindex(*patch.hidden.shape):
        p, q = np.abs(cells - low - np.array([[i], [j]]))
        assert sparing.hidden[i, j] != bool((((p <= 0) & (q <= 3)) | ((p <= 2) & (q <= 1))).any())


def test_a_part_is_a_smaller_window_of_the_same_cells():
    for seed in range(10):
        patch = random_patch(np.random.default_rng(seed))
        x, y = patch.known.low_x, patch.known.low_y
        assert np.array_equal(patch.part(x + 2, y + 3, x + 9, y + 5), patch.hidden[2:9, 3:5])
        assert np.array_equal(patch.part(x, y, x + 1, y + 14), patch.hidden[:1, :14])


def test_places_need_both_coordinates():
    with pytest.raises(ValueError, match="zip"):
        _clear(np.ones((4, 4), dtype=bool), np.array([[1, 1]]), np.array([1]), np.array([1, 2]))
