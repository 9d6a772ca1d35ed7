"""What the person at the terminal sees: phases as lines, the flight as one live line, checks as a table.

All drawing happens on its own thread four times a second; the loop only leaves its newest record here.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from flight.preflight import Check, Level
from flight.tick import TickRecord

REFRESH_HZ = 4.0
PLAIN_LINE_EVERY_S = 2.0
_STYLES = {Level.PASS: "green", Level.WARN: "yellow", Level.FAIL: "bold red"}


class Status:
    """Live status on a terminal, plain lines elsewhere. Context manager; methods may be called from any thread.

    With `machine_output` everything goes to standard error, because standard output belongs to the JSON result.
    """

    def __init__(self, machine_output: bool = False, console: Console | None = None) -> None:
        self._console = console or Console(file=sys.stderr if machine_output else sys.stdout, highlight=False)
        self._record: TickRecord | None = None
        self._started_s = math.nan
        self._misses = 0
        self._flying = threading.Event()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop_live()

    def phase(self, text: str) -> None:
        """A new phase or event, one line."""
        self._console.print(Text(text), soft_wrap=True)

    def checks(self, checks: Sequence[Check]) -> None:
        """The preflight table."""
        table = Table("check", "", "seen", "what to do", title="preflight", title_justify="left", box=None, pad_edge=False)
        for check in checks:
            table.add_row(check.name, Text(check.level.value, _STYLES[check.level]), Text(check.seen), Text(check.advice))
        self._console.print(table)

    def publish(self, record: TickRecord, deadline_misses: int) -> None:
        """The newest tick. Called by the loop: stores two references, draws nothing."""
        self._record, self._misses = record, deadline_misses

    def start_live(self, started_s: float) -> None:
        """Begin to show the flight. `started_s`: its start on the records' clock."""
        self._started_s = started_s
        self._closing.clear()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)
        self._thread.start()

    def stop_live(self) -> None:
        """End the live line, leaving its last state on the screen. Idempotent."""
        self._closing.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(2.0)

    def _run(self) -> None:
        if not self._console.is_terminal:
            while not self._closing.wait(PLAIN_LINE_EVERY_S):
                self._console.print(self._line(), soft_wrap=True)
            return
        with Live(self._line(), console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
            while not self._closing.wait(1.0 / REFRESH_HZ):
                live.update(self._line(), refresh=True)

    def _line(self) -> Text:
        record = self._record
        if record is None or record.position is None or record.velocity is None:
            return Text("flying: no position yet")
        speed = math.hypot(record.velocity.x, record.velocity.y, record.velocity.z)
        rules = ", ".join(sorted({item.rule for item in record.verdict.interventions}))
        state, style = (
            ("BRAKING", "bold red") if record.verdict.braking else (("limited", "yellow") if rules else ("free", "green"))
        )
        line = Text(f"{record.now_s - self._started_s:6.1f} s  goal {record.distance_to_goal_m:5.2f} m  ")
        line.append(f"at ({record.position.x:5.2f}, {record.position.y:5.2f}, {record.position.z:4.2f})  {speed:4.2f} m/s  ")
        line.append(f"clear {record.verdict.clearance_m:4.2f} m  late ticks {self._misses}  ")
        line.append(state, style)
        return line.append(f" {rules}" if rules else "")
