"""A report of a flight that could not write its results: everything from the recording alone, cut as a SIGKILL leaves it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from recorded_flight import record_lockstep
from stand import Program

from flight.broken_off import complete, log_of
from flight.recording_reader import read_recording
from flight.recover import recover
from flight.results import write_log
from flight.run_folder import ReportError, read_run


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Path:
    path = tmp_path_factory.mktemp("recording") / "flight.mcap"
    record_lockstep(path, seeker_policy, duration_s=8.0)
    return path


@pytest.fixture
def killed(tmp_path: Path, recording: Path) -> Path:
    """A run folder after a SIGKILL: a recording without its end, and nothing else."""
    data = recording.read_bytes()
    (tmp_path / "flight.mcap").write_bytes(data[: len(data) * 9 // 10])
    return tmp_path


@pytest.mark.parametrize("recovered", [False, True])
def test_fly_report_makes_a_report_from_the_recording_alone(killed: Path, recovered: bool) -> None:
    if recovered:
        recover(killed / "flight.mcap")
        (killed / "flight.mcap").unlink()
    program = Program("flight", "report", str(killed))
    assert program.finish(120.0) == 0, program.err
    html = (killed / "report.html").read_text()
    assert "broken off" in html
    assert "No scans were kept" not in html, "the waterfall is drawn from the recorded scans"
    assert (killed / "trajectory.png").stat().st_size > 10_000
    assert "made from flight" in program.err
    summary = json.loads((killed / "summary.json").read_text())
    assert summary["outcome"] == "broken_off"
    assert summary["loop"]["rate_hz"] == pytest.approx(20.0)
    assert summary["recording"]["cut"] is None if recovered else "file ends" in summary["recording"]["cut"]
    run = read_run(killed)
    assert run.scans is not None
    assert len(run.scans.poses) > 100
    assert run.boxes is not None


def test_the_results_are_those_the_flight_would_have_written(tmp_path: Path, recording: Path) -> None:
    """A flight's own trajectory.csv and scans.npz, and the same made from its recording: equal."""
    own, made = tmp_path / "own", tmp_path / "made"
    own.mkdir()
    made.mkdir()
    write_log(own, log_of(read_recording(recording)))
    shutil.copy(recording, made / "flight.mcap")
    assert complete(made) is not None
    for name in ("trajectory.csv", "timing.csv"):
        assert (made / name).read_bytes() == (own / name).read_bytes()
    assert np.array_equal(read_run(made).scans.codes, _scans(own / "scans.npz"))  # type: ignore[union-attr]


def _scans(path: Path) -> np.ndarray:
    with np.load(path) as file:
        return np.asarray(file["codes"])


def test_what_is_there_is_kept(killed: Path) -> None:
    assert complete(killed) is not None
    assert complete(killed) is None
    summary = (killed / "summary.json").read_bytes()
    (killed / "scans.npz").unlink()
    assert complete(killed) == "scans.npz made from flight.mcap"
    assert (killed / "summary.json").read_bytes() == summary
    assert read_run(killed).scans is not None


def test_a_folder_without_recording_is_left_alone(tmp_path: Path) -> None:
    assert complete(tmp_path) is None
    with pytest.raises(ReportError, match=r"summary\.json"):
        read_run(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_cut_before_its_first_tick_is_one_line(killed: Path) -> None:
    data = (killed / "flight.mcap").read_bytes()
    (killed / "flight.mcap").write_bytes(data[:40_000])
    program = Program("flight", "report", str(killed))
    assert program.finish(60.0) == 2
    assert program.err.count("\n") == 1, program.err
