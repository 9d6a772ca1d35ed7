"""Work in forked children of a warm process: each starts with everything imported, is limited, and answers with one object."""

from __future__ import annotations

import gc
import json
import os
import resource
import selectors
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

MEMORY_BYTES = 6 << 30
WALL_PER_CPU = 8.0  # wall time allowed per second of processor time: these machines are shared
ANSWER_BYTES = 64 << 20
T = TypeVar("T")
Answer = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Job(Generic[T]):
    """One piece of work: `work` runs in the child, for at most `cpu_s` of processor time."""

    key: T
    work: Callable[[], Answer]
    cpu_s: float


@dataclass(slots=True)
class _Child(Generic[T]):
    key: T
    pid: int
    pipe: int
    deadline_s: float
    answer: bytearray = field(default_factory=bytearray)


def run_forked(jobs: Iterator[Job[T]], at_once: int) -> Iterator[tuple[T, Answer]]:
    """Answers in the order in which they come. A child that ends without one: {"ended": how}; errors are raised here."""
    running: dict[int, _Child[T]] = {}
    selector = selectors.DefaultSelector()
    gc.collect()
    gc.freeze()  # shared pages stay shared
    exhausted = False
    while running or not exhausted:
        while not exhausted and len(running) < at_once:
            job = next(jobs, None)
            if job is None:
                exhausted = True
            else:
                child = _start(job)
                running[child.pipe] = child
                selector.register(child.pipe, selectors.EVENT_READ)
        for pipe in _readable(selector, running):
            child = running[pipe]
            data = os.read(pipe, 65536)
            child.answer += data
            if not data or len(child.answer) > ANSWER_BYTES or time.monotonic() > child.deadline_s:
                selector.unregister(pipe)
                del running[pipe]
                yield child.key, _end(child)
    selector.close()


def _readable(selector: selectors.DefaultSelector, running: dict[int, _Child[T]]) -> list[int]:
    """Pipes with something to read, after ending the children that are over their time (which closes theirs)."""
    if not running:
        return []
    now = time.monotonic()
    for child in running.values():
        if now > child.deadline_s:
            os.kill(child.pid, signal.SIGKILL)
    wait_s = max(0.0, min(child.deadline_s for child in running.values()) - now) + 0.01
    return [int(key.fd) for key, _ in selector.select(min(wait_s, 1.0))]


def _start(job: Job[T]) -> _Child[T]:
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        _work(job, writing)
    os.close(writing)
    return _Child(job.key, pid, reading, time.monotonic() + WALL_PER_CPU * job.cpu_s)


def _work(job: Job[T], writing: int) -> None:
    """In the child; never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        gc.disable()
        cpu_s = int(job.cpu_s) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        silent = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(silent, descriptor)
        data = json.dumps(_answer(job)).encode()
        while data:
            data = data[os.write(writing, data) :]
        code = 0
    finally:
        os._exit(code)


def _answer(job: Job[T]) -> Answer:
    try:
        return job.work()
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001  told to the parent, which raises it
        return {"error": traceback.format_exc()}


def _end(child: _Child[T]) -> Answer:
    """Collect a child that has closed its pipe or is to be closed."""
    os.close(child.pipe)
    try:
        os.killpg(child.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        os.kill(child.pid, signal.SIGKILL)
    status = os.waitpid(child.pid, 0)[1]
    if child.answer:
        try:
            answer: Answer = json.loads(child.answer)
        except ValueError:
            return {"ended": "answer cut off"}
        if "error" in answer:
            raise ChildProcessError(f"{child.key}: {answer['error']}")
        return answer
    if time.monotonic() > child.deadline_s or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return {"ended": "time"}
    return {"ended": f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit {os.WEXITSTATUS(status)}"}
