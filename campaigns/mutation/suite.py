"""Which tests a mutant is shown to."""

from __future__ import annotations

import ast
import hashlib
import math
from pathlib import Path

TESTS = "tests/safety"
SLOW = (
    "test_closed_loop.py",
    "test_closed_loop_vehicle.py",
    "test_fence_closed_loop.py",
    "test_fence_oracle.py",
    "test_false_alarms.py",
)
"""Test files that are not shown to mutants: leaving them out can only make a mutant survive that they would kill."""


def suite_digest(root: Path, budget_s: float = math.inf) -> str:
    """Identifies the tests that a survivor has survived."""
    text = "".join(path.read_text() for path in sorted((root / TESTS).rglob("*.py")))
    return hashlib.sha256(f"{text}{budget_s}".encode()).hexdigest()


def properties(root: Path) -> list[str]:
    """Names of the tests that hypothesis feeds: functions under `@given`, and state machines."""
    found = []
    for path in sorted((root / TESTS).rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            given = isinstance(node, ast.FunctionDef) and any(_is_given(decorator) for decorator in node.decorator_list)
            machine = isinstance(node, ast.ClassDef) and any("StateMachine" in ast.dump(base) for base in node.bases)
            if given or machine:
                found.append(f"{path.name}::{getattr(node, 'name', '')}")
    return found


def _is_given(decorator: ast.expr) -> bool:
    return isinstance(decorator, ast.Call) and isinstance(decorator.func, ast.Name) and decorator.func.id == "given"
