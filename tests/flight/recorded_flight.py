"""Recordings for the tests: a flight in lockstep with the recorder in the place it has in `fly`.

`python tests/flight/recorded_flight.py POLICY OUT` (from the project's folder) makes the committed recording anew.
"""

from __future__ import annotations

import sys
from pathlib import Path

from campaigns.lockstep import LockstepFlight, StackConfig
from flight.recorder import Recorder
from flight.recording_config import RecordingConfig
from flight.recording_schema import FlightHeader, this_machine
from flight.tick import Pilot, TickRecord
from policy_export.runner import PolicyRunner
from safety.config import Fence, SafetyConfig
from safety.messages import Health, LidarScan, VehicleState
from sim_gateway.world import load_world

ROOT = Path(__file__).parents[2]
SAFETY = SafetyConfig(fence=Fence(min_m=(-0.5, -4.0, 0.5), max_m=(35.5, 4.0, 4.0)))
EPOCH_NS = 1_800_000_000_000_000_000


class RecordedPilot:
    """A pilot whose every tick is recorded."""

    def __init__(self, pilot: Pilot, recorder: Recorder) -> None:
        self._pilot, self._recorder = pilot, recorder
        self.records: list[TickRecord] = []

    def reset(self) -> None:
        self._pilot.reset()

    def tick(self, scan: LidarScan | None, state: VehicleState | None, now_s: float, health: Health | None = None) -> TickRecord:
        record = self._pilot.tick(scan, state, now_s, health)
        self.records.append(record)
        self._recorder.tick(record, scan, state, record.sent, now_s + 0.001, self._pilot.goal)
        return record


def header_of(flight: LockstepFlight, policy: PolicyRunner) -> FlightHeader:
    goal = flight.goal
    return FlightHeader(
        mission="lockstep",
        clock_offset_ns=EPOCH_NS,
        rate_hz=20.0,
        goal_m=(goal.x, goal.y, goal.z),
        goal_radius_m=flight.config.arrival_radius_m,
        safety=flight.config.safety,
        policy_path=flight.config.policy.name,
        policy_sha256=policy.sha256,
        dynamics="internal",
        seed=flight.world.seed,
        boxes_m=tuple(tuple(map(float, box)) for box in flight.world.static_boxes),  # type: ignore[arg-type]
        machine=this_machine(),
    )


def record_lockstep(path: Path, policy: Path, *, seed: int = 1, duration_s: float = 10.0) -> list[TickRecord]:
    """Fly `duration_s` of a generated corridor and record it to `path`; the ticks as flown."""
    runner = PolicyRunner.load(policy)
    world = load_world(ROOT / "configs" / "worlds" / "corridor.yaml", seed)
    flight = LockstepFlight(world, StackConfig(policy, SAFETY, time_limit_s=duration_s), runner)
    header, config = header_of(flight, runner), RecordingConfig()
    with Recorder(path, header, policy.read_bytes(), config, clock=lambda: flight.simulation.time_s) as recorder:
        pilot = RecordedPilot(flight.pilot, recorder)
        flight.pilot = pilot  # type: ignore[assignment]
        recorder.event("the policy flies")
        flight.run()
        recorder.event("time is up")
    assert recorder.summary.problem is None
    return pilot.records


if __name__ == "__main__":
    records = record_lockstep(Path(sys.argv[2]), Path(sys.argv[1]))
    print(f"{len(records)} ticks, {sum(bool(r.verdict.interventions) for r in records)} with an intervention")
