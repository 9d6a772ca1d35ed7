"""Run chosen tests, in a chosen order, in this process, and say which failed."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hypothesis
import pytest

PROFILE = "mutation"
EXAMPLES = 30  # of a property, per mutant: the same ones every time
IDLE_PLUGINS = (
    "cacheprovider", "unraisableexception", "threadexception", "faulthandler", "warnings", "logging", "doctest", "junitxml",
)  # fmt: skip
OPTIONS = ("-q", "--tb=line", "--capture=no", "--assert=plain", "-o", "addopts=", *(f"-pno:{name}" for name in IDLE_PLUGINS))
CHOSEN_SETTINGS = "_hypothesis_internal_use_settings"  # where hypothesis keeps the settings of one test


@dataclass(eq=False)
class Probe:
    """A pytest plugin: keeps the tests of `order` (all when None), in that order; notes durations and failures.

    Ends the run when so many different test functions have failed (0: never); one that has failed is not run again.
    """

    order: list[str] | None
    enough: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    failed: dict[str, str] = field(default_factory=dict)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Choose and order."""
        if self.order is not None:
            known = {item.nodeid: item for item in items}
            items[:] = [known[name] for name in self.order if name in known]
        for item in items:
            _fewer_examples(item)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Note processor time: wall time says more about the neighbours."""
        begin = time.process_time()
        result = yield
        self.seconds[item.nodeid] = time.process_time() - begin
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note what failed."""
        if report.failed:
            self.failed[report.nodeid] = report.longreprtext[-400:]

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Leave out what would say the same once more."""
        if self.enough and function_of(item.nodeid) in map(function_of, self.failed):
            pytest.skip("failed already")
        if self.enough and len(set(map(function_of, self.failed))) >= self.enough:
            item.session.shouldstop = "enough"
            pytest.skip("enough have failed")

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """A test file that cannot even be imported."""
        if report.failed:
            self.failed[report.nodeid] = f"not collected: {report.longreprtext[-400:]}"

    def pytest_internalerror(self, excrepr: object) -> None:
        """An error outside any test."""
        self.failed["pytest"] = str(excrepr)[-400:]


def function_of(name: str) -> str:
    """The test function of a test: without its parameters."""
    return name.partition("[")[0]


def _fewer_examples(item: pytest.Item) -> None:
    function = getattr(item, "obj", None)
    chosen = getattr(function, CHOSEN_SETTINGS, None)
    if chosen is not None and chosen.max_examples > EXAMPLES:
        setattr(function, CHOSEN_SETTINGS, hypothesis.settings(chosen, max_examples=EXAMPLES))


def fixed_examples() -> None:
    """Properties run the same few examples every time, and are not shrunk: call before test files are imported."""
    hypothesis.settings.register_profile(
        PROFILE,
        derandomize=True,
        database=None,
        deadline=None,
        max_examples=EXAMPLES,
        phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate),
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    hypothesis.settings.load_profile(PROFILE)


def run_tests(root: Path, files: list[str], order: list[str] | None, enough: int, plugins: tuple[Any, ...] = ()) -> Probe:
    """Run tests of some files until so many different ones have failed (0: all)."""
    probe = Probe(order, enough)
    sys.path[:0] = [str(root)]
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # quick to start; hypothesis works without its own
    arguments = [
        *OPTIONS,
        *(["--exitfirst"] if enough == 1 else ["--continue-on-collection-errors"]),
        f"--rootdir={root}",
        "-c",
        str(root / "pyproject.toml"),
    ]
    code = pytest.main([*arguments, *(str(root / name) for name in files)], plugins=[probe, *plugins])
    if code != pytest.ExitCode.OK and not probe.failed:
        probe.failed["pytest"] = f"exit code {int(code)}"
    return probe
