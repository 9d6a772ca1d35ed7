"""Make each mutant in a forked child and let the tests look for it, most discriminating first."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from campaigns.mutation.forks import Answer, Job, run_forked
from campaigns.mutation.hotswap import preload, swap, unaffected
from campaigns.mutation.ledger import KILLED, NO_CHANGE, SURVIVED, TIMEOUT, Ledger, Verdict
from campaigns.mutation.mutants import Mutant, SourceFile, changed_lines, mutants_of, sources
from campaigns.mutation.probe import fixed_examples, run_tests
from campaigns.mutation.testmap import TestMap

CPU_SLACK_S = 10.0
CPU_PER_SECOND = 3.0  # a mutant may make its tests this much slower before it is stopped
FIRST_TESTS = 6  # of one file, tried by themselves: most mutants fall here
Report = Callable[[Mutant, Verdict], None]


@dataclass
class Hunt:
    """The mutants of one file against the tests. `budget_s`: stop looking after tests worth this much time."""

    root: Path
    path: str
    tests: TestMap
    budget_s: float
    killers: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._sources = sources(self.root)
        self.source = self._sources[self.path]
        self._seconds = self.tests.seconds

    def order(self, mutant: Mutant) -> list[str]:
        """Tests for a mutant: recent killers in the same function first, then those that run the line, fast before slow."""
        covering, exact = self.tests.covering(self.path, self.source, mutant.line)
        recent = {name: rank for rank, name in enumerate(self.killers.get(mutant.definition, []))}
        covering.sort(key=lambda name: (recent.get(name, len(recent)), name not in exact, self._seconds[name]))
        total, chosen = 0.0, []
        for name in covering:
            total += self._seconds[name]
            if total <= self.budget_s or not chosen:
                chosen.append(name)
        return chosen

    def prepare(self) -> None:
        """In the process that will fork: import all that the change cannot touch."""
        fixed_examples()
        preload([*self.tests.modules, *unaffected(self._sources, {self.path})])
        self._file = SourceFile(self.path, self.source)

    def probe(self, mutant: Mutant, order: list[str]) -> Answer:
        """In the child: make the mutant and run its tests until one fails."""
        changed = self._file.changed(mutant)
        before, after = changed_lines(self.source, changed)
        result: Answer = {"before": before, "after": after, "failed": {}, "tests": 0}
        if self._file.same_program(changed):
            return result
        swap(self.root, {self.path: changed})
        first = [name for name in order if name.partition("::")[0] == order[0].partition("::")[0]][:FIRST_TESTS]
        for part in (first, [name for name in order if name not in first]):
            if part and not result["failed"]:
                files = list(dict.fromkeys(name.partition("::")[0] for name in part))
                probe = run_tests(self.root, files, part, 1)
                result["failed"] = probe.failed
                result["tests"] += len(probe.seconds)
        return result

    def run(self, mutants: list[Mutant], at_once: int) -> Iterator[tuple[Mutant, Verdict]]:
        """All verdicts, as they come."""
        begun: dict[Mutant, float] = {}

        def jobs() -> Iterator[Job[Mutant]]:
            for mutant in mutants:
                order = self.order(mutant)
                begun[mutant] = time.monotonic()
                expected = sum(self._seconds[name] for name in order)
                yield Job(mutant, partial(self.probe, mutant, order), CPU_SLACK_S + CPU_PER_SECOND * expected)

        for mutant, answer in run_forked(jobs(), at_once):
            verdict = judged(answer, time.monotonic() - begun.pop(mutant))
            if verdict.outcome == KILLED:
                self._credit(mutant, verdict.killer)
            yield mutant, verdict

    def _credit(self, mutant: Mutant, killer: str) -> None:
        """The test that killed comes first for the next mutant of the same function."""
        killers = self.killers.setdefault(mutant.definition, [])
        if killer in self._seconds:
            if killer in killers:
                killers.remove(killer)
            killers.insert(0, killer)


def judged(answer: Answer, seconds: float) -> Verdict:
    """The verdict that an answer means. Running out of time is its own outcome, not a kill."""
    if "ended" in answer:
        outcome = TIMEOUT if answer["ended"] == "time" else KILLED
        return Verdict(outcome, f"the process ended: {answer['ended']}", 0, "", "", seconds)
    if answer["failed"]:
        outcome, killer = KILLED, next(iter(answer["failed"]))
    else:
        outcome, killer = SURVIVED if answer["tests"] else NO_CHANGE, ""
    return Verdict(outcome, killer, answer["tests"], answer["before"], answer["after"], seconds)


def hunt_file(
    root: Path, path: str, tests: TestMap, ledger_path: Path, suite: str, budget_s: float, at_once: int, report: Report
) -> None:
    """Run the mutants of one file that have no verdict yet, in a process of its own (what it imports stays there)."""
    pid = os.fork()
    if pid:
        status = os.waitpid(pid, 0)[1]
        if status:
            raise ChildProcessError(f"{path}: the process that hunts its mutants ended with status {status}")
        return
    code = 1
    try:
        _hunt_here(Hunt(root, path, tests, budget_s), Ledger(ledger_path), suite, at_once, report)
        code = 0
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        os._exit(code)


def _hunt_here(hunt: Hunt, ledger: Ledger, suite: str, at_once: int, report: Report) -> None:
    known = ledger.known(hunt.path, hunt.source, suite)
    pending = [m for m in mutants_of(hunt.path, hunt.source) if (m.operator, m.occurrence) not in known]
    hunt.prepare()
    for mutant, verdict in hunt.run(pending, at_once):
        ledger.add(mutant, hunt.source, suite, verdict)
        report(mutant, verdict)
