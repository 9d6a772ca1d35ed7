"""Make each mutant in a forked child and let the tests look for it, most discriminating first."""

from __future__ import annotations

import hashlib
import os
import random
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from campaigns.mutation.forks import Answer, Job, run_forked
from campaigns.mutation.hotswap import forget, module_name, swap
from campaigns.mutation.inplace import function_at, replace
from campaigns.mutation.ledger import KILLED, NO_CHANGE, SURVIVED, TIMEOUT, Ledger, Verdict
from campaigns.mutation.mutants import Mutant, SourceFile, changed_lines, mutants_of, sources
from campaigns.mutation.probe import Probe, fixed_examples, run_tests
from campaigns.mutation.testmap import BaselineError, TestMap

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
        self._file = SourceFile(self.path, self.source)

    def order(self, mutant: Mutant) -> list[str]:
        """Tests for a mutant: recent killers in the same function first, then those that run the line, fast before slow."""
        covering, exact = self.tests.covering(self.path, self.source, mutant.line)
        recent = {name: rank for rank, name in enumerate(self.killers.get(mutant.definition, []))}
        covering.sort(key=lambda name: (recent.get(name, len(recent)), name not in exact, self._seconds[name]))
        chosen: list[str] = []
        total = 0.0
        for name in covering:
            total += self._seconds[name]
            if total <= self.budget_s or not chosen:
                chosen.append(name)
        return chosen

    def probe(self, mutant: Mutant, order: list[str], session: pytest.Session) -> Answer:
        """In the child: make the mutant and run its tests until one fails."""
        changed = self._file.changed(mutant)
        before, after = changed_lines(self.source, changed)
        result: Answer = {"before": before, "after": after, "failed": {}, "tests": 0}
        if self._file.same_program(changed):
            return result
        if self._changed_in_place(mutant, changed):
            return result | run_items(session, order)
        return result | self._imported_anew(changed, order)

    def _changed_in_place(self, mutant: Mutant, changed: str) -> bool:
        """Give one function its changed code, where nothing has run it yet."""
        name = function_at(self.source, mutant.line)
        if name is None or self.tests.runs_on_import(self.path, self.source, mutant.line) or not _compiles(changed):
            return False
        return replace(module_name(self.path), name, changed, str(self.root / self.path))

    def _imported_anew(self, changed: str, order: list[str]) -> Answer:
        """Forget all of ours that is imported, and import it with the change: a test file first, then the rest."""
        forget(self.root)
        swap(self.root, {self.path: changed})
        first = [name for name in order if name.partition("::")[0] == order[0].partition("::")[0]][:FIRST_TESTS]
        tests = 0
        for part in (first, [name for name in order if name not in first]):
            if part:
                probe = run_tests(self.root, list(dict.fromkeys(name.partition("::")[0] for name in part)), part, 1)
                tests += len(probe.seconds)
                if probe.failed:
                    return {"failed": probe.failed, "tests": tests}
        return {"failed": {}, "tests": tests}

    def run(self, mutants: list[Mutant], at_once: int, session: pytest.Session) -> Iterator[tuple[Mutant, Verdict]]:
        """All verdicts, as they come. `session`: pytest's, everything collected."""
        begun: dict[Mutant, float] = {}

        def jobs() -> Iterator[Job[Mutant]]:
            for mutant in mutants:
                order = self.order(mutant)
                begun[mutant] = time.monotonic()
                expected = sum(self._seconds[name] for name in order)
                yield Job(mutant, partial(self.probe, mutant, order, session), CPU_SLACK_S + CPU_PER_SECOND * expected)

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


def _compiles(source: str) -> bool:
    try:
        compile(source, "changed", "exec", dont_inherit=True)
    except (SyntaxError, ValueError):
        return False
    return True


def run_items(session: pytest.Session, order: list[str]) -> Answer:
    """Run collected tests in this order until one fails."""
    probe = next(plugin for plugin in session.config.pluginmanager.get_plugins() if isinstance(plugin, Probe))
    items = {item.nodeid: item for item in session.items}
    for name in order:
        session.config.hook.pytest_runtest_protocol(item=items[name], nextitem=None)
        if probe.failed:
            break
    return {"failed": probe.failed, "tests": len(probe.seconds)}


@dataclass(eq=False)
class Task:
    """What to hunt: files, and how. `sample`: so many mutants of each file, chosen at random; None = all."""

    root: Path
    paths: list[str]
    tests: TestMap
    ledger: Path
    suite: str
    budget_s: float
    sample: int | None
    at_once: int
    report: Report

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """In place of running the tests once: with everything imported and collected, fork for every mutant."""
        ledger = Ledger(self.ledger)
        self._check_soundness(session, ledger)
        for path in self.paths:
            hunt = Hunt(self.root, path, self.tests, self.budget_s)
            known, mutants = ledger.known(path, hunt.source, self.suite), mutants_of(path, hunt.source)
            random.Random(path).shuffle(mutants)  # a run that is stopped, or a sample, has seen a fair choice
            pending = [m for m in mutants[: self.sample] if (m.operator, m.occurrence) not in known]
            for mutant, verdict in hunt.run(pending, self.at_once, session):
                ledger.add(mutant, hunt.source, self.suite, verdict)
                self.report(mutant, verdict)
        ledger.close()
        return True

    def _check_soundness(self, session: pytest.Session, ledger: Ledger) -> None:
        """Without any change every test must pass in a forked child too, or each mutant would seem killed."""
        state = hashlib.sha256("".join([self.suite, *sources(self.root).values()]).encode()).hexdigest()
        if ledger.is_sound(state):
            return
        seconds = self.tests.seconds
        job = Job("unchanged", partial(run_items, session, list(seconds)), CPU_SLACK_S + CPU_PER_SECOND * sum(seconds.values()))
        answer = dict(run_forked(iter([job]), 1))["unchanged"]
        if answer.get("failed") or answer.get("tests") != len(seconds):
            raise BaselineError(f"without any change: {answer}")
        ledger.mark_sound(state)


def hunt_all(task: Task) -> None:
    """Run the mutants that have no verdict yet, in a process of its own (what it imports stays there)."""
    pid = os.fork()
    if pid:
        status = os.waitpid(pid, 0)[1]
        if status:
            raise ChildProcessError(f"the process that hunts mutants ended with status {status}")
        return
    code = 1
    try:
        fixed_examples()
        probe = run_tests(task.root, list(task.tests.files), None, 0, (task,))
        code = 0 if not probe.failed else 1
        sys.stderr.write("".join(probe.failed.values()))
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        os._exit(code)
