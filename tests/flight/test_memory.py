"""The process that flies: no simulator and no torch in it, memory that does not grow, and well under the limit."""

from __future__ import annotations

from benchmarks import memory


def test_minutes_of_flight_take_no_more_memory_than_the_first() -> None:
    """The hour is `python -m benchmarks memory`; a leak of one record a tick shows in three minutes as well."""
    figures = {figure["name"]: figure for figure in memory.run(True, minutes=3.0)}
    assert all(figure["ok"] for figure in figures.values()), figures
    assert figures["simulator or torch modules"]["value"] == 0
    assert figures["ticks that the policy flew"]["value"] > 95.0
