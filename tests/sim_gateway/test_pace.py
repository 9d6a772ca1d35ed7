"""Vehicle time against the clock, on computers that are quick, held up once, and too slow for good."""

from __future__ import annotations

import pytest

from sim_gateway.pace import GIVE_UP_S, PATIENCE_S, Pace

STEP_S = 0.004


def run(
    pace: Pace, seconds: float, steps_per_s: float, stall_at_s: float = -1.0, stall_s: float = 0.0
) -> list[tuple[float, float]]:
    """A computer that turns every 2 ms and simulates at most `steps_per_s`; gives (clock, backlog after the turn)."""
    now_s = vehicle_s = 0.0
    seen = []
    while now_s < seconds:
        if stall_at_s >= 0.0 and now_s >= stall_at_s:
            now_s, stall_at_s = now_s + stall_s, -1.0
        behind_s = pace.behind_s(now_s, vehicle_s)
        steps = min(int(behind_s / STEP_S), round(0.02 * steps_per_s))
        vehicle_s += steps * STEP_S
        now_s += max(0.002, steps / steps_per_s)
        seen.append((now_s, behind_s - steps * STEP_S))
    return seen


def test_a_quick_computer_drops_nothing() -> None:
    pace = Pace(1.0, 0.0)
    assert max(behind for _, behind in run(pace, 20.0, 2000.0)) < 2 * STEP_S
    assert pace.dropped_s == 0.0


def test_a_stall_is_worked_off() -> None:
    pace = Pace(1.0, 0.0)
    seen = run(pace, 5.0, 2000.0, stall_at_s=2.0, stall_s=0.2)
    assert max(behind for time_s, behind in seen if time_s > 2.5) < 2 * STEP_S
    assert pace.dropped_s == 0.0


def test_a_long_stall_is_given_up_at_once() -> None:
    pace = Pace(1.0, 0.0)
    run(pace, 5.0, 2000.0, stall_at_s=2.0, stall_s=0.8)
    assert pace.dropped_s == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("steps_per_s", [240.0, 150.0, 50.0])
def test_a_slow_computer_is_never_far_behind(steps_per_s: float) -> None:
    """250 steps a second are due. What cannot be had is dropped in small pieces instead of growing up to the limit."""
    pace = Pace(1.0, 0.0)
    seen = run(pace, 20.0, steps_per_s)
    lost = 1.0 - steps_per_s / 250.0
    assert max(behind for time_s, behind in seen if time_s > 1.0) < PATIENCE_S * lost * 2 + 0.03
    assert pace.dropped_s == pytest.approx(20.0 * lost, abs=GIVE_UP_S)


def test_speed_counts_in_vehicle_seconds() -> None:
    pace = Pace(4.0, 10.0)
    assert pace.behind_s(10.1, 0.0) == pytest.approx(0.4)
    assert pace.due_s(0.4) == pytest.approx(10.1)
    assert pace.behind_s(10.6, 0.0) == 0.0, "2.4 vehicle seconds are more than half a second of the clock"
    assert pace.dropped_s == pytest.approx(0.6)
