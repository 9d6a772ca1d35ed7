"""What a user can get wrong, through the real command: one line that says what to change, the right exit code, nothing armed."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from stand import Program, Stand

USAGE, REFUSED = 2, 3


@pytest.fixture
def stand(tmp_path: Path, seeker_policy: Path) -> Stand:
    return Stand(tmp_path, seeker_policy)


def refused(program: Program, code: int, *words: str) -> None:
    """The program ended with `code` and one line on stderr that holds `words`; nothing was armed or written."""
    assert program.finish(60.0) == code, program.out + program.err
    assert program.err.count("\n") == 1, program.err
    assert program.err.startswith("fly: ")
    assert "Traceback" not in program.err
    for word in words:
        assert word in program.err, program.err
    assert "arming" not in program.out


def replaced(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("radius_m: 0.3", "radius_n: 0.3", ("mission.yaml:12", "goal.radius_n", "unknown key")),
        (
            "position_m: world",
            "position_m: [4.0, 3.9, 1.2]",
            ("mission.yaml:10: goal", "goal.position_m (4, 3.9)", "outside", "fence"),
        ),
        ("takeoff_height_m: 1.0", "takeoff_height_m: .nan", ("mission.yaml:9", "takeoff_height_m", "finite")),
        ("max_m: [10.0, 4.0, 4.0]", "max_m: [10.0, .inf, 4.0]", ("safety.fence.max_m.1", "finite")),
    ],
)
def test_a_mistake_in_the_mission(stand: Stand, old: str, new: str, words: tuple[str, ...]) -> None:
    refused(stand.fly(change=replaced(old, new)), USAGE, *words)
    assert not (stand.folder / "run").exists()


def test_missing_policy_file(stand: Stand) -> None:
    stand.policy = stand.folder / "nowhere.onnx"
    refused(stand.fly(), USAGE, "policy.path", "nowhere.onnx")


def test_missing_world_file(stand: Stand) -> None:
    refused(stand.fly(change=replaced("world.yaml", "nowhere.yaml")), USAGE, "sim.world", "nowhere.yaml")


def test_corrupt_policy_file(stand: Stand) -> None:
    content = bytearray(stand.policy.read_bytes())
    content[len(content) // 2] ^= 0xFF
    stand.policy = stand.folder / "corrupt.onnx"
    stand.policy.write_bytes(content)
    refused(stand.fly(), USAGE, "corrupt.onnx", "refused")


def test_another_policy_than_the_mission_names(stand: Stand) -> None:
    change = replaced("frame:", f"  sha256: {'0' * 64}\nframe:")
    refused(stand.fly(change=change), USAGE, "sha256")


def test_start_inside_an_obstacle(stand: Stand) -> None:
    refused(stand.fly(change=replaced("takeoff_point_m: world", "takeoff_point_m: [8.0, 2.0]")), REFUSED, "inside", "obstacle")


def test_goal_inside_an_obstacle(stand: Stand) -> None:
    refused(stand.fly(change=replaced("position_m: world", "position_m: [8.0, 2.0, 1.2]")), REFUSED, "obstacle")


def test_no_vehicle_answers_within_ten_seconds(stand: Stand) -> None:
    """The connection is right, nobody is there. The deadline is the default one."""
    change = replaced("connection: sim", f"connection: udpin://127.0.0.1:{stand.onboard_port}")
    program = stand.fly("--yes", change=lambda text: without_world(change(text)).replace("  connect_s: 10.0\n", ""))
    refused(program, REFUSED, "no vehicle answering", f"127.0.0.1:{stand.onboard_port}", "within 10 s")


def test_lidar_does_not_answer(stand: Stand) -> None:
    """The vehicle answers, the LiDAR's port is closed."""
    gateway = stand.gateway()
    try:
        real = replaced("connection: sim", f"connection: udpin://127.0.0.1:{stand.onboard_port}")
        change = replaced(f"port: {stand.lidar_port}", "port: 9")
        program = stand.fly(
            "--yes", change=lambda text: without_world(change(real(text))).replace("lidar_s: 10.0", "lidar_s: 1.5")
        )
        refused(program, REFUSED, "LiDAR not answering on 127.0.0.1:9", "1.5 s", "lidar.port")
    finally:
        gateway.stop()


@pytest.mark.parametrize("which", ["onboard", "lidar"])
def test_port_in_use(stand: Stand, which: str) -> None:
    kind = socket.SOCK_DGRAM if which == "onboard" else socket.SOCK_STREAM
    port = stand.onboard_port if which == "onboard" else stand.lidar_port
    with socket.socket(socket.AF_INET, kind) as other:
        other.bind(("127.0.0.1", port))
        if which == "lidar":
            other.listen()
        refused(stand.fly(), REFUSED, str(port), "in use")


def test_a_real_vehicle_is_not_armed_without_being_asked(stand: Stand) -> None:
    change = replaced("connection: sim", "connection: udpin://127.0.0.1:14999")
    refused(stand.fly(change=lambda text: without_world(change(text))), USAGE, "--yes")


def test_results_are_never_overwritten(stand: Stand) -> None:
    (stand.folder / "run").mkdir()
    (stand.folder / "run" / "summary.json").write_text("{}")
    refused(stand.fly(), USAGE, "not empty", "--out")
    assert (stand.folder / "run" / "summary.json").read_text() == "{}"


@pytest.mark.parametrize(
    "arguments", [[], ["--mission"], ["--mission", "x.yaml", "--speed"], ["--mission", "x.yaml", "--seed", "-1"]]
)
def test_a_wrong_command_line(arguments: list[str]) -> None:
    refused(Program("flight", *arguments), USAGE, "--help")


def test_a_mission_that_is_not_there(tmp_path: Path) -> None:
    refused(Program("flight", "--mission", str(tmp_path / "none.yaml")), USAGE, "none.yaml", "No such file")


def without_world(text: str) -> str:
    """The mission with numbers where it said `world`, as a real vehicle needs them."""
    return text.replace("takeoff_point_m: world", "takeoff_point_m: [1.0, 0.0]").replace(
        "position_m: world", "position_m: [4.5, 0.3, 1.2]"
    )
