"""The process that flies: no simulator and no torch in it, memory that does not grow, and well under the limit."""

from __future__ import annotations

import pytest

from benchmarks import memory


def test_minutes_of_flight_take_no_more_memory_than_the_first() -> None:
    """The hour is `python -m benchmarks memory`; a leak of one record a tick shows in three minutes as well."""
    figures = {figure["name"]: figure for figure in memory.run(True, minutes=3.0)}
    assert all(figure["ok"] for figure in figures.values()), figures
    for mode in ("without recording", "with recording"):
        assert figures[f"{mode}: simulator or torch modules"]["value"] == 0
        assert figures[f"{mode}: ticks that the policy flew"]["value"] > 95.0


def test_the_slope_is_that_of_the_hour_after_the_first_sixth() -> None:
    flat_after_warm_up = [80.0, *[100.0] * 11]
    assert memory.slope_mib_h(flat_after_warm_up, 60.0) == pytest.approx(0.0, abs=1e-9)
    assert memory.slope_mib_h([100.0 + k / 12 for k in range(12)], 60.0) == pytest.approx(1.0)
    assert memory.slope_mib_h([100.0 + k / 12 for k in range(12)], 30.0) == pytest.approx(2.0)
