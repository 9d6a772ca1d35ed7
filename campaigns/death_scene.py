"""The faults of the process-death matrix, and the scene of a run: gateway, relays, `fly`, and how one of them is struck."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from campaigns.ports import free_port
from campaigns.sabotage import FAULTS
from campaigns.wire_tap import ByteTap, WireTap
from flight.gateway_process import GatewayProcess, GatewayReady

WORLD = Path("configs/worlds/corridor.yaml")
POLICY = Path("policies/corridor_ppo_lstm.onnx")
BOUND_S = 0.15
FULL_SPEED_M_S = 0.85
FLYING_DEADLINE_S = 90.0
LANDING_DEADLINE_S = 60.0
WATCH_S = 4.0
HARDWARE_PRIORITY = 40

MISSION = """\
name: process-death
vehicle: {{connection: "udpin://127.0.0.1:{fly_port}"}}
policy: {{path: {policy}}}
frame: {{takeoff_point_m: [{start[0]}, {start[1]}], heading_deg: 0}}
takeoff_height_m: 2.0
goal: {{position_m: [{goal[0]}, {goal[1]}, {goal[2]}], radius_m: 0.2}}
lidar: {{driver: scip-tcp, host: 127.0.0.1, port: {lidar_port}}}
safety:
  fence: {{min_m: [-0.5, -4.0, 0.5], max_m: [35.5, 4.0, 4.0]}}
"""


@dataclass(frozen=True, slots=True)
class Cell:
    """One fault of one process. `resume_s`: when a stopped process goes on. `bound_s`: no moving setpoint later than this."""

    process: str
    fault: str
    resume_s: float | None = None
    bound_s: float = BOUND_S
    fly_lands: bool = False

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.fault}, SIGCONT after {self.resume_s:g} s" if self.resume_s is not None else self.fault


CELLS = (
    Cell("fly", "hang"),
    Cell("fly", "swallowed"),
    Cell("fly", "gil"),
    Cell("fly", "SIGSTOP"),
    Cell("fly", "SIGSTOP", 1.0),
    Cell("fly", "SIGSTOP", 5.0),
    Cell("fly", "SIGKILL"),
    Cell("fly", "SIGTERM", fly_lands=True),
    Cell("guard", "SIGSTOP"),
    Cell("guard", "SIGSTOP", 1.0),
    Cell("guard", "SIGSTOP", 5.0),
    Cell("guard", "SIGKILL"),
    Cell("guard", "SIGTERM", fly_lands=True),
    Cell("LiDAR", "silent", bound_s=0.3, fly_lands=True),
    Cell("telemetry", "silent", bound_s=0.25),
)


class Scene:
    """Gateway, relays and `fly` of one run. Context manager: all of it is gone afterwards."""

    def __init__(self, cell: Cell, seed: int, folder: Path) -> None:
        self.cell = cell
        self._seed, self._folder = seed, folder
        self._onboard, self._fly_port, ground = (free_port(socket.SOCK_DGRAM) for _ in range(3))
        self._lidar = free_port(socket.SOCK_STREAM)
        arguments = ["--world", str(WORLD), "--seed", str(seed), "--onboard-port", str(self._onboard)]
        arguments += ["--gcs-port", str(ground), "--lidar-port", str(self._lidar)]
        self.gateway = GatewayProcess(arguments, folder / "gateway.json")
        self._stack = contextlib.ExitStack()
        self.fly: subprocess.Popen[bytes]

    def __enter__(self) -> Scene:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self.gateway)
            ready = self.gateway.start(300.0)
            self.wire = stack.enter_context(WireTap(self._onboard, self._fly_port))
            self.scans = stack.enter_context(ByteTap(self._lidar))
            _hurry(os.getpid(), [self.wire.thread_id, self.scans.thread_id])
            for child in _children(os.getpid(), "sim_gateway"):
                _hurry(child)
            self.fly = self._start_fly(ready)
            stack.callback(self._end_fly)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _start_fly(self, ready: GatewayReady) -> subprocess.Popen[bytes]:
        mission = self._folder / "mission.yaml"
        places = {"start": ready.start, "goal": ready.goal, "fly_port": self._fly_port, "lidar_port": self.scans.port}
        mission.write_text(MISSION.format(policy=POLICY.resolve(), **places))
        module = ["campaigns.sabotage", self.cell.fault] if self.cell.fault in FAULTS else ["flight"]
        options = ["--mission", str(mission), "--out", str(self._folder / "run"), "--yes"]
        with (self._folder / "fly.txt").open("wb") as log:
            return subprocess.Popen([sys.executable, "-m", *module, *options], stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def _end_fly(self) -> None:
        for pid in (*_children(self.fly.pid, "flight.guard"), self.fly.pid):
            _kill(pid, signal.SIGKILL)
        self.fly.wait(10.0)

    def wait_for_full_speed(self) -> None:
        """Raises `RuntimeError` with fly's last words when it does not come to that."""
        deadline = time.monotonic() + FLYING_DEADLINE_S
        while self.wire.flying_speed_m_s() < FULL_SPEED_M_S:
            if self.fly.poll() is not None or time.monotonic() > deadline:
                words = (self._folder / "fly.txt").read_text(errors="replace").strip().splitlines()
                raise RuntimeError(f"never at full speed: {words[-1:] or self.fly.poll()}")
            time.sleep(0.02)

    def strike(self) -> float:
        """Let the fault happen; returns when."""
        if self.cell.process == "LiDAR":
            self.scans.mute = True
        elif self.cell.process == "telemetry":
            self.wire.mute = True
        else:
            number = signal.SIGUSR1 if self.cell.fault in FAULTS else signal.Signals[self.cell.fault]
            target = self.fly.pid if self.cell.process == "fly" else _children(self.fly.pid, "flight.guard")[0]
            struck_s = time.monotonic()
            _kill(target, number)
            if self.cell.resume_s is not None:
                time.sleep(self.cell.resume_s)
                _kill(target, signal.SIGCONT)
            return struck_s
        return time.monotonic()

    def watch(self) -> int | None:
        """Wait until the vehicle is in its final hands; exit code of `fly` where it ended by itself."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.fly.wait(LANDING_DEADLINE_S if self.cell.fly_lands else WATCH_S)
        if not self.cell.fly_lands:
            time.sleep(WATCH_S)
        return self.fly.poll()


def _children(parent: int, word: str) -> list[int]:
    """Children of `parent` whose command line holds `word`."""
    found = []
    for path in Path(f"/proc/{parent}/task").glob("*/children"):
        for pid in path.read_text().split():
            with contextlib.suppress(OSError):
                if word in Path(f"/proc/{pid}/cmdline").read_text():
                    found.append(int(pid))
    return found


def _kill(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def _hurry(pid: int, threads: list[int | None] | None = None) -> None:
    """Real-time priority where it is permitted: simulator and relays stand for hardware, which no other program holds up."""
    chosen = threads if threads is not None else [int(path.name) for path in Path(f"/proc/{pid}/task").glob("*")]
    for thread in chosen:
        with contextlib.suppress(PermissionError, ProcessLookupError):
            os.sched_setscheduler(thread or 0, os.SCHED_FIFO, os.sched_param(HARDWARE_PRIORITY))
