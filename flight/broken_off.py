"""Results of a flight that could not write them (SIGKILL, power cut): made from its recording, as the flight would have.

What the folder holds already is never replaced; a recording that was cut off is read up to its last whole second.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from flight.flight_log import FlightLog
from flight.rate_keeper import RateStatistics, percentiles_ms
from flight.recording_reader import Recording, read_recording
from flight.recording_setup import FILE_NAME
from flight.results import write_log
from flight.scan_log import write_scans
from flight.summary import build_summary, write_json_atomic
from flight.trajectory import draw_trajectory_png

OUTCOME = "broken_off"
MESSAGE = "fly ended without writing its results; these are from its recording"
RECORDINGS = (FILE_NAME, "flight-recovered.mcap")
_NEEDED = ("summary.json", "trajectory.csv")


def complete(folder: Path) -> str | None:
    """Write what a report needs and `folder` lacks, from the recording in it; one line about it, None if nothing was to be done.

    Raises `RecordingError` where the recording cannot be read.
    """
    file = next((folder / name for name in RECORDINGS if (folder / name).is_file()), None)
    whole = all((folder / name).is_file() for name in _NEEDED)
    if file is None or (whole and (folder / "scans.npz").is_file()):
        return None
    recording = read_recording(file)
    if not recording.ticks:
        return None
    flight_log = log_of(recording)
    if whole:
        write_scans(folder / "scans.npz", flight_log.scans.scans(), recording.ticks[0].record.now_s)
        return f"scans.npz made from {file.name}"
    _write_results(folder, recording, flight_log)
    return f"the results were missing: made from {file.name}, {len(flight_log)} ticks"


def log_of(recording: Recording) -> FlightLog:
    """The flight's log, tick by tick, as it stood in memory."""
    flight_log = FlightLog(max_ticks=max(1, len(recording.ticks)))
    for sample in recording.ticks:
        record = sample.record if sample.sent is None else replace(sample.record, sent=sample.sent)
        flight_log.append(record, sample.sent_time_s, sample.lateness_s)
        flight_log.see(sample.scan, sample.state)
    return flight_log


def _write_results(folder: Path, recording: Recording, flight_log: FlightLog) -> None:
    header, arrived = recording.header, any(sample.record.goal_reached for sample in recording.ticks)
    summary = build_summary(
        flight_log,
        _loop(recording),
        outcome=OUTCOME,
        goal=header.goal,
        goal_reached=arrived,
        policy_path=header.policy_path,
        policy_sha256=header.policy_sha256,
        dynamics=header.dynamics,
        failsafe_events=[text for _, text in recording.events],
        extra={
            "message": MESSAGE,
            "mission": header.mission,
            "seed": header.seed,
            "goal_m": header.goal_m,
            "goal_radius_m": header.goal_radius_m,
            "fence_m": {"min": header.safety.fence.min_m, "max": header.safety.fence.max_m},
            "boxes_m": header.boxes_m,
            "recording": {"ticks": len(flight_log), "missing": recording.missing_ticks, "cut": recording.salvage.cut},
        },
    )
    write_log(folder, flight_log)
    boxes = np.array(header.boxes_m, dtype=np.float64).reshape(-1, 6) if header.boxes_m is not None else None
    draw_trajectory_png(
        folder / "trajectory.png",
        flight_log,
        boxes=boxes,
        goal=header.goal,
        goal_radius_m=header.goal_radius_m,
        fence=header.safety.fence,
        title=f"{header.mission}: {OUTCOME.replace('_', ' ')}",
    )
    write_json_atomic(folder / "summary.json", summary)


def _loop(recording: Recording) -> RateStatistics:
    """What the loop's keeper would have said: the rate from the first tick to the last, missing ones counted."""
    first, last = recording.ticks[0], recording.ticks[-1]
    elapsed_s = last.record.now_s - first.record.now_s
    rate_hz = (last.tick - first.tick) / elapsed_s if elapsed_s > 0.0 else math.nan
    lateness = percentiles_ms([sample.lateness_s for sample in recording.ticks])
    return RateStatistics(rate_hz, last.tick - first.tick + 1, last.deadline_misses, lateness)
