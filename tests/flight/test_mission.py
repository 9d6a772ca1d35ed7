"""The mission file: the shipped one loads, and whatever contradicts itself is refused with line and field."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from stand import ROOT, Stand

from flight.errors import MissionError, RefusedError
from flight.mission import Mission, goal_problem, load_mission, takeoff_point_problem
from flight.preflight import Check, Level, check_goal_clear, check_start, require
from flight.px4 import LossAction
from safety.config import Fence, SafetyConfig
from safety.frames import CorridorVector

CORRIDOR = ROOT / "configs" / "corridor.yaml"
SAFETY = SafetyConfig(fence=Fence(min_m=(0.0, -4.0, 0.3), max_m=(35.0, 4.0, 4.0)))
FULL = """\
policy: {path: p.onnx}
vehicle: {connection: "udpin://127.0.0.1:14540", stream_rate_hz: 50.0}
frame: {takeoff_point_m: [4.0, 0.5], heading_deg: 12.5}
takeoff_height_m: 2.0
goal: {position_m: [30.0, 0.5, 2.0], radius_m: 0.3}
lidar: {port: 10940, mount_yaw_deg: 5.0, blind_sectors_deg: [[10.0, 12.0]]}
safety:
  fence: {min_m: [0.0, -4.0, 0.3], max_m: [35.0, 4.0, 4.0]}
  max_horizontal_speed_m_s: 1.2
