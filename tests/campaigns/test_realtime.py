"""How real-time flights are judged from what the simulator reports."""

from __future__ import annotations

from pathlib import Path

import pytest

from campaigns.realtime import RealFlight, fence_margin_m, summarise
from safety.config import Fence, SafetyConfig

SAFETY = SafetyConfig(fence=Fence(min_m=(-0.5, -4.0, 0.5), max_m=(35.5, 4.0, 4.0)))
LOOP = {"rate_hz": 20.0, "ticks": 600, "deadline_misses": 1, "scan_to_setpoint_ms": {"p50": 25.0, "p99": 40.0}}


def flight(**changes: object) -> RealFlight:
    values = {
        "seed": 1, "exit_code": 0, "outcome": "goal_reached", "goal_reached": True, "true_distance_to_goal_m": 0.1, "contacts": 0,
        "min_clearance_m": 0.3, "fence_margin_m": 0.5, "duration_s": 30.0, "loop": LOOP,
    }  # fmt: skip
    return RealFlight(**(values | changes))  # type: ignore[arg-type]


def report(*rows: tuple[float, float, float, float]) -> dict[str, object]:
    events = [{"t": 1.0, "mode": "AUTO.TAKEOFF"}, {"t": 5.0, "mode": "OFFBOARD"}, {"t": 9.0, "mode": "AUTO.LAND"}]
    return {"events": events, "trajectory": {"rows": [[*row, 0.0, 0.0, 0.0, 0.0] for row in rows]}}


def test_only_offboard_counts_for_the_fence() -> None:
    ground, inside, landing = (0.5, 4.0, 0.0, 0.0), (6.0, 10.0, 1.0, 2.0), (9.5, 30.0, 0.0, 0.1)
    assert fence_margin_m(report(ground, inside, landing), SAFETY) == pytest.approx(1.4)
    assert fence_margin_m(report(ground), SAFETY) is None


def test_the_hull_not_the_centre_must_stay_inside() -> None:
    margin = fence_margin_m(report((6.0, 10.0, 3.7, 2.0)), SAFETY)
    assert margin == pytest.approx(4.0 - 3.7 - SAFETY.vehicle_radius_m)
    assert flight(fence_margin_m=margin).left_fence


@pytest.mark.parametrize(
    "spoilt",
    [{"contacts": 1}, {"exit_code": 1}, {"true_distance_to_goal_m": 0.31}, {"fence_margin_m": -0.01}, {"contacts": None}],
)
def test_anything_wrong_is_not_clean(spoilt: dict[str, object]) -> None:
    assert flight().clean
    assert not flight(**spoilt).clean


def test_summary_counts_what_was_flown_and_what_was_not() -> None:
    refused = flight(exit_code=3, outcome="not flown", goal_reached=False, true_distance_to_goal_m=None, loop={})
    result = summarise(Path("m.yaml"), [flight(), flight(seed=2, fence_margin_m=-0.2), refused])
    assert result["goal_reached_and_landed"] == 2
    assert result["clean_success"]["n"] == 3
    assert result["left_fence"] == 1
    assert result["ticks"] == 1200
    assert result["loop_rate_hz"]["mean"] == 20.0
