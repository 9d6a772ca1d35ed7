"""The architecture as a test: which house may import which, and what a companion computer must never need."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ALLOWED = {
    "safety": set(),
    "policy_export": set(),
    "sim_gateway": set(),
    "flight": {"safety", "policy_export"},
    "training": {"sim_gateway", "policy_export"},
    "campaigns": {"training", "flight", "sim_gateway", "policy_export", "safety"},
}
# What the companion computer does not have.
HEAVY = {"torch", "jsbsim", "pymavlink", "gymnasium", "numba", "onnx", "onnxscript"}
# What flight uses of policy_export; everything these import must do without the exporter's libraries.
RUNTIME_ROOTS = ("policy_export.runner", "policy_export.observation", "policy_export.contract")


def imports(path: Path) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module, node.lineno


def files(house: str) -> list[Path]:
    found = sorted((ROOT / house).rglob("*.py"))
    assert found, f"no Python file in {house}/"
    return found


@pytest.mark.parametrize("house", ALLOWED)
def test_no_house_imports_one_it_must_not_know(house: str) -> None:
    known = ALLOWED[house] | {house}
    bad = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in files(house)
        for name, line in imports(path)
        if name.split(".")[0] in ALLOWED and name.split(".")[0] not in known
    ]
    assert bad == []


def flying_files() -> list[Path]:
    """All of flight and safety, and the part of policy_export that the runner, the contract or the observation imports."""
    reached, waiting = set(), list(RUNTIME_ROOTS)
    while waiting:
        name = waiting.pop()
        path = ROOT.joinpath(*name.split(".")).with_suffix(".py")
        if name not in reached and path.is_file():
            reached.add(name)
            waiting += [other for other, _ in imports(path) if other.startswith("policy_export.")]
    return [ROOT.joinpath(*name.split(".")).with_suffix(".py") for name in sorted(reached)] + files("flight") + files("safety")


def test_what_flies_needs_no_simulator_and_no_trainer() -> None:
    checked = flying_files()
    assert ROOT / "policy_export" / "policy_file.py" in checked
    bad = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in checked
        for name, line in imports(path)
        if name.split(".")[0] in HEAVY
    ]
    assert bad == []


def test_importing_what_flies_loads_nothing_heavy() -> None:
    code = (
        "import sys, pkgutil, importlib, flight, safety, policy_export.runner\n"
        "for house in (flight, safety):\n"
        "    for module in pkgutil.walk_packages(house.__path__, house.__name__ + '.'):\n"
        "        if not module.name.endswith('__main__'): importlib.import_module(module.name)\n"
        f"print(sorted(set(sys.modules) & {HEAVY!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_no_circular_imports_between_files() -> None:
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for house in ALLOWED for p in files(house)}
    graph = {name: {n for n, _ in imports(path) if n in modules and not _lazy(path, n)} for name, path in modules.items()}
    assert _cycle(graph) == []


def _lazy(path: Path, name: str) -> bool:
    """Imported only inside a function or for type checking: no cycle at import time."""
    tree = ast.parse(path.read_text())
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    return not any(
        (isinstance(node, ast.ImportFrom) and node.module == name)
        or (isinstance(node, ast.Import) and any(alias.name == name for alias in node.names))
        for node in top
    )


def _cycle(graph: dict[str, set[str]]) -> list[str]:
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done:
            return []
        for other in sorted(graph[name]):
            found = visit(other, [*path, name])
            if found:
                return found
        done.add(name)
        return []

    for name in graph:
        found = visit(name, [])
        if found:
            return found
    return []
