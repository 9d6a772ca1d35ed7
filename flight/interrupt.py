"""SIGINT and SIGTERM as a request to land: never an exception in the middle of a flight."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any, Self


class Interrupted(Exception):  # noqa: N818  (a request, not an error)
    """The user asked to stop. Raised only by `Interrupt.check`, where stopping is safe."""


class Interrupt:
    """Catches SIGINT and SIGTERM while it is entered; further signals only raise `count`.

    `notify` is called once, on the first signal, from the main thread.
    """

    def __init__(self, notify: Callable[[str], None] | None = None) -> None:
        self.name: str | None = None
        self.count = 0
        self._notify = notify
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        self.count += 1
        if self.name is None:
            self.name = signal.Signals(number).name
            if self._notify is not None:
                self._notify(self.name)

    @property
    def requested(self) -> bool:
        """Whether a signal has come."""
        return self.name is not None

    def check(self) -> None:
        """Raise `Interrupted` when a signal has come."""
        if self.requested:
            raise Interrupted(self.name)
