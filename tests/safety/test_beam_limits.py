"""Beams at their limits: steep tilts of a short-sighted LiDAR, ground met exactly, windows of whole beams."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_plant import config, state

from safety.lidar import BeamTable, _unseen, see
from safety.messages import LidarScan

BAND_M = 0.3  # a beam shows free space only while it is this near to the height of the LiDAR


def test_a_table_that_is_not_prepared_holds_no_beams():
    table = BeamTable()
    assert (table.cos.shape, table.sin.shape) == ((0,), (0,))


@pytest.mark.parametrize(("range_max_m", "roll_rad", "pitch_rad"), [(0.4, 1.2566, 1.2566), (1.0, 0.0, 1.12), (0.5, 1.0, -1.3)])
def test_a_steep_beam_shows_free_space_in_the_band_only_however_short_it_is(range_max_m, roll_rad, pitch_rad):
    """High above the ground; how far each beam rises is worked out by turning it about the two axes."""
    bearings = np.array([-1.2, -0.4, 0.4, 1.2])
    one = LidarScan(0.0, np.full(4, np.inf), -1.2, 0.8, 0.01, range_max_m)
    found = see(one, state(z=9.0, roll=roll_rad, pitch=pitch_rad), BeamTable(), config())
    steep = 0
    for beam, bearing in enumerate(bearings.tolist()):
        up = math.cos(bearing) * math.sin(pitch_rad) + math.sin(bearing) * math.sin(roll_rad) * math.cos(pitch_rad)
        reach_m = min(range_max_m, BAND_M / abs(up))
        steep += reach_m < range_max_m
        assert found.free_m[beam] == pytest.approx(reach_m * math.sqrt(1.0 - up * up))
    assert steep > 0


@pytest.mark.parametrize(("higher_m", "kept"), [(0.0, True), (1e-9, False)])
def test_a_return_at_the_very_height_of_the_ground_band_is_an_obstacle(higher_m, kept):
    """Straight ahead and 0.3 rad down: two metres of it are two sines lower; the ground's band ends there, or just above."""
    low_m = 1.0 + 2.0 * math.sin(-0.3)
    c = config(ground_z_m=low_m + higher_m, ground_band_m=0.0)
    one = LidarScan(0.0, np.array([2.0, np.inf]), 0.0, 0.1, 0.1, 4.0)
    found = see(one, state(z=1.0, pitch=-0.3), BeamTable(), c)
    assert math.isfinite(found.range_m[0]) == kept


def test_a_beam_that_ends_a_whole_number_of_beams_away_counts():
    """0.26 rad are ten beams exactly: of beams 0 to 10 three lost ones are more than a fifth, of 0 to 9 two are not."""
    lost = np.isin(np.arange(40), (8, 9, 10))
    found = _unseen(np.where(lost, np.nan, 1.0), 0.26 / 10)
    assert found is not None
    assert found[0]
    wider = _unseen(np.where(lost, np.nan, 1.0), 0.0261)
    assert wider is not None
    assert not wider[0]


def test_wide_beams_look_at_their_neighbours_only():
    """At 0.2 rad one beam on either side is within 0.26 rad: the one between two good ones is seen."""
    found = _unseen(np.array([np.nan, 1.0, 1.0, 1.0, np.nan, 1.0, 1.0]), 0.2)
    assert found is not None
    assert found.tolist() == [True, True, False, True, True, True, False]
