"""MAVProxy against the gateway's ground station link: typed commands, and what it prints within a deadline.

MAVProxy's `mode NAME` fails in itself with every PX4 vehicle (it hands a tuple where pymavlink wants numbers), so modes are
changed by its `long` command.
"""

from __future__ import annotations

import os
import re
import subprocess
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from campaigns.clients.card import Seen

_STOP_S = 10.0


@dataclass(frozen=True, slots=True)
class Step:
    """A line typed (empty: only wait), and the text that must then appear."""

    verb: str
    typed: str
    expected: str
    within_s: float


def _mode(verb: str, sub: int, expected: str, within_s: float) -> Step:
    return Step(verb, f"long MAV_CMD_DO_SET_MODE 1 4 {sub}", expected, within_s)


STEPS = (
    Step("connect", "", r"Detected vehicle 1:1", 30.0),
    Step("parameters: list", "", r"Received 875 parameters", 60.0),
    Step("parameters: write", "param set MIS_TAKEOFF_ALT 4", r"LOITER>", 5.0),
    Step("parameters: read back", "param fetch MIS_TAKEOFF_ALT", r"MIS_TAKEOFF_ALT\s*=\s*4\.0", 10.0),
    Step("arm", "arm throttle", r"ARMED", 10.0),
    _mode("mode: Takeoff", 2, r"Mode TAKEOFF", 10.0),
    Step("mode: Hold after it", "", r"Mode LOITER", 20.0),
    _mode("mode: Return", 5, r"Mode RTL", 10.0),
    _mode("mode: Hold", 3, r"Mode LOITER", 10.0),
    _mode("mode: Land", 6, r"Mode LAND", 10.0),
    Step("landed and disarmed", "", r"DISARMED", 40.0),
    Step("mission: load", "wp load {mission}", r"Loaded 3 waypoints(?s:.*)Flight plan received|Sent all 3 waypoints", 20.0),
    Step("mission: list", "wp list", r"Requesting 3 waypoints", 10.0),
    Step("rally points: list", "rally list", r"Requesting 0 rally", 10.0),
    Step("log list", "log list", r"numLogs 1", 10.0),
)


class MavProxy:
    """A running MAVProxy."""

    def __init__(self, executable: Path, port: int, folder: Path) -> None:
        command = [str(executable), f"--master=udpin:127.0.0.1:{port}", f"--state-basedir={folder}", "--nowait"]
        self._child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder, start_new_session=True
        )
        self._text, self._from = "", 0
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._child.stdout is not None
        while chunk := os.read(self._child.stdout.fileno(), 65536):
            self._text += chunk.decode("utf-8", "replace")

    def step(self, step: Step, typed: str) -> Seen:
        """Type, and wait for what is expected behind what was already seen."""
        started = time.monotonic()
        if typed and self._child.stdin is not None:
            self._child.stdin.write(f"{typed}\n".encode())
            self._child.stdin.flush()
        found = None
        while found is None and time.monotonic() - started < step.within_s and self._child.poll() is None:
            time.sleep(0.05)
            found = re.compile(step.expected).search(self._text, self._from)
        taken = round(time.monotonic() - started, 1)
        if found is None:
            return Seen(step.verb, False, f"not within {step.within_s:g} s: {self._text[-150:]!r}", taken)
        self._from = found.end()
        return Seen(step.verb, True, " ".join(found.group().split())[:80], taken)

    def close(self) -> None:
        """End it."""
        self._child.terminate()
        try:
            self._child.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait(_STOP_S)


def perform(executable: Path, port: int, folder: Path) -> list[dict[str, Any]]:
    """All steps."""
    mission = folder / "mission.txt"
    mission.write_text(_MISSION)
    proxy = MavProxy(executable, port, folder)
    try:
        return [asdict(proxy.step(step, step.typed.format(mission=mission))) for step in STEPS]
    finally:
        proxy.close()


_MISSION = "QGC WPL 110\n" + "\n".join(
    "\t".join(map(str, (number, int(number == 0), 3, command, 0, 0, 0, 0, 47.3978, 8.5456, 5.0, 1)))
    for number, command in enumerate((16, 22, 16))
)
