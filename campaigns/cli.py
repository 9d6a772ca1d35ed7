"""`evaluate-policy`: success, collisions and path efficiency of policy files, with confidence intervals."""

from __future__ import annotations

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

EXAMPLES = """Examples:

  evaluate-policy policies/corridor_ppo_lstm.onnx --split unseen --episodes 200

  evaluate-policy policies/corridor_ppo_lstm.onnx --split dynamic --safety off --json
"""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


class Dynamics(StrEnum):
    """What flies: the gateway's vehicle in lockstep."""

    INTERNAL = "internal"
    JSBSIM = "jsbsim"


class Switch(StrEnum):
    """on or off."""

    ON = "on"
    OFF = "off"


@app.command(epilog=EXAMPLES)
def evaluate(
    policies: Annotated[list[Path], typer.Argument(help="policy files (.onnx)")],
    split: Annotated[str, typer.Option(help="named set of corridors in --splits")] = "unseen",
    episodes: Annotated[int, typer.Option(min=1, max=100_000, help="corridors to fly")] = 200,
    dynamics: Annotated[Dynamics, typer.Option(help="what flies")] = Dynamics.INTERNAL,
    safety: Annotated[Switch, typer.Option(help="with or without the safety layer")] = Switch.ON,
    seed: Annotated[int | None, typer.Option(min=0, help="first corridor's seed; default: the split's")] = None,
    mission: Annotated[Path, typer.Option(help="mission whose safety limits and arrival radius are used")] = Path(
        "configs/corridor.yaml"
    ),
    splits: Annotated[Path, typer.Option(help="file that names the splits")] = Path("configs/evaluation.yaml"),
    workers: Annotated[int | None, typer.Option(min=1, help="processes; default: all cores")] = None,
    out: Annotated[Path | None, typer.Option(help="write the whole result, every episode, to this JSON file")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Fly policies through named corridors, whole stack in lockstep: policy file, safety, vehicle, LiDAR."""
    from campaigns.evaluate import Campaign, report, run_campaign
    from campaigns.splits import load_split
    from flight.mission import load_mission
    from policy_export.runner import PolicyRunner
    from sim_gateway.dynamics import require_dynamics

    require_dynamics(dynamics.value)
    chosen = load_split(split, splits)
    if seed is not None:
        chosen = chosen.model_copy(update={"first_seed": seed})
    flown = load_mission(mission)
    for policy in policies:
        PolicyRunner.load(policy)  # a bad file is refused before any work is done
    reports = []
    for policy in policies:
        campaign = Campaign(policy, chosen, flown.safety, safety is Switch.ON, flown.goal.radius_m, dynamics.value)
        results = run_campaign(campaign, episodes, workers)
        reports.append(report(campaign, split, results))
    _write(reports, out, as_json)


def _write(reports: list[dict[str, Any]], out: Path | None, as_json: bool) -> None:
    result: Any = reports[0] if len(reports) == 1 else reports
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=1) + "\n")
    if as_json:
        short = [{k: v for k, v in r.items() if k != "episodes"} for r in reports]
        print(json.dumps(short[0] if len(short) == 1 else short, indent=1))
        return
    for one in reports:
        print(markdown(one))


def markdown(one: dict[str, Any]) -> str:
    """One evaluation as a small table."""

    def rate(name: str) -> str:
        p = one[name]
        return f"{100 * p['rate']:.1f} % [{100 * p['low']:.1f}, {100 * p['high']:.1f}] of {p['n']}"

    rows = [
        ("policy", f"{one['policy']} ({one['policy_sha256'][:12]})"),
        ("corridors", f"{one['split']}: {one['description']}, seeds from {one['first_seed']}"),
        ("dynamics", one["dynamics"]),
        ("safety layer", "on" if one["safety"] else "off"),
        ("clean success (goal within 0.3 m, no contact), 95 % interval", rate("clean_success")),
        ("success (contacts allowed)", rate("success")),
        ("collisions per episode", f"{one['collisions_per_episode']:.3f}"),
        ("path efficiency", f"{one['path_efficiency']:.3f}"),
        ("episode length", f"{one['episode_steps']:.0f} ticks, {one['duration_s']:.1f} s"),
        ("least clearance", f"{one['min_clearance_m']:.2f} m (mean of episodes {one['mean_min_clearance_m']:.2f} m)"),
        ("failures", "; ".join(f"{cause}: seeds {seeds[:8]}" for cause, seeds in one["failures"].items()) or "none"),
    ]
    return "\n".join(["| figure | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows), ""])


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2."""
    from campaigns.errors import USER_ERRORS

    try:
        app()
    except USER_ERRORS as error:
        print(f"evaluate-policy: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
