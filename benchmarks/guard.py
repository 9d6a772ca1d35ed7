"""What the guard costs: the way of a setpoint to the vehicle and of a sample back, each next to MAVSDK without a guard.

The peer is what `fly` did before there was a guard: one-shot messages through MAVSDK's direct-message plugin on the same wire.
Also the guard's start and its memory. Takes about 40 seconds.
"""

from __future__ import annotations

import json as json_module
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flight.guard.client import SetpointGuard
from flight.realtime import RealTimeConfig, real_time

ROOT = Path(__file__).resolve().parent.parent
FLIGHT_S = 15.0
PERIOD_S = 0.03
STEP_M_S = 0.001
"""Each setpoint is told from the others by its velocity to the east."""

PRIORITY = 51
MAX_GROWTH_MS = 1.0
MAX_START_MS, MAX_MEMORY_MB = 100.0, 20.0

Figure = dict[str, Any]
Send = Callable[[float], None]


def run(json: bool) -> list[Figure]:
    """Medians and p99 in ms with the guard, next to those without; its start in ms, its memory in MB."""
    guarded, direct = _ways(guarded=True), _ways(guarded=False)
    figures = []
    for name in ("setpoint to the vehicle", "sample to fly"):
        for label, percent in (("p50", 50.0), ("p99", 99.0)):
            value, peer = (float(np.percentile(ways[name], percent)) for ways in (guarded, direct))
            limit = {"target": f"+{MAX_GROWTH_MS:g} ms", "ok": value - peer <= MAX_GROWTH_MS} if label == "p50" else {}
            figures.append(_figure(f"{name} {label}", value, "ms", peer) | limit)
    start_ms, memory_mb = _start_and_memory()
    start = _figure("start until the wire is open, processor time", start_ms, "ms", None)
    memory = _figure("peak memory", memory_mb, "MB", None)
    return [
        *figures,
        start | {"target": MAX_START_MS, "ok": start_ms <= MAX_START_MS},
        memory | {"target": MAX_MEMORY_MB, "ok": memory_mb <= MAX_MEMORY_MB},
    ]


def _figure(name: str, value: float, unit: str, peer: float | None) -> Figure:
    ratio = value / peer if peer else None
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio, "target": None, "ok": None}


def _ways(*, guarded: bool) -> dict[str, NDArray[np.float64]]:
    """Durations in ms of all setpoints and samples of one connection."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    command = [sys.executable, "-m", "benchmarks._fake_vehicle", str(port), str(FLIGHT_S)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with ExitStack() as stack:
        vehicle = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
        stack.callback(vehicle.kill)
        sent, heard = _fly(stack, port, vehicle, guarded=guarded)
        output, _ = vehicle.communicate(timeout=2.0 * FLIGHT_S)
    record = json_module.loads(output)
    there = [arrived_s - sent[number] for east, arrived_s in record["setpoints"] if (number := round(east / STEP_M_S)) in sent]
    back = [heard[int(number)] - left_s for number, left_s in record["attitudes"] if int(number) in heard]
    return {"setpoint to the vehicle": 1e3 * np.array(there), "sample to fly": 1e3 * np.array(back)}


def _fly(
    stack: ExitStack, port: int, vehicle: subprocess.Popen[str], *, guarded: bool
) -> tuple[dict[int, float], dict[int, float]]:
    """Send setpoints for as long as the vehicle lives; when each left, and when each sample was there."""
    from mavsdk import Configuration, Mavsdk
    from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage

    url, guard = f"udpin://127.0.0.1:{port}", SetpointGuard(f"udpin://127.0.0.1:{port}", PRIORITY)
    if guarded:
        stack.enter_context(guard)
        guard.start(10.0)
        url = guard.relay_url
    mavsdk = Mavsdk(Configuration.create_manual(245, 191, True))
    stack.callback(mavsdk.destroy)
    mavsdk.add_any_connection(url)
    system = mavsdk.first_autopilot(FLIGHT_S)
    if system is None:
        raise RuntimeError(f"no heartbeat through {url}")
    direct = MavlinkDirect(system)
    heard: dict[int, float] = {}

    def on_attitude(message: Any, _user_data: Any) -> None:
        heard.setdefault(int(json_module.loads(message.fields_json)["time_boot_ms"]), time.monotonic())

    direct.subscribe_message("ATTITUDE", on_attitude)

    def send_directly(east: float) -> None:
        fields = {
            "target_system": 1,
            "target_component": 1,
            "coordinate_frame": 1,
            "type_mask": 0x5C7,
            "vy": east,
            "yaw_rate": 0.0,
        }
        fields |= dict.fromkeys(("time_boot_ms", "x", "y", "z", "vx", "vz", "afx", "afy", "afz", "yaw"), 0)
        direct.send_message(MavlinkMessage("SET_POSITION_TARGET_LOCAL_NED", 0, 0, 1, 1, json_module.dumps(fields)))

    def send_to_guard(east: float) -> None:
        guard.command((0.0, east, 0.0, 0.0), time.monotonic())

    if guarded:
        guard.engage((1, 1))
    return _stream(send_to_guard if guarded else send_directly, vehicle), heard


def _stream(send: Send, vehicle: subprocess.Popen[str]) -> dict[int, float]:
    sent: dict[int, float] = {}
    with real_time(RealTimeConfig(), lambda text: print(text, file=sys.stderr)):
        while vehicle.poll() is None:
            number = len(sent) + 1
            sent[number] = time.monotonic()
            send(number * STEP_M_S)
            time.sleep(PERIOD_S)
    return sent


def _start_and_memory() -> tuple[float, float]:
    """Processor time of a start, ms, the least of five (elapsed time would be the machine's); peak resident memory, MB."""
    starts = []
    for _ in range(5):
        with SetpointGuard("udpin://127.0.0.1:0") as guard:
            guard.start(10.0)
            starts.append(1e-6 * int(Path(f"/proc/{guard.pid}/schedstat").read_text().split()[0]))
            status = Path(f"/proc/{guard.pid}/status").read_text()
    peak_kb = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    return min(starts), peak_kb / 1024.0
