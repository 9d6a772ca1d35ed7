"""Accidents written by hand: dangerous changes of `safety/` that somebody might make. Two tests or more must notice each.

    python -m campaigns.accidents --out results/accidents.json

Each entry of tests/safety/accidents/*.yaml names a file, the exact text that is there (once) and the text that would do harm.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from pydantic import BaseModel, ConfigDict

from campaigns.command_line import positive, prepare_output, run_command
from campaigns.mutation.forks import Answer, Job, run_forked
from campaigns.mutation.hotswap import forget, preload, swap
from campaigns.mutation.mutants import sources
from campaigns.mutation.probe import fixed_examples, function_of, run_tests
from campaigns.mutation.suite import SLOW
from campaigns.mutation.testmap import BaselineError, TestMap
from strict_yaml import load_config

FOLDER = Path("tests/safety/accidents")
LEAST_TESTS = 2  # that must notice each accident
CPU_S = 400.0


class Accident(BaseModel):
    """One dangerous change. `catalogue`: fault or edge case it stands for."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    catalogue: str
    story: str
    file: str
    old: str
    new: str

    def applied(self, source: str) -> str:
        """The source with the change made. Raises `ValueError` when the text is not there exactly once."""
        times = source.count(self.old)
        if times != 1:
            raise ValueError(f"accident '{self.name}': its old text stands {times} times in {self.file}; write it anew")
        return source.replace(self.old, self.new)


class AccidentFile(BaseModel):
    """What a YAML file of accidents holds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    accidents: list[Accident]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Which tests noticed an accident, and why there is no answer if there is none."""

    accident: Accident
    tests: list[str]
    problem: str

    @property
    def noticed(self) -> bool:
        """Whether enough tests noticed it."""
        return len(set(map(function_of, self.tests))) >= LEAST_TESTS


def load_accidents(folder: Path = FOLDER) -> list[Accident]:
    """All accidents, file by file."""
    return [one for path in sorted(folder.glob("*.yaml")) for one in load_config(path, AccidentFile).accidents]


def _order(tests: TestMap, accident: Accident, source: str) -> list[str]:
    """The tests that run the changed lines, the fast ones first."""
    first = source[: source.index(accident.old)].count("\n") + 1
    found: dict[str, bool] = {}
    for line in range(first, first + accident.old.rstrip("\n").count("\n") + 1):
        covering, exact = tests.covering(accident.file, source, line)
        found |= {name: found.get(name, False) or name in exact for name in covering}
    return sorted(found, key=lambda name: (not found[name], tests.seconds[name]))


def orders(root: Path, accidents: list[Accident], tests: TestMap) -> dict[str, list[str]]:
    """For each accident the tests that may notice it."""
    texts = sources(root)
    return {accident.name: _order(tests, accident, texts[accident.file]) for accident in accidents}


def recorded(path: Path) -> dict[str, list[str]]:
    """For each accident of an earlier result the tests that noticed it then."""
    return {entry["name"]: entry["noticed_by"] for entry in json.loads(path.read_text())["entries"]}


def happen(root: Path, accidents: list[Accident], tests: dict[str, list[str]], at_once: int) -> Iterator[Outcome]:
    """Let each accident happen in a forked child, and see which of its tests notice; in the order in which they end."""
    texts = sources(root)
    changed = {accident.name: accident.applied(texts[accident.file]) for accident in accidents}
    fixed_examples()
    preload(["numpy.testing", "pydantic"])

    def look(accident: Accident) -> Answer:
        forget(root)
        swap(root, {accident.file: changed[accident.name]})
        order = tests[accident.name]
        probe = run_tests(root, list(dict.fromkeys(name.partition("::")[0] for name in order)), order, LEAST_TESTS)
        return {"failed": [name for name in probe.failed if name in probe.seconds], "others": probe.failed}

    by_name = {accident.name: accident for accident in accidents}
    jobs = (Job(accident.name, partial(look, accident), CPU_S) for accident in accidents)
    for name, answer in run_forked(jobs, at_once):
        problem = answer.get("ended", "") or ("" if answer["failed"] else "; ".join(answer["others"].values()))
        yield Outcome(by_name[name], answer.get("failed", []), problem)


