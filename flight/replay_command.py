"""What `fly replay` prints, and its exit codes: 0 the same, 1 something differs."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

from flight.errors import ExitCode
from flight.recording_reader import Recording, read_recording
from flight.replay import Comparison, PolicyComparison, compare, compare_policy

MOST_FIELDS = 8


def run_replay(file: Path, policy: Path | None, tolerance: float, as_json: bool) -> int:
    """Replay `file` and print what came of it. Raises `RecordingError`."""
    recording = read_recording(file)
    if recording.salvage.cut is not None:
        sys.stderr.write(f"fly: {file}: {recording.salvage.cut}; what is there is replayed (fly recover makes it whole)\n")
    if policy is not None:
        other = compare_policy(recording, policy, recording.header.rate_hz)
        _print(json.dumps(dataclasses.asdict(other)) if as_json else describe_policy(other, recording))
        return ExitCode.GOAL_REACHED
    result = compare(recording, tolerance)
    _print(json.dumps(result.as_dict()) if as_json else describe(result, recording, tolerance))
    return ExitCode.GOAL_REACHED if result.identical else ExitCode.NOT_REACHED


def describe(result: Comparison, recording: Recording, tolerance: float = 0.0) -> str:
    """Lines for the user."""
    how = "bit for bit" if tolerance == 0.0 else f"within {tolerance:g}"
    same = result.ticks - result.differing_ticks
    lines = [f"{same} of {result.ticks} ticks the same {how} ({_name(recording)})"]
    if result.missing_ticks:
        after = f"tick {result.ticks} is the first that was not recorded"
        lines.append(f"{result.missing_ticks} ticks not compared: {after}, and what comes after it depends on it")
    if result.first is not None:
        lines.append(result.first.describe())
        often = [f"{name} ({count})" for name, count in list(result.fields.items())[:MOST_FIELDS]]
        lines.append(f"ticks that differ, by field: {', '.join(often)}")
        if not result.same_machine:
            lines.append(
                "recorded on another processor or with other libraries, which may round the last bit otherwise: "
                "--tolerance 1e-4 leaves that out"
            )
    return "\n".join(lines)


def describe_policy(result: PolicyComparison, recording: Recording) -> str:
    """Lines for the user."""
    lines = [f"{result.policy} on the inputs of {_name(recording)}: asked in {result.compared} of {result.ticks} ticks"]
    if result.first_tick is None:
        lines.append("decides the same throughout (velocity within 0.05 m/s, yaw rate within 0.1 rad/s)")
    else:
        lines.append(
            f"decides otherwise in {result.noticeable} ticks, first at tick {result.first_tick} ({result.first_time_s:.2f} s)"
        )
    for what, unit, spread in (
        ("wanted velocity", "m/s", result.velocity_m_s),
        ("wanted yaw rate", "rad/s", result.yaw_rate_rad_s),
        ("velocity after the safety filter", "m/s", result.sent_velocity_m_s),
    ):
        if spread:
            numbers = ", ".join(f"{name} {value:.3f}" for name, value in spread.items())
            lines.append(f"  {what}, difference in {unit}: {numbers}")
    lines.append(f"  ticks braking: recorded {result.braking[0]}, this policy {result.braking[1]}")
    lines += [f"  ticks of {rule}: recorded {a}, this policy {b}" for rule, (a, b) in result.rules.items()]
    return "\n".join(lines)


def _name(recording: Recording) -> str:
    seed = f" seed {recording.header.seed}" if recording.header.seed is not None else ""
    return f"{recording.header.mission}{seed}, policy {recording.header.policy_sha256[:12]}"


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
