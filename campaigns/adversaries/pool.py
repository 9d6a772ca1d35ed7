"""All cases over all cores, with a progress bar, handed back as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from itertools import islice
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from campaigns.adversaries.cases import MAIN, Case, Result, run_case
from campaigns.workers import process_pool

_AHEAD = 4  # cases per process that wait for their turn


Item = TypeVar("Item")
Done = TypeVar("Done")


def run_all(cases: list[Case], jobs: int) -> Iterator[Result]:
    """Results in the order in which they are ready, on `jobs` processes."""
    with _bar() as bar:
        task = bar.add_task("adversaries", total=sum(case.ticks for case in cases), bad=0)
        bad = 0
        for result in spread(run_case, cases, jobs):
            bad += bool(result.outcome.events) and result.case.block == MAIN
            bar.update(task, advance=result.case.ticks, bad=bad)
            yield result


def spread(function: Callable[[Item], Done], items: Iterable[Item], jobs: int) -> Iterator[Done]:
    """`function` of every item on `jobs` processes, as they get ready."""
    if jobs == 1:
        yield from map(function, items)
        return
    waiting, running = iter(items), set[Future[Done]]()
    with process_pool(jobs) as pool:
        while True:
            running |= {pool.submit(function, item) for item in islice(waiting, _AHEAD * jobs - len(running))}
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)


def _bar() -> Progress:
    text = TextColumn("{task.completed:,.0f} of {task.total:,.0f} ticks, {task.fields[bad]} bad")
    columns = (TextColumn("{task.description}"), BarColumn(), text, TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))
