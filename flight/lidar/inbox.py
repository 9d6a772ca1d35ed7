"""A letter box of one: messages put in by another thread, the newest wins, one sender only."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

OWNER_TIMEOUT_S = 2.0
"""A sender silent for this long gives its place to another."""


@dataclass(frozen=True, slots=True)
class Letter:
    """A message and when it arrived, monotonic s."""

    text: str
    arrived_s: float


class Inbox:
    """Never blocks the sender and never grows. The first sender keeps the box: what a second one sends is counted, not taken."""

    def __init__(self) -> None:
        self.refused = 0
        self._fresh = threading.Condition()
        self._letter: Letter | None = None
        self._owner: object = None
        self._owner_s = -math.inf

    def put(self, text: str, arrived_s: float, sender: object = None) -> bool:
        """Whether the message was taken. `sender`: anything that tells senders apart (system and component id)."""
        with self._fresh:
            if sender != self._owner and arrived_s - self._owner_s < OWNER_TIMEOUT_S:
                self.refused += 1
                return False
            self._owner, self._owner_s = sender, arrived_s
            self._letter = Letter(text, arrived_s)
            self._fresh.notify_all()
        return True

    def wait(self, timeout_s: float) -> bool:
        """Whether a message lies in the box within `timeout_s`; it stays there."""
        with self._fresh:
            return self._fresh.wait_for(lambda: self._letter is not None, timeout_s)

    def take(self, timeout_s: float) -> Letter | None:
        """The newest message not taken before, or None if none comes within `timeout_s`."""
        with self._fresh:
            self._fresh.wait_for(lambda: self._letter is not None, timeout_s)
            letter, self._letter = self._letter, None
            return letter
