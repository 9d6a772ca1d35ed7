"""The same function of an index, many times: over the cores of this machine, or over a Ray cluster."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from threading import Thread
from typing import Any, TypeVar

from campaigns.errors import ClusterError

Result = TypeVar("Result")
# Each task of a cluster computes this many indices: fewer round trips, and still many tasks per core.
RAY_CHUNK = 4
CONNECT_TIMEOUT_S = 5.0


@contextmanager
def process_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """New processes for the block. One that ends by an exception or Ctrl-C ends them at once, with all that still waits; a parent
    that is killed takes them with it."""
    others = set(active_children())
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_follow_the_parent)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()
        raise
    pool.shutdown()


def _follow_the_parent() -> None:
    """Leave Ctrl-C to the parent, and end when it has ended: otherwise the same command, given again, would meet its own past."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_after_the_parent, daemon=True).start()


def _end_after_the_parent() -> None:
    parent = parent_process()
    assert parent is not None, "runs in a child only"
    parent.join()
    os._exit(1)


def over_processes(function: Callable[[int], Result], count: int, workers: int | None = None) -> Iterator[tuple[int, Result]]:
    """(index, `function(index)`) of 0..count-1 as they are done, on `workers` new processes; all cores by default."""
    workers = min(workers or os.cpu_count() or 1, count)
    if workers == 1:
        yield from ((i, function(i)) for i in range(count))
        return
    with process_pool(workers) as pool:
        futures = {pool.submit(function, i): i for i in range(count)}
        for future in as_completed(futures):
            yield futures[future], future.result()


def over_ray(function: Callable[[int], Result], count: int, address: str) -> Iterator[tuple[int, Result]]:
    """As `over_processes`, on all cores of the Ray cluster at `address`, whose nodes have this project installed.

    Raises `ClusterError` without Ray, or if no cluster answers there.
    """
    ray = _connect(address)
    try:
        shared = ray.put(function)
        task = ray.remote(num_cpus=1)(_chunk)
        waiting = [task.remote(shared, range(k, min(k + RAY_CHUNK, count))) for k in range(0, count, RAY_CHUNK)]
        while waiting:
            done, waiting = ray.wait(waiting)
            yield from ray.get(done[0])
    finally:
        ray.shutdown()


def _connect(address: str) -> Any:
    """The module itself, which may not be installed, connected."""
    try:
        import ray  # noqa: PLC0415  # an extra
    except ImportError:
        raise ClusterError("--ray needs the extra `cluster`: pip install -c constraints.txt '.[cluster]'") from None
    host, _, port = address.rpartition(":")
    try:
        # Ray itself waits for minutes where nothing answers.
        socket.create_connection((host, int(port)), timeout=CONNECT_TIMEOUT_S).close()
        ray.init(address=address, log_to_driver=False, logging_level="error")
    except (OSError, ValueError, RuntimeError) as error:
        raise ClusterError(f"no Ray cluster at {address} (HOST:PORT): {str(error).splitlines()[0]}") from None
    return ray


def _chunk(function: Callable[[int], Result], indices: range) -> list[tuple[int, Result]]:
    return [(i, function(i)) for i in indices]
