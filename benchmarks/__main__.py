"""`python -m benchmarks NAME [--json]`: run one benchmark, or `all`.

Each benchmark is a module with `run(json: bool) -> list[dict]`; a figure has name, value, unit, peer, ratio, target, ok.
Ratios compare within one run: machines are shared, absolute times mean little.
"""

from __future__ import annotations

import argparse
import importlib
import json
import pkgutil
import sys
import time
from pathlib import Path
from typing import Any

import benchmarks

Figure = dict[str, Any]


def names() -> list[str]:
    """The benchmarks there are: every module of this folder."""
    return sorted(m.name for m in pkgutil.iter_modules(benchmarks.__path__) if not m.name.startswith("_"))


def run_one(name: str, as_json: bool) -> list[Figure]:
    """Run one benchmark and keep its figures under runs/benchmarks/."""
    print(f"== {name} ==", file=sys.stderr, flush=True)
    started = time.perf_counter()
    figures: list[Figure] = importlib.import_module(f"benchmarks.{name}").run(as_json)
    folder = Path("runs/benchmarks")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(figures, indent=1) + "\n")
    print(f"   {len(figures)} figures in {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return figures


def table(figures: list[Figure]) -> str:
    """The figures as aligned text."""
    head = ("name", "value", "unit", "peer", "ratio", "target", "ok")
    rows = [head, *(tuple(_cell(figure.get(key)) for key in head) for figure in figures)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=[*names(), "all"], help="which benchmark")
    parser.add_argument("--json", action="store_true", help="one JSON list on stdout")
    arguments = parser.parse_args()
    chosen = names() if arguments.name == "all" else [arguments.name]
    figures = [figure for name in chosen for figure in run_one(name, arguments.json)]
    print(json.dumps(figures, indent=1) if arguments.json else table(figures))
    return 0 if all(figure.get("ok") is not False for figure in figures) else 1


if __name__ == "__main__":
    sys.exit(main())