timeouts: {flight_s: 100.0, land_s: 50.0}
failsafe: {stall_s: 0.15, setpoint_loss_timeout_s: 0.5, escalation: {hold_after_s: 2.0}}
sim: {world: w.yaml, seed: 3, wind_m_s: [1.0, 0.5, 0.0], gcs_port: 14550}
"""


def load(tmp_path: Path, text: str) -> Mission:
    path = tmp_path / "m.yaml"
    path.write_text(text)
    return load_mission(path)


def test_the_shipped_mission_is_valid_and_names_existing_files() -> None:
    mission = load_mission(CORRIDOR, seed=17)
    assert mission.simulated
    assert mission.sim is not None
    assert mission.sim.seed == 17
    assert mission.sim.world.exists()
    assert mission.policy.path.exists()
    assert mission.goal.radius_m < 0.3  # arrival is judged by the estimate, the task by the truth
    assert mission.failsafe.loss_action == LossAction.HOLD == 5


def test_every_start_and_goal_of_the_shipped_corridor_fits_its_fence() -> None:
    """Whatever the seed draws, the fence of the mission has room for it."""
    safety = load_mission(CORRIDOR).safety
    world = yaml.safe_load((CORRIDOR.parent / "worlds" / "corridor.yaml").read_text())["corridor"]
    for x in world["start_x_m"]:
        for y in world["start_y_m"]:
            assert takeoff_point_problem((x, y), safety) is None
    for x in world["goal_x_m"]:
        for y in world["goal_y_m"]:
            for z in world["goal_z_m"]:
                assert goal_problem(CorridorVector(x, y, z), safety) is None


def test_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    mission = load(tmp_path, FULL)
    assert mission.policy.path == tmp_path / "p.onnx"
    assert mission.sim is not None
    assert mission.sim.world == tmp_path / "w.yaml"
    assert load(tmp_path, FULL.replace("p.onnx", "/a/p.onnx")).policy.path == Path("/a/p.onnx")


@pytest.mark.parametrize("bad", [".nan", ".inf", "-.inf", "nan"])
def test_a_number_that_is_not_finite_is_refused_everywhere(tmp_path: Path, bad: str) -> None:
    numbers = list(re.finditer(r"(?<![\w.:/-])-?\d+(\.\d+)?(?![\w.:])", FULL))
    assert len(numbers) > 25
    for number in numbers:
        text = FULL[: number.start()] + bad + FULL[number.end() :]
        line = FULL.count("\n", 0, number.start()) + 1
        with pytest.raises(MissionError, match=rf"m\.yaml:{line}: .*finite"):
            load(tmp_path, text)


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("flight_s: 100.0", "flight_x: 100.0", 10, "timeouts.flight_x: unknown key"),
        ("[30.0, 0.5, 2.0]", "[36.0, 0.5, 2.0]", 5, r"goal\.position_m \(36, 0.5\) m is outside"),
        ("[30.0, 0.5, 2.0]", "[30.0, 3.7, 2.0]", 5, r"goal\.position_m \(30, 3.7\) m is outside"),
        ("[30.0, 0.5, 2.0]", "[30.0, 0.5]", 5, r"goal\.position_m"),
        ("[30.0, 0.5, 2.0]", "world", 5, "`world` needs vehicle.connection: sim"),
        ("[4.0, 0.5]", "world", 3, "`world` needs vehicle.connection: sim"),
        ("[4.0, 0.5]", "[4.0, -3.9]", 3, r"frame\.takeoff_point_m \(4, -3.9\) m is outside"),
        ("takeoff_height_m: 2.0", "takeoff_height_m: 3.95", 4, "takeoff_height_m: 3.95 m is outside"),
        ("takeoff_height_m: 2.0", "", 1, "takeoff_height_m: required key is missing"),
        ("udpin://127.0.0.1:14540", "tcp:somewhere", 2, "vehicle.connection"),
        ("udpin://127.0.0.1:14540", "udpin://127.0.0.1:99999", 2, "1..65535"),
        ("udpin://127.0.0.1:14540", "udpin://127.0.0.1:14540 ; rm", 2, "vehicle.connection"),
        ("max_m: [35.0, 4.0, 4.0]", "max_m: [35.0, -4.0, 4.0]", 8, "fence y"),
        ("min_m: [0.0, -4.0, 0.3]", "min_m: [0.0, -4.0, 3.9]", 7, "fence z: nothing is left of the fence"),
        ("setpoint_loss_timeout_s: 0.5", "setpoint_loss_timeout_s: 5", 11, "setpoint_loss_timeout_s"),
        ("setpoint_loss_timeout_s: 0.5", "setpoint_loss_action: rtl", 11, "setpoint_loss_action"),
        ("hold_after_s: 2.0", "hold_after_s: 2.5", 11, r"raise safety\.fault_hold_s"),
        ("[1.0, 0.5, 0.0]", "[14.0, 14.0, 0.0]", 12, "wind"),
        ("seed: 3", "seed: -3", 12, r"sim\.seed"),
        ("heading_deg: 12.5", "heading_deg: compass", 3, r"frame\.heading_deg"),
        ("path: p.onnx", "path: p.onnx, sha256: abc", 1, r"policy\.sha256"),
    ],
)
def test_mistakes_are_named_with_line_and_field(tmp_path: Path, old: str, new: str, line: int, words: str) -> None:
    assert old in FULL
    with pytest.raises(MissionError, match=rf"m\.yaml:{line}: .*{words}"):
        load(tmp_path, FULL.replace(old, new))


def test_sim_needs_a_sim_section(tmp_path: Path) -> None:
    text = FULL.replace("udpin://127.0.0.1:14540", "sim")
    text = "\n".join(line for line in text.splitlines() if not line.startswith("sim:"))
    with pytest.raises(MissionError, match=r"m\.yaml:1: sim: .*required"):
        load(tmp_path, text)


def test_a_seed_needs_a_simulated_world(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text("\n".join(line for line in FULL.splitlines() if not line.startswith("sim:")))
    assert load_mission(path).sim is None
    with pytest.raises(MissionError, match="--seed"):
        load_mission(path, seed=3)


def test_the_mission_of_the_stand_is_valid(tmp_path: Path, seeker_policy: Path) -> None:
    assert load_mission(Stand(tmp_path, seeker_policy).mission()).name == "stand"


def test_start_against_boxes() -> None:
    pillar = (4.0, 1.0, 0.0, 4.5, 1.5, 4.0)
    high = (4.0, -0.2, 3.0, 4.5, 0.2, 4.0)
    clear = check_start((4.2, 0.0), 2.0, [pillar, high], SAFETY)
    assert [check.level for check in clear] == [Level.PASS]
    assert check_start((4.2, 1.2), 2.0, [pillar], SAFETY)[0].seen.endswith("inside an obstacle")
    assert "0.30 m from" in check_start((4.2, 0.7), 2.0, [pillar], SAFETY)[0].seen
    assert check_start((4.2, 0.0), 2.95, [high], SAFETY)[0].level is Level.FAIL


def test_goal_against_boxes() -> None:
    pillar = (4.0, 1.0, 0.0, 4.5, 1.5, 4.0)
    assert check_goal_clear(CorridorVector(4.2, 0.6, 2.0), [pillar], SAFETY)[0].level is Level.PASS
    assert check_goal_clear(CorridorVector(4.2, 0.7, 2.0), [pillar], SAFETY)[0].level is Level.FAIL
    assert check_goal_clear(CorridorVector(4.2, 1.2, 4.3), [pillar], SAFETY)[0].level is Level.FAIL


def test_require_names_the_first_failed_check() -> None:
    passed = Check("one", Level.PASS, "fine")
    warned = Check("two", Level.WARN, "so so", "look")
    require([passed, warned])
    with pytest.raises(RefusedError, match="preflight refused: three: broken; mend it"):
        require([passed, warned, Check("three", Level.FAIL, "broken", "mend it"), Check("four", Level.FAIL, "x", "y")])


def test_the_example_with_polygons_is_valid_and_its_fence_is_kept() -> None:
    safety = load_mission(ROOT / "configs" / "polygon_fence.yaml").safety
    assert goal_problem(CorridorVector(20.0, 2.0, 2.0), safety) is None
    assert "outside the safe part of the fence by 0.35 m" in str(goal_problem(CorridorVector(20.0, 3.0, 2.0), safety))
    assert "outside" in str(takeoff_point_problem((12.0, -3.5), safety))
