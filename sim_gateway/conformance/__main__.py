"""Print the conformance table of the gateway against recordings of a real PX4.

python -m sim_gateway.conformance /path/to/px4_reference
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from sim_gateway.conformance import command_group, flight_group, guard_group, status_group
from sim_gateway.conformance.facts import Json, RecordingsError, read_facts, write_facts
from sim_gateway.conformance.rows import Row, same_share

WANTED = 0.95
GROUPS: dict[str, tuple[str, Callable[[Json], list[Row]]]] = {
    "census": ("link_census", status_group.census),
    "modes": ("modes", status_group.modes),
    "parameters": ("parameters", status_group.parameters),
    "commands": ("commands", command_group.commands),
    "lifecycle": ("lifecycle", flight_group.lifecycle),
    "offboard_loss": ("offboard_loss", flight_group.offboard_loss),
    "odd_setpoints": ("odd_setpoints", flight_group.odd_setpoints),
    "override": ("override", command_group.override),
    "geofence": ("geofence", guard_group.geofence),
    "failures": ("failures", guard_group.failures),
}


def compare(facts: dict[str, Json], only: str | None = None) -> list[Row]:
    """All rows, or those of one group."""
    return [row for name, (key, rows) in GROUPS.items() if only in (None, name) for row in rows(facts[key])]


def markdown(rows: list[Row]) -> str:
    """The table for docs/gateway.md: a line per group, then every row that differs."""
    lines = ["| recorded | behaviours | same |", "|---|---:|---:|"]
    for name in GROUPS:
        group = [row for row in rows if row.group == name]
        if group:
            lines.append(f"| {name} | {len(group)} | {sum(row.same for row in group)} |")
    lines.append(f"| **all** | **{len(rows)}** | **{sum(row.same for row in rows)} ({100 * same_share(rows):.1f} %)** |")
    lines += ["", "| what differs | PX4 v1.17 | gateway | why |", "|---|---|---|---|"]
    for row in rows:
        if not row.same:
            cells = (f"{row.group}: {row.case}", row.recorded, row.gateway, row.reason or "not yet as recorded")
            lines.append("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |")
    return "\n".join(lines)


def plain(rows: list[Row]) -> str:
    """Every row as one line of text, and the shares."""
    lines = [
        f"{'same' if row.same else 'DIFFERENT':9}  {row.group}: {row.case}: recorded {row.recorded}, gateway {row.gateway}"
        + (f" ({row.reason})" if row.reason else "")
        for row in rows
    ]
    for name in GROUPS:
        group = [row for row in rows if row.group == name]
        if group:
            lines.append(f"{name}: {sum(row.same for row in group)} of {len(group)} same")
    return "\n".join([*lines, f"all: {100 * same_share(rows):.1f} % of {len(rows)} same; wanted {100 * WANTED:.0f} %"])


def main(
    recordings: Annotated[Path, typer.Argument(help="The folder px4_reference, or a file written by --write-facts.")],
    only: Annotated[str | None, typer.Option(help=f"One group: {', '.join(GROUPS)}.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print the table of docs/gateway.md.")] = False,
    facts_file: Annotated[Path | None, typer.Option("--write-facts", help="Only write what is compared to this file.")] = None,
) -> None:
    """Compare; exit code 1 below 95 % same."""
    if only is not None and only not in GROUPS:
        raise typer.BadParameter(f"no group is called {only!r}: choose one of {', '.join(GROUPS)}")
    try:
        facts = read_facts(recordings)
    except RecordingsError as error:
        raise typer.BadParameter(str(error)) from None
    if facts_file is not None:
        write_facts(facts, facts_file)
        return
    rows = compare(facts, only)
    if as_json:
        typer.echo(json.dumps({"same": same_share(rows), "rows": [asdict(row) for row in rows]}, indent=1))
    else:
        typer.echo(markdown(rows) if as_markdown else plain(rows))
    raise typer.Exit(0 if same_share(rows) >= WANTED else 1)


if __name__ == "__main__":
    typer.run(main)
