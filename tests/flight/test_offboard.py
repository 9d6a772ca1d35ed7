"""When a flight ends, judged tick by tick without a vehicle; and that waiting for the terminal is not part of it."""

from __future__ import annotations

import io
import math
import os
import signal
import threading
import time
from dataclasses import replace

import pytest
from flight_records import record
from rich.console import Console
from stand import ROOT

from flight.errors import ExitCode
from flight.interrupt import Interrupt, Interrupted
from flight.mission import Mission, load_mission
from flight.offboard import FlightJudge
from flight.preflight import Check, Level
from flight.status import Status
from flight.tick import TickRecord
from safety.messages import Verdict


@pytest.fixture(scope="module")
def mission() -> Mission:
    return load_mission(ROOT / "configs" / "corridor.yaml")


def tick(time_s: float, distance_m: float, verdict: Verdict | None = None) -> TickRecord:
    clean = Verdict(braking=False)
    return replace(
        record(0), now_s=time_s, distance_to_goal_m=distance_m, goal_reached=distance_m <= 0.3, verdict=verdict or clean
    )


def endings(mission: Mission, ticks: list[TickRecord]) -> tuple[float, str, ExitCode] | None:
    """(time, outcome, exit code) of the first ending."""
    judge = FlightJudge(mission)
    for item in ticks:
        judge.pausing(item)
        ending = judge.ending(item)
        if ending is not None:
            return item.now_s, ending.outcome, ending.exit_code
    return None


def test_the_goal_ends_the_flight_at_once(mission: Mission) -> None:
    ticks = [tick(0.05 * k, 5.0 - 0.05 * k) for k in range(120)]
    assert endings(mission, ticks) == (pytest.approx(94 * 0.05), "goal_reached", ExitCode.GOAL_REACHED)


def test_no_progress_is_stuck(mission: Mission) -> None:
    """Half a metre nearer counts, hovering does not."""
    approach = [tick(0.05 * k, 20.0 - 0.05 * k) for k in range(100)]
    hover = [tick(5.0 + 0.05 * k, 15.0 + 0.2 * math.sin(k)) for k in range(1000)]
    end = endings(mission, approach + hover)
    assert end is not None
    assert end[1:] == ("stuck", ExitCode.NOT_REACHED)
    assert mission.timeouts.stuck_s <= end[0] <= 5.0 + mission.timeouts.stuck_s + 0.1


def test_slow_progress_ends_at_the_time_limit(mission: Mission) -> None:
    ticks = [tick(0.5 * k, 30.0 - 0.05 * k) for k in range(500)]
    end = endings(mission, ticks)
    assert end == (mission.timeouts.flight_s + 0.5, "timeout", ExitCode.NOT_REACHED)


@pytest.mark.parametrize("rule", ["scan_stale", "state_stale", "command_not_finite"])
def test_a_fault_that_lasts_ends_the_flight(mission: Mission, rule: str) -> None:
    fault = Verdict(braking=True, fault=rule)
    ticks = [tick(0.05 * k, 20.0) for k in range(20)] + [tick(1.0 + 0.05 * k, 20.0, fault) for k in range(200)]
    end = endings(mission, ticks)
    assert end is not None
    assert end[1:] == ("safety", ExitCode.SAFETY_ENDED)
    assert end[0] == pytest.approx(1.0 + mission.failsafe.escalation.hold_after_s, abs=0.051)


def test_a_fault_pauses_until_it_is_healthy_for_a_second(mission: Mission) -> None:
    judge = FlightJudge(mission)
    moving = [
        not judge.pausing(tick(0.05 * k, 20.0, Verdict(braking=True, fault="scan_stale") if k == 3 else None)) for k in range(60)
    ]
    assert moving[:3] == [True] * 3
    first_again = moving.index(True, 3)
    assert 0.05 * (first_again - 3) == pytest.approx(mission.failsafe.escalation.healthy_s, abs=0.051)
    assert all(moving[first_again:])


def test_signals_are_a_request() -> None:
    names: list[str] = []
    with Interrupt(names.append) as interrupt:
        interrupt.check()
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        deadline = time.monotonic() + 2.0
        while interrupt.count < 4 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert names == ["SIGTERM"]
        assert interrupt.count >= 2
        with pytest.raises(Interrupted, match="SIGTERM"):
            interrupt.check()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


class StoppedTerminal(io.StringIO):
    """A terminal after Ctrl-S: writing waits until somebody lets it go on."""

    def __init__(self) -> None:
        super().__init__()
        self.go_on = threading.Event()

    def write(self, text: str) -> int:
        self.go_on.wait(10.0)
        return super().write(text)


def test_a_stopped_terminal_does_not_hold_up_the_flight() -> None:
    terminal = StoppedTerminal()
    with Status(console=Console(file=terminal, width=120)) as status:
        started = time.monotonic()
        status.phase("arming")
        status.checks([Check("lidar", Level.WARN, "8 Hz", "look at it")])
        status.start_live(0.0)
        for k in range(100):
            status.publish(record(k), 0)
        status.stop_live()
        status.phase("landing")
        assert time.monotonic() - started < 0.5
        terminal.go_on.set()
    text = terminal.getvalue()
    assert text.index("arming") < text.index("look at it") < text.index("landing")


def test_the_live_line_says_what_matters() -> None:
    text = io.StringIO()
    with Status(console=Console(file=text, width=200, force_terminal=True)) as status:
        status.publish(replace(record(40), verdict=Verdict(braking=True, clearance_m=0.5)), 7)
        status.start_live(0.0)
        time.sleep(0.6)
        status.stop_live()
    assert "BRAKING" in text.getvalue()
    assert "late ticks 7" in text.getvalue()
