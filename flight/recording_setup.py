"""Before arming: what a flight's recording starts with, and whether there is to be one."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from flight.errors import RefusedError
from flight.mission import Mission
from flight.recorder import FlightRecorder, NoRecorder, Notify, Recorder, RecordingSummary
from flight.recording_schema import FlightHeader, this_machine
from policy_export.runner import PolicyRunner
from safety.frames import CorridorFrame, CorridorVector

NOT_INSTALLED = "not recorded: foxglove-sdk is missing; pip install 'lstm-pilot[record]'"
FILE_NAME = "flight.mcap"


def flight_header(
    mission: Mission,
    policy: PolicyRunner,
    goal: CorridorVector,
    frame: CorridorFrame | None = None,
    boxes: Sequence[Sequence[float]] | None = None,
) -> FlightHeader:
    """The header of a flight of `mission` that starts now. `boxes`: obstacles that a simulator knows, corridor frame, m."""
    origin = frame.origin_ned if frame is not None else None
    return FlightHeader(
        mission=mission.name,
        clock_offset_ns=time.time_ns() - time.monotonic_ns(),
        rate_hz=policy.metadata.rate_hz,
        goal_m=(goal.x, goal.y, goal.z),
        goal_radius_m=mission.goal.radius_m,
        level_scans=mission.lidar.tilt_compensation,
        safety=mission.safety,
        policy_path=str(mission.policy.path),
        policy_sha256=policy.sha256,
        dynamics=mission.sim.dynamics if mission.simulated and mission.sim else "vehicle",
        seed=mission.sim.seed if mission.simulated and mission.sim else None,
        origin_ned_m=(origin.x, origin.y, origin.z) if origin is not None else None,
        heading_rad=frame.heading_rad if frame is not None else None,
        boxes_m=tuple((b[0], b[1], b[2], b[3], b[4], b[5]) for b in boxes) if boxes is not None else None,
        machine=this_machine(),
    )


class FlightRecording:
    """The recorder of one flight and, once it is closed, what became of the recording."""

    def __init__(self, recorder: Recorder | None) -> None:
        self._recorder = recorder

    @property
    def recorder(self) -> FlightRecorder:
        """Where the loop leaves its ticks."""
        return self._recorder if self._recorder is not None else NoRecorder()

    @property
    def summary(self) -> RecordingSummary | None:
        """For summary.json; None where nothing was recorded."""
        return self._recorder.summary if self._recorder is not None else None


@contextmanager
def record_flight(mission: Mission, folder: Path, header: FlightHeader, notify: Notify) -> Iterator[FlightRecording]:
    """Record one flight as the mission asks, into `folder`. Without foxglove-sdk the flight goes on, and one line says so.

    Raises `RefusedError` (before arming) when the file cannot be made or the live view's port is taken.
    """
    config = mission.recording
    if not config.enabled and config.live_port is None:
        yield FlightRecording(None)
        return
    try:
        import foxglove  # noqa: F401, PLC0415  (optional: extra `record`)
    except ImportError:
        notify(NOT_INSTALLED)
        yield FlightRecording(None)
        return
    path = folder / FILE_NAME if config.enabled else None
    recorder = Recorder(path, header, _policy_bytes(mission), config, notify)
    try:
        recorder.__enter__()
    except OSError as error:
        raise RefusedError(f"cannot record to {path}: {error.strerror}; see `recording` in docs/recording.md") from None
    try:
        yield FlightRecording(recorder)
    finally:
        recorder.close()


def _policy_bytes(mission: Mission) -> bytes:
    try:
        return mission.policy.path.read_bytes()
    except OSError as error:
        raise RefusedError(f"cannot read the policy for the recording: {error.filename}: {error.strerror}") from None
