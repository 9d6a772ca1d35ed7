import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from sim_gateway.lidar import Lidar, LidarConfig, apply_sensor, measure

QUIET = LidarConfig(noise_sigma_m=0.0)


def generator(seed=0):
    return np.random.Generator(np.random.PCG64(seed))


def test_policy_beams_look_along_the_middle_of_their_sectors():
    bearings = np.degrees(LidarConfig().bearings_rad)
    np.testing.assert_allclose(bearings, np.arange(-89.5, 90.0, 1.0), atol=1e-9)


def test_the_device_has_steps_of_half_a_degree_edge_to_edge():
    config = LidarConfig.device()
    np.testing.assert_allclose(np.degrees(config.bearings_rad), np.arange(-90.0, 90.1, 0.5), atol=1e-9)
    assert (config.beams, config.rate_hz, config.range_min_m, config.range_max_m) == (361, 20.0, 0.1, 4.0)


def test_limits_map_to_infinity_and_zero():
    measured = measure(QUIET, np.array([0.0, 0.0999, 0.1, 2.0, 3.9999, 4.0, 9.0]), generator())
    np.testing.assert_array_equal(measured, [0.0, 0.0, 0.1, 2.0, 3.9999, math.inf, math.inf])


def test_noise_has_the_configured_size_and_no_bias():
    measured = measure(LidarConfig(noise_sigma_m=0.02), np.full(40_000, 2.0), generator(1))
    assert measured.mean() == pytest.approx(2.0, abs=0.0005)
    assert measured.std() == pytest.approx(0.02, rel=0.03)


def test_drop_outs_come_as_often_as_configured_and_read_as_nothing_there():
    measured = measure(LidarConfig(dropout_probability=0.1), np.full(40_000, 2.0), generator(2))
    lost = np.isinf(measured)
    assert lost.mean() == pytest.approx(0.1, abs=0.01)
    assert np.isfinite(measured[~lost]).all()


@pytest.mark.parametrize(("probability", "lost"), [(0.0, 0), (1.0, 500)])
def test_drop_out_certainties(probability, lost):
    measured = measure(LidarConfig(dropout_probability=probability), np.full(500, 1.0), generator(3))
    assert np.isinf(measured).sum() == lost


@settings(max_examples=100, deadline=None)
@given(ranges=st.lists(st.floats(0.0, 20.0), min_size=1, max_size=50), seed=st.integers(0, 99))
def test_a_reading_is_zero_infinite_or_within_the_limits(ranges, seed):
    config = LidarConfig(noise_sigma_m=0.3, dropout_probability=0.2)
    measured = measure(config, np.array(ranges), generator(seed))
    finite = measured[np.isfinite(measured) & (measured != 0.0)]
    assert ((finite >= config.range_min_m) & (finite < config.range_max_m)).all()
    assert not np.isnan(measured).any()


def test_the_kernel_may_work_in_place():
    ranges = np.array([1.0, 5.0])
    apply_sensor(ranges, np.zeros(2), np.ones(2), 0.0, 0.5, 0.1, 4.0, ranges)
    np.testing.assert_array_equal(ranges, [1.0, math.inf])


def test_a_scan_sees_a_pillar_on_its_side_only():
    pillar = np.array([[-0.2, 1.0, 0.0, 0.2, 1.4, 10.0]])
    ranges = Lidar(QUIET).scan(pillar, np.array([0.0, 0.0, 2.0]), np.eye(3), generator())
    assert ranges[179] == pytest.approx(1.0 / math.sin(math.radians(89.5)))
    assert np.isinf(ranges[:90]).all()


@pytest.mark.parametrize(
    "change", [{"beams": 1}, {"fov_rad": 0.0}, {"dropout_probability": 1.5}, {"noise_sigma_m": math.nan}, {"beam": 3}]
)
def test_bad_configurations_are_refused(change):
    with pytest.raises(ValidationError, match=next(iter(change))):
        LidarConfig(**change)
