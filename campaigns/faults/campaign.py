"""All cases over all cores, and what they came to."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from campaigns.faults.catalogue import ELSEWHERE, IN_FLIGHT, Entry
from campaigns.faults.ground import GROUND, VARIANTS, refused
from campaigns.faults.oracle import Verdict
from campaigns.faults.run import Case, play
from campaigns.faults.scenes import FLIGHT_SCENES
from campaigns.faults.stage import load
from campaigns.workers import process_pool
from flight.mission import Mission
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter

ENTRIES: dict[str, Entry] = {entry.id: entry for entry in IN_FLIGHT}
GROUND_ENTRIES = {entry.id: entry for entry in GROUND}
ON_GROUND = "ground"
KEEP_EVERY_S = 20.0
_loaded: dict[Path, tuple[Mission, PolicyRunner]] = {}


@dataclass(frozen=True, slots=True)
class Result:
    """One case and its verdict; see `oracle.Verdict`."""

    fault: str
    scene: str
    seed: int
    expected: str
    problem: str | None
    reaction_s: float | None = None
    bound_s: float | None = None
    rules: tuple[str, ...] = ()
    outcome: str = ""
    fence_margin_m: float | None = None
    contacts: int = 0


def cases(seeds: int, only: list[str] | None = None, scenes: tuple[str, ...] = FLIGHT_SCENES) -> list[Case]:
    """Every entry in every scene with every seed, and the ground entries in their variants."""
    wanted = set(only) if only else {*ENTRIES, *GROUND_ENTRIES}
    unknown = wanted - set(ENTRIES) - set(GROUND_ENTRIES)
    if unknown:
        raise ValueError(f"no such fault: {', '.join(sorted(unknown))}; elsewhere: {', '.join(ELSEWHERE)}")
    flown = [Case(name, scene, seed) for seed in range(1, seeds + 1) for name in ENTRIES if name in wanted for scene in scenes]
    return flown + [Case(name, ON_GROUND, variant) for name in GROUND_ENTRIES if name in wanted for variant in range(VARIANTS)]


def run_case(case: Case, mission_file: Path, make_filter: Callable[..., SafetyFilter] = SafetyFilter) -> Result:
    """Play one case; mission and policy are loaded once per process."""
    if mission_file not in _loaded:
        os.environ.setdefault("FOXGLOVE_LOG_LEVEL", "off")
        _loaded[mission_file] = load(mission_file)
    mission, runner = _loaded[mission_file]
    if case.scene == ON_GROUND:
        problem = refused(GROUND_ENTRIES[case.entry], case.seed, mission.policy.path)
        return Result(case.entry, ON_GROUND, case.seed, "refuse", problem)
    entry = ENTRIES[case.entry]
    expected = entry.expects(case.scene)
    _, verdict = play(entry, case.scene, case.seed, mission, runner, make_filter)
    bound_s = expected.bound_s if expected.bound_s > 0.0 else None
    return result_of(case, expected.reaction.value, bound_s, verdict)


def result_of(case: Case, expected: str, bound_s: float | None, verdict: Verdict) -> Result:
    """The verdict as it is kept: what is not finite is None."""
    values = asdict(verdict)
    if not math.isfinite(verdict.fence_margin_m):
        values["fence_margin_m"] = None
    return Result(case.entry, case.scene, case.seed, expected, bound_s=bound_s, **values)


def run_all(
    wanted: list[Case], mission_file: Path, jobs: int | None = None, keep: Callable[[list[Result]], None] = lambda _: None
) -> list[Result]:
    """All cases on `jobs` processes, with a progress bar; in the order of `wanted`. `keep` gets what there is now and then."""
    jobs = min(jobs or os.cpu_count() or 1, len(wanted))
    results: dict[Case, Result] = {}
    kept_s = time.monotonic()
    with _progress() as progress:
        bar = progress.add_task("faults", total=len(wanted), bad=0)
        for case, result in _played(wanted, mission_file, jobs):
            results[case] = result
            bad = sum(r.problem is not None for r in results.values())
            progress.update(bar, advance=1, bad=bad)
            if result.problem is not None:
                progress.console.print(f"{result.fault} {result.scene} seed {result.seed}: {result.problem}", highlight=False)
            if time.monotonic() - kept_s > KEEP_EVERY_S:
                kept_s = time.monotonic()
                keep([results[case] for case in wanted if case in results])
    return [results[case] for case in wanted]


def _played(wanted: list[Case], mission_file: Path, jobs: int) -> Iterator[tuple[Case, Result]]:
    if jobs == 1:
        yield from ((case, run_case(case, mission_file)) for case in wanted)
        return
    with process_pool(jobs) as pool:
        futures = {pool.submit(run_case, case, mission_file): case for case in wanted}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("wrong {task.fields[bad]}"))
    return Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True))


def summarise(results: list[Result], command: str, seeds: int) -> dict[str, Any]:
    """All of it as one JSON-able object."""
    faults = list(dict.fromkeys(result.fault for result in results))
    wrong = [result for result in results if result.problem is not None]
    flown = [result for result in results if result.scene != ON_GROUND]
    return {
        "command": command,
        "kind": "fault campaign",
        "faults": len(faults),
        "scenes": list(dict.fromkeys(result.scene for result in results)),
        "seeds": seeds,
        "runs": len(results),
        "right": len(results) - len(wrong),
        "contacts": sum(result.contacts > 0 for result in flown),
        "each": [_row(name, [r for r in results if r.fault == name]) for name in faults],
        "wrong": [asdict(result) for result in wrong],
        "elsewhere": ELSEWHERE,
        "results": [asdict(result) for result in results],
    }


def _row(name: str, results: list[Result]) -> dict[str, Any]:
    """One fault over all scenes and seeds. Times of the runs in which something had to happen within a bound."""
    timed = [r for r in results if r.reaction_s is not None and r.bound_s is not None]
    entry = ENTRIES.get(name)
    times = [r.reaction_s for r in timed if r.reaction_s is not None]
    return {
        "fault": name,
        "title": entry.title if entry is not None else GROUND_ENTRIES[name].title,
        "note": entry.note if entry is not None else "",
        "expected": sorted({r.expected for r in results}),
        "scenes": len({r.scene for r in results}),
        "runs": len(results),
        "right": sum(r.problem is None for r in results),
        "reaction_median_s": median(times) if times else None,
        "reaction_worst_s": max(times) if times else None,
        "bound_s": max((r.bound_s for r in timed if r.bound_s is not None), default=None),
        "rules": sorted({rule for r in timed for rule in r.rules[:1]}),
        "least_fence_margin_m": min((r.fence_margin_m for r in results if r.fence_margin_m is not None), default=None),
    }
