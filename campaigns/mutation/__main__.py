"""Mutation score of `safety/` under the tests in tests/safety.

    python -m campaigns.mutation --out results/mutation.json

Makes every mutant that cosmic-ray's operators make, each in a child forked from a process that has everything else imported.
Verdicts are kept in --work, so that a stopped run goes on where it was; after stronger tests only the survivors run again.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import sys
import time
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from campaigns.command_line import positive, prepare_output, run_command
from campaigns.mutation.hunt import Task, hunt_all
from campaigns.mutation.ledger import KILLED, Ledger, Verdict
from campaigns.mutation.mutants import Mutant, sources
from campaigns.mutation.probe import EXAMPLES
from campaigns.mutation.report import collect, figures, load_equivalents
from campaigns.mutation.suite import SLOW, properties, suite_digest
from campaigns.mutation.testmap import BaselineError, TestMap


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m campaigns.mutation", description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--out", type=Path, help="write the result to this JSON file")
    parser.add_argument("--module", action="append", help="only this file, e.g. safety/limits.py; may be repeated")
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1, help="mutants at a time")
    parser.add_argument("--work", type=Path, default=Path("runs/mutation"), help="folder of the ledger and the map of the tests")
    parser.add_argument("--fresh", action="store_true", help="forget all verdicts first")
    parser.add_argument("--budget-s", type=float, default=math.inf, help="per mutant, only the fastest tests of this much time")
    parser.add_argument("--sample", type=positive, help="only so many mutants of each file, chosen at random")
    parser.add_argument("--without", nargs="*", default=list(SLOW), help="test files that are left out")
    parser.add_argument("--list", action="store_true", help="print the survivors that have no proof")
    return parser.parse_args()


def show(mutant: Mutant, verdict: Verdict) -> None:
    """One line per mutant that was not killed."""
    if verdict.outcome != KILLED and verdict.tests:
        where = f"{mutant.path}:{mutant.line} {mutant.definition}"
        print(f"{verdict.outcome} ({verdict.seconds:.0f} s) {where}\n  - {verdict.before}\n  + {verdict.after}", flush=True)


def command_of(chosen: argparse.Namespace) -> str:
    """The command line, as far as it decides the result."""
    modules = "".join(f" --module {path}" for path in chosen.module or ())
    sample = f" --sample {chosen.sample}" if chosen.sample else ""
    budget = f" --budget-s {chosen.budget_s:g}" if math.isfinite(chosen.budget_s) else ""
    return f"python -m campaigns.mutation{modules}{sample}{budget} --out results/mutation.json"


def main() -> int:
    """Run what has no verdict yet; 0 when every mutant is killed or proved equivalent."""
    chosen, root, begin = options(), Path.cwd(), time.monotonic()
    if unknown := set(chosen.module or ()) - set(sources(root)):
        raise ValueError(f"no such file of safety/: {', '.join(sorted(unknown))}; write it as safety/limits.py")
    if chosen.out:
        prepare_output(chosen.out)
    chosen.work.mkdir(parents=True, exist_ok=True)
    sys.pycache_prefix, sys.dont_write_bytecode = str(chosen.work / "pycache"), False  # children find test files compiled
    ledger_path = chosen.work / "ledger.sqlite"
    if chosen.fresh:
        ledger_path.unlink(missing_ok=True)
    tests = TestMap(root, chosen.work / "tests.json", chosen.without)
    print(f"recorded: {', '.join(tests.refresh(chosen.jobs)) or 'nothing new'}", flush=True)
    print(f"fail without any change, and judge nothing: {', '.join(tests.broken) or 'none'}", flush=True)
    suite = suite_digest(root, chosen.budget_s)
    paths = chosen.module or list(sources(root))
    hunt_all(Task(root, paths, tests, ledger_path, suite, chosen.budget_s, chosen.sample, chosen.jobs, show))
    ledger = Ledger(ledger_path)
    result = figures(collect(root, ledger, suite), load_equivalents())
    ledger.close()
    result |= {
        "cosmic_ray": importlib.metadata.version("cosmic-ray"),
        "tests": len(tests.seconds),
        "broken_tests": tests.broken,
        "properties": len(properties(root)),
        "examples_per_property": EXAMPLES,
        "seconds": time.monotonic() - begin,
        "command": command_of(chosen),
    }
    if chosen.list:
        for one in (s for s in result["survivors"] if not s["proof"]):
            print(f"{one['path']}:{one['line']} {one['definition']} {one['operator']}\n  - {one['before']}\n  + {one['after']}")
    if chosen.out:
        chosen.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({name: value for name, value in result.items() if name not in {"survivors", "command"}}))
    return 0 if result["unexplained"] == 0 and result["not_run"] == 0 else 1


if __name__ == "__main__":
    run_command("mutation", main, BaselineError, ValueError)
