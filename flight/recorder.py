"""The recorder: takes what each tick saw and did off the loop's hands, and writes it to an MCAP file on a thread of its own.

The loop only puts a reference into a bounded queue: it never waits for encoding, disk or a viewer. When the queue is full (a
disk that stands still) a tick is dropped and counted. Every 0.8 s the writer ends its chunk and asks the disk to
keep it, so that a power cut or a SIGKILL costs at most the last second (`fly recover` makes an indexed file of the rest).

Nothing that goes wrong here ends a flight: recording stops, says so in one line, and the flight goes on.
"""

from __future__ import annotations

import logging
import math
import os
import queue
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from flight.live_view import LiveView, start_live_view
from flight.recording_channels import Channels
from flight.recording_config import RecordingConfig
from flight.recording_schema import POLICY_ATTACHMENT, FlightHeader, TickSample
from flight.tick import TickRecord
from safety.frames import CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState

log = logging.getLogger("flight.recorder")

QUEUE_TICKS = 400
"""20 s at 20 Hz, about 1 MB: as long as a slow memory card may stand still."""
FLUSH_EVERY_S = 0.8
CHUNK_BYTES = 1 << 20
"""Chunks end by time, not by size: each costs some 300 bytes of index in memory until the file is closed."""
CLOSE_S = 5.0
MIN_FREE_BYTES = 100 * 1024 * 1024

