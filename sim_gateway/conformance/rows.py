"""One row of the conformance table, how values are compared, and every tolerance with its reason."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# Rates: the recording counted messages for 15 s of wall time, so one message more or less is no difference.
RATE_SHARE, RATE_HZ = 0.05, 0.08
# Mode changes and texts: recorded to some 0.1 s (setpoints at 20 Hz, checks of PX4 at 10 Hz, a busy machine).
EVENT_S = 0.15
# Takeoff and landing: the recorded altitude estimate is off by up to 0.5 m, at 0.7 m/s of landing speed.
LANDING_S = 1.0
# Start-up: wall time of a process start on a shared machine.
START_UP_S = 0.2
# Speeds and distances: the recorded estimate scatters by 0.15 to 0.3 m/s rms, with a correlation time of 2 to 4 s.
SPEED_M_S, DISTANCE_M = 0.35, 0.6
# Yaw after 4 s of turning.
YAW_RAD = 0.12
# Battery: the charge was recorded in steps of 0.2 s, with a gap of 0.36 s in the stream just when it was low.
BATTERY_S = 0.45


@dataclass(frozen=True, slots=True)
class Row:
    """`reason`: why it differs on purpose; empty where it is the same, or differs without one."""

    group: str
    case: str
    recorded: str
    gateway: str
    same: bool
    reason: str = ""


class Table:
    """Collects the rows of one group. `reasons`: case prefix to why the gateway differs on purpose."""

    def __init__(self, group: str, reasons: dict[str, str] | None = None) -> None:
        self.group, self._reasons = group, reasons or {}
        self.rows: list[Row] = []

    def equal(self, case: str, recorded: object, gateway: object) -> None:
        """The two must be equal."""
        self.add(case, str(recorded), str(gateway), recorded == gateway)

    def within(self, case: str, recorded: Sequence[float], gateway: float | None, margin: float) -> None:
        """The gateway's value must lie in the recorded range, widened by `margin` on both sides."""
        low, high = min(recorded), max(recorded)
        shown = "never" if gateway is None else f"{gateway:.2f}"
        same = gateway is not None and low - margin <= gateway <= high + margin
        self.add(case, f"{low:.2f} .. {high:.2f}", shown, same)

    def add(self, case: str, recorded: str, gateway: str, same: bool) -> None:
        """One row."""
        reason = "" if same else next((why for start, why in self._reasons.items() if case.startswith(start)), "")
        self.rows.append(Row(self.group, case, recorded, gateway, same, reason))


def numbers_hidden(texts: Iterable[str]) -> list[str]:
    """Texts with `#` for numbers (altitudes depend on where the flight was), without the logger's file names.

    The recorder cut off blanks at the end of a piece.
    """
    return [re.sub(r"\d+", "#", text).rstrip() for text in texts if not text.startswith("[logger]")]


def same_share(rows: Sequence[Row]) -> float:
    """Share of rows that are the same; 1 for none."""
    return sum(row.same for row in rows) / len(rows) if rows else 1.0
