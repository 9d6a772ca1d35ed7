"""The named splits, flights in the training dynamics, the failure taxonomy and the tables of `evaluate-policy`."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from campaigns import cli, evaluate
from campaigns.errors import ClusterError
from campaigns.evaluate import Campaign, report, run_campaign
from campaigns.evaluation_report import markdown, replay_command
from campaigns.lockstep import StackConfig, what_was_hit
from campaigns.splits import load_splits
from campaigns.statistics import EpisodeResult
from campaigns.training_flight import TrainingFlight, gusts
from campaigns.workers import over_processes, over_ray
from flight.mission import load_mission
from policy_export.runner import PolicyRunner
from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.lidar import LidarConfig
from sim_gateway.simulation import WindConfig

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "configs" / "evaluation.yaml"
SPLITS = load_splits(["all"], FILE)
MISSION = load_mission(ROOT / "configs" / "corridor.yaml")
RUNNER = PolicyRunner.load(MISSION.policy.path)
STACK = StackConfig(MISSION.policy.path, MISSION.safety)
EMPTY = generate_corridor(2_000_000, CorridorConfig(pillars=(0, 0)))


def test_every_named_split_is_there_and_draws_its_worlds():
    names = {"static", "unseen", "dynamic", "dynamic_fast", "paper_world", "dense", "narrow_fov", "dropout", "wind"}
    assert set(SPLITS) == names | {"noisy_estimate"}
    for split in SPLITS.values():
        world = split.world(3)
        assert world.seed == split.first_seed + 3
        fence = split.safety(MISSION.safety).fence
        x, y, z = world.goal
        assert fence.margin_m(x, y, z, MISSION.safety.vehicle_radius_m) > 0.0
        assert fence.margin_m(world.start[0], world.start[1], split.takeoff_height_m, 0.35) > 0.0


def test_no_two_splits_share_a_corridor():
    firsts = sorted(split.first_seed for name, split in SPLITS.items() if name != "static")
    assert firsts[0] >= 2_000_000
    assert np.diff(firsts).min() >= 100_000  # the most episodes that evaluate-policy flies


def test_the_splits_are_what_their_descriptions_say():
    speeds = [[mover.speed_m_s for k in range(20) for mover in SPLITS[n].world(k).movers] for n in ("dynamic", "dynamic_fast")]
    assert 0.2 <= min(speeds[0]) < max(speeds[0]) <= 0.5 <= min(speeds[1]) < max(speeds[1]) <= 1.0
    assert min(len(SPLITS["dense"].world(k).static_boxes) for k in range(5)) >= 4 + 14
    assert SPLITS["narrow_fov"].lidar().fov_rad == pytest.approx(math.radians(120.0))
    assert SPLITS["dropout"].lidar().dropout_probability == 0.05
    assert SPLITS["unseen"].lidar() == LidarConfig.device()
    assert [name for name, split in SPLITS.items() if split.estimate == "px4_sih"] == ["noisy_estimate"]


def test_a_flight_in_the_training_dynamics_reaches_the_goal_and_repeats():
    first, second = (TrainingFlight(EMPTY, STACK, RUNNER).run() for _ in range(2))
    assert first == second
    assert first.clean_success
    assert first.failure is None
    assert 0.9 < first.path_efficiency <= 1.0
    assert 20.0 < first.duration_s < 60.0
    assert TrainingFlight(EMPTY, STACK, RUNNER, seed=1).run() != first


def test_time_up_is_a_timeout_and_the_fence_a_failure_of_its_own():
    flight = TrainingFlight(EMPTY, replace(STACK, time_limit_s=1.0), RUNNER)
    result = flight.run()
    assert (result.success, result.failure, result.ticks) == (False, "timeout", 20)
    behind = MISSION.safety.model_copy(
        update={"fence": MISSION.safety.fence.model_copy(update={"min_m": (20.0, -4.0, 0.5), "max_m": (35.5, 4.0, 4.0)})}
    )
    outside = TrainingFlight(EMPTY, replace(STACK, safety=behind, filtered=False, time_limit_s=1.0), RUNNER).run()
    assert outside.failure == "fence"


def test_a_narrow_scanner_shows_less():
    flight = TrainingFlight(EMPTY, replace(STACK, lidar=SPLITS["narrow_fov"].lidar()), RUNNER)
    scan = flight._scan(0.0)
    assert scan.ranges_m.size == 120
    assert scan.angle_min_rad == pytest.approx(math.radians(-59.5))


def test_gusts_have_the_size_asked_for():
    wind = gusts(WindConfig((1.0, -1.0, 0.0), 0.5), np.random.default_rng(0))
    rows = np.array([wind() for _ in range(40_000)])
    np.testing.assert_allclose(rows.std(axis=0), 0.5, atol=0.08)
    np.testing.assert_allclose(rows.mean(axis=0), (1.0, -1.0, 0.0), atol=0.12)


@pytest.mark.parametrize(("y", "cause"), [(0.0, "hit_moving"), (2.0, "hit_static"), (3.9, "wall")])
def test_what_was_hit_has_a_name(y, cause):
    wall, pillar, mover = (
        [-1.0, 4.0, 0.0, 36.0, 4.2, 10.0],
        [5.0, 1.8, 0.0, 5.4, 2.2, 10.0],
        [5.0, -0.2, 0.0, 5.4, 0.2, 10.0],
    )
    assert what_was_hit(np.array([wall, pillar, mover]), 2, (4.8, y, 2.0), 0.35) == cause


def evaluation(results, split="unseen"):
    return report(Campaign(MISSION.policy.path, SPLITS[split], MISSION.safety), split, results)


def episode(seed, failure=None):
    return EpisodeResult(seed, failure is None, failure in (None, "missed_goal"), 0, failure, 600, 30.0, 30.0, 29.0, 0.4, 1.0, {})


def test_tables_name_failures_and_how_to_fly_them_again():
    flown = evaluation([episode(2_000_000), episode(2_000_001, "timeout"), episode(2_000_002, "diverged")])
    assert flown["failures"] == {"timeout": [2_000_001], "diverged": [2_000_002]}
    text = markdown([flown])
    assert "- timeout: seeds 2000001" in text
    assert replay_command(flown, 2_000_001) in text
    both = markdown([flown, evaluation([episode(2_100_000)], "dynamic")])
    assert both.count("| unseen |") == both.count("| dynamic |") == 1
    assert "To fly one again" not in markdown([evaluation([episode(1)])])


def test_a_replayed_failure_is_the_same_flight(tmp_path):
    arguments = [str(MISSION.policy.path), "--mission", str(ROOT / "configs" / "corridor.yaml"), "--splits", str(FILE)]
    arguments += ["--dynamics", "training", "--workers", "1", "--split", "dense"]
    files = tmp_path / "two.json", tmp_path / "again.json"
    for file, more in zip(files, (["--episodes", "2"], ["--episodes", "1", "--seed", "2600001"]), strict=True):
        result = CliRunner().invoke(cli.app, [*arguments, *more, "--out", str(file)])
        assert result.exit_code == 0, result.output
    two, again = (json.loads(file.read_text()) for file in files)
    assert two["episodes"][1] == again["episodes"][0]
    assert two["dynamics"] == "training"
    assert "mean jerk" in files[0].with_suffix(".md").read_text()


def test_a_log_file_is_told_of_progress(monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "TELL_EVERY_S", 0.0)
    campaign = Campaign(MISSION.policy.path, SPLITS["unseen"], MISSION.safety, dynamics="training")
    run_campaign(campaign, 1, workers=1)
    assert "1 of 1 flown, clean 100.0 %" in capsys.readouterr().err


def squared(number):
    return number * number


def test_processes_give_every_index_once():
    assert dict(over_processes(squared, 5, 2)) == {i: i * i for i in range(5)}


def test_without_a_cluster_the_mistake_is_named():
    pattern = "extra `cluster`" if not has_ray() else "no Ray cluster at 127.0.0.1:1"
    with pytest.raises(ClusterError, match=pattern):
        next(over_ray(squared, 3, "127.0.0.1:1"))


def has_ray():
    try:
        import ray  # noqa: F401
    except ImportError:
        return False
    return True


@pytest.mark.skipif(not has_ray(), reason="needs the extra `cluster`")
def test_two_nodes_of_a_ray_cluster_fly_what_this_machine_flies(monkeypatch):
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        campaign = Campaign(MISSION.policy.path, SPLITS["unseen"], MISSION.safety, dynamics="training")
        assert run_campaign(campaign, 6, ray_address=cluster.address) == run_campaign(campaign, 6, workers=1)
    finally:
        cluster.shutdown()
