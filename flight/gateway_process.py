"""`sim-gateway` as a child process: started for `vehicle.connection: sim`, stopped when the flight is over.

The gateway is another program (another installation may hold it); all that is known here is its command line, the JSON
line it prints when ready and the report file it writes.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flight.errors import GatewayError

MAX_READY_LINE = 4 * 1024 * 1024
MAX_REPORT_BYTES = 256 * 1024 * 1024
STOP_DEADLINE_S = 10.0
ERROR_PREFIX = "sim-gateway: "
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class GatewayReady:
    """What the gateway said when it was ready: its world in the corridor frame (m, rad), ports and dynamics.

    `boxes`: (xmin, ymin, zmin, xmax, ymax, zmax) at time 0.
    """

    start: tuple[float, float, float]
    start_yaw_rad: float
    goal: tuple[float, float, float]
    boxes: tuple[Box, ...]
    lidar_port: int
    onboard_port: int
    details: Mapping[str, Any] = field(default_factory=dict)


class GatewayProcess:
    """A running gateway. Context manager: leaving it stops the child (SIGTERM, then SIGKILL) and reaps it."""

    def __init__(self, arguments: list[str], report: Path) -> None:
        self.report_path = report
        self._command = [sys.executable, "-m", "sim_gateway", *arguments, "--report", str(report), "--quit-with-parent"]
        self._child: subprocess.Popen[bytes] | None = None
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (lives as long as this object)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def start(self, timeout_s: float, keep_waiting: Callable[[], None] | None = None) -> GatewayReady:
        """Start the child and wait for its ready line. Raises `GatewayError` with the gateway's own last words."""
        try:
            self._child = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,  # its end tells the gateway that we are gone, however we went
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
                start_new_session=True,  # Ctrl-C in the terminal is for `fly`, which lands before it stops the simulator
            )
        except OSError as error:
            raise GatewayError(f"cannot start sim-gateway: {error.strerror}") from None
        line = self._read_ready_line(time.monotonic() + timeout_s, keep_waiting)
        if line is None:
            raise GatewayError(f"sim-gateway was not ready within {timeout_s:g} s{self._last_words()}; see `sim-gateway --help`")
        return parse_ready_line(line)

    def stop(self) -> None:
        """Ask the child to write its report and end; kill it after 10 s. Idempotent."""
        child, self._child = self._child, None
        if child is None:
            return
        child.terminate()
        if child.stdin is not None:
            child.stdin.close()
        try:
            child.wait(STOP_DEADLINE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait(STOP_DEADLINE_S)
        if child.stdout is not None:
            child.stdout.close()

    @property
    def running(self) -> bool:
        """Whether the child is alive."""
        return self._child is not None and self._child.poll() is None

    def report(self) -> dict[str, Any]:
        """The report of the flight (truth trajectory, contacts, clearance); empty when the gateway left none."""
        try:
            if self.report_path.stat().st_size > MAX_REPORT_BYTES:
                return {}
            content = json.loads(self.report_path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def _read_ready_line(self, deadline: float, keep_waiting: Callable[[], None] | None) -> bytes | None:
        child = self._child
        if child is None or child.stdout is None:
            return None
        line = b""
        with selectors.DefaultSelector() as selector:
            selector.register(child.stdout, selectors.EVENT_READ)
            while time.monotonic() < deadline and len(line) < MAX_READY_LINE:
                if keep_waiting is not None:
                    keep_waiting()
                if not selector.select(timeout=0.1):
                    continue
                chunk = os.read(child.stdout.fileno(), 65536)
                line += chunk
                if b"\n" in line:
                    return line.split(b"\n", 1)[0]
                if not chunk:
                    child.wait(STOP_DEADLINE_S)
                    raise GatewayError(f"sim-gateway did not start{self._last_words()}")
        return None

    def _last_words(self) -> str:
        """The gateway's own error line on standard error, else the last line there."""
        with contextlib.suppress(OSError):
            self._stderr.seek(0, os.SEEK_END)
            self._stderr.seek(max(0, self._stderr.tell() - 4096))
            lines = self._stderr.read().decode("utf-8", "replace").strip().splitlines()
            own = [line.removeprefix(ERROR_PREFIX) for line in lines if line.startswith(ERROR_PREFIX)]
            if lines:
                return f": {(own or lines)[-1].strip()[:300]}"
        return ""


def parse_ready_line(line: bytes) -> GatewayReady:
    """The JSON line of a ready gateway. Raises `GatewayError` when a field is missing or not finite."""
    try:
        data = json.loads(line)
        return GatewayReady(
            start=_point(data["start"]),
            start_yaw_rad=float(_finite([data["start_yaw_rad"]], 1)[0]),
            goal=_point(data["goal"]),
            boxes=tuple(map(_box, data["boxes"])),
            lidar_port=int(data["lidar_port"]),
            onboard_port=int(data["onboard_port"]),
            details=data,
        )
    except (ValueError, KeyError, TypeError) as error:
        raise GatewayError(
            f"sim-gateway's ready line cannot be read ({error!r}); are gateway and fly of the same version?"
        ) from None


def _point(values: Any) -> tuple[float, float, float]:
    x, y, z = _finite(values, 3)
    return x, y, z


def _box(values: Any) -> Box:
    x_min, y_min, z_min, x_max, y_max, z_max = _finite(values, 6)
    return x_min, y_min, z_min, x_max, y_max, z_max


def _finite(values: Any, count: int) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in values)
    if len(numbers) != count or not all(math.isfinite(value) for value in numbers):
        raise ValueError(f"expected {count} finite numbers, got {values!r}")
    return numbers
