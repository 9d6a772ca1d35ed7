"""What the safety layer costs: the same corridors on both sides, and the bounds that must hold."""

from __future__ import annotations

import pytest

from campaigns.price import acceptable, figures, markdown, price
from campaigns.statistics import EpisodeResult


def episode(seed: int, success: bool = True, contacts: int = 0, speed: float = 0.8) -> EpisodeResult:
    return EpisodeResult(seed, success, success, contacts, None, 800, 40.0, 40.0 * speed, 30.0, 0.1, 1.0, {})


def sides(on: list[EpisodeResult], off: list[EpisodeResult]) -> dict:
    both = {"on": figures(on), "off": figures(off)}
    return both | {"price": price(both["on"], both["off"])}


def test_differences_are_on_minus_off_over_the_same_corridors():
    on = [episode(0), episode(1, success=False), episode(2)]
    off = [episode(0), episode(1), episode(2, contacts=2)]
    found = sides(on, off)["price"]
    assert found["clean_success_difference"] == 0.0
    assert (found["only_on"], found["only_off"]) == (1, 1)
    assert found["mean_speed_ratio"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("lost", "speed", "good"), [(0, 0.8, True), (1, 0.8, True), (2, 0.8, False), (0, 0.73, True), (0, 0.71, False)]
)
def test_one_point_of_success_and_a_tenth_of_speed_are_the_bounds(lost, speed, good):
    on = [episode(i, success=i >= lost, speed=speed) for i in range(100)]
    assert acceptable(sides(on, [episode(i) for i in range(100)])["price"]) is good


def test_the_table_shows_both_sides():
    text = markdown(sides([episode(0), episode(1)], [episode(0), episode(1, contacts=1)]))
    assert "| clean success | 100.0 % | 50.0 % |" in text
    assert "+50.0 points" in text
