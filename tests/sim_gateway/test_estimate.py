import math

import numpy as np
import pytest
from numba import njit

from sim_gateway.estimate import (
    ERROR_SIZE,
    PRESETS,
    PROCESSES,
    EstimateNoise,
    UnknownPresetError,
    error_coefficients,
    estimate_preset,
    initial_error,
    step_error,
)

SAMPLES = 200_000
DT = 0.05


@njit
def record(error, coefficients, normals):
    """Errors after each step, [steps, 12]; compiled, as training uses the kernels."""
    out = np.empty((normals.shape[0], error.shape[0]))
    for i in range(normals.shape[0]):
        step_error(error, coefficients, normals[i])
        out[i] = error
    return out


def coefficients(noise, dt):
    out = np.empty((2, PROCESSES))
    error_coefficients(noise.as_array(), dt, out)
    return out


def series(noise, seed=0):
    generator = np.random.Generator(np.random.PCG64(seed))
    error = np.empty(ERROR_SIZE)
    initial_error(noise.as_array(), generator.standard_normal(ERROR_SIZE), error)
    return record(error, coefficients(noise, DT), generator.standard_normal((SAMPLES, PROCESSES)))


def test_errors_have_their_sizes_and_correlation_times():
    noise = PRESETS["nominal"]
    errors = series(noise)
    sizes = [*noise.position_m, *noise.velocity_m_s, *noise.attitude_rad]
    np.testing.assert_allclose(errors[:, :PROCESSES].std(axis=0), sizes, rtol=0.08)
    lag = round(2.0 / DT)
    for i in range(PROCESSES):
        assert np.corrcoef(errors[:-lag, i], errors[lag:, i])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.06)


def test_the_recorded_preset_has_the_recorded_velocity_errors():
    errors = series(PRESETS["px4_sih"], seed=1)
    np.testing.assert_allclose(errors[:, 3:6].std(axis=0), [0.162, 0.319, 0.167], rtol=0.1)


def test_axes_are_independent():
    correlation = np.corrcoef(series(PRESETS["nominal"], seed=2)[:, :PROCESSES].T)
    assert np.abs(correlation - np.eye(PROCESSES)).max() < 0.1


def test_two_half_steps_are_one_whole_step():
    noise = PRESETS["px4_sih"]
    whole, half = coefficients(noise, 0.1), coefficients(noise, 0.05)
    np.testing.assert_allclose(half[0] ** 2, whole[0], rtol=1e-12)
    np.testing.assert_allclose(half[1] ** 2 * (1.0 + half[0] ** 2), whole[1] ** 2, rtol=1e-12)


def test_the_bias_is_drawn_once_and_stays():
    errors = series(PRESETS["px4_sih"], seed=3)
    assert (errors[:, 9:] == errors[0, 9:]).all()
    assert np.abs(errors[0, 9:]).max() > 0.0


def test_biases_differ_between_flights_with_the_recorded_size():
    noise, generator = PRESETS["px4_sih"], np.random.Generator(np.random.PCG64(4))
    errors = np.empty((4000, ERROR_SIZE))
    for row in errors:
        initial_error(noise.as_array(), generator.standard_normal(ERROR_SIZE), row)
    np.testing.assert_allclose(errors[:, 9:].std(axis=0), noise.position_bias_m, rtol=0.05)
    np.testing.assert_allclose(errors[:, 3:6].std(axis=0), noise.velocity_m_s, rtol=0.05)


def test_the_preset_none_is_exactly_zero():
    assert (series(PRESETS["none"]) == 0.0).all()


def test_an_unknown_preset_lists_the_names():
    with pytest.raises(UnknownPresetError, match="none, nominal, px4_sih"):
        estimate_preset("perfect")


@pytest.mark.parametrize(
    "change",
    [{"position_m": (-0.1, 0.0, 0.0)}, {"velocity_time_s": (2.0, 0.0, 2.0)}, {"acceleration_m_s2": (math.nan, 0.0, 0.0)}],
)
def test_sizes_and_times_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        EstimateNoise(**change)
