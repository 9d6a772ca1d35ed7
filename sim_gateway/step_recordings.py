"""Recorded velocity and yaw-rate steps: CSV files with commands, estimate and simulator truth, NED, as px4_reference describes.

A file is `NAME_repN.csv`; files that differ only in N are repetitions of one step. Only the columns named here are read.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_BYTES = 32 * 2**20
MIN_ROWS = 50
_REPETITION = re.compile(r"_rep\d+$")
_COMMAND = ("cmd_vx", "cmd_vy", "cmd_vz", "cmd_yawrate")
_ESTIMATE = ("vx", "vy", "vz", "z")
_SMOOTHING_SAMPLES = 5  # each side, of the height's derivative
_TRUTH = ("gt_x", "gt_y", "gt_z", "gt_vx", "gt_vy", "gt_vz", "gt_roll", "gt_pitch", "gt_yaw")


class StepRecordingError(ValueError):
    """A file that is no recording of a step; the message names file and cause."""


@dataclass(frozen=True, slots=True)
class StepRecording:
    """One recorded step, n samples, NED, SI; `time_s` [n] is 0 at the first setpoint of the step.

    `command` [n, 4]: velocity (body FRD when `in_body_frame`) and yaw rate. `estimated_velocity` [n, 3], `estimated_descent`
    [n, 1] (derivative of the estimated z). Of the truth: `position`, `velocity` [n, 3], `tilt_rad`, `yaw_rad` (unwrapped) [n].
    """

    name: str
    in_body_frame: bool
    time_s: Array
    command: Array
    estimated_velocity: Array
    estimated_descent: Array
    position: Array
    velocity: Array
    tilt_rad: Array
    yaw_rad: Array


def load_step(path: Path) -> StepRecording:
    """Read one file. Raises `StepRecordingError`."""
    columns = _columns(path)
    roll, pitch = columns["gt_roll"], columns["gt_pitch"]
    name = _REPETITION.sub("", path.stem)
    return StepRecording(
        name=name,
        in_body_frame=name.startswith("body"),
        time_s=columns["t_s"],
        command=_stack(columns, _COMMAND),
        estimated_velocity=_stack(columns, _ESTIMATE[:3]),
        estimated_descent=_smooth(np.gradient(columns["z"], columns["t_s"]))[:, None],
        position=_stack(columns, _TRUTH[:3]),
        velocity=_stack(columns, _TRUTH[3:6]),
        tilt_rad=np.arccos(np.clip(np.cos(roll) * np.cos(pitch), -1.0, 1.0)),
        yaw_rad=np.unwrap(columns["gt_yaw"]),
    )


def load_steps(paths: list[Path]) -> dict[str, list[StepRecording]]:
    """All recordings in files and folders, by the step's name. Raises `StepRecordingError`, also when there is none."""
    files = [file for path in paths for file in (sorted(path.glob("*.csv")) if path.is_dir() else [path])]
    if not files:
        raise StepRecordingError(f"no CSV file in {', '.join(map(str, paths))}: name recordings of steps or a folder of them")
    steps: dict[str, list[StepRecording]] = {}
    for file in files:
        recording = load_step(file)
        steps.setdefault(recording.name, []).append(recording)
    return steps


def _columns(path: Path) -> dict[str, Array]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise StepRecordingError(f"{path}: larger than {MAX_BYTES} bytes; give one step per file")
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise StepRecordingError(f"{path}: cannot be read ({error})") from None
    if len(rows) < MIN_ROWS:
        raise StepRecordingError(f"{path}: {len(rows)} rows are too few for a step; {MIN_ROWS} are needed")
    columns = {name: _column(path, rows, name) for name in ("t_s", *_COMMAND, *_ESTIMATE, *_TRUTH)}
    if not (np.diff(columns["t_s"]) > 0.0).all() or not columns["t_s"][0] < 0.0 < columns["t_s"][-1]:
        raise StepRecordingError(f"{path}: t_s must grow, and 0 (the step) lie inside")
    return columns


def _column(path: Path, rows: list[dict[str, str]], name: str) -> Array:
    """One column; before the first setpoint a command may be empty, which is zero."""
    values = []
    for number, row in enumerate(rows, start=2):
        text = row.get(name)
        if text is None:
            raise StepRecordingError(f"{path}: has no column {name} in line {number}")
        try:
            value = float(text) if text or not name.startswith("cmd_") else 0.0
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise StepRecordingError(f"{path}: {name} in line {number} is {text!r}, not a finite number")
        values.append(value)
    return np.array(values)


def _smooth(values: Array) -> Array:
    width = 2 * _SMOOTHING_SAMPLES + 1
    mean: Array = np.convolve(np.pad(values, _SMOOTHING_SAMPLES, mode="edge"), np.full(width, 1.0 / width), "valid")
    return mean


def _stack(columns: dict[str, Array], names: tuple[str, ...]) -> Array:
    return np.stack([columns[name] for name in names], axis=1)
