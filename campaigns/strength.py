"""How well the tests of safety/ would notice a mistake, as the section of docs/safety.md that `campaigns.publish` writes."""

from __future__ import annotations

from typing import Any


def strength(results: dict[str, dict[str, Any]]) -> str:
    """Markdown of mutation score, comparison with cosmic-ray's own runs, accidents and oracle, as far as they are there."""
    parts = [mutation(results["mutation"])] if "mutation" in results else []
    if "mutation_crosscheck" in results:
        parts.append(crosscheck(results["mutation_crosscheck"]))
    if "accidents" in results:
        parts.append(accidents(results["accidents"]))
    if "fence_oracle" in results:
        parts.append(fence_oracle(results["fence_oracle"]))
    return "\n\n".join(parts)


def mutation(result: dict[str, Any]) -> str:
    """The score per file, and what is not killed."""
    real = result["mutants"] - result["only_annotations"] - result["not_run"]
    left = f"{result['not_run']:,} were not run (those that were are chosen at random), " if result["not_run"] else ""
    text = (
        f"`{result['command']}`: cosmic-ray {result['cosmic_ray']} makes {result['mutants']:,} mutants. {left}"
        f"{result['only_annotations']} change annotations that never run. Of the other {real:,}, {result['killed']:,} are killed "
        f"({100 * result['score']:.2f} %), {result['proved_equivalent']} are proved equivalent one by one "
        f"({100 * result['equivalent_share']:.2f} %, `tests/safety/equivalent_mutants.json`), "
        f"{result['unexplained']} survive unexplained ({result['timeout']} of them ran out of time, which is no kill). "
        f"{result['tests']:,} tests, {result['properties']} of them properties of hypothesis."
    )
    rows = [f"| `{path}` | {_row(counts)} |" for path, counts in result["files"].items()]
    return "\n".join(
        [text, "", "| file | mutants | not run | killed | proved equivalent | unexplained |", "|---|---|---|---|---|---|", *rows]
    )


def _row(counts: dict[str, int]) -> str:
    proved = counts.get("proved equivalent", 0)
    unexplained = counts.get("survived", 0) + counts.get("timeout", 0) - proved
    figures = (counts["mutants"], counts.get("not run", 0), counts.get("killed", 0), proved, unexplained)
    return " | ".join(map(str, figures))


def crosscheck(result: dict[str, Any]) -> str:
    """Agreement with `cosmic-ray exec`."""
    return (
        f"`{result['command']}`: of {result['mutants']} mutants chosen at random ({result['survivors']} of them survivors), "
        f"`cosmic-ray exec`, one process each and all tests in full, judged {result['agreed']} the same."
    )


def fence_oracle(result: dict[str, Any]) -> str:
    """The fence beside exact fractions and shapely."""
    return (
        f"`python tests/safety/fence_oracle.py --cases {result['cases']}`: {result['cases']:,} random places and ways over "
        f"{result['fences']:,} fences ({result['concave or with exclusions']:,} concave or with exclusions) judged by exact "
        f"fractions and shapely {result['shapely']} too: {result['disagreements']} disagreements."
    )


def accidents(result: dict[str, Any]) -> str:
    """How many accidents were noticed."""
    return (
        f"`{result['command']}`: {result['accidents']} accidents written by hand (`tests/safety/accidents/`: fail-open returns, "
        f"order swapped, one edge only, delay or error left out, NaN let through, mirrored scan and their like), "
        f"{result['noticed_by_two_tests_or_more']} of them noticed by two tests or more."
    )
