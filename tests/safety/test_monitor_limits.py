"""What a threshold of the monitors may be at all."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from safety.monitor_config import MonitorConfig


@pytest.mark.parametrize(
    ("name", "value"), [("link_delay_lasts_s", 0.0), ("link_delay_lasts_s", 1000.0), ("echo_s", 0.01), ("echo_s", 1.0)]
)
def test_a_threshold_at_its_limit_is_accepted(name, value):
    assert getattr(MonitorConfig.model_validate({name: value}), name) == value


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("link_delay_lasts_s", -0.001, "greater than or equal to 0"),
        ("link_delay_lasts_s", 1000.001, "less than or equal to 1000"),
        ("echo_s", 0.0, "greater than 0"), ("echo_s", -0.5, "greater than 0"), ("echo_s", 1.001, "less than or equal to 1"),
    ],
)  # fmt: skip
def test_a_threshold_beyond_its_limit_is_refused(name, value, words):
    with pytest.raises(ValidationError, match=words):
        MonitorConfig.model_validate({name: value})