Notify = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What became of a recording, for summary.json. `file`: None when nothing was kept."""

    file: str | None
    ticks: int
    dropped: int
    problem: str | None


class FlightRecorder(Protocol):
    """What a flight knows of a recorder. No method blocks or raises, whatever the disk does."""

    def tick(
        self,
        record: TickRecord,
        scan: LidarScan | None,
        state: VehicleState | None,
        sent: SafeCommand | None,
        sent_time_s: float,
        goal: CorridorVector,
        lateness_s: float = 0.0,
        deadline_misses: int = 0,
    ) -> None:
        """Take one tick. `record` as `Pilot.tick` gave it, `sent` what really went out at `sent_time_s` (None: nothing)."""

    def event(self, text: str) -> None:
        """Take one line about what happened."""


class NoRecorder:
    """Records nothing."""

    def tick(self, *_tick: object) -> None:
        """Forget it."""

    def event(self, text: str) -> None:
        """Forget it."""


class Recorder:
    """Records one flight to `path` (None: live view only). A context manager; made by `flight.recording_setup` in a flight.

    `policy`: bytes of the policy file, kept in the recording so that a replay needs nothing else. `notify` gets one line
    when recording has to stop. Raises `OSError` on entering when the file cannot be made, `RefusedError` when the live
    view's port is taken.
    """

    def __init__(
        self,
        path: Path | None,
        header: FlightHeader,
        policy: bytes,
        config: RecordingConfig,
        notify: Notify = log.warning,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.recorded = self.dropped = 0
        self.problem: str | None = None
        self._path, self._header, self._policy, self._config = path, header, policy, config
        self._notify, self._clock = notify, clock
        self._ticks = 0
        self._logged = False
        self._queue: queue.SimpleQueue[TickSample | tuple[str, float] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._file: _McapFile | None = None
        self._live: LiveView | None = None

    def __enter__(self) -> Self:
        from foxglove import Context  # noqa: PLC0415  (optional: extra `record`)

        with ExitStack() as undo:
            self._context = context = Context()  # channels close when their context goes
            if self._config.live_port is not None:
                self._live = start_live_view(context, self._config.live_host, self._config.live_port)
                undo.callback(self._live.stop)
            if self._path is not None:
                self._file = _McapFile(self._path, context, self._config.max_size_mb)
                undo.callback(self._file.close)
                self._file.attach_policy(self._policy)
            self._channels = Channels(context, self._header)
            self._channels.start(self._clock())
            undo.pop_all()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def tick(
        self,
        record: TickRecord,
        scan: LidarScan | None,
        state: VehicleState | None,
        sent: SafeCommand | None,
        sent_time_s: float,
        goal: CorridorVector,
        lateness_s: float = 0.0,
        deadline_misses: int = 0,
    ) -> None:
        """Take one tick, on the loop's thread. `record` as `Pilot.tick` gave it, `sent` what really went out at `sent_time_s`."""
        number = self._ticks
        self._ticks = number + 1
        if self._queue.qsize() >= QUEUE_TICKS:
            self.dropped += 1
            return
        self._queue.put(
            TickSample(number, record, scan, state, sent, sent_time_s, goal, lateness_s, deadline_misses, self.dropped)
        )

    def event(self, text: str) -> None:
        """Take one line about what happened. Any thread."""
        if self._queue.qsize() < 2 * QUEUE_TICKS:
            self._queue.put((text, self._clock()))

    def close(self) -> None:
        """Write what is queued, end the file, stop the live view; gives up on a disk that does not answer. Idempotent."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join(CLOSE_S)
            if self._thread.is_alive():
                self._complain(f"recording incomplete: the disk did not take the rest within {CLOSE_S:g} s")
        live, self._live = self._live, None
        if live is not None:
            live.stop()

    @property
    def summary(self) -> RecordingSummary:
        """What became of it; complete after `close`."""
        file = self._path.name if self._path is not None and self._path.exists() else None
        return RecordingSummary(file, self.recorded, self.dropped, self.problem)

    # -- the writer's thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            try:
                item = self._queue.get(timeout=FLUSH_EVERY_S)
            except queue.Empty:
                self._keep_safe()
                continue
            if item is None:
                break
            self._write(item)
            self._keep_safe()
        self._end_file(None)
        if self._ticks == 0 and self._path is not None:
            self._path.unlink(missing_ok=True)  # nothing was flown

    def _write(self, item: TickSample | tuple[str, float]) -> None:
        """One tick or event into all channels. What cannot be written is lost alone, counted and said once."""
        try:
            if isinstance(item, TickSample):
                self._channels.sample(item)
                self.recorded += self._file is not None
            else:
                self._channels.event(*item)
            self._logged = True
        except Exception as error:  # noqa: BLE001  foxglove-sdk documents no exceptions; none may end the thread
            self.dropped += isinstance(item, TickSample)
            self._complain(f"recording incomplete: {_one_line(error)}")

    def _keep_safe(self) -> None:
        """Every `FLUSH_EVERY_S`: end the chunk, let the disk keep it, look at size and space."""
        file = self._file
        if file is None or not file.due(self._clock()):
            return
        try:
            problem = file.keep(self._logged)
        except Exception as error:  # noqa: BLE001  as above
            problem = _one_line(error)
        self._logged = False
        if problem is not None:
            self._end_file(problem)

    def _end_file(self, problem: str | None) -> None:
        """Close the file, with its index if that is still possible."""
        file, self._file = self._file, None
        try:
            if file is not None:
                file.close()
        except Exception as error:  # noqa: BLE001  as above
            problem = problem or _one_line(error)
        if problem is not None:
            self._complain(f"recording stopped: {problem}")

    def _complain(self, problem: str) -> None:
        """Say the first problem; the summary keeps it."""
        if self.problem is None:
            self.problem = problem
            self._notify(problem)


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


class _McapFile:
    """One MCAP file that is worth something at any moment. Raises `OSError` and what foxglove-sdk raises."""

    def __init__(self, path: Path, context: Any, max_size_mb: float) -> None:
        import foxglove  # noqa: PLC0415
        from foxglove.mcap import MCAPWriteOptions  # noqa: PLC0415

        options = MCAPWriteOptions(chunk_size=CHUNK_BYTES, compression_threads=0, profile="lstm_pilot")
        self._writer = foxglove.open_mcap(str(path), context=context, writer_options=options)
        self._descriptor = os.open(path, os.O_RDONLY)
        self._path = path
        self._max_bytes = max_size_mb * 1e6
        self._size = 0
        self._kept_s = -math.inf
        self._closed = False

    def attach_policy(self, data: bytes) -> None:
        """Keep the policy file in the recording."""
        now_ns = time.time_ns()
        self._writer.attach(
            log_time=now_ns, create_time=now_ns, name=POLICY_ATTACHMENT, media_type="application/octet-stream", data=data
        )

    def due(self, now_s: float) -> bool:
        """Whether it is time for `keep`."""
        if now_s - self._kept_s < FLUSH_EVERY_S:
            return False
        self._kept_s = now_s
        return True

    def keep(self, grown: bool) -> str | None:
        """End the chunk and wait for the disk to have it. `grown`: something was logged since. A reason to end, or None."""
        self._writer.flush()
        os.fsync(self._descriptor)
        before, size = self._size, os.fstat(self._descriptor).st_size
        self._size = size
        if size == before and grown:
            return "foxglove-sdk writes nothing"
        if size >= self._max_bytes:
            return f"{self._path.name} has reached recording.max_size_mb ({size / 1e6:.0f} MB)"
        space = os.fstatvfs(self._descriptor)
        if space.f_bavail * space.f_frsize < MIN_FREE_BYTES:
            return f"less than {MIN_FREE_BYTES // 2**20} MiB free on the disk; delete old runs"
        return None

    def close(self) -> None:
        """Write the index and end the file. Idempotent."""
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.close()
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)
