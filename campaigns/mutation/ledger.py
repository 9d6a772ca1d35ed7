"""Verdicts on disk: nothing is lost when a run is stopped, and nothing is run twice."""

from __future__ import annotations

import hashlib
import sqlite3
from dataclasses import astuple, dataclass
from pathlib import Path

from campaigns.mutation.mutants import Mutant

KILLED, SURVIVED, TIMEOUT, NO_CHANGE = "killed", "survived", "timeout", "no change"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one mutant. `killer`: the test that failed; `tests`: how many ran; `before`, `after`: the changed line."""

    outcome: str
    killer: str
    tests: int
    before: str
    after: str
    seconds: float


class Ledger:
    """One row per mutant of one state of a file."""

    def __init__(self, path: Path) -> None:
        self._db = sqlite3.connect(path)
        self._db.execute(
            "create table if not exists verdicts (path text, digest text, operator text, occurrence int, outcome text,"
            " killer text, tests int, before text, after text, seconds real, suite text,"
            " primary key (path, digest, operator, occurrence))"
        )

        self._db.execute("create table if not exists sound (state text primary key)")

    def is_sound(self, state: str) -> bool:
        """Whether all tests passed, without any change, for this state of sources and tests."""
        return self._db.execute("select 1 from sound where state = ?", (state,)).fetchone() is not None

    def mark_sound(self, state: str) -> None:
        """They did."""
        with self._db:
            self._db.execute("insert or replace into sound values (?)", (state,))

    def known(self, path: str, source: str, suite: str) -> dict[tuple[str, int], Verdict]:
        """Verdicts that hold for this source: a kill stays one, anything else holds for the same tests only."""
        rows = self._db.execute(
            "select operator, occurrence, outcome, killer, tests, before, after, seconds from verdicts"
            " where path = ? and digest = ? and (outcome in (?, ?) or suite = ?)",
            (path, _digest(source), KILLED, NO_CHANGE, suite),
        )
        return {(row[0], row[1]): Verdict(*row[2:]) for row in rows}

    def add(self, mutant: Mutant, source: str, suite: str, verdict: Verdict) -> None:
        """Keep one verdict."""
        values = (mutant.path, _digest(source), mutant.operator, mutant.occurrence, *astuple(verdict), suite)
        with self._db:
            self._db.execute("insert or replace into verdicts values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", values)

    def close(self) -> None:
        """Done."""
        self._db.close()


def _digest(source: str) -> str:
    return hashlib.sha256(source.encode()).hexdigest()
