"""`evaluate-policy`: success, collisions and path efficiency of policy files, with confidence intervals."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

EXAMPLES = """Examples:

  evaluate-policy policies/corridor_ppo_lstm.onnx --split unseen --episodes 200

  evaluate-policy policies/corridor_ppo_lstm.onnx --split dynamic --safety off --json

  evaluate-policy policies/*.onnx --split all --dynamics training --episodes 1000 --out results/splits.json
"""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


class Dynamics(StrEnum):
    """What flies: the trainer's compiled kernels, the gateway's vehicle, or JSBSim, all under the same stack."""

    TRAINING = "training"
    INTERNAL = "internal"
    JSBSIM = "jsbsim"


class Switch(StrEnum):
    """on or off."""

    ON = "on"
    OFF = "off"


@app.command(epilog=EXAMPLES)
def evaluate(
    policies: Annotated[list[Path], typer.Argument(help="policy files (.onnx)")],
    split: Annotated[
        list[str] | None, typer.Option(help="named set of corridors in --splits; repeat it for several, or `all`")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, max=100_000, help="corridors to fly")] = 200,
    dynamics: Annotated[Dynamics, typer.Option(help="what flies")] = Dynamics.INTERNAL,
    safety: Annotated[Switch, typer.Option(help="with or without the safety layer")] = Switch.ON,
    seed: Annotated[int | None, typer.Option(min=0, help="first corridor's seed; default: the split's")] = None,
    mission: Annotated[Path, typer.Option(help="mission whose safety limits and arrival radius are used")] = Path(
        "configs/corridor.yaml"
    ),
    splits: Annotated[Path, typer.Option(help="file that names the splits")] = Path("configs/evaluation.yaml"),
    workers: Annotated[int | None, typer.Option(min=1, help="processes; default: all cores")] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="fly on the Ray cluster at HOST:PORT instead (extra `cluster`)")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="write the whole result, every episode, to this JSON file; the tables beside it as .md")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on stdout")] = False,
) -> None:
    """Fly policies through named corridors, whole stack in lockstep: policy file, safety, vehicle, LiDAR."""
    from campaigns.command_line import prepare_output
    from campaigns.evaluate import TRAINING, Campaign, report, run_campaign
    from campaigns.splits import load_splits
    from flight.mission import load_mission
    from policy_export.runner import PolicyRunner
    from sim_gateway.dynamics import require_dynamics

    if out is not None:
        prepare_output(out, beside=(".md",))
    if dynamics.value != TRAINING:
        require_dynamics(dynamics.value)
    chosen = load_splits(split or ["unseen"], splits)
    if seed is not None:
        chosen = {name: one.model_copy(update={"first_seed": seed}) for name, one in chosen.items()}
    flown = load_mission(mission)
    for policy in policies:
        PolicyRunner.load(policy)  # a bad file is refused before any work is done
    reports = []
    for policy in policies:
        for name, one in chosen.items():
            campaign = Campaign(policy, one, flown.safety, safety is Switch.ON, flown.goal.radius_m, dynamics.value)
            reports.append(report(campaign, name, run_campaign(campaign, episodes, workers, ray)))
    _write(reports, out, as_json)


def _write(reports: list[dict[str, Any]], out: Path | None, as_json: bool) -> None:
    from campaigns.evaluation_report import markdown

    if out is not None:
        out.write_text(json.dumps(reports[0] if len(reports) == 1 else reports, indent=1) + "\n")
        out.with_suffix(".md").write_text(markdown(reports))
    if as_json:
        short = [{k: v for k, v in r.items() if k != "episodes"} for r in reports]
        print(json.dumps(short[0] if len(short) == 1 else short, indent=1))
        return
    print(markdown(reports))


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2."""
    from campaigns.command_line import run_command

    run_command("evaluate-policy", lambda: app(standalone_mode=False))


if __name__ == "__main__":
    main()
