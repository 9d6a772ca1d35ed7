"""Which tests run which lines, and how long they take: recorded once per test file, kept beside the ledger."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from campaigns.mutation.forks import Answer, Job, run_forked
from campaigns.mutation.mutants import definitions, sources
from campaigns.mutation.probe import fixed_examples, run_tests
from campaigns.mutation.suite import TESTS

RECORD_CPU_S = 900.0
Lines = dict[str, dict[int, list[str]]]  # file -> line -> tests that ran it; "" = while importing


class BaselineError(Exception):
    """A test fails without any change made."""


@dataclass(frozen=True, slots=True)
class FileMap:
    """What one test file does: seconds per test, lines per source file, modules it needs that are not ours."""

    seconds: dict[str, float]
    lines: Lines
    modules: list[str]


class _Contexts:
    """Tells coverage which test runs."""

    def __init__(self, coverage: Any) -> None:
        self._coverage = coverage

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._coverage.switch_context(item.nodeid)
        result = yield
        self._coverage.switch_context("")
        return result


def _record(root: Path, file: str) -> Answer:
    """In a child: run one test file under coverage."""
    from coverage import Coverage  # noqa: PLC0415  traces from here on; a plain run must not load it

    fixed_examples()
    coverage = Coverage(data_file=None, source=[str(root / "safety")], config_file=False)
    coverage.start()
    coverage.switch_context("")
    probe = run_tests(root, [file], None, 0, (_Contexts(coverage),))
    coverage.stop()
    data = coverage.get_data()
    number = {name: at for at, name in enumerate(probe.seconds)} | {"": -1}
    lines = {
        Path(name).relative_to(root).as_posix(): {
            line: [number[test] for test in tests] for line, tests in data.contexts_by_lineno(name).items()
        }
        for name in data.measured_files()
    }
    return {
        "seconds": probe.seconds,
        "failed": probe.failed,
        "lines": lines,
        "modules": sorted(set(_foreign(root)) - {"__main__"}),
    }


def _foreign(root: Path) -> Iterator[str]:
    """Names of imported modules that lie elsewhere."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if getattr(module, "__spec__", None) is not None and (file is None or not Path(file).is_relative_to(root)):
            yield name


class TestMap:
    """The whole map. `without`: names of test files that are not used (slow ones).

    `broken`: tests that fail without any change. They are told and judge nothing.
    """

    __test__ = False

    def __init__(self, root: Path, store: Path, without: Collection[str] = ()) -> None:
        self._root, self._store, self._without = root, store, without
        self.files: dict[str, FileMap] = {}
        self.broken: list[str] = []

    def refresh(self, at_once: int) -> list[str]:
        """Record the test files that are new or changed (all, when `safety/` or a helper changed); which ones."""
        kept = json.loads(self._store.read_text()) if self._store.exists() else {}
        wanted = self._digests()
        stale = [name for name, digest in wanted.items() if kept.get(name, {}).get("digest") != digest]
        jobs = (Job(name, partial(_record, self._root, name), RECORD_CPU_S) for name in stale)
        for name, answer in run_forked(iter(jobs), at_once):
            if "ended" in answer or not set(answer["failed"]) <= set(answer["seconds"]):
                raise BaselineError(f"{name} without any change: {answer.get('ended') or answer['failed']}")
            kept[name] = answer | {"digest": wanted[name]}
            self._store.write_text(json.dumps(kept))
        self.files = {name: _file_map(kept[name]) for name in wanted}
        self.broken = sorted(test for name in wanted for test in kept[name]["failed"])
        return stale

    def _digests(self) -> dict[str, str]:
        folder = self._root / TESTS
        own = sorted(folder.glob("test_*.py"))
        shared = "".join(sources(self._root).values())
        shared += "".join(path.read_text() for path in sorted(folder.rglob("*.py")) if path not in own)
        return {
            path.relative_to(self._root).as_posix(): hashlib.sha256((shared + path.read_text()).encode()).hexdigest()
            for path in own
            if path.name not in self._without
        }

    @property
    def seconds(self) -> dict[str, float]:
        """Duration of every test, s."""
        return {name: s for one in self.files.values() for name, s in one.seconds.items()}

    @property
    def modules(self) -> list[str]:
        """Every module of others that some test needs."""
        return sorted({name for one in self.files.values() for name in one.modules})

    def covering(self, path: str, source: str, line: int) -> tuple[list[str], set[str]]:
        """Tests that can notice a change of a line, and those of them that run the very line."""
        span = definitions(source).get(line)
        found: list[str] = []
        exact: set[str] = set()
        for one in self.files.values():
            ran = one.lines.get(path, {})
            exact |= set(ran.get(line, ())) & set(one.seconds)
            inside = _ran_in(ran, span)
            names = set(one.seconds) if "" in inside else inside  # run while importing: any test of the file may notice
            found += [name for name in one.seconds if name in names]
        return found, exact

    def runs_on_import(self, path: str, source: str, line: int) -> bool:
        """Whether the function that holds a line runs while some test file is imported."""
        span = definitions(source).get(line)
        return any("" in _ran_in(one.lines.get(path, {}), span) for one in self.files.values())


def _ran_in(ran: dict[int, list[str]], span: tuple[int, int] | None) -> set[str]:
    """Tests that ran any line of a span (of the whole file when None)."""
    return {test for at, tests in ran.items() if span is None or span[0] <= at <= span[1] for test in tests}


def _file_map(kept: Answer) -> FileMap:
    names = [*kept["seconds"], ""]
    lines = {
        path: {int(line): [names[at] for at in tests] for line, tests in found.items()} for path, found in kept["lines"].items()
    }
    seconds = {test: s for test, s in kept["seconds"].items() if test not in kept["failed"]}
    return FileMap(seconds, lines, kept["modules"])
