"""What a driver's thread needs of a device: open it, take its scans, let it go. One object per connection."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from flight.lidar.config import LidarSource
from flight.lidar.inbox import Inbox
from flight.lidar.motion import BodyMotion
from safety.messages import LidarScan

POLL_S = 0.1
"""Longest single wait: a driver asked to stop does so within this time."""


class NoMoreScansError(Exception):
    """The source has come to its end and will not give another scan."""


@dataclass(frozen=True, slots=True)
class Host:
    """What a session is given. `now`: monotonic seconds. `count_bad`: (wrong checksums, wrong frames) to be added.

    `inbox`: messages fed from outside. `motion`: the vehicle's own motion now, if it is known.
    """

    config: LidarSource
    now: Callable[[], float]
    stop: threading.Event
    count_bad: Callable[[int, int], None]
    inbox: Inbox
    motion: Callable[[], BodyMotion | None]


class Session(Protocol):
    """One connection. A broken link, protocol or clock ends it with an error of `driver.BREAKS`."""

    @property
    def clock_uncertainty_s(self) -> float:
        """How well the device's clock is known; infinite where it has none or cannot be asked."""
        ...

    @property
    def clock_drift_s(self) -> float:
        """How far the device's clock has moved against ours."""
        ...

    def open(self) -> str:
        """Handshake; what the device says it is."""
        ...

    def scans(self) -> Iterator[LidarScan]:
        """Scans with strictly increasing times until the driver stops."""
        ...

    def quit(self) -> None:
        """Silence the device."""
        ...

    def close(self) -> None:
        """Let the link go; idempotent."""
        ...
