"""Figures from the ledger, and the list of mutants that are proved equivalent."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from campaigns.mutation.ledger import KILLED, NO_CHANGE, SURVIVED, TIMEOUT, Ledger, Verdict
from campaigns.mutation.mutants import Mutant, mutants_of, sources

EQUIVALENT = Path("tests/safety/equivalent_mutants.json")
MOST_EQUIVALENT = 0.02  # share of all mutants that the list may hold


@dataclass(frozen=True, slots=True)
class Equivalent:
    """A change that cannot be noticed, and why. Named by its text, which survives other edits of the file."""

    path: str
    definition: str
    before: str
    after: str
    proof: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What identifies the change."""
        return self.path, self.definition, self.before, self.after


def load_equivalents(path: Path = EQUIVALENT) -> list[Equivalent]:
    """The reviewed list."""
    return [Equivalent(**entry) for entry in json.loads(path.read_text())] if path.exists() else []


def collect(root: Path, ledger: Ledger, suite: str) -> list[tuple[Mutant, Verdict | None]]:
    """Every mutant of today's sources with its verdict, None when it has not been run."""
    result: list[tuple[Mutant, Verdict | None]] = []
    for path, source in sources(root).items():
        known = ledger.known(path, source, suite)
        result += [(mutant, known.get((mutant.operator, mutant.occurrence))) for mutant in mutants_of(path, source)]
    return result


def figures(found: list[tuple[Mutant, Verdict | None]], equivalents: list[Equivalent]) -> dict[str, Any]:
    """Counts per file and in all, and every mutant that no test killed."""
    proofs = {one.key: one.proof for one in equivalents}
    per_file: dict[str, Counter[str]] = {}
    survivors: list[dict[str, Any]] = []
    for mutant, verdict in found:
        counts = per_file.setdefault(mutant.path, Counter())
        counts["mutants"] += 1
        counts[verdict.outcome if verdict else "not run"] += 1
        if verdict is not None and verdict.outcome in {SURVIVED, TIMEOUT}:
            proof = proofs.get((mutant.path, mutant.definition, verdict.before, verdict.after))
            counts["proved equivalent"] += proof is not None
            survivors.append(
                asdict(mutant) | {"outcome": verdict.outcome, "before": verdict.before, "after": verdict.after, "proof": proof}
            )
    total = sum(per_file.values(), Counter())
    real = total["mutants"] - total[NO_CHANGE] - total["not run"]
    return {
        "mutants": total["mutants"],
        "only_annotations": total[NO_CHANGE],
        "killed": total[KILLED],
        "survived": total[SURVIVED],
        "timeout": total[TIMEOUT],
        "not_run": total["not run"],
        "proved_equivalent": total["proved equivalent"],
        "unexplained": total[SURVIVED] + total[TIMEOUT] - total["proved equivalent"],
        "score": total[KILLED] / max(real, 1),
        "equivalent_share": total["proved equivalent"] / max(real, 1),
        "files": {path: dict(counts) for path, counts in sorted(per_file.items())},
        "survivors": survivors,
    }
