"""The `fly` command itself: help, where its output goes, and how it ends before anything is armed."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from stand import Program, Stand

from flight.errors import ExitCode, MissionError
from flight.offboard import Ending
from flight.results import judge_flight, make_run_folder, remove_if_empty, truth_from_report


def test_help_has_examples_and_exit_codes() -> None:
    program = Program("flight", "--help")
    assert program.finish(60.0) == 0
    for words in ("fly --mission configs/corridor.yaml", "--json", "--seed", "Exit codes", "Ctrl-C"):
        assert words in program.out
    assert program.err == ""


def test_ctrl_c_before_arming_arms_nothing(tmp_path: Path, seeker_policy: Path) -> None:
    stand = Stand(tmp_path, seeker_policy)
    program = stand.fly("--json")
    program.wait_for("starting the simulator", 60.0)
    program.process.send_signal(signal.SIGINT)
    assert program.finish(60.0) == 1
    assert "stopped by SIGINT before arming" in program.err
    assert program.out == ""
    assert not (tmp_path / "run").exists()


def test_run_folders_are_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = make_run_folder(None, "a"), make_run_folder(None, "a")
    assert first != second
    assert first.parent == Path("runs")
    assert first.name.endswith("-a")
    wanted = make_run_folder(tmp_path / "x" / "y", "a")
    assert wanted.is_dir()
    (wanted / "summary.json").write_text("{}")
    with pytest.raises(MissionError, match="not empty"):
        make_run_folder(wanted, "a")
    remove_if_empty(wanted)
    remove_if_empty(first)
    assert wanted.exists()
    assert not first.exists()


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MissionError, match="cannot write"):
        make_run_folder(tmp_path / "file" / "run", "a")


def test_truth_of_a_report() -> None:
    truth = truth_from_report(
        {"trajectory": {"columns": ["t", "x", "y", "z"], "rows": [[0.0, 1.0, 2.0, 3.0], [0.1, 4.0, 5.0, 6.0]]}}
    )
    assert truth is not None
    assert truth.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    for nothing in ({}, {"trajectory": None}, {"trajectory": {"rows": []}}, {"trajectory": {"rows": [[1.0], ["a"]]}}):
        assert truth_from_report(nothing) is None


def test_contact_and_a_failed_landing_outweigh_the_goal() -> None:
    reached = Ending("goal_reached", ExitCode.GOAL_REACHED, "goal reached")
    assert judge_flight(reached, True, 0)[:2] == (ExitCode.GOAL_REACHED, "goal_reached")
    assert judge_flight(reached, True, None)[:2] == (ExitCode.GOAL_REACHED, "goal_reached")
    assert judge_flight(reached, False, 0)[:2] == (ExitCode.NOT_REACHED, "not_landed")
    assert judge_flight(reached, True, 2)[:2] == (ExitCode.NOT_REACHED, "contact")
    safety = Ending("safety", ExitCode.SAFETY_ENDED, "safety ended the flight")
    assert judge_flight(safety, True, 0)[:2] == (ExitCode.SAFETY_ENDED, "safety")
