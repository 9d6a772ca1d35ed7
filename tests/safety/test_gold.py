"""What the filter decides in scripted flights is what it decided when the files in gold/ were reviewed (see `gold_flights`)."""

from __future__ import annotations

import json

import pytest
from gold_flights import CALM_FLIGHTS, FAULTY_FLIGHTS, fly, path


def same(now, kept) -> bool:
    """Equal, numbers up to rounding."""
    if isinstance(kept, list):
        return isinstance(now, list) and len(now) == len(kept) and all(map(same, now, kept))
    if isinstance(kept, float) and isinstance(now, int | float):
        return now == pytest.approx(kept, rel=1e-6, abs=1e-7)
    return now == kept


@pytest.mark.parametrize("flight", [*CALM_FLIGHTS, *FAULTY_FLIGHTS])
def test_decisions_are_the_reviewed_ones(flight):
    kept = json.loads(path(flight).read_text())
    for tick, (now, then) in enumerate(zip(fly(flight), kept, strict=True)):
        assert same(now, then), f"tick {tick} of flight {flight}"


def test_flights_meet_every_stage():
    """Gold that is all alike would prove nothing."""
    rows = [row for flight in (*CALM_FLIGHTS, *FAULTY_FLIGHTS) for row in json.loads(path(flight).read_text())]
    rules = [found[0] for row in rows for found in row[3]]
    for rule in (
        "obstacle",
        "fence",
        "hold_off",
        "return_speed",
        "unseen",
        "speed_limit",
        "acceleration_limit",
        "speed_cap",
    ):
        assert rules.count(rule) >= 10, rule
    assert len({row[2] for row in rows}) >= 15
    assert {row[4] for row in rows} == {0, 1, 2, 3, 4}
