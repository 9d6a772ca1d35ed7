"""Monitors must be silent on healthy flights: a long lockstep flight, the committed recording, and PX4-like estimate noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safety_vehicle import empty_world, state_of

from campaigns.lockstep import LockstepFlight, StackConfig
from flight.recording_reader import read_recording
from flight.replay import compare, pilot_of, recorded_policy
from safety.config import Fence, SafetyConfig
from safety.estimate_monitor import EstimateMonitor
from safety.messages import Health, VehicleState
from safety.monitor_config import MonitorConfig
from safety.reactions import NOTICES, REACTIONS
from sim_gateway.estimate import PRESETS
from sim_gateway.simulation import Simulation, step_at
from sim_gateway.world import load_world

ROOT = Path(__file__).parents[2]
POLICY = ROOT / "policies" / "corridor_ppo_lstm.onnx"
SAFETY = SafetyConfig(fence=Fence(min_m=(-0.5, -4.0, 0.5), max_m=(35.5, 4.0, 4.0)))
MONITOR_RULES = REACTIONS.keys() | NOTICES.keys()


def alarms(flight: LockstepFlight) -> set[str]:
    return {item.rule for record in flight.log.records for item in record.verdict.interventions} & MONITOR_RULES


@pytest.mark.parametrize("seed", [1, 4])
def test_a_whole_flight_under_the_nominal_estimate_is_silent(seed: int) -> None:
    world = load_world(ROOT / "configs" / "worlds" / "corridor.yaml", seed)
    flight = LockstepFlight(world, StackConfig(POLICY, SAFETY, estimate="nominal", time_limit_s=60.0))
    result = flight.run()
    assert result.success
    assert len(flight.log.records) > 400
    assert not alarms(flight)


def test_the_committed_recording_is_silent_and_replays_bit_for_bit() -> None:
    """It was made before there was any health in recordings."""
    recording = read_recording(ROOT / "tests" / "data" / "corridor_seed1.mcap")
    assert {sample.record.health for sample in recording.ticks} == {None}
    pilot = pilot_of(recording, recorded_policy(recording))
    told = {
        item.rule
        for sample in recording.ticks
        for item in pilot.tick(sample.scan, sample.state, sample.record.now_s).verdict.interventions
    }
    assert not told & MONITOR_RULES
    assert compare(recording).differing_ticks == 0 or not compare(recording).same_machine


@pytest.mark.parametrize(("preset", "seed"), [("nominal", 1), ("px4_sih", 1), ("px4_sih", 2), ("px4_sih", 3)])
def test_ten_minutes_of_estimates_are_silent(preset: str, seed: int) -> None:
    """Hovering and flying about for ten minutes under each kind of noise: no jump, no mismatch, nothing frozen."""
    simulation = Simulation(empty_world(), estimate=PRESETS[preset], seed=seed, hover_height_m=5.0)
    monitor, random, wanted = EstimateMonitor(MonitorConfig()), np.random.default_rng(seed), np.zeros(3)
    found: list[object] = []
    for k in range(12_000):
        if k % 40 == 0:
            wanted = random.uniform((-1.0, -0.5, -0.1), (1.0, 0.5, 0.1))
        sample: VehicleState = state_of(simulation.estimate())
        monitor.judge(sample, Health(), float(np.linalg.norm(wanted)), sample.time_s, found)  # type: ignore[arg-type]
        simulation.advance(step_at((k + 1) * 0.05) - simulation.steps, wanted, 0.1)
    assert not found
