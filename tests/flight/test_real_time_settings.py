"""Real-time settings: in force where permitted and taken back afterwards; one line and no more where they are not."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from pydantic import ValidationError

from flight.realtime import RealTimeConfig, real_time

ROOT = Path(__file__).resolve().parents[2]


def may_use_fifo() -> bool:
    """Whether this process may change to SCHED_FIFO: tried in a process of its own."""
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, timeout=30).returncode == 0


def locked_kib() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmLck:"))


def schedule() -> tuple[int, int]:
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


def test_every_thread_gets_the_policy_and_loses_it_again() -> None:
    said: list[str] = []
    seen: dict[str, tuple[int, int]] = {}
    go, stop = threading.Event(), threading.Event()

    def other(name: str) -> None:
        go.wait(10.0)
        seen[name] = schedule()
        stop.wait(10.0)
        seen[f"{name} after"] = schedule()

    before = threading.Thread(target=other, args=("started before",))
    before.start()
    with real_time(RealTimeConfig(fifo_priority=7, lock_memory=False), warn=said.append) as state:
        inside = threading.Thread(target=other, args=("started inside",))
        inside.start()
        go.set()
        deadline = time.monotonic() + 10.0
        while len(seen) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        own = schedule()
    stop.set()
    before.join(10.0)
    inside.join(10.0)
    usual = (os.SCHED_OTHER, 0)
    if may_use_fifo():
        assert (state.fifo_priority, said) == (7, [])
        assert own == (os.SCHED_FIFO, 7)
        assert (seen["started before"], seen["started inside"]) == ((os.SCHED_FIFO, 6), (os.SCHED_FIFO, 7))
    else:
        assert state.fifo_priority == 0
        assert len(said) == 1
        assert "LimitRTPRIO" in said[0]
    assert (schedule(), seen["started before after"], seen["started inside after"]) == (usual, usual, usual)


def test_memory_is_locked_as_it_is_touched_and_not_as_it_is_reserved() -> None:
    """Locked whole, this would take the megabytes that were only reserved."""
    import mmap

    said: list[str] = []
    with real_time(RealTimeConfig(fifo_priority=0), warn=said.append) as state:
        before_kib = resident_kib()
        with mmap.mmap(-1, 64 << 20) as reserved:
            reserved[0] = 1
            grown_kib, locked = resident_kib() - before_kib, locked_kib()
    assert grown_kib < 8 << 10
    assert state.memory_locked is (locked > 0)
    assert bool(said) is not state.memory_locked
    assert locked_kib() == 0


def resident_kib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def test_the_loop_alone_is_pinned() -> None:
    cores = os.sched_getaffinity(0)
    one = max(cores)
    others: list[set[int]] = []
    done = threading.Event()
    thread = threading.Thread(target=lambda: (done.wait(10.0), others.append(os.sched_getaffinity(0))))
    thread.start()
    with real_time(RealTimeConfig(fifo_priority=0, lock_memory=False, cpu=one)) as state:
        assert (state.cpu, os.sched_getaffinity(0)) == (one, {one})
        done.set()
        thread.join(10.0)
    assert (others, os.sched_getaffinity(0)) == ([cores], cores)


def test_an_absent_core_is_named_in_one_line() -> None:
    said: list[str] = []
    cores = os.sched_getaffinity(0)
    with real_time(RealTimeConfig(fifo_priority=0, lock_memory=False, cpu=1000), warn=said.append) as state:
        assert state.cpu is None
        assert os.sched_getaffinity(0) == cores
    assert len(said) == 1
    assert "core 1000" in said[0]
    assert "realtime.cpu" in said[0]


def test_switched_off_nothing_is_touched() -> None:
    said: list[str] = []
    with real_time(RealTimeConfig(fifo_priority=0, lock_memory=False), warn=said.append) as state:
        assert schedule() == (os.SCHED_OTHER, 0)
        assert locked_kib() == 0
    assert (state.warning, said) == (None, [])


AS_A_USER = """
import os, resource, sys
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (64 << 10, 64 << 10))
if os.getuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
from flight.realtime import RealTimeConfig, real_time
with real_time(RealTimeConfig(), warn=print) as state:
    print(state.fifo_priority, state.memory_locked, os.sched_getscheduler(0))
"""


def test_without_permission_the_flight_goes_on_with_one_line_of_warning() -> None:
    """As an ordinary user with the limits most systems have: nothing is in force, and the line says what to set."""
    done = subprocess.run(
        [sys.executable, "-c", "import encodings.ascii, flight.realtime\n" + AS_A_USER],
        cwd=ROOT, check=False, capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    warning, state = done.stdout.splitlines()
    assert "LimitRTPRIO=90" in warning
    assert "LimitMEMLOCK=infinity" in warning
    assert "docs/companion_computer.md" in warning
    assert state == f"0 False {os.SCHED_OTHER}"


@pytest.mark.parametrize("section", [{"fifo_priority": 99}, {"fifo_priority": -1}, {"cpu": -1}, {"nice": 3}])
def test_impossible_settings_are_refused_with_the_mission(section: dict[str, int]) -> None:
    with pytest.raises(ValidationError, match=next(iter(section))):
        RealTimeConfig.model_validate(section)
