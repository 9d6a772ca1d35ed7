"""Processes of a campaign: broken off, they end at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from multiprocessing import active_children
from pathlib import Path

import pytest

from campaigns.workers import over_processes

ROOT = Path(__file__).resolve().parents[2]
MANY = 10_000  # seconds that the last of them sleeps: nobody waits for that
BUSY = f"""
import time
from campaigns.workers import over_processes
for index, _ in over_processes(time.sleep, {MANY}, 2):
    print(index, flush=True)
"""


def test_who_stops_asking_waits_for_nobody() -> None:
    arriving = over_processes(time.sleep, MANY, 2)
    assert next(arriving)[0] < 3
    began = time.monotonic()
    arriving.close()
    for child in active_children():
        child.join(10.0)
    assert not active_children()
    assert time.monotonic() - began < 10.0


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_parent_that_is_killed_takes_them_with_it(how: signal.Signals) -> None:
    parent = subprocess.Popen([sys.executable, "-c", BUSY], cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert parent.stdout is not None
    try:
        assert int(parent.stdout.readline()) < 3
        parent.send_signal(how)
        rest, _ = parent.communicate(timeout=20.0)  # they share its output, which ends with the last of them
    finally:
        with suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)
    assert (rest, parent.returncode) == ("", -how)


@pytest.mark.parametrize("to_all", [False, True], ids=["by kill", "at the terminal"])
def test_ctrl_c_ends_them_at_once(to_all: bool) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", BUSY], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert child.stdout is not None
        assert int(child.stdout.readline()) < 3
        (os.killpg if to_all else os.kill)(child.pid, signal.SIGINT)
        _, said = child.communicate(timeout=20.0)
    finally:
        child.kill()
    assert "KeyboardInterrupt" in said
