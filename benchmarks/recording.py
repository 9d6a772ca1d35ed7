"""What recording costs: on the loop's thread beside the tick itself, and on the machine as a whole.

The tick is the real one: policy, safety filter, a scan of 361 beams, with the shipped policy where there is one. Blocks with and
without a recorder take turns at 20 Hz in one process, so that both meet the same machine. Costs on the loop's thread are its
own CPU time; lateness and duration are wall time, where the writer thread's share of the interpreter would show.
"""

from __future__ import annotations

import gc
import math
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

Figure = dict[str, Any]

RATE_HZ = 20.0
BLOCKS = 6
BLOCK_TICKS = 60
WARM_UP = 10
SHARE = 0.05
"""Recording may cost this part of a tick on the loop's thread: of its work, and so much more of its 50 ms."""
BEAMS = 361
ROOT = Path(__file__).parents[1]


class _Flight:
    """A pilot with inputs along a corridor, made before the clock runs."""

    def __init__(self, policy: Path) -> None:
        from flight.tick import Pilot
        from policy_export.runner import PolicyRunner
        from safety.config import Fence, SafetyConfig
        from safety.filter import SafetyFilter
        from safety.frames import CorridorVector

        self.policy = policy
        self.safety = SafetyConfig(fence=Fence(min_m=(-1.0, -4.0, 0.3), max_m=(36.0, 4.0, 4.0)))
        self.runner = PolicyRunner.load(policy)
        self.pilot = Pilot(self.runner, SafetyFilter(self.safety), CorridorVector(33.0, 0.0, 2.0), 0.2)
        self._ranges = [_ranges(seed) for seed in range(64)]
        self._tick = 0

    def header(self) -> Any:
        from flight.recording_schema import FlightHeader, this_machine

        goal = self.pilot.goal
        return FlightHeader(
            mission="benchmark",
            clock_offset_ns=time.time_ns() - time.monotonic_ns(),
            rate_hz=RATE_HZ,
            goal_m=(goal.x, goal.y, goal.z),
            goal_radius_m=0.2,
            safety=self.safety,
            policy_path=self.policy.name,
            policy_sha256=self.runner.sha256,
            machine=this_machine(),
        )

    def inputs(self, now_s: float) -> tuple[Any, Any]:
        from safety.frames import CorridorVector
        from safety.messages import LidarScan, VehicleState

        self._tick += 1
        ranges = self._ranges[self._tick % len(self._ranges)].copy()
        scan = LidarScan(now_s - 0.01, ranges, -math.pi / 2, math.pi / (BEAMS - 1), 0.1, 4.0, self._tick)
        x, zero = 5.0 + (0.04 * self._tick) % 20.0, CorridorVector(0.0, 0.0, 0.0)
        velocity = CorridorVector(0.8, 0.0, 0.0)
        return scan, VehicleState(now_s - 0.005, CorridorVector(x, 0.3, 2.0), velocity, zero, 0.02, 0.03, 0.05, 0.0)


def _ranges(seed: int) -> np.ndarray:
    """A corridor's walls at 4 m with 1 cm of noise, in whole millimetres as a device gives them."""
    bearing = np.linspace(-math.pi / 2, math.pi / 2, BEAMS)
    with np.errstate(divide="ignore"):
        walls = 3.2 / np.abs(np.sin(bearing)) + 0.01 * np.random.default_rng(seed).standard_normal(BEAMS)
    return np.where(walls > 4.0, np.inf, np.round(walls, 3)).astype(np.float32)


def _block(flight: _Flight, recorder: Any) -> dict[str, list[float]]:
    """One block at 20 Hz: CPU time of tick and hand-over on this thread, wall time of both, lateness; us."""
    from flight.rate_keeper import RateKeeper

    costs: dict[str, list[float]] = {"tick": [], "hand_over": [], "wall": [], "lateness": []}
    keeper = RateKeeper(RATE_HZ)
    for k in range(BLOCK_TICKS + WARM_UP):
        now_s = keeper.wait()
        scan, state = flight.inputs(now_s)
        begin_wall, begin = time.perf_counter_ns(), time.thread_time_ns()
        record = flight.pilot.tick(scan, state, now_s)
        ticked = time.thread_time_ns()
        if recorder is not None:
            recorder.tick(record, scan, state, record.sent, now_s, flight.pilot.goal, keeper.lateness_s, keeper.deadline_misses)
        done, done_wall = time.thread_time_ns(), time.perf_counter_ns()
        if k < WARM_UP:
            continue
        costs["tick"].append((ticked - begin) / 1e3)
        costs["hand_over"].append((done - ticked) / 1e3)
        costs["wall"].append((done_wall - begin_wall) / 1e3)
        costs["lateness"].append(1e6 * keeper.lateness_s)
    return costs


