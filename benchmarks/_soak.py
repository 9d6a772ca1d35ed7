"""The process whose memory is measured by `benchmarks.memory`: flight, safety and the policy runtime, nothing else.

`python -m benchmarks._soak POLICY INPUTS MINUTES FOLDER RECORD` flies the ticks as fast as it can, writes the results and prints
one JSON object. RECORD: 1 with the recorder on, as in flight; its chunks end by simulated time.
"""

from __future__ import annotations

import gc
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np

import flight.session  # noqa: F401  (everything that `fly` loads, the MAVSDK link included)
from flight.flight_log import FlightLog
from flight.rate_keeper import LatenessStatistics, RateStatistics
from flight.recorder import Recorder
from flight.recording_config import RecordingConfig
from flight.recording_schema import FlightHeader, this_machine
from flight.report import write_report
from flight.scan_log import write_scans
from flight.summary import build_summary, write_json_atomic
from flight.tick import Pilot, TickRecord
from flight.trajectory import write_timing_csv, write_trajectory_csv
from policy_export.runner import PolicyRunner
from safety.config import Fence, SafetyConfig
from safety.filter import SafetyFilter
from safety.frames import CorridorVector
from safety.messages import LidarScan, VehicleState

TICK_S = 0.05
GOAL = CorridorVector(31.0, 0.0, 2.0)
FENCE = Fence(min_m=(-0.5, -4.0, 0.5), max_m=(35.5, 4.0, 4.0))
FOREIGN = ("torch", "sim_gateway", "training", "campaigns", "numba", "pymavlink", "jsbsim", "gymnasium", "matplotlib")

Sample = tuple[LidarScan, VehicleState, float]


def samples(path: Path, ticks: int) -> Iterator[Sample]:
    """Scan, state and time of every tick; the recorded minute repeats."""
    with np.load(path, allow_pickle=False) as file:
        ranges, states = file["ranges_m"], file["states"]
    zero = CorridorVector(0.0, 0.0, 0.0)
    for k in range(ticks):
        now_s = 1000.0 + TICK_S * k
        x, y, z, vx, vy, vz, yaw = states[k % len(states)].tolist()
        position, velocity = CorridorVector(x, y, z), CorridorVector(vx, vy, vz)
        state = VehicleState(now_s - 0.01, position, velocity, zero, 0.0, 0.0, yaw, 0.0)
        seen = ranges[k % len(ranges)]
        yield LidarScan(now_s - 0.02, seen.copy(), -math.pi / 2, math.pi / (seen.size - 1), 0.1, 4.0, k), state, now_s


def resident_mib() -> float:
    """Resident memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def held() -> int:
    """File descriptors and threads of this process now."""
    return len(os.listdir("/proc/self/fd")) + len(os.listdir("/proc/self/task"))


def peak_mib() -> float:
    """Largest resident memory of this process so far."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024.0


def main() -> None:
    """Command line, for the benchmark only."""
    policy, inputs, minutes, folder = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), Path(sys.argv[4])
    record = sys.argv[5] == "1"
    folder.mkdir(parents=True)
    ticks = round(minutes * 60.0 / TICK_S)
    runner = PolicyRunner.load(policy, rate_hz=1.0 / TICK_S)
    pilot = Pilot(runner, SafetyFilter(SafetyConfig(fence=FENCE)), GOAL, 0.2)
    log = FlightLog(max_ticks=ticks)
    log.reserve()
    gc.collect()
    gc.freeze()
    gc.disable()
    clock = _Clock()
    with _recorder(folder, runner, policy, clock) if record else nullcontext() as recorder:
        resident, gained = _fly(pilot, log, recorder, clock, inputs, ticks)
    gc.enable()
    _write_results(log, runner, folder)
    report = {
        "resident_mib": resident,
        "peak_mib": peak_mib(),
        "gained": gained,
        "minutes": len(log) * TICK_S / 60.0,
        "recorded": recorder.recorded / ticks if recorder is not None else 1.0,
        "flown": sum(record.wanted is not None for record in log.records) / ticks,
        "foreign": [name for name in FOREIGN if name in sys.modules],
    }
    print(json.dumps(report))


def _header(runner: PolicyRunner, policy: Path) -> FlightHeader:
    return FlightHeader(
        mission="soak",
        clock_offset_ns=0,
        rate_hz=runner.metadata.rate_hz,
        goal_m=(GOAL.x, GOAL.y, GOAL.z),
        goal_radius_m=0.2,
        safety=SafetyConfig(fence=FENCE),
        policy_path=str(policy),
        policy_sha256=runner.sha256,
        dynamics="recorded",
        machine=this_machine(),
    )


class _Clock:
    """Simulated time, for the recorder."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def _recorder(folder: Path, runner: PolicyRunner, policy: Path, clock: _Clock) -> Recorder:
    return Recorder(folder / "flight.mcap", _header(runner, policy), policy.read_bytes(), RecordingConfig(), clock=clock)


def _fly(
    pilot: Pilot, log: FlightLog, recorder: Recorder | None, clock: _Clock, inputs: Path, ticks: int
) -> tuple[list[float], int]:
    """All ticks, no faster than the recorder writes them.

    Gives the resident memory at every twelfth of the time, and the descriptors and threads gained since the first of them.
    """
    resident, counts = [], []
    for k, (scan, state, now_s) in enumerate(samples(inputs, ticks)):
        record = pilot.tick(scan, state, now_s)
        log.append(record, now_s + 0.001, 0.0001)
        log.see(scan, state)
        if recorder is not None:
            _record(recorder, k, record, scan, state)
            clock.now_s = now_s
        if (k + 1) % (ticks // 12) == 0:
            resident.append(resident_mib())
            counts.append(held())
            print(f"   {(k + 1) * TICK_S / 60.0:4.0f} min: {resident[-1]:.2f} MiB", file=sys.stderr, flush=True)
    return resident, counts[-1] - counts[0]


def _record(recorder: Recorder, k: int, record: TickRecord, scan: LidarScan, state: VehicleState) -> None:
    recorder.tick(record, scan, state, record.sent, record.now_s + 0.001, GOAL, 0.0001)
    while k - recorder.recorded - recorder.dropped > 20 and recorder.problem is None:
        time.sleep(0.0005)


def _write_results(log: FlightLog, runner: PolicyRunner, folder: Path) -> None:
    loop = RateStatistics(20.0, len(log), 0, LatenessStatistics(0.1, 0.1, 0.1))
    policy = {"policy_path": "policy.onnx", "policy_sha256": runner.sha256}
    summary = build_summary(log, loop, outcome="soak", goal=GOAL, goal_reached=False, dynamics="recorded", **policy)
    write_json_atomic(folder / "summary.json", summary)
    write_trajectory_csv(folder / "trajectory.csv", log)
    write_timing_csv(folder / "timing.csv", log)
    write_scans(folder / "scans.npz", log.scans.scans(), log.records[0].now_s)
    write_report(folder)


if __name__ == "__main__":
    main()