def report(outcomes: list[Outcome]) -> dict[str, Any]:
    """All outcomes as one JSON object."""
    entries = [
        {"name": one.accident.name, "catalogue": one.accident.catalogue, "file": one.accident.file, "story": one.accident.story}
        | {"noticed_by": one.tests, "problem": one.problem}
        for one in sorted(outcomes, key=lambda one: (one.accident.file, one.accident.name))
    ]
    return {
        "accidents": len(outcomes),
        "noticed_by_two_tests_or_more": sum(one.noticed for one in outcomes),
        "command": "python -m campaigns.accidents --out results/accidents.json",
        "entries": entries,
    }


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m campaigns.accidents", description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, help="write the result to this JSON file")
    parser.add_argument("--only", action="append", help="only accidents with this text in their name; may be repeated")
    parser.add_argument(
        "--ignore", action="append", default=[], help="leave out tests with this text in their name (unsteady ones)"
    )
    parser.add_argument("--missing", action="store_true", help="only what the file at --out does not show as noticed; it is kept")
    parser.add_argument("--again", type=Path, help="an earlier result: run only the tests that noticed each accident then")
    parser.add_argument("--handful", type=positive, help="only so many, every day others")
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="accidents at a time")
    parser.add_argument("--work", type=Path, default=Path("runs/mutation"), help="folder of the map of the tests")
    return parser.parse_args()


def handful(accidents: list[Accident], count: int, day: int) -> list[Accident]:
    """So many of them; on consecutive days all get their turn."""
    first = day * count % max(len(accidents), 1)
    return (accidents * 2)[first : first + min(count, len(accidents))]


def _noticed(path: Path, ignore: list[str]) -> dict[str, list[str]]:
    """Accidents of an earlier result that enough tests noticed, those to be ignored not counted."""
    seen = recorded(path) if path.exists() else {}
    left = {name: [one for one in tests if not any(text in one for text in ignore)] for name, tests in seen.items()}
    return {name: tests for name, tests in left.items() if len(set(map(function_of, tests))) >= LEAST_TESTS}


def main() -> int:
    """Let accidents happen; 0 when each was noticed by enough tests."""
    chosen, root = options(), Path.cwd()
    if chosen.out:
        prepare_output(chosen.out)
    accidents = [one for one in load_accidents() if not chosen.only or any(text in one.name for text in chosen.only)]
    kept = _noticed(chosen.out, chosen.ignore) if chosen.missing and chosen.out else {}
    accidents = [one for one in accidents if one.name not in kept]
    if chosen.again:
        again = _noticed(chosen.again, chosen.ignore)
        accidents = [one for one in accidents if one.name in again]
    if chosen.handful:
        accidents = handful(accidents, chosen.handful, date.today().toordinal())
    if chosen.again:
        tests = recorded(chosen.again)
    else:
        chosen.work.mkdir(parents=True, exist_ok=True)
        sys.pycache_prefix, sys.dont_write_bytecode = str(chosen.work / "pycache"), False
        known = TestMap(root, chosen.work / "tests.json", SLOW)
        known.refresh(chosen.jobs)
        print(f"fail without any change, and judge nothing: {', '.join(known.broken) or 'none'}", flush=True)
        preload(known.modules)
        tests = orders(root, accidents, known)
        tests = {name: [one for one in order if not any(text in one for text in chosen.ignore)] for name, order in tests.items()}
    outcomes = [Outcome(one, kept[one.name], "") for one in load_accidents() if one.name in kept]
    for outcome in happen(root, accidents, tests, chosen.jobs):
        outcomes.append(outcome)
        who = ", ".join(outcome.tests) or outcome.problem or "nobody"
        print(f"{len(outcome.tests)} {outcome.accident.name}: {who}", flush=True)
        if chosen.out:  # after each: a run that is stopped keeps what it has seen
            chosen.out.write_text(json.dumps(report(outcomes), indent=1) + "\n")
    noticed = sum(outcome.noticed for outcome in outcomes)
    print(f"{noticed} of {len(outcomes)} accidents noticed by {LEAST_TESTS} tests or more")
    return 0 if outcomes and all(one.noticed for one in outcomes) else 1


if __name__ == "__main__":
    run_command("accidents", main, BaselineError, ValueError)
