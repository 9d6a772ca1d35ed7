"""The 20 Hz loop in flight: how late it wakes and how long a scan takes to become a setpoint, on an idle and a busy machine.

`fly` flies a simulated mission of a minute with all that belongs to it (MAVSDK link, LiDAR driver, policy, safety filter, log,
recording). In the same minute a process of its own runs the least a loop can be, an absolute-time sleep under the same real-time
settings: its p99 is the measure. Once with nothing else, once with a busy process on every core. The simulator stands for
hardware, so it gets real-time priority as well: a LiDAR does not slow down because the computer is busy.

Steal (the host taking the processor away) is a figure too: no loop can do anything about it. Takes about four minutes.
"""

from __future__ import annotations

import csv
import json as json_module
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
FLIGHT_S = 60.0
AROUND_S = 25.0
"""Start, takeoff and landing, at the most, besides the flight."""
DEADLINE_S = 400.0
P99_RATIO = 1.5
"""The flight's p99 may be at most this many times the bare loop's."""
P99_SLACK_MS = 0.05
"""Added to the limit: what the clock and some 1200 samples leave open on a quiet machine."""
RATE_TOLERANCE = 0.005
GATEWAY_PRIORITY = 40

Figure = dict[str, Any]
Samples = dict[str, NDArray[np.float64]]


def run(json: bool) -> list[Figure]:
    """Wake-up lateness p50, p99, p99.9, max and scan to setpoint p50, p99, max, in ms, for both states of the machine."""
    figures: list[Figure] = []
    for name, busy in (("idle", 0), ("all cores loaded", os.cpu_count() or 1)):
        print(f"   a flight of {FLIGHT_S:g} s, machine {name}", file=sys.stderr, flush=True)
        before = _steal_ticks()
        with tempfile.TemporaryDirectory() as folder, _load(busy):
            flown, bare_ms = _fly_beside_bare_loop(Path(folder))
        figures += _figures(name, flown, bare_ms)
        steal_s = (_steal_ticks() - before) / os.sysconf("SC_CLK_TCK")
        figures.append(_figure(f"{name}: stolen by the host", steal_s, "s", None))
    return figures


# -- the flight and its peer --------------------------------------------------------------------------------------


def _fly_beside_bare_loop(folder: Path) -> tuple[Samples, NDArray[np.float64]]:
    """Timing of a flight's ticks, and the bare loop's latenesses in ms while it flew."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "flight", "--mission", str(_mission(folder)), "--out", str(folder / "run")]
    flight = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        _wait_for(flight, "the policy flies")
        _hardware_priority(flight.pid)
        bare = subprocess.run(
            [sys.executable, "-m", "benchmarks._bare_loop", str(FLIGHT_S - 5.0)],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
            timeout=2.0 * FLIGHT_S,
            check=True,
        )
        rest, _ = flight.communicate(timeout=AROUND_S + 2.0 * FLIGHT_S)
    finally:
        if flight.poll() is None:
            flight.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                flight.wait(AROUND_S)
            flight.kill()
    timing = folder / "run" / "timing.csv"
    if not timing.exists():
        raise RuntimeError(f"the flight left no timing: {rest.strip().splitlines()[-1:]}")
    return _timing(timing), np.array(json_module.loads(bare.stdout))


def _wait_for(flight: subprocess.Popen[str], text: str) -> None:
    """Read the flight's lines until one holds `text`."""
    deadline_s, seen = time.monotonic() + DEADLINE_S, ""
    while flight.stdout is not None and time.monotonic() < deadline_s and (line := flight.stdout.readline()):
        seen = line
        if text in line:
            return
    raise RuntimeError(f"the flight did not get as far as {text!r}: {seen.strip()}")


def _hardware_priority(flight: int) -> None:
    """Real-time priority for every thread of the simulator that `fly` has started, where it is permitted."""
    children = " ".join(path.read_text() for path in Path(f"/proc/{flight}/task").glob("*/children"))
    for child in children.split():
        if "sim_gateway" not in Path(f"/proc/{child}/cmdline").read_text():
            continue  # the guard has its own
        for thread in Path(f"/proc/{child}/task").glob("*"):
            with suppress(PermissionError, ProcessLookupError):
                os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(GATEWAY_PRIORITY))


def _mission(folder: Path) -> Path:
    """The shipped mission at a speed too slow to arrive: it flies until its time is up, with the safety filter at work."""
    text = (ROOT / "configs" / "corridor.yaml").read_text(encoding="utf-8")
    replaced = {
        "../policies/": f"{ROOT}/policies/",
        "worlds/": f"{ROOT}/configs/worlds/",
        "\nsafety:\n": "\nsafety:\n  max_horizontal_speed_m_s: 0.4\n",
        "port: 10940": f"port: {_free_port(socket.SOCK_STREAM)}",
        "flight_s: 180.0": f"flight_s: {FLIGHT_S}\n  stuck_s: 3600.0",
        "\nsim:\n": f"\nsim:\n  onboard_port: {_free_port(socket.SOCK_DGRAM)}\n  gcs_port: {_free_port(socket.SOCK_DGRAM)}\n",
    }
    for old, new in replaced.items():
        if text.count(old) != 1:
            raise RuntimeError(f"configs/corridor.yaml should hold {old!r} once")
        text = text.replace(old, new)
    path = folder / "mission.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _timing(path: Path) -> Samples:
    with path.open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


@contextmanager
def _load(processes: int) -> Iterator[None]:
    """So many busy processes of ordinary priority, for the length of the block."""
    command = [sys.executable, "-m", "benchmarks._bare_loop", "busy", str(DEADLINE_S)]
    children = [subprocess.Popen(command, cwd=ROOT) for _ in range(processes)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


# -- figures ------------------------------------------------------------------------------------------------------


def _figures(name: str, flown: Samples, bare_ms: NDArray[np.float64]) -> list[Figure]:
    lateness_ms, way_ms = flown["lateness_ms"], flown["scan_to_setpoint_ms"]
    figures = []
    for label, percent in (("p50", 50.0), ("p99", 99.0), ("p99.9", 99.9), ("max", 100.0)):
        value, peer = float(np.nanpercentile(lateness_ms, percent)), float(np.percentile(bare_ms, percent))
        figure = _figure(f"{name}: wake-up lateness {label}", value, "ms", peer)
        if label == "p99":
            figure |= {"target": P99_RATIO, "ok": value <= P99_RATIO * peer + P99_SLACK_MS}
        figures.append(figure)
    for label, percent in (("p50", 50.0), ("p99", 99.0), ("max", 100.0)):
        figures.append(_figure(f"{name}: scan to setpoint {label}", float(np.nanpercentile(way_ms, percent)), "ms", None))
    span_s = float(flown["time_s"][-1] - flown["time_s"][0])
    rate_hz = (flown["time_s"].size - 1) / span_s
    figures.append(
        _figure(f"{name}: mean rate", rate_hz, "Hz", 20.0)
        | {"target": f"within {RATE_TOLERANCE:.1%}", "ok": abs(rate_hz / 20.0 - 1.0) <= RATE_TOLERANCE}
    )
    return figures


def _figure(name: str, value: float, unit: str, peer: float | None) -> Figure:
    ratio = value / peer if peer else None
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio, "target": None, "ok": None}


def _steal_ticks() -> int:
    """Jiffies that the host took from this machine so far; 0 where /proc/stat is not there."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    except OSError:
        return 0
    return int(fields[8]) if len(fields) > 8 else 0
