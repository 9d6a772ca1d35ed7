"""Which cells the beams of one scan show free, against looking at every beam for every cell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from safety_plant import config

from safety.free_space import _reaches, _ViewTemplate
from safety.lidar import SeenScan

HALF = 25  # cells: the 2.5 m up to which a scan is taken in
CORNER_M = 0.1 * math.sqrt(2.0)  # a cell's far corner, seen from anywhere in the cell of the LiDAR, is so much further
NEAREST_M = CORNER_M / math.sin(math.radians(60.0))  # nearer cells fill more of the view
ALL = config(fov_margin_rad=0.0)
NO_POINTS = np.empty(0)


def shown_by(free_m, increment_rad: float, yaw_rad: float = 0.0, first_rad: float = 0.0) -> SeenScan:
    """A scan whose beams went so far."""
    beams = np.asarray(free_m, dtype=float)
    return SeenScan(0.0, 5.05, 0.05, yaw_rad, first_rad, increment_rad, NO_POINTS, NO_POINTS, NO_POINTS, beams, beams, None)


def expected(seen: SeenScan) -> dict[tuple[int, int], bool]:
    """Cells that must or must not be free, for beams that divide a turn; none where rounding decides which beam is the nearest.

    All beams must reach the far corner that may look at the cell: as many on either side of its bearing as that is wide, and one,
    rounded up to a power of two. There is nothing where no beam is.
    """
    increment, turn = seen.angle_increment_rad, round(2.0 * math.pi / seen.angle_increment_rad)
    reach = dict(enumerate(seen.free_m.tolist()))
    cells = {}
    for i in range(-HALF, HALF + 1):
        for j in range(-HALF, HALF + 1):
            far_m = 0.1 * math.hypot(i, j) + CORNER_M
            bearing = (math.atan2(j, i) - seen.yaw_rad - seen.angle_min_rad) / increment
            if abs(bearing + 0.5 - round(bearing + 0.5)) < 2e-3:
                continue
            if not NEAREST_M + CORNER_M <= far_m <= 2.5:
                cells[i, j] = False
                continue
            aside = math.ceil(math.asin(CORNER_M / (far_m - CORNER_M)) / increment) + 1
            aside = 1 << (aside - 1).bit_length()
            beams = range(round(bearing) - aside, round(bearing) + aside + 1)
            cells[i, j] = all(reach.get(beam % turn, 0.0) >= far_m for beam in beams)
    return cells


def assert_shows(view: _ViewTemplate, seen: SeenScan) -> int:
    """The template agrees in every cell; how many it shows."""
    free, wanted = view.visible(seen, ALL), expected(seen)
    assert free.shape == (2 * HALF + 1, 2 * HALF + 1)
    assert len(wanted) > 2000
    for (i, j), is_free in wanted.items():
        assert free[i + HALF, j + HALF] == is_free, (i, j)
    return int(np.count_nonzero(free))


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("turn", [360, 720])
def test_a_cell_is_shown_when_all_beams_that_may_look_at_it_reach_its_far_corner(seed, turn):
    chance = np.random.default_rng(seed)
    reach = np.where(chance.random(turn) < 0.01, chance.uniform(0.2, 2.4, turn), 3.0)
    beams = turn if seed % 2 else turn // 2
    seen = shown_by(reach[:beams], 2.0 * math.pi / turn, chance.uniform(-9.0, 9.0), chance.uniform(-4.0, 4.0))
    assert assert_shows(_ViewTemplate(HALF), seen) > 100


@pytest.mark.parametrize("turn", [3, 5, 7, 12, 61, 363, 1449, 4096])
def test_few_and_many_beams_to_a_turn(turn):
    """A turn of three beams shows nothing wrong; 363 and 1449 of them are, divided and multiplied, a little off a whole turn."""
    reach = np.full(turn, 3.0)
    reach[turn // 2], reach[0] = 1.2, 2.1
    assert_shows(_ViewTemplate(HALF), shown_by(reach, 2.0 * math.pi / turn, 0.123))


def test_all_that_can_be_shown_is_a_ring():
    free = _ViewTemplate(HALF).visible(shown_by(np.full(360, 9.0), math.pi / 180.0), ALL)
    for i, j in np.ndindex(free.shape):
        assert free[i, j] == (NEAREST_M <= 0.1 * math.hypot(i - HALF, j - HALF) <= 2.5 - CORNER_M)


def test_a_beam_that_ends_at_the_far_corner_shows_the_cell():
    """The cell ten ahead: its far corner is 1.1414 m away."""
    for reach_m, is_free in ((1.14145, True), (1.1414, False)):
        free = _ViewTemplate(HALF).visible(shown_by(np.full(360, reach_m), math.pi / 180.0), ALL)
        assert free[HALF + 10, HALF] == is_free


def test_a_beam_that_ends_exactly_at_the_far_corner_shows_the_cell():
    view, ahead = _ViewTemplate(HALF), (HALF + 10, HALF)
    view.visible(shown_by(np.full(360, 3.0), math.pi / 180.0), ALL)
    exact = view._needed_m[ahead]
    for reach_m, is_free in ((exact, True), (np.nextafter(exact, np.float32(0.0)), False)):
        assert view.visible(shown_by(np.full(360, float(reach_m)), math.pi / 180.0), ALL)[ahead] == is_free


def test_another_geometry_makes_another_template():
    """Beams of one degree, of half a degree, again of one but fewer: each time as in a new template."""
    view = _ViewTemplate(HALF)
    for beams, turn in ((200, 360), (200, 720), (150, 720), (150, 360), (151, 360)):
        seen = shown_by(np.full(beams, 3.0), 2.0 * math.pi / turn, 0.7)
        assert assert_shows(view, seen) > 50
        assert np.array_equal(view.visible(seen, ALL), _ViewTemplate(HALF).visible(seen, ALL))


def test_the_same_geometry_is_prepared_once():
    view, seen = _ViewTemplate(HALF), shown_by(np.full(360, 3.0), math.pi / 180.0)
    view.visible(seen, ALL)
    needed = view._needed_m
    view.visible(replace(seen, yaw_rad=1.0, angle_min_rad=0.5), ALL)
    assert view._needed_m is needed


def test_beams_beyond_a_turn_are_left_off():
    """An increment a little too large for its name: 361 beams of a degree are a turn and the first one again."""
    reach = np.full(361, 3.0)
    reach[360] = 0.3
    free = _ViewTemplate(HALF).visible(shown_by(reach, math.pi / 180.0), ALL)
    assert np.array_equal(free, _ViewTemplate(HALF).visible(shown_by(reach[:360], math.pi / 180.0), ALL))


def reached(free_m, unseen=None, margin_rad: float = 0.0, increment_rad: float = 0.1) -> list[float]:
    """How far the beams show free space."""
    seen = shown_by(free_m, increment_rad)
    flags = None if unseen is None else np.isin(np.arange(len(free_m)), unseen)
    before = seen.free_m.copy()
    found = _reaches(replace(seen, unseen=flags), config(fov_margin_rad=margin_rad)).tolist()
    assert np.array_equal(seen.free_m, before, equal_nan=True)
    return found


NAN = math.nan


@pytest.mark.parametrize(
    ("free_m", "expected_m"),
    [
        ([5.0, NAN, 3.0, 4.0, 7.0], [5.0, 3.0, 3.0, 4.0, 7.0]),
        ([2.0, NAN, 3.0, 4.0, 7.0], [2.0, 2.0, 3.0, 4.0, 7.0]),
        ([5.0, 6.0, NAN, 4.0, 7.0], [5.0, 6.0, 4.0, 4.0, 7.0]),
        ([5.0, 6.0, NAN, 8.0, 7.0], [5.0, 6.0, 6.0, 8.0, 7.0]),
        ([NAN, 6.0, 5.0, 8.0, 7.0], [6.0, 6.0, 5.0, 8.0, 7.0]),
        ([5.0, 6.0, 5.0, 8.0, NAN], [5.0, 6.0, 5.0, 8.0, 8.0]),
        ([5.0, 6.0, 5.0, NAN, 7.0], [5.0, 6.0, 5.0, 5.0, 7.0]),
        ([5.0, NAN, NAN, 8.0, 7.0], [5.0, 5.0, 8.0, 8.0, 7.0]),
        ([5.0, NAN, NAN, NAN, 7.0], [5.0, 5.0, 0.0, 7.0, 7.0]),
        ([NAN, 6.0, 5.0, 2.0], [6.0, 6.0, 5.0, 2.0]),
        ([2.0, 6.0, 5.0, NAN], [2.0, 6.0, 5.0, 5.0]),
    ],
)
def test_a_lost_beam_reaches_as_far_as_the_shorter_of_its_neighbours(free_m, expected_m):
    """Without a neighbour that was seen it reaches nowhere."""
    assert reached(free_m, []) == expected_m


@pytest.mark.parametrize("bearings", [[0], [4], [1, 2], [0, 1, 2, 3, 4]])
def test_bearings_with_too_many_lost_beams_reach_nowhere(bearings):
    found = reached([5.0, NAN, 3.0, 4.0, 7.0], bearings)
    for beam, reach_m in enumerate([5.0, 3.0, 3.0, 4.0, 7.0]):
        assert found[beam] == (0.0 if beam in bearings else reach_m)
    assert reached([5.0, NAN, NAN, NAN, 7.0], bearings)[2] == 0.0


@pytest.mark.parametrize(("margin_rad", "lost"), [(0.0, 0), (0.04, 0), (0.06, 1), (0.14, 1), (0.16, 2), (0.24, 2), (0.26, 3)])
def test_the_edges_of_a_view_reach_nowhere(margin_rad, lost):
    """Beams are a tenth of a radian apart: those whose own bearing lies in the margin, which begins half a beam outside."""
    free_m = [4.0] * 7
    expected_m = [0.0] * lost + [4.0] * (7 - 2 * lost) + [0.0] * lost
    assert reached(free_m, None, margin_rad) == expected_m
    assert reached(free_m, [], margin_rad) == expected_m


@pytest.mark.parametrize(("beams", "lost"), [(62, 0), (61, 2)])
def test_a_view_all_round_has_no_edges(beams, lost):
    """Of beams a tenth of a radian apart 62 are 6.2: what is left of a turn, 0.083, is less than one more would need."""
    assert reached([4.0] * beams, None, 0.2).count(0.0) == 2 * lost
