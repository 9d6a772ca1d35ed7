"""The `sim-gateway` command as another program starts it."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import development as mav
from typer.testing import CliRunner

from sim_gateway.cli import app, completed, main
from sim_gateway.flight_report import FlightRecorder, write_json_atomically
from tests.sim_gateway.px4_stand_in import StandIn

pytestmark = pytest.mark.timeout(60)

BOXES = """
kind: boxes
boxes:
  length_m: 20.0
  width_m: 8.0
  height_m: 10.0
  start: [2.0, 0.0, 0.0]
  goal: [18.0, 0.0, 2.0]
  boxes:
    - {center: [10.0, 2.0, 5.0], size: [1.0, 1.0, 10.0]}
"""


@pytest.fixture
def world(tmp_path: Path) -> Path:
    path = tmp_path / "world.yaml"
    path.write_text(BOXES)
    return path


def _free_ports() -> tuple[int, int]:
    """A UDP port p of which p + 40 is free too, bound nowhere, and a free TCP port."""
    for port in range(26100, 28000, 3):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as b:
            try:
                a.bind(("127.0.0.1", port))
                b.bind(("127.0.0.1", port + 40))
            except OSError:
                continue
        with socket.socket() as tcp:
            tcp.bind(("127.0.0.1", 0))
            return port, int(tcp.getsockname()[1])
    raise RuntimeError("no free ports")


@contextmanager
def _started(world: Path, *options: str, stdin: int = subprocess.DEVNULL) -> Iterator[tuple[subprocess.Popen[str], dict, int]]:
    port, lidar = _free_ports()
    command = [sys.executable, "-m", "sim_gateway", "--world", str(world), "--onboard-port", str(port), "--gcs-port", "0"]
    command += ["--lidar-port", str(lidar), *options]
    child = subprocess.Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        line = child.stdout.readline()
        assert line, child.stderr.read() if child.stderr else ""
        yield child, json.loads(line), port
    finally:
        child.kill()
        child.communicate(timeout=10)


def _ends(child: subprocess.Popen[str], within_s: float) -> int:
    try:
        return child.wait(within_s)
    except subprocess.TimeoutExpired:
        pytest.fail(f"still running after {within_s} s")


@pytest.mark.realtime
def test_ready_line_telemetry_and_report(world: Path, tmp_path: Path) -> None:
    report = tmp_path / "deep" / "report.json"
    with _started(world, "--report", str(report), "--goal", "15,1,2.5", "--start", "3,-1") as (child, ready, port):
        assert ready["ready"] is True
        assert (ready["start"], ready["goal"]) == ([3.0, -1.0, 0.0], [15.0, 1.0, 2.5])
        assert len(ready["boxes"]) >= 1
        with socket.create_connection(("127.0.0.1", ready["lidar_port"]), timeout=5) as lidar:
            lidar.sendall(b"VV\n")
            assert lidar.recv(100).startswith(b"VV\n00")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind(("127.0.0.1", port))
            client.settimeout(5.0)
            seen = set()
            parser = mav.MAVLink(None)
            parser.robust_parsing = True
            deadline = time.monotonic() + 5.0
            while "HEARTBEAT" not in seen and time.monotonic() < deadline:
                seen |= {message.get_type() for message in parser.parse_buffer(client.recv(4096)) or []}
        assert {"HEARTBEAT", "ATTITUDE", "LOCAL_POSITION_NED"} <= seen
        child.send_signal(signal.SIGTERM)
        assert _ends(child, 5.0) == 0
        assert child.stdout is not None
        assert child.stdout.read() == ""
    truth = json.loads(report.read_text())
    assert truth["contacts"] == 0
    assert truth["min_clearance_m"] is None
    assert truth["trajectory"]["columns"][0] == "t"
    assert truth["real_time_factor"] == pytest.approx(1.0, abs=0.15)
    assert truth["goal"] == [15.0, 1.0, 2.5]
    assert not list(report.parent.glob(".*.tmp"))


@pytest.mark.realtime
def test_quits_when_the_parents_pipe_closes_but_not_on_a_null_stdin(world: Path) -> None:
    with _started(world, "--quit-with-parent", stdin=subprocess.PIPE) as (child, _, _port):
        time.sleep(0.7)
        assert child.poll() is None
        assert child.stdin is not None
        child.stdin.close()
        assert _ends(child, 5.0) == 0
        child.stdin = None
    with _started(world, "--quit-with-parent") as (child, _, _port):
        time.sleep(0.7)
        assert child.poll() is None


@pytest.mark.realtime
def test_quits_when_its_parent_is_killed(world: Path, tmp_path: Path) -> None:
    port, lidar = _free_ports()
    arguments = ["-m", "sim_gateway", "--world", str(world), "--onboard-port", str(port), "--gcs-port", "0", "--quit-with-parent"]
    arguments += ["--lidar-port", str(lidar)]
    script = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, *{arguments!r}], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)\n"
        "child.stdout.readline(); print(child.pid, flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        parent.kill()
    deadline = time.monotonic() + 5.0
    while _alive(pid):
        assert time.monotonic() < deadline, "the gateway outlived its parent"
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.realtime
def test_speed_and_max_time(world: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    with _started(world, "--speed", "4", "--max-time", "4", "--report", str(report)) as (child, _, _port):
        began = time.monotonic()
        assert _ends(child, 10.0) == 0
        assert time.monotonic() - began < 3.0
    truth = json.loads(report.read_text())
    assert truth["duration_s"] == pytest.approx(4.0, abs=0.11)
    assert truth["real_time_factor"] == pytest.approx(4.0, rel=0.15)


@pytest.mark.realtime
def test_simulator_of_px4_ends_when_px4_has_gone(world: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    with _started(world, "--px4", "tcp:0", "--speed", "0", "--report", str(report)) as (child, ready, _port):
        px4 = StandIn(int(ready["px4"].removeprefix("tcp:")))
        px4.start()
        px4.fly(0.2)
        px4.close()
        assert _ends(child, 5.0) == 0
    assert json.loads(report.read_text())["answered_steps"] in (49, 50)


@pytest.mark.realtime
def test_follower_and_links_from_the_command_line(world: Path, tmp_path: Path) -> None:
    link = f"pty:{tmp_path / 'mavlink'},baud=115200"
    with _started(world, "--link", link) as (_, ready, port):
        assert ready["links"] == [f"serial:{os.path.realpath(tmp_path / 'mavlink')}"]
        with _started(world, "--follow", f"udpout://127.0.0.1:{port + 40}", "--origin", "2,0,0") as (_child, follower, _):
            assert (follower["origin"], follower["start"]) == ([2.0, 0.0, 0.0], [2.0, 0.0, 0.0])
            with socket.create_connection(("127.0.0.1", follower["lidar_port"]), timeout=10) as lidar:
                lidar.sendall(b"MD0360036000001\n")
                heard = b""
                while b"\n99b\n" not in heard:
                    heard += lidar.recv(4096)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--px4", "tcp:x"], "tcp:4560"),
        (["--follow", "ftp://127.0.0.1:1"], "udpin://127.0.0.1:14551"),
        (["--serial-lidar", "ld06", "--serial-link", "/no/such/folder/lidar", "--lidar-port", "0"], "/no/such/folder/lidar"),
    ],
)
def test_places_that_cannot_be_opened_are_one_line_and_exit_2(world: Path, options: list[str], word: str) -> None:
    command = [sys.executable, "-m", "sim_gateway", "--world", str(world), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=50, stdin=subprocess.DEVNULL, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert word in line


def test_without_a_word_it_says_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--world" in _refused(capsys)


def test_px4_alone_means_its_usual_port() -> None:
    usual = ["--px4", "tcp:4560"]
    assert completed(["--world", "w", "--px4"]) == ["--world", "w", *usual]
    assert completed(["--px4", "--world", "w"]) == [*usual, "--world", "w"]
    assert completed(["--px4", "tcp:4570"]) == ["--px4", "tcp:4570"]


@pytest.mark.parametrize("which", ["udp", "tcp"])
def test_port_in_use_is_one_line_and_exit_2(world: Path, which: str) -> None:
    port, lidar = _free_ports()
    kind = socket.SOCK_DGRAM if which == "udp" else socket.SOCK_STREAM
    taken = port + 40 if which == "udp" else lidar
    with socket.socket(socket.AF_INET, kind) as holder:
        holder.bind(("127.0.0.1", taken))
        if which == "tcp":
            holder.listen()
        options = ["--onboard-port", str(port), "--gcs-port", "0", "--lidar-port", str(lidar)]
        command = [sys.executable, "-m", "sim_gateway", "--world", str(world), *options]
        done = subprocess.run(command, capture_output=True, text=True, timeout=50, stdin=subprocess.DEVNULL, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert str(taken) in line
    assert ("--onboard-port" if which == "udp" else "--lidar-port") in line


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--world", "no/such.yaml"], "no/such.yaml"),
        (["--start", "1"], "--start"),
        (["--start", "1,nan"], "--start"),
        (["--goal", "10,2,5"], "obstacle"),
        (["--wind", "a,b,c"], "--wind"),
        (["--heading", "nan"], "--heading"),
        (["--speed", "nan"], "--speed"),
        (["--dynamics", "magic"], "internal"),
        (["--no-such-option"], "--no-such-option"),
        (["--link", "udp:0"], "--link"),
        (["--link", "serial:/dev/ttyUSB0"], "baud=57600"),
        (["--speed", "0"], "--px4"),
        (["--no-gps"], "--px4"),
        (["--follow", "udpin://127.0.0.1:14551", "--speed", "2"], "--speed"),
        (["--follow", "udpin://127.0.0.1:14551", "--origin", "1,2"], "--origin"),
        (["--origin", "1,2,0"], "--follow"),
        (["--serial-link", "lidar"], "--serial-lidar"),
        (["--follow", "udpin://127.0.0.1:14551", "--px4"], "choose one"),
        (["--follow", "udpin://127.0.0.1:14551", "--vehicles", "2"], "--vehicles"),
        (["--px4", "--link", "udp:14540,delay_ms=5"], "--link"),
        (["--onboard-port", "14550"], "--gcs-port"),
        (["--report", "/"], "--report"),
        (["--report", "/dev/null/truth.json"], "--report"),
    ],
)
def test_bad_options_are_one_line_and_exit_2(
    world: Path, options: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert word in _refused(capsys, "--world", str(world), *options)


def test_bad_world_file_names_the_field(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(BOXES.replace("width_m", "widht_m"))
    assert "widht_m" in _refused(capsys, "--world", str(path))


def _refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr of a command that must refuse its arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["sim-gateway", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    return str(captured.err.strip()) if len(captured.err.strip().splitlines()) == 1 else pytest.fail(captured.err)


def test_help_shows_examples() -> None:
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    assert "sim-gateway --world" in result.stdout


def test_report_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_json_atomically(path, {"a": 1})
    with pytest.raises(ValueError, match="Out of range"):
        write_json_atomically(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1}
    assert os.listdir(tmp_path) == ["report.json"]


def test_recorder_counts_contacts_in_the_air_only_and_stays_bounded() -> None:
    import numpy as np

    from sim_gateway import flight_report
    from sim_gateway.scene import World
    from sim_gateway.simulation import Simulation

    wall = np.array([[3.0, -5.0, 0.0, 3.5, 5.0, 10.0]])
    world = World("wall", 0, 20.0, 10.0, 10.0, wall, (), (0.0, 0.0, 0.0), 0.0, (10.0, 0.0, 2.0))
    simulation = Simulation(world, estimate="none", hover_height_m=2.0)
    recorder = FlightRecorder(simulation, {"seed": 1})
    for _ in range(2000):
        simulation.advance(1, (1.0, 0.0, 0.0), 0.0)
        recorder.watch()
    assert recorder.contacts == 1
    assert recorder.min_clearance_m < -0.3
    times = [row[0] for row in recorder.rows]
    assert np.diff(times).mean() == pytest.approx(0.05, abs=1e-3)
    limit = flight_report._MAX_ROWS
    try:
        flight_report._MAX_ROWS = 60  # type: ignore[misc]
        for _ in range(3000):
            simulation.advance(1, (0.0, 0.0, 0.0), 0.0)
            recorder.watch()
    finally:
        flight_report._MAX_ROWS = limit  # type: ignore[misc]
    assert len(recorder.rows) < 170
    assert recorder.as_dict()["seed"] == 1
