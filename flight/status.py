"""What the person at the terminal sees: phases as lines, the flight as one live line, checks as a table.

All drawing happens on one thread of its own. The flight only leaves things here and never waits for the terminal: output
that is stopped (Ctrl-S, a full pipe) must not stop the setpoint stream.
"""

from __future__ import annotations

import math
import queue
import sys
import threading
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from flight.preflight import Check, Level
from flight.tick import TickRecord

LIVE_EVERY_S = 0.25
PLAIN_LINE_EVERY_S = 2.0
DRAIN_S = 2.0
_STYLES = {Level.PASS: "green", Level.WARN: "yellow", Level.FAIL: "bold red"}


class Status:
    """Live status on a terminal, plain lines elsewhere. Context manager; methods may be called from any thread or signal.

    With `machine_output` everything goes to standard error, because standard output belongs to the JSON result.
    """

    def __init__(self, machine_output: bool = False, console: Console | None = None) -> None:
        self._console = console or Console(file=sys.stderr if machine_output else sys.stdout, highlight=False)
        self._lines: queue.SimpleQueue[RenderableType] = queue.SimpleQueue()
        self._record: TickRecord | None = None
        self._started_s = math.nan
        self._misses = 0
        self._flying = False
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._flying, self._closing = False, True
        self._thread.join(DRAIN_S)

    def phase(self, text: str) -> None:
        """A new phase or event, one line."""
        self._lines.put(Text(text))

    def checks(self, checks: Sequence[Check]) -> None:
        """The preflight table."""
        table = Table("check", "", "seen", "what to do", title="preflight", title_justify="left", box=None, pad_edge=False)
        for check in checks:
            table.add_row(check.name, Text(check.level.value, _STYLES[check.level]), Text(check.seen), Text(check.advice))
        self._lines.put(table)

    def publish(self, record: TickRecord, deadline_misses: int) -> None:
        """The newest tick. Called by the loop: stores two references, draws nothing."""
        self._record, self._misses = record, deadline_misses

    def start_live(self, started_s: float) -> None:
        """Begin to show the flight. `started_s`: its start on the records' clock."""
        self._started_s, self._flying = started_s, True

    def stop_live(self) -> None:
        """End the live line, leaving its last state on the screen. Does not wait."""
        self._flying = False

    def _run(self) -> None:
        while not self._closing or not self._lines.empty():
            if self._flying and self._console.is_terminal:
                self._show_live()
            elif self._flying:
                self._show_plain()
            else:
                self._print_lines(LIVE_EVERY_S)

    def _print_lines(self, wait_s: float) -> None:
        """Print what is there; wait up to `wait_s` for something to come."""
        try:
            self._console.print(self._lines.get(timeout=wait_s), soft_wrap=True)
            while True:
                self._console.print(self._lines.get_nowait(), soft_wrap=True)
        except queue.Empty:
            return

    def _show_live(self) -> None:
        with Live(self._line(), console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
            while self._flying:
                self._print_lines(LIVE_EVERY_S)
                live.update(self._line(), refresh=True)

    def _show_plain(self) -> None:
        due_s = time.monotonic() + PLAIN_LINE_EVERY_S
        while self._flying:
            self._print_lines(LIVE_EVERY_S)
            if time.monotonic() >= due_s:
                self._console.print(self._line(), soft_wrap=True)
                due_s += PLAIN_LINE_EVERY_S

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
