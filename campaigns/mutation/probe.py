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
    """A pytest plugin: keeps the tests of `order` (all when None), in that order; notes durations and failures."""

    order: list[str] | None
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

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """A test file that cannot even be imported."""
        if report.failed:
            self.failed[report.nodeid] = f"not collected: {report.longreprtext[-400:]}"

    def pytest_internalerror(self, excrepr: object) -> None:
        """An error outside any test."""
        self.failed["pytest"] = str(excrepr)[-400:]


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


def run_tests(root: Path, files: list[str], order: list[str] | None, failures: int, plugins: tuple[Any, ...] = ()) -> Probe:
    """Run tests of some files until so many have failed (0: all)."""
    probe = Probe(order)
    sys.path[:0] = [str(root)]
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # quick to start; hypothesis works without its own
    arguments = [*OPTIONS, f"--maxfail={failures}", f"--rootdir={root}", "-c", str(root / "pyproject.toml")]
    code = pytest.main([*arguments, *(str(root / name) for name in files)], plugins=[probe, *plugins])
    if code != pytest.ExitCode.OK and not probe.failed:
        probe.failed["pytest"] = f"exit code {int(code)}"
    return probe
