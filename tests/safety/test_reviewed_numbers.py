"""Every number that decides something stands here a second time: a limit is changed knowingly or not at all."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import pkgutil

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError
from safety_plant import FENCE

import safety
import safety.config
import safety.monitor_config
from safety.config import SafetyConfig
from safety.escalation import EscalationConfig
from safety.monitor_config import MonitorConfig

MODULES = [importlib.import_module(f"safety.{found.name}") for found in pkgutil.iter_modules(safety.__path__)]
OWN = [(m, n, v) for m in MODULES for n, v in vars(m).items() if getattr(v, "__module__", m.__name__) == m.__name__]
MESSAGES = [value for _, _, value in OWN if inspect.isclass(value) and dataclasses.is_dataclass(value)]
MODELS = [value for _, _, value in OWN if inspect.isclass(value) and issubclass(value, BaseModel)]


def constants():
    """Module constants that are numbers, or tuples of them."""
    for module in MODULES:
        for name, value in vars(module).items():
            values = value if isinstance(value, tuple) else (value,)
            if name.isupper() and values and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
                yield module.__name__.removeprefix("safety."), name, value


REVIEWED = {
    "allowance.EPSILON_M": 1e-09,
    "allowance.SLIDE_SHARE": 0.25,
    "allowance.HOLD_OFF_PER_S": 10.0,
    "allowance.POINT_BAND_M": 0.05,
    "allowance.FENCE_BAND_M": 0.5,
    "allowance.PUSH_ROUNDS": 6,
    "allowance.SECTORS": 16,
    "allowance.BOUND_WEIGHT": 10000.0,
    "allowance.NEAR_M": 0.05,
    "allowance.PROJECTIONS": 3,
    "allowance._LEAST_M": 1e-06,
    "braking.HISTORY": 64,
    "braking.STANDSTILL_M_S": 0.1,
    "estimate_monitor.WINDOW_SAMPLES": 64,
    "estimate_monitor.ROUNDING_S": 1e-06,
    "fence.SEARCH_STEP_M": 0.005,
    "fence.SEARCH_SHARE": 2.0**-11,
    "fence.MOST_CELLS": 256.0,
    "fence_far.WITHIN_M": 0.5,
    "fence_far._ROUNDING_M": 1e-06,
    "fence_rules.MAX_VERTICES": 64,
    "fence_rules.LEAST_GAP_M": 0.001,
    "fence_rules.LEAST_AREA_M2": 1e-06,
    "fence_tube._LEAST_M2": 1e-12,
    "filter.MAX_GAP_TICKS": 2.0,
    "filter.GATE_SLACK": 1e-09,
    "filter.MEMORY_REACH_M": 1.5,
    "free_space.CELL_M": 0.1,
    "free_space.SIDE_CELLS": 128,
    "free_space.CARVE_M": 2.5,
    "free_space.RECENTRE_CELLS": 8,
    "free_space.PATCH_CELLS": 12,
    "unseen_cells.CELL_M": 0.1,
    "unseen_cells.SURFACE_CELLS": 2,
    "free_space.TAKE_OFF_M": 0.9,
    "free_space.VICINITY_CELLS": 2,
    "free_space.STEP_M": 0.2,
    "free_space._REACH_ERROR_M": 0.14142135623730953,
    "free_space._WIDEST_RAD": 1.0471975511965976,
    "lidar.MAX_BEAMS": 4096,
    "lidar.RANGE_SLACK_M": 0.1,
    "lidar.UNKNOWN_WINDOW_RAD": 0.26,
    "lidar.UNKNOWN_SHARE": 0.2,
    "lidar.TILT_BAND_M": 0.3,
    "lidar._LEVEL": 1e-06,
    "limits.ROUNDING_M_S": 1e-09,
    "loop_monitor.MISSES_WITHIN_S": 1.0,
    "loop_monitor.FOREIGN_WITHIN_S": 1.0,
    "loop_monitor.FOREIGN_ECHOES": 6,
    "loop_monitor.MAX_FOREIGN": 128,
    "loop_monitor.ROUNDING_S": 1e-06,
    "memory.CAPACITY": 2048,
    "memory.LEAST_DEPTH_M": 0.15,
    "memory.MOVED_S": 1.0,
    "memory.NOTHING_M": 1000000.0,
    "memory.SAME_PLACE_M": 0.2,
    "monitors.FROZEN_SCANS": 3,
    "monitors.FROZEN_SPEED_M_S": 0.3,
    "monitors.FROZEN_YAW_RATE_RAD_S": 0.2,
    "monitors.MOST_BEAMS": 0.5,
    "monitors.WALL_SHARE": 0.1,
    "monitors.WALL_RANGE": 0.75,
    "policy_monitor.BAD_WITHIN_S": 1.0,
    "policy_monitor.FULL": 0.99,
    "policy_monitor.ROUNDING_S": 1e-06,
    "reactions.TICK_S": 0.1,
    "residual.SAMPLES": 64,
    "residual.LEAST_SPEED_M_S": 0.2,
    "residual.LEAST_CHANGE_M_S": 0.1,
    "residual.EVIDENCE": 0.08,
    "residual.SHARE_MOST": 2.0,
    "residual.ROUNDING_S": 1e-06,
    "scan_monitor.REFERENCE_S": 1.0,
    "scan_monitor.WRONG_SHARE": 0.5,
    "scan_monitor.WRONG_M": 0.05,
    "open_space.ROUNDING_M": 1e-06,
    "shield.EPSILON_M": 1e-09,
    "shield.SCALES": (0.8, 0.6, 0.4, 0.2, 0.1, 0.05),
    "shield.TURNS_RAD": tuple(math.radians(a) for a in (15.0, 30.0, 45.0, 60.0, 75.0, 85.0)),
    "shield.PUSHES": (1.0, 1.5),
    "shield.FIRST_LOOK": 8,
    "shield.OUTWARD": (0.0, 0.1),
    "sight.STANDING_AFTER": 2.0,
    "sight.STEP_M": 0.2,
    "sight.ROUNDING_M": 1e-09,
}


def test_constants_are_the_reviewed_numbers():
    found = {f"{module}.{name}": value for module, name, value in constants()}
    assert found == REVIEWED


MONITORS = {
    "position_jump_m": 0.25,
    "altitude_jump_m": 0.25,
    "velocity_mismatch_m_s": 1.6,
    "velocity_window_s": 0.4,
    "jumps_window_s": 5.0,
    "frozen_state_s": 0.2,
    "frozen_command_m_s": 0.3,
    "direction_speed_m_s": 0.4,
    "direction_error_m_s": 0.4,
    "direction_s": 0.7,
    "accuracy_m": 1.0,
    "accuracy_s": 1.0,
    "tilt_rad": 0.95,
    "tumbling_rad": 1.4,
    "mask_s": 0.5,
    "mask_motion_m": 0.2,
    "mirror_turn_rad": 0.15,
    "mirror_votes": 4,
    "hidden_norm_max": 9.0,
    "bad_commands": 3,
    "inference_late_s": 0.03,
    "inference_hung_s": 0.05,
    "saturated_s": 2.0,
    "oscillation_m_s": 0.3,
    "oscillation_ticks": 10,
    "late_s": 0.05,
    "late_ticks": 3,
    "gap_s": 0.25,
    "link_delay_s": 0.5,
    "link_delay_lasts_s": 0.4,
    "echo_error_m_s": 0.25,
    "echo_s": 0.6,
    "battery_low": 0.15,
    "battery_critical": 0.07,
    "nominal_state_age_s": 0.08,
    "nominal_scan_age_s": 0.12,
    "nominal_late_s": 0.02,
    "nominal_link_delay_s": 0.1,
    "braking_horizon_s": 0.6,
    "braking_memory_s": 2.0,
    "braking_weak": 0.9,
    "braking_healthy": 1.0,
    "braking_failed": 0.7,
    "braking_failed_s": 0.5,
    "cap_least": 0.25,
}
ESCALATION = {"hold_after_s": 2.0, "land_after_s": 10.0, "healthy_s": 1.0, "blocked_hold_s": 15.0}


@pytest.mark.parametrize(("model", "values"), [(MonitorConfig, MONITORS), (EscalationConfig, ESCALATION)])
def test_default_thresholds_are_the_reviewed_numbers(model, values):
    assert model().model_dump() == values


TINY = 5e-324
BOUNDS = [
    (safety.config.Positive, [TINY, 1000.0], [0.0, -TINY, 1000.0000001]),
    (safety.config.NotNegative, [0.0, TINY, 1000.0], [-TINY, 1000.0000001]),
    (safety.monitor_config.Positive, [TINY, 1000.0], [0.0, -TINY, 1000.0000001]),
    (safety.monitor_config.NotNegative, [0.0, TINY, 1000.0], [-TINY, 1000.0000001]),
    (safety.monitor_config.Share, [TINY, 1.0], [0.0, 1.0000001]),
]


@pytest.mark.parametrize(("kind", "good", "bad"), BOUNDS)
def test_ranges_of_settings_are_exact(kind, good, bad):
    adapter = TypeAdapter(kind)
    for value in good:
        assert adapter.validate_python(value) == value
    for value in bad:
        with pytest.raises(ValidationError):
            adapter.validate_python(value)


COUNTS = [
    ("mirror_votes", 1, 100),
    ("bad_commands", 2, 20),
    ("oscillation_ticks", 2, 1000),
    ("late_ticks", 1, 20),
]


@pytest.mark.parametrize(("field", "least", "most"), COUNTS)
def test_ranges_of_counts_are_exact(field, least, most):
    assert getattr(MonitorConfig(**{field: least}), field) == least
    assert getattr(MonitorConfig(**{field: most}), field) == most
    for value in (least - 1, most + 1):
        with pytest.raises(ValidationError, match=field):
            MonitorConfig(**{field: value})


PAIRS = [
    (MonitorConfig, "tilt_rad", "tumbling_rad", 1.2),
    (MonitorConfig, "inference_late_s", "inference_hung_s", 0.04),
    (MonitorConfig, "battery_critical", "battery_low", 0.1),
    (MonitorConfig, "nominal_late_s", "late_s", 0.03),
    (MonitorConfig, "nominal_link_delay_s", "link_delay_s", 0.2),
    (MonitorConfig, "braking_failed", "braking_weak", 0.8),
    (MonitorConfig, "braking_weak", "braking_healthy", 0.95),
    (SafetyConfig, "lag_min_s", "lag_s", 0.5),
    (SafetyConfig, "return_speed_m_s", "max_horizontal_speed_m_s", 0.4),
    (SafetyConfig, "hold_off_speed_m_s", "return_speed_m_s", 0.3),
    (SafetyConfig, "hold_off_speed_m_s", "max_vertical_speed_m_s", 0.28),
    (SafetyConfig, "memory_hold_s", "memory_s", 5.0),
]


@pytest.mark.parametrize(("model", "low", "high", "value"), PAIRS)
def test_pairs_may_be_equal_and_no_more(model, low, high, value):
    """G2: what must not exceed another may just reach it."""
    given = {"fence": FENCE} if model is SafetyConfig else {}
    assert getattr(model(**given, **{low: value, high: value}), low) == value
    with pytest.raises(ValidationError, match=f"{low}.*must not exceed.*{high}"):
        model(**given, **{low: value * 1.001, high: value})


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
def test_messages_cannot_be_changed_or_extended(kind):
    assert kind.__dataclass_params__.frozen
    assert "__slots__" in vars(kind)
    empty = kind.__new__(kind)
    with pytest.raises((dataclasses.FrozenInstanceError, TypeError)):
        setattr(empty, dataclasses.fields(kind)[0].name, 0.0)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_configuration_is_frozen_closed_and_finite(model):
    assert model.model_config["frozen"] is True
    assert model.model_config["extra"] == "forbid"
    assert model.model_config["allow_inf_nan"] is False
