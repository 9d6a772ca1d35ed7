"""Does `cosmic-ray exec` itself come to the same verdicts? A sample of mutants, in a copy of the tree, one process each.

python -m campaigns.mutation.crosscheck --count 30 --out results/mutation_crosscheck.json
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.plugins import get_operator
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, WorkItem

from campaigns.mutation.ledger import KILLED, SURVIVED, Ledger, Verdict
from campaigns.mutation.mutants import Mutant
from campaigns.mutation.report import collect
from campaigns.mutation.suite import suite_digest

COPIED = ("safety", "sim_gateway", "tests/safety", "tests/conftest.py", "strict_yaml.py", "pyproject.toml")
TIMEOUT_S = 600.0
CONFIG = """[cosmic-ray]
module-path = "safety"
timeout = {timeout}
excluded-modules = []
test-command = "{python} -m pytest -x -q -p no:cacheprovider tests/safety"

[cosmic-ray.distributor]
name = "local"
"""


def sample(root: Path, ledger: Ledger, suite: str, count: int, seed: int) -> list[tuple[Mutant, Verdict]]:
    """Mutants whose verdicts are compared: at random, a fifth of them survivors where there are so many."""
    found = [(m, v) for m, v in collect(root, ledger, suite) if v is not None and v.outcome in {KILLED, SURVIVED}]
    chance = random.Random(seed)
    survivors = [pair for pair in found if pair[1].outcome == SURVIVED]
    killed = [pair for pair in found if pair[1].outcome == KILLED]
    few = chance.sample(survivors, min(count // 5, len(survivors)))
    return few + chance.sample(killed, min(count - len(few), len(killed)))


def work_item(root: Path, mutant: Mutant) -> WorkItem:
    """The same mutant in cosmic-ray's own terms."""
    operator = get_operator(mutant.operator)()
    nodes = ast_nodes(get_ast((root / mutant.path).read_text()))
    places = [place for node in nodes for place in operator.mutation_positions(node)]
    begin, end = places[mutant.occurrence]
    return WorkItem.single(uuid.uuid4().hex, MutationSpec(mutant.path, mutant.operator, mutant.occurrence, begin, end))


def copy_tree(root: Path, target: Path) -> None:
    """What the tests of safety need."""
    for name in COPIED:
        source = root / name
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target / name)


def execute(root: Path, mutants: list[Mutant]) -> dict[Mutant, str]:
    """Run `cosmic-ray exec` over them, in a copy; its outcomes."""
    with tempfile.TemporaryDirectory(prefix="crosscheck-") as folder:
        copy = Path(folder)
        copy_tree(root, copy)
        (copy / "config.toml").write_text(CONFIG.format(timeout=TIMEOUT_S, python=sys.executable))
        items = {mutant: work_item(root, mutant) for mutant in mutants}
        with use_db(copy / "session.sqlite", WorkDB.Mode.create) as database:
            database.add_work_items(items.values())
        command = [str(Path(sys.executable).parent / "cosmic-ray"), "exec", "config.toml", "session.sqlite"]
        environment = {"PYTHONPATH": str(copy), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        subprocess.run(command, cwd=copy, env=environment, check=True, timeout=TIMEOUT_S * len(mutants))
        with use_db(copy / "session.sqlite", WorkDB.Mode.open) as database:
            outcomes = {job: str(result.test_outcome.value) for job, result in database.results if result.test_outcome}
    return {mutant: outcomes.get(item.job_id, "none") for mutant, item in items.items()}


def compare(chosen: list[tuple[Mutant, Verdict]], theirs: dict[Mutant, str]) -> dict[str, Any]:
    """Agreement, and every pair."""
    rows = [
        {
            "path": m.path,
            "operator": m.operator,
            "occurrence": m.occurrence,
            "after": v.after,
            "ours": v.outcome,
            "cosmic_ray": theirs[m],
        }
        for m, v in chosen
    ]
    agreed = sum(row["ours"] == row["cosmic_ray"] for row in rows)
    return {"mutants": len(rows), "survivors": sum(row["ours"] == SURVIVED for row in rows), "agreed": agreed, "rows": rows}


def main() -> int:
    """Compare; 0 when all agree."""
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.mutation.crosscheck", description=(__doc__ or "").split("\n", maxsplit=1)[0]
    )
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--work", type=Path, default=Path("runs/mutation"))
    options, root, begin = parser.parse_args(), Path.cwd(), time.monotonic()
    ledger = Ledger(options.work / "ledger.sqlite")
    chosen = sample(root, ledger, suite_digest(root), options.count, options.seed)
    ledger.close()
    result = compare(chosen, execute(root, [mutant for mutant, _ in chosen])) | {
        "seconds": time.monotonic() - begin,
        "command": f"python -m campaigns.mutation.crosscheck --count {options.count} --out results/mutation_crosscheck.json",
    }
    if options.out:
        options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({name: value for name, value in result.items() if name != "rows"}))
    return 0 if result["agreed"] == result["mutants"] else 1


if __name__ == "__main__":
    sys.exit(main())
