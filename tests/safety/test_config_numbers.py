"""Limits of the configuration met exactly, and the two forms of a fence that must not be mixed."""

from __future__ import annotations

import pytest
from pydantic import ValidationError
from safety_plant import config

from safety.config import Fence, braking_distance_m, speed_cap_m_s

SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0))
HIGH = ((0.0, 0.0, 0.0), (4.0, 4.0, 3.0))


def test_a_box_and_a_complete_polygon_fence_are_one_too_many():
    with pytest.raises(ValidationError, match="not some of both"):
        Fence(min_m=HIGH[0], max_m=HIGH[1], floor_m=0.0, ceiling_m=3.0, inclusion=SQUARE)


@pytest.mark.parametrize(("floor_m", "ceiling_m"), [(1.0, 1.0), (1.0, 0.5)])
def test_a_ceiling_is_above_its_floor(floor_m, ceiling_m):
    with pytest.raises(ValidationError, match=f"fence z: floor_m {floor_m} must be smaller than ceiling_m {ceiling_m}"):
        Fence(floor_m=floor_m, ceiling_m=ceiling_m, inclusion=SQUARE)


@pytest.mark.parametrize(("axis", "name"), [(0, "x"), (1, "y"), (2, "z")])
@pytest.mark.parametrize("least", [3.0, 4.0])
def test_a_box_is_longer_than_nothing_on_every_axis(axis, name, least):
    low = tuple(least if k == axis else 0.0 for k in range(3))
    with pytest.raises(ValidationError, match=f"fence {name}: min_m {least} must be smaller than max_m 3.0"):
        Fence(min_m=low, max_m=(3.0, 3.0, 3.0))


@pytest.mark.parametrize(("more_m", "left"), [(0.0, False), (2.0**-20, True)])
def test_between_floor_and_ceiling_something_must_be_left(more_m, left):
    """Without errors and margin 0.125 m of the vehicle are taken off on either side: of 0.25 m nothing is left."""
    changes = {"vehicle_half_height_m": 0.125, "position_error_m": 0.0, "velocity_error_m_s": 0.0, "margin_m": 0.0}
    fence = Fence(floor_m=1.0, ceiling_m=1.25 + more_m, inclusion=SQUARE)
    if left:
        assert config(fence=fence, **changes).keep_in_z() == (1.125, 1.125 + more_m)
    else:
        with pytest.raises(ValidationError, match="fence z: nothing is left of the fence"):
            config(fence=fence, **changes)


@pytest.mark.parametrize("delay_s", [1e-200, 1e-9, 0.4])
def test_at_no_distance_there_is_no_speed_however_short_the_delay(delay_s):
    assert speed_cap_m_s(0.0, delay_s, 2.0) == 0.0
    assert speed_cap_m_s(-1.0, delay_s, 2.0) == 0.0


def test_braking_is_as_long_as_the_lag_up_to_the_knee_and_a_parabola_above():
    """b = 2 m/s^2, tau = 0.5 s: the knee is at 1 m/s. From 3 m/s: (9 - 1) / 4 + 0.5."""
    assert [braking_distance_m(v, 0.5, 2.0) for v in (0.0, 0.5, 1.0, 3.0)] == [0.0, 0.25, 0.5, 2.5]
