"""PX4's own log (.ulg), fetched over MAVLink after landing. Slow (a telemetry link takes minutes), so only on request.

Nothing here can fail a flight: whatever the vehicle does, one line says what came of it, in bounded time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

LIST_DEADLINE_S = 15.0
DOWNLOAD_DEADLINE_S = 600.0
STALL_S = 20.0
MAX_BYTES = 2 * 1024**3
CANCEL_S = 2.0
POLL_S = 0.05
FILE_NAME = "px4.ulg"


class StopRequest(Protocol):
    """Something that may ask to stop (`flight.interrupt.Interrupt`); `count` grows with every signal."""

    count: int


@dataclass
class _Answer:
    """The progress of one asynchronous call, written on MAVSDK's thread."""

    done: threading.Event = field(default_factory=threading.Event)
    result: str = "NO_ANSWER"
    entries: list[Any] = field(default_factory=list)
    heard_s: float = field(default_factory=time.monotonic)

    def on_entries(self, result: Any, entries: Any, _user_data: Any = None) -> None:
        """The list of logs."""
        self.result, self.entries = result.name, list(entries or ())
        self.done.set()

    def on_progress(self, result: Any, _progress: Any, _user_data: Any = None) -> None:
        """A piece of the log, or its end."""
        self.heard_s = time.monotonic()
        if result.name != "NEXT":
            self.result = result.name
            self.done.set()


def fetch_px4_log(system: Any, folder: Path, stop: StopRequest, list_deadline_s: float = LIST_DEADLINE_S) -> str:
    """Fetch the newest log of MAVSDK's `system` into `folder`; returns one line about what came of it. Never raises.

    Another signal (Ctrl-C) ends the waiting.
    """
    from mavsdk import MavsdkError  # noqa: PLC0415  (loads a 30 MB library)
    from mavsdk.plugins.log_files import LogFiles  # noqa: PLC0415

    try:
        return _fetch(LogFiles(system), folder / FILE_NAME, stop, list_deadline_s)
    except (MavsdkError, RuntimeError, OSError) as error:
        return f"no PX4 log: {' '.join(str(error).split())}"


def _fetch(plugin: Any, target: Path, stop: StopRequest, list_deadline_s: float) -> str:
    signals = stop.count
    listing = _Answer()
    plugin.get_entries_async(listing.on_entries)
    _wait(listing.done, lambda: stop.count > signals, list_deadline_s)
    if not listing.done.is_set() or listing.result == "TIMEOUT":
        return f"no PX4 log: the vehicle did not list its logs (asked for at most {list_deadline_s:g} s)"
    if listing.result != "SUCCESS" or not listing.entries:
        return f"no PX4 log: the vehicle has none to give ({listing.result.lower().replace('_', ' ')})"
    newest = max(listing.entries, key=lambda entry: int(entry.id))
    if not 0 < int(newest.size_bytes) <= MAX_BYTES:
        return f"no PX4 log: the newest has {newest.size_bytes} bytes; copy it from the vehicle's card"
    return _download(plugin, newest, target, lambda: stop.count > signals)


def _download(plugin: Any, entry: Any, target: Path, stopped: Callable[[], bool]) -> str:
    answer = _Answer()
    plugin.download_log_file_async(entry, str(target), answer.on_progress)
    _wait(answer.done, lambda: stopped() or time.monotonic() - answer.heard_s > STALL_S, DOWNLOAD_DEADLINE_S)
    if answer.done.is_set() and answer.result == "SUCCESS":
        return f"PX4 log: {target} ({entry.size_bytes} bytes)"
    if not answer.done.is_set():
        plugin.cancel_download_log_file()
        answer.done.wait(CANCEL_S)  # MAVSDK calls back once more: after the plugin is gone that would be into freed memory
        answer.result = "stopped by a signal" if stopped() else "too slow"
    target.unlink(missing_ok=True)
    return f"no PX4 log: download failed ({answer.result.lower().replace('_', ' ')}); copy it from the vehicle's card"


def _wait(done: threading.Event, given_up: Callable[[], bool], timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while not done.wait(POLL_S):
        if given_up() or time.monotonic() > deadline:
            return
