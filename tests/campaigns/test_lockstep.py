"""The whole stack in lockstep with the shipped policy: repeatable to the byte, judged by the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from campaigns.evaluate import Campaign, report, run_campaign
from campaigns.lockstep import BRAKE_AFTER_GOAL_S, TICK_S, LockstepFlight, StackConfig, mean_jerk
from campaigns.splits import Split, load_split
from flight.mission import load_mission
from flight.trajectory import write_trajectory_csv
from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.scene import World, box_row
from strict_yaml import ConfigError

ROOT = Path(__file__).resolve().parents[2]
MISSION = load_mission(ROOT / "configs" / "corridor.yaml")
STACK = StackConfig(MISSION.policy.path, MISSION.safety)
SPLITS = ROOT / "configs" / "evaluation.yaml"


def blocked_world() -> World:
    """A corridor with a wall right across, nearer than the goal."""
    free = generate_corridor(2_000_000, CorridorConfig(pillars=(0, 0)))
    wall = box_row((15.0, 0.0, 5.0), (0.5, 8.0, 10.0))
    boxes = np.vstack([free.static_boxes, wall])
    return replace_boxes(free, boxes)


def replace_boxes(world: World, boxes: np.ndarray) -> World:
    size = (world.length_m, world.width_m, world.height_m)
    return World("blocked", world.seed, *size, boxes, (), world.start, world.start_yaw_rad, world.goal)


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("first.csv", "second.csv"):
        flight = LockstepFlight(generate_corridor(2_000_003), STACK)
        flight.run()
        write_trajectory_csv(tmp_path / name, flight.log)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]
    assert len(written[0].splitlines()) > 300


def test_another_seed_of_the_noise_gives_another_flight() -> None:
    paths = []
    for seed in (1, 2):
        flight = LockstepFlight(generate_corridor(2_000_003), STACK, seed=seed)
        flight.run()
        paths.append(flight.log.positions_m[:200])
    assert not np.array_equal(paths[0], paths[1])


def test_an_unseen_corridor_is_flown_cleanly() -> None:
    result = LockstepFlight(generate_corridor(2_000_000), STACK).run()
    assert result.clean_success
    assert result.failure is None
    assert 0.8 < result.path_efficiency <= 1.0
    assert result.duration_s < 60.0


def test_the_path_ends_at_the_goals_radius_as_the_task_does() -> None:
    flight = LockstepFlight(generate_corridor(2_000_000), STACK)
    result = flight.run()
    assert result.success
    assert result.duration_s <= result.ticks * TICK_S - BRAKE_AFTER_GOAL_S, "the braking after arrival counts"
    assert flight.simulation.flown_m - 1.0 < result.path_length_m < flight.simulation.flown_m - 0.05


def test_a_wall_across_is_not_touched_and_counts_as_timeout() -> None:
    result = LockstepFlight(blocked_world(), replace(STACK, time_limit_s=40.0)).run()
    assert result.failure == "timeout"
    assert result.contacts == 0
    assert result.min_clearance_m > 0.0


def test_the_results_do_not_depend_on_the_number_of_processes() -> None:
    campaign = Campaign(MISSION.policy.path, load_split("unseen", SPLITS), MISSION.safety)
    one, two = run_campaign(campaign, 2, workers=1), run_campaign(campaign, 2, workers=2)
    assert one == two
    figures = report(campaign, "unseen", one)
    assert figures["clean_success"]["n"] == 2
    assert len(figures["policy_sha256"]) == 64


def test_test_corridors_are_never_training_corridors() -> None:
    from training.config import EVALUATION_SEED_START

    for name in ("unseen", "dynamic", "noisy_estimate", "wind", "dropout"):
        assert load_split(name, SPLITS).first_seed >= EVALUATION_SEED_START + 1_000_000


def test_unknown_split_names_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"no split 'unsen'; there are: .*unseen"):
        load_split("unsen", SPLITS)


def test_a_split_is_one_kind_of_world() -> None:
    with pytest.raises(ValueError, match="corridor or paper"):
        Split.model_validate({"description": "x", "first_seed": 1, "corridor": {}, "paper": {}})


def test_jerk_of_constant_acceleration_is_zero_and_of_a_ramp_is_its_slope() -> None:
    ticks = np.arange(50) * 0.05
    steady = np.column_stack([2.0 * ticks, 0 * ticks, 0 * ticks])
    assert mean_jerk(steady) == pytest.approx(0.0, abs=1e-9)
    assert mean_jerk(np.column_stack([0.5 * 3.0 * ticks**2, 0 * ticks, 0 * ticks])) == pytest.approx(3.0)
