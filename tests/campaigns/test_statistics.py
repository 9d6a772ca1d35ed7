"""Intervals and summaries."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from campaigns.statistics import EpisodeResult, mean, proportion, summarise
from training.intervals import wilson_interval


def episode(seed: int = 0, *, success: bool = True, contacts: int = 0, failure: str | None = None) -> EpisodeResult:
    return EpisodeResult(seed, success, success, contacts, failure, 600, 30.0, 30.0, 27.0, 0.4, 1.0, {"shield": 3})


def test_wilson_agrees_with_published_values() -> None:
    # 81 of 263: (0.2553, 0.3662), Newcombe 1998, table I, method 3
    low, high = wilson_interval(81, 263)
    assert low == pytest.approx(0.2553, abs=1e-4)
    assert high == pytest.approx(0.3662, abs=1e-4)


@given(st.integers(1, 2000), st.floats(0.0, 1.0))
def test_interval_holds_the_rate_and_stays_in_0_1(n: int, share: float) -> None:
    k = round(share * n)
    low, high = wilson_interval(k, n)
    assert 0.0 <= low <= k / n + 1e-12
    assert k / n - 1e-12 <= high <= 1.0


@given(st.integers(1, 300))
def test_more_episodes_narrow_the_interval(n: int) -> None:
    narrow, wide = wilson_interval(2 * n, 4 * n), wilson_interval(n, 2 * n)
    assert narrow[1] - narrow[0] < wide[1] - wide[0]


def test_nothing_measured_says_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert math.isnan(mean([]))


def test_a_goal_reached_with_contact_is_success_but_not_clean() -> None:
    results = [episode(1), episode(2, contacts=2, failure="hit_static"), episode(3, success=False, failure="timeout")]
    summary = summarise(results)
    assert summary["success"]["rate"] == pytest.approx(2 / 3)
    assert summary["clean_success"]["rate"] == pytest.approx(1 / 3)
    assert summary["collisions_per_episode"] == pytest.approx(2 / 3)
    assert summary["failures"] == {"hit_static": [2], "timeout": [3]}
    assert summary["path_efficiency"] == pytest.approx(0.9)
    assert summary["interventions_per_tick"]["shield"] == pytest.approx(9 / 1800)


@pytest.mark.parametrize(
    ("arrived", "contacts", "failure", "clean"),
    [
        (True, 0, None, True),
        (True, 0, "missed_goal", True),
        (True, 0, "fence", False),
        (True, 1, "wall", False),
        (False, 0, "timeout", False),
    ],
)
def test_a_clean_arrival_is_judged_by_what_the_vehicle_could_know(arrived, contacts, failure, clean) -> None:
    flown = EpisodeResult(1, False, arrived, contacts, failure, 600, 30.0, 30.0, 27.0, 0.4, 1.0, {})
    assert flown.clean_arrival is clean
    assert summarise([flown])["clean_arrival"]["rate"] == float(clean)
    assert not flown.clean_success


def test_proportion_counts() -> None:
    assert proportion([True, True, False, True])["rate"] == 0.75
    assert proportion([True] * 200)["low"] > 0.98
