"""What public clients saw, as tables."""

from __future__ import annotations

from typing import Any


def markdown(result: dict[str, Any]) -> str:
    """A table per kind of client: those that know the same verbs share one."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, shown in result["clients"].items():
        groups.setdefault(tuple(step["verb"] for step in shown), []).append(name)
    tables = [_table(verbs, {name: result["clients"][name] for name in names}) for verbs, names in groups.items()]
    return "\n\n".join([f"`{result['command']}`, world `{result['world']}`:", *tables])


def _table(verbs: tuple[str, ...], clients: dict[str, list[dict[str, Any]]]) -> str:
    lines = [f"| verb | {' | '.join(clients)} |", "|---|" + "---|" * len(clients)]
    for number, verb in enumerate(verbs):
        lines.append(f"| {verb} | {' | '.join(_cell(shown[number]) for shown in clients.values())} |")
    return "\n".join(lines)


def _cell(step: dict[str, Any]) -> str:
    seen = str(step["seen"]).replace("|", "/")
    return seen if step["ok"] else f"**failed**: {seen}"
