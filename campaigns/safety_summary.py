"""What the campaigns against the safety layer have shown, a row each: (what, figure, command) for README."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Row = tuple[str, str, str]
Result = dict[str, Any]


def safety_rows(results: dict[str, Result]) -> list[Row]:
    """Of every campaign that has a result."""
    return [(what, figure(results[name]), results[name]["command"]) for name, (what, figure) in _ROWS.items() if name in results]


def _adversaries(result: Result) -> str:
    block = result["blocks"]["main"]
    return (
        f"{block['ticks']:,} ticks in {block['flights']:,} flights: {block['flights_with_violations']} crossed the fence, "
        f"touched something or broke a limit (least clearance {1e3 * block['clearance_m']:.0f} mm)"
    )


def _faults(result: Result) -> str:
    return f"{result['faults']} faults: {result['right']:,} of {result['runs']:,} right reactions in time"


def _process_death(result: Result) -> str:
    return (
        f"{result['good']} of {result['runs']} good: {result['late_moving_setpoints']} moving setpoints more than 150 ms later, "
        f"{result['contacts']} contacts"
    )


def _mutation(result: Result) -> str:
    tried = result["mutants"] - result["only_annotations"] - result["not_run"]
    return (
        f"{result['killed']:,} of {tried:,} mutants killed, {result['proved_equivalent']} proved equivalent, "
        f"{result['unexplained']} unexplained"
    )


_ROWS: dict[str, tuple[str, Callable[[Result], str]]] = {
    "adversaries": ("policies that attack the filter, estimate errors at their bound, fixed obstacles", _adversaries),
    "faults": ("catalogued faults in every phase of flight", _faults),
    "faults_realtime": ("the same over MAVSDK in real time", _faults),
    "process_death": ("the program hung, stopped or killed in flight, seen on the wire", _process_death),
    "mutation": ("mistakes put into `safety/` that its tests notice", _mutation),
}
