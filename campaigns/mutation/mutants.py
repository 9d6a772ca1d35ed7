"""The mutants of a source file: cosmic-ray's own operators, in cosmic-ray's own order and numbering."""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.ast.ast_query import ASTQuery
from cosmic_ray.mutating import MutationVisitor
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator, operator_names

Scope = TypeVar("Scope", ast.FunctionDef, ast.ClassDef)
RUNTIME_FIELDS = ("ClassVar", "InitVar", "KW_ONLY")  # annotations that a dataclass reads


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: the `occurrence`-th place where `operator` applies in the file. `line`: where it begins, from 1."""

    path: str
    operator: str
    occurrence: int
    line: int
    definition: str


def operators() -> Iterator[tuple[str, Operator]]:
    """Every operator that needs no arguments, as cosmic-ray uses them without a configuration."""
    for name in operator_names():
        kind = get_operator(name)
        if not kind.arguments():
            yield name, kind()


def mutants_of(path: str, source: str) -> list[Mutant]:
    """All mutants of a file, in a fixed order."""
    nodes = list(ast_nodes(get_ast(source)))
    found = []
    for name, operator in operators():
        places = ((node, start) for node in nodes for start, _ in operator.mutation_positions(node))
        for occurrence, (node, start) in enumerate(places):
            found.append(Mutant(path, name, occurrence, start[0], ASTQuery(node).get_definition_name() or ""))
    return found


class SourceFile:
    """One file, parsed once: a forked child changes the tree that it inherited."""

    def __init__(self, path: str, source: str) -> None:
        self.path, self.source = path, source
        self._tree = get_ast(source)
        self._executable = executable(source)

    def changed(self, mutant: Mutant) -> str:
        """The source with the one change made. Only once per process: the tree stays changed."""
        visitor = MutationVisitor(mutant.occurrence, get_operator(mutant.operator)())
        tree = visitor.walk(self._tree)
        if not visitor.mutation_applied:
            raise ValueError(f"{mutant.operator} has no {mutant.occurrence}-th place in {self.path}; list the mutants again")
        return str(tree.get_code())

    def same_program(self, changed: str) -> bool:
        """Whether the change touches nothing but annotations that never run."""
        return self._executable is not None and self._executable == executable(changed)


def changed_lines(source: str, changed: str) -> tuple[str, str]:
    """What stood there and what stands there now, without indentation; several lines joined by ` / `."""
    old, new = source.splitlines(), changed.splitlines()
    if len(old) == len(new):
        pairs = [(a.strip(), b.strip()) for a, b in zip(old, new, strict=True) if a != b]
        return " / ".join(a for a, _ in pairs), " / ".join(b for _, b in pairs)
    difference = [line for line in difflib.unified_diff(old, new, n=0, lineterm="") if not line.startswith(("---", "+++", "@@"))]
    before = " / ".join(line[1:].strip() for line in difference if line.startswith("-"))
    return before, " / ".join(line[1:].strip() for line in difference if line.startswith("+"))


def executable(source: str) -> str | None:
    """What runs of a source, to compare; None where annotations run (no `from __future__ import annotations`) or nothing does."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return None
    if not any(isinstance(node, ast.ImportFrom) and node.module == "__future__" for node in tree.body):
        return None
    return ast.dump(_WithoutAnnotations().visit(tree))


class _WithoutAnnotations(ast.NodeTransformer):
    """Takes out annotations that nothing evaluates. Those of other than dataclass fields may be read (pydantic): they stay."""

    def __init__(self) -> None:
        self._in_plain_scope = [True]

    def visit_arg(self, node: ast.arg) -> ast.arg:
        node.annotation = None
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        node.returns = None
        return self._scoped(node, True)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.ClassDef:
        return self._scoped(node, any("dataclass" in ast.dump(decorator) for decorator in node.decorator_list))

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AnnAssign:
        if self._in_plain_scope[-1] and not any(name in ast.dump(node.annotation) for name in RUNTIME_FIELDS):
            node.annotation = ast.Constant(None)
        self.generic_visit(node)
        return node

    def _scoped(self, node: Scope, plain: bool) -> Scope:
        self._in_plain_scope.append(plain)
        self.generic_visit(node)
        self._in_plain_scope.pop()
        return node


def definitions(source: str) -> dict[int, tuple[int, int]]:
    """For each line inside a function's body, the first and last line of that (outermost) body."""
    spans: dict[int, tuple[int, int]] = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            span = (node.body[0].lineno, node.end_lineno or node.lineno)
            for line in range(span[0], span[1] + 1):
                spans.setdefault(line, span)
    return spans


def sources(root: Path, folder: str = "safety") -> dict[str, str]:
    """Text of every file of a package by its path relative to `root`."""
    return {path.relative_to(root).as_posix(): path.read_text() for path in sorted((root / folder).rglob("*.py"))}
