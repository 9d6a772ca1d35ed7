"""A stand for the whole `fly` program: a small empty world, a policy that seeks the goal, free ports, the real commands."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]

WORLD = """\
kind: boxes
boxes:
  start: [1.0, 0.0, 0.0]
  goal: [4.5, 0.3, 1.2]
  boxes:
    - {center: [5.0, 4.1, 2.0], size: [14.0, 0.2, 4.0]}
    - {center: [5.0, -4.1, 2.0], size: [14.0, 0.2, 4.0]}
    - {center: [8.0, 2.0, 2.0], size: [0.5, 0.5, 4.0]}
"""

MISSION = """\
name: stand
vehicle:
  connection: sim
policy:
  path: {policy}
frame:
  takeoff_point_m: world
  heading_deg: vehicle
takeoff_height_m: 1.0
goal:
  position_m: world
  radius_m: 0.3
lidar:
  port: {lidar_port}
safety:
  fence:
    min_m: [-1.0, -4.0, 0.2]
    max_m: [10.0, 4.0, 4.0]
timeouts:
  connect_s: 10.0
  lidar_s: 10.0
  flight_s: 60.0
sim:
  world: {world}
  seed: 1
  onboard_port: {onboard_port}
  gcs_port: {gcs_port}
"""


def free_port(kind: socket.SocketKind) -> int:
    """A port that nothing uses now. The gateway also binds 40 and 4020 above it, so high ones are refused."""
    while True:
        with socket.socket(socket.AF_INET, kind) as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        if port < 61000:
            return port


@dataclass
class Stand:
    """Files and ports of one flight in `folder`."""

    folder: Path
    policy: Path
    onboard_port: int = field(default_factory=lambda: free_port(socket.SOCK_DGRAM))
    gcs_port: int = field(default_factory=lambda: free_port(socket.SOCK_DGRAM))
    lidar_port: int = field(default_factory=lambda: free_port(socket.SOCK_STREAM))

    def mission(self, change: Callable[[str], str] = lambda text: text) -> Path:
        """Write the world and the mission, the latter changed by `change`; returns the mission's path."""
        self.folder.mkdir(parents=True, exist_ok=True)
        world = self.folder / "world.yaml"
        world.write_text(WORLD)
        text = MISSION.format(
            policy=self.policy,
            world=world,
            lidar_port=self.lidar_port,
            onboard_port=self.onboard_port,
            gcs_port=self.gcs_port,
        )
        path = self.folder / "mission.yaml"
        path.write_text(change(text))
        return path

    def fly(self, *options: str, change: Callable[[str], str] = lambda text: text) -> Program:
        """Start `fly` on this stand's mission, results in `folder/run`."""
        return Program("flight", "--mission", str(self.mission(change)), "--out", str(self.folder / "run"), *options)

    def gateway(self) -> Program:
        """Start only the gateway, for a `fly` that is given its connection; returns when it is ready."""
        self.mission()
        arguments = ["--world", str(self.folder / "world.yaml"), "--onboard-port", str(self.onboard_port)]
        arguments += ["--gcs-port", str(self.gcs_port), "--lidar-port", str(self.lidar_port)]
        program = Program("sim_gateway", *arguments)
        program.wait_for('"ready": true', 300.0)
        return program

    def summary(self) -> dict[str, Any]:
        """The flight's summary.json."""
        return dict(json.loads((self.folder / "run" / "summary.json").read_text()))


class Program:
    """A command of this project as a child process, its output collected."""

    def __init__(self, module: str, *arguments: str) -> None:
        command = [sys.executable, "-m", module, *arguments]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.out, self.err = "", ""
        self._readers = [
            threading.Thread(target=self._read, args=(name, getattr(self.process, f"std{name}")), daemon=True)
            for name in ("out", "err")
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str, stream: Any) -> None:
        for line in stream:
            setattr(self, name, getattr(self, name) + line)

    def wait_for(self, text: str, timeout_s: float) -> None:
        """Until `text` was printed. Fails when the program ends first or time runs out."""
        deadline = time.monotonic() + timeout_s
        while text not in self.out + self.err:
            assert self.process.poll() is None, f"ended before {text!r}:\n{self.out}\n{self.err}"
            assert time.monotonic() < deadline, f"no {text!r} within {timeout_s} s:\n{self.out}\n{self.err}"
            time.sleep(0.02)

    def finish(self, timeout_s: float = 120.0) -> int:
        """Exit code, once it ended by itself."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.stop()
            raise AssertionError(f"still running after {timeout_s} s:\n{self.out}\n{self.err}") from None
        for reader in self._readers:
            reader.join(5.0)
        return code

    def stop(self) -> None:
        """End it, gently first."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(10.0)
