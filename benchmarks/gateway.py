"""How fast the simulator is, in processor time of one core, and whether its memory stays flat.

A vehicle with autopilot and LiDAR (180 beams, 20 Hz) flies OFFBOARD in lockstep, with internal dynamics and with JSBSim; 20
vehicles fly with all their telemetry; one is flown over PX4's simulator interface; one flies for a simulated hour. Speeds are
simulated seconds per second of processor time: the wall clock of a shared machine says little. Takes some minutes, most of them
for the hour.
"""

from __future__ import annotations

import json as json_module
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks._gateway_flight import WORLD, fleet, fly, single
from benchmarks.memory import slope_mib_h
from sim_gateway.px4_gateway import Px4Config, Px4Gateway, warm_up
from sim_gateway.simulation import Simulation
from sim_gateway.vehicle import STEP_S

ROOT = Path(__file__).resolve().parent.parent
SPEED_TARGETS = {"internal": 200.0, "jsbsim": 30.0}
SPEED_SPAN_S, ROUNDS = 30.0, 5
VEHICLES, FLEET_SPAN_S, FLEET_SHARE = 20, 5.0, 1.0
SLOPE_MIB_H = 5.0
"""Allowed growth over an hour: the vehicle's own log of the flight (2.3 MiB, ends at 4) and the allocator's rounding."""
RESET_MS, RESETS = 10.0, 20
DEADLINE_S = 3600.0
PX4_SPAN_S, PX4_SPEED, PX4_STEP_S = 20.0, 8.0, 200e-6
"""How fast a real PX4 and its simulator have to be together, and what PX4 itself was seen to take for a step."""

Figure = dict[str, Any]


def run(json: bool, minutes: float = 60.0) -> list[Figure]:
    """Speeds to real time, share of a core of 20 vehicles, reset in ms, memory and its slope."""
    figures = speed_figures()
    figures += [fleet_figure(), px4_figure()]
    figures += [reset_figure(name) for name in SPEED_TARGETS]
    return [*figures, *memory_figures(minutes)]


def speed_figures() -> list[Figure]:
    """Real-time factors, medians of rounds in which the dynamics take turns."""
    vehicles = {name: single(name) for name in SPEED_TARGETS}
    taken: dict[str, list[float]] = {name: [] for name in vehicles}
    for _ in range(ROUNDS):
        for name, vehicle in vehicles.items():
            seconds = _processor_s(lambda v=vehicle: fly([v], v.advance, SPEED_SPAN_S, v.simulation.scan))
            taken[name].append(SPEED_SPAN_S / seconds)
    middle = {name: sorted(factors)[ROUNDS // 2] for name, factors in taken.items()}
    return [
        _figure(f"vehicle, autopilot and LiDAR, {name} dynamics", middle[name], "x real time", target, at_least=True)
        for name, target in SPEED_TARGETS.items()
    ]


def fleet_figure() -> Figure:
    """Processor seconds per simulated second of 20 vehicles with both MAVLink links and the LiDAR device."""
    with fleet(VEHICLES) as (vehicles, advance):
        seconds = _processor_s(lambda: fly(vehicles, advance, FLEET_SPAN_S, lambda: None))
    return _figure(f"{VEHICLES} vehicles with full telemetry", seconds / FLEET_SPAN_S, "cores", FLEET_SHARE)


def px4_figure() -> Figure:
    """The simulator's part of the lockstep with PX4: physics, sensors, LiDAR and wire. What it may take leaves PX4 its own."""
    config = Px4Config(address="tcp:0", speed=0.0, lidar_port=0, max_time_s=PX4_SPAN_S)
    warm_up(WORLD)
    with Px4Gateway(WORLD, config) as gateway:
        port = gateway.ready_message()["px4"].removeprefix("tcp:")
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        stand_in = subprocess.Popen([sys.executable, "-m", "benchmarks._px4_echo", port], cwd=ROOT, env=environment)
        seconds = _processor_s(lambda: gateway.run(threading.Event()))
    stand_in.wait(10.0)
    target = 1.0 / (1.0 / PX4_SPEED - PX4_STEP_S / STEP_S)
    return _figure(
        "simulator of a real PX4, its part of the lockstep", PX4_SPAN_S / seconds, "x real time", target, at_least=True
    )


def reset_figure(dynamics: str) -> Figure:
    """A new simulation in the same world, ready to step."""
    times = sorted(_processor_s(lambda: Simulation(WORLD, hover_height_m=2.0, dynamics=dynamics)) for _ in range(RESETS))
    return _figure(f"reset, {dynamics} dynamics", 1e3 * times[RESETS // 2], "ms", RESET_MS)


def memory_figures(minutes: float) -> list[Figure]:
    """Resident memory of a process that flies one vehicle with all its links, and its slope."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "benchmarks._gateway_flight", str(minutes)]
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, timeout=DEADLINE_S, check=True)
    resident: list[float] = json_module.loads(done.stdout)
    name = f"one vehicle over {minutes:g} simulated minutes"
    ratio = resident[-1] / resident[0]
    return [
        _figure(f"{name}: slope after a sixth", slope_mib_h(resident, minutes), "MiB/h", SLOPE_MIB_H),
        {"name": f"{name}: resident", "value": resident[-1], "unit": "MiB", "peer": resident[0], "ratio": ratio},
    ]


def _processor_s(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


def _figure(name: str, value: float, unit: str, limit: float, *, at_least: bool = False) -> Figure:
    ok = value >= limit if at_least else value <= limit
    target = f"{'>=' if at_least else '<='} {limit:g}"
    return {"name": name, "value": value, "unit": unit, "peer": limit, "ratio": value / limit, "target": target, "ok": ok}