def _take_turns(folder: Path, policy: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, float]]:
    """(with recorder, without, totals of the recorder)."""
    from flight.recorder import Recorder
    from flight.recording_config import RecordingConfig

    flight, path = _Flight(policy), folder / "flight.mcap"
    blocks: dict[bool, list[dict[str, list[float]]]] = {True: [], False: []}
    recorder = Recorder(path, flight.header(), policy.read_bytes(), RecordingConfig(), lambda text: print(text, file=sys.stderr))
    writer_s = 0.0
    with recorder:
        writer = next(thread for thread in threading.enumerate() if thread.name == "recorder")
        for block in range(2 * BLOCKS):
            print(f"   block {block + 1} of {2 * BLOCKS}", file=sys.stderr, flush=True)
            recording = block % 2 == 0
            before_s = _cpu_s(writer)
            blocks[recording].append(_block(flight, recorder if recording else None))
            writer_s += _cpu_s(writer) - before_s
    ticks = BLOCKS * (BLOCK_TICKS + WARM_UP)
    totals = {
        "writer_us": 1e6 * writer_s / ticks,
        "bytes": (path.stat().st_size - policy.stat().st_size) / ticks,
        "dropped": float(recorder.dropped),
        "recorded": float(recorder.recorded == ticks),
    }
    return _joined(blocks[True]), _joined(blocks[False]), totals


def _cpu_s(thread: threading.Thread) -> float:
    """CPU time of a thread of this process so far."""
    assert thread.ident is not None
    return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))


def _joined(blocks: list[dict[str, list[float]]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _policy(folder: Path) -> Path:
    """The shipped policy; where there is none, a network of the same shape with random weights."""
    shipped = ROOT / "policies" / "corridor_ppo_lstm.onnx"
    if shipped.is_file():
        return shipped
    import torch

    from policy_export.checkpoint import Checkpoint, PolicyLayout
    from policy_export.contract import ActionLayout, TrainingRecord, default_layout
    from policy_export.export import export_policy
    from policy_export.network import NetworkConfig, PolicyNetwork

    torch.manual_seed(0)
    layout = PolicyLayout(observation=default_layout(), action=ActionLayout())
    export_policy(Checkpoint(PolicyNetwork(NetworkConfig()).eval(), layout, TrainingRecord()), folder / "policy.onnx")
    return folder / "policy.onnx"


def run(json: bool) -> list[Figure]:
    """Hand-over against the tick's own work (at most 5 %), tick and lateness with and without recorder. Takes 45 s."""
    with tempfile.TemporaryDirectory() as name:
        policy = _policy(Path(name))
        gc.collect()
        gc.freeze()
        gc.disable()  # as the control loop flies
        try:
            with_it, without, totals = _take_turns(Path(name), policy)
        finally:
            gc.enable()
            gc.unfreeze()
    tick_us = float(np.median(with_it["tick"]))
    figures = [
        _figure("recording: hand-over on the loop's thread, median", float(np.median(with_it["hand_over"])), tick_us, SHARE),
        _figure("recording: hand-over on the loop's thread, p99", float(np.percentile(with_it["hand_over"], 99)), tick_us, None),
        _figure("recording: tick with it beside without, CPU median", tick_us, float(np.median(without["tick"])), None),
    ]
    for key, what in (("wall", "tick and hand-over, wall time"), ("lateness", "wake-up lateness")):
        for share in (50, 99):
            mine, peer = (float(np.percentile(costs[key], share)) for costs in (with_it, without))
            figures.append(_figure(f"recording: {what} beside without, p{share}", mine, peer, None))
    figures.append(_figure("recording: writer thread's CPU per tick", totals["writer_us"], 1e6 / RATE_HZ, None))
    figures.append({**_figure("recording: bytes on disk per tick", totals["bytes"], None, None), "unit": "B"})
    lost = {**_figure("recording: ticks dropped", totals["dropped"], None, None), "unit": "ticks", "target": "0"}
    figures.append({**lost, "ok": totals["dropped"] == 0.0 and bool(totals["recorded"])})
    return figures


def _figure(name: str, value: float, peer: float | None, limit: float | None) -> Figure:
    ratio = value / peer if peer else None
    return {
        "name": name,
        "value": round(value, 2),
        "unit": "us",
        "peer": None if peer is None else round(peer, 2),
        "ratio": None if ratio is None else round(ratio, 4),
        "target": None if limit is None else f"ratio <= {limit:g}",
        "ok": None if limit is None or ratio is None else ratio <= limit,
    }
