"""Real-time settings for the time in the air: SCHED_FIFO, locked memory, one core for the loop. Each where it is permitted.

Nothing here makes a flight safe: a loop that is late brakes (`flight.offboard`, stall) whatever the scheduler does. It makes
lateness rare. What the system refuses is said in one line before arming, with the setting that would permit it.

All threads of the process get the policy, not only the loop's: they share the interpreter's lock, and a telemetry callback that
holds it while some other program has the processor would keep the loop waiting. Memory is locked page by page as it is
touched (MCL_ONFAULT), because locking it as reserved would take hundreds of megabytes of thread stacks that nobody uses.
"""

from __future__ import annotations

import ctypes
import logging
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

log = logging.getLogger("flight.realtime")

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # asm-generic/mman.h, the same on x86-64 and ARM
_CAP_IPC_LOCK = 14  # linux/capability.h
_GUIDE = "docs/companion_computer.md"


class RealTimeConfig(BaseModel):
    """Section `realtime` of the mission. Everything is used where the system permits it."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    fifo_priority: int = Field(default=50, ge=0, le=90, description="SCHED_FIFO priority of the loop; 0: usual scheduling")
    lock_memory: bool = Field(default=True, description="keep every page once touched in memory")
    cpu: int | None = Field(default=None, ge=0, le=1023, description="core for the loop alone (isolcpus=); null: any core")


@dataclass(frozen=True, slots=True)
class RealTimeState:
    """What is in force. `problems`: what was asked for and refused, each with what to do."""

    fifo_priority: int = 0
    memory_locked: bool = False
    cpu: int | None = None
    problems: tuple[str, ...] = ()

    @property
    def warning(self) -> str | None:
        """All problems in one line, None without any."""
        if not self.problems:
            return None
        return f"real time: {'; '.join(self.problems)}; the loop may be late under load ({_GUIDE})"


@contextmanager
def real_time(config: RealTimeConfig, warn: Callable[[str], None] = log.warning) -> Iterator[RealTimeState]:
    """Apply the settings for the length of the block, called by the loop's own thread; `warn` gets at most one line.

    Threads started inside inherit the loop's priority and lose it at the end like the others. Processes started inside would
    inherit it too: start them before.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
    state = apply(config)
    if state.warning is not None:
        warn(state.warning)
    try:
        yield state
    finally:
        if state.fifo_priority:
            _usual_scheduling()
        if state.memory_locked:
            _libc().munlockall()
        if state.cpu is not None:
            os.sched_setaffinity(0, cores)


def apply(config: RealTimeConfig) -> RealTimeState:
    """Apply what is permitted, for good; tells what is in force. `real_time` takes it back."""
    pinning = _pin(config.cpu) if config.cpu is not None else None
    locking = _lock_memory() if config.lock_memory else None
    scheduling = _first_in_first_out(config.fifo_priority) if config.fifo_priority else None
    return RealTimeState(
        fifo_priority=config.fifo_priority if scheduling is None else 0,
        memory_locked=config.lock_memory and locking is None,
        cpu=config.cpu if pinning is None else None,
        problems=tuple(problem for problem in (pinning, locking, scheduling) if problem is not None),
    )


def _first_in_first_out(priority: int) -> str | None:
    """The loop's thread at `priority`, all others just below. Gives the problem, or None."""
    if not hasattr(os, "sched_setscheduler"):
        return "SCHED_FIFO needs Linux"
    own = threading.get_native_id()
    try:
        os.sched_setscheduler(own, os.SCHED_FIFO, os.sched_param(priority))
        for thread in _threads():
            if thread != own:
                _schedule(thread, os.SCHED_FIFO, max(1, priority - 1))
    except PermissionError:
        return "SCHED_FIFO is not permitted, set LimitRTPRIO=90"
    except OSError as error:
        return f"SCHED_FIFO is refused ({error.strerror})"
    return None


def _usual_scheduling() -> None:
    for thread in _threads():
        _schedule(thread, os.SCHED_OTHER, 0)


def _schedule(thread: int, policy: int, priority: int) -> None:
    try:
        os.sched_setscheduler(thread, policy, os.sched_param(priority))
    except ProcessLookupError:
        log.debug("thread %d has ended meanwhile", thread)


def _threads() -> list[int]:
    return [int(entry.name) for entry in Path("/proc/self/task").iterdir()]


def _lock_memory() -> str | None:
    """Lock all pages as they are touched. Gives the problem, or None.

    Under a finite limit nothing is locked: with MCL_FUTURE a later allocation would fail in flight instead of here.
    """
    if not _may_lock_without_limit():
        return "memory locking is not permitted, set LimitMEMLOCK=infinity"
    try:
        failed = _libc().mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0
    except AttributeError:
        return "memory locking needs Linux"
    return f"memory locking is refused ({os.strerror(ctypes.get_errno())})" if failed else None


def _may_lock_without_limit() -> bool:
    import resource  # noqa: PLC0415  (POSIX only)

    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        return True
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return False
    effective = next((int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")), 0)
    return bool(effective >> _CAP_IPC_LOCK & 1)


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _pin(cpu: int) -> str | None:
    """The calling thread on one core. Gives the problem, or None."""
    if not hasattr(os, "sched_setaffinity"):
        return f"core {cpu}: pinning needs Linux"
    allowed = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, ValueError):
        return f"core {cpu} is not one of this computer's ({', '.join(map(str, sorted(allowed)))}), change realtime.cpu"
    return None
