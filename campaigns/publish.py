"""Write what was measured where people read it: model cards beside the policies, the tables in README and docs/safety.md.

    python -m campaigns.publish

Reads the policy files and `results/*.json`; no figure is ever typed in. Run it after a campaign.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from campaigns.adversaries.report import section
from campaigns.clients.report import markdown as client_tables
from campaigns.command_line import run_command
from campaigns.evaluation_table import commands, evaluation_table
from campaigns.faults.report import markdown as fault_table
from campaigns.price import markdown as price_table
from campaigns.process_death import markdown
from campaigns.safety_summary import safety_rows
from campaigns.strength import strength
from policy_export.errors import PolicyError
from policy_export.policy_file import PolicyFile, read_policy_file
from sim_gateway.faults import KINDS, Kind
from strict_yaml import load_config
from training.config import EnvironmentConfig, TrainingConfig

RESULTS = Path("results")
POLICIES = Path("policies")
PRESETS = Path("configs/training")
README = Path("README.md")
SAFETY = Path("docs/safety.md")
BEGIN, END = "<!-- results -->", "<!-- end of results -->"
GATEWAY = Path("docs/gateway.md")
FAULTS = "<!-- fault campaign -->", "<!-- end of fault campaign -->"
CLIENTS = "<!-- clients -->", "<!-- end of clients -->"
FAULT_KINDS = "<!-- fault kinds -->", "<!-- end of fault kinds -->"
ADVERSARIES = "<!-- adversaries -->", "<!-- end of adversaries -->"
PRICE = "<!-- price in success -->", "<!-- end of price in success -->"
PROCESS_DEATH = "<!-- process death -->", "<!-- end of process death -->"
STRENGTH = "<!-- strength of the tests -->", "<!-- end of strength of the tests -->"
PAPER_UNSEEN_SUCCESS = "77.4 %"
PAPER_PATH_EFFICIENCY = "0.85"


def read_results(folder: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Every result file by its name without `.json`; of a file that holds several, each by name and place."""
    results: dict[str, dict[str, Any]] = {}
    for path in sorted(folder.glob("*.json")):
        content = json.loads(path.read_text())
        results |= (
            {f"{path.stem}_{k}": one for k, one in enumerate(content)} if isinstance(content, list) else {path.stem: content}
        )
    return results


def evaluations(results: dict[str, dict[str, Any]], weights: str | None = None) -> list[dict[str, Any]]:
    """Every lockstep evaluation, of one policy only when the digest of its weights is given."""
    return [one for one in results.values() if "split" in one and weights in (None, one["weights_sha256"])]


def realtime_rows(results: dict[str, dict[str, Any]]) -> list[tuple[str, str, str]]:
    """(what, figure, command) of flights over MAVSDK in wall-clock time."""
    rows = []
    for result in results.values():
        if "loop_rate_hz" not in result:
            continue
        n, loop = result["flights"], result["loop_rate_hz"]
        figure = (
            f"{result['goal_reached_and_landed']} of {n} reached the goal and landed, {result['contacts']} contacts, "
            f"{result['left_fence']} left the fence (least margin {result['least_fence_margin_m']:.2f} m)"
        )
        rows.append((f"{n} flights in a row over MAVSDK, real time, a new corridor each", figure, result["command"]))
        median, tail = result["scan_to_setpoint_ms_p50"], result["scan_to_setpoint_ms_p99_worst"]
        timing = (
            f"{loop['mean']:.3f} Hz mean, {loop['worst']:.3f} Hz worst flight; {result['deadline_misses']} of {result['ticks']} "
            f"ticks late; {median:.0f} ms median, {tail:.0f} ms worst p99; "
            f"load average of the machine {result['load_average_at_end']:.1f}"
        )
        rows.append(("loop rate; deadline misses; scan to setpoint, same flights", timing, "same"))
    return rows


def table(rows: list[tuple[str, str, str]]) -> str:
    """Markdown."""
    body = [f"| {what} | {figure} | `{command}` |" for what, figure, command in rows]
    return "\n".join(["| what | figure | command |", "|---|---|---|", *body])


def model_card(file: PolicyFile, path: Path, results: dict[str, dict[str, Any]]) -> str:
    """The card of one policy, from its own metadata and the results measured on exactly these weights."""
    meta, training = file.metadata, file.metadata.training
    details, action = training.details, meta.action
    preset = PRESETS / f"{path.stem.removeprefix('corridor_')}.yaml"
    minutes = float(str(details.get("seconds", 0.0))) / 60.0
    limits = ", ".join(
        f"{name} {low:g}..{high:g}"
        for name, low, high in zip(("vx", "vy", "vz", "yaw rate"), action.low, action.high, strict=True)
    )
    verification = f"{meta.verification.max_abs_difference:.1e}" if meta.verification else "not verified"
    facts = [
        ("file", f"`{path.name}`, {path.stat().st_size} bytes, SHA-256 `{file.sha256}`"),
        ("command", f"`train-policy --config {preset} --out runs/{preset.stem}`"),
        ("then", f"`export-policy runs/{preset.stem}/best.pt -o {path}`"),
        ("seed, commit, configuration", f"{training.seed}, `{training.git_commit}`, `{training.config_hash}`"),
        ("decisions at this checkpoint", f"{training.steps:,}"),
        ("training time to this checkpoint", f"{minutes:.0f} min on one core of a shared two-core machine"),
        ("memory", f"{meta.memory}, hidden size {meta.hidden_size}, {meta.rate_hz:g} Hz"),
        ("action limits", f"{limits} (m/s, rad/s, {action.frame} frame)"),
        ("verification", f"largest difference to the network in float64 over 1,000 steps: {verification}"),
    ]
    lines = [
        f"# {path.stem}",
        "",
        "Flies a corridor of pillars it has not seen, from 2D LiDAR and own motion, to a given goal.",
        "",
    ]
    lines += ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in facts), ""]
    measured = evaluations(results, meta.weights_sha256)
    lines += ["## Results", "", evaluation_table(measured), "", commands(measured), ""]
    return "\n".join([*lines, trained_on(load_config(preset, TrainingConfig).environment)])


def trained_on(environment: EnvironmentConfig) -> str:
    """What the weights have seen and what they have not, for the card."""
    (least, most), share = environment.pillars, environment.moving_share
    moving, never = "", "Never on moving obstacles, never outdoors"
    if share:
        low, high = environment.moving_pillars
        moving = (
            f", in {share:.0%} of the corridors {low} to {high} more that move at up to {environment.mover_speed_max_mps:g} m/s"
        )
        never = "Never on people or animals, never outdoors"
    harsh, lost, wind_m_s = environment.estimate.harsh_share, environment.dropout[1], environment.vehicle.wind_mps[1]
    return f"""## Trained on, and not on
Corridors of 35 x 8 m with {least} to {most} fixed square pillars{moving}.
Altitude 1.5 to 3 m, an Iris-class vehicle with randomised mass, drag, motors and gains, estimate errors of nominal size (in
{harsh:.0%} of the episodes up to those recorded on PX4's simplest simulator), 0 to {lost:.0%} lost beams, up to
{wind_m_s:g} m/s of wind.
{never}, never on a real LiDAR. It must fly behind a safety layer.
"""


def main() -> None:
    """Command line; it has no options."""
    argparse.ArgumentParser(
        prog="python -m campaigns.publish", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    publish()


def publish() -> None:
    """Write the cards and the tables."""
    results = read_results()
    for path in sorted(POLICIES.glob("*.onnx")):
        path.with_suffix(".md").write_text(model_card(read_policy_file(path), path, results))
    _write_block(README, BEGIN, END, results_block(results))
    if "process_death" in results:
        _write_block(SAFETY, *PROCESS_DEATH, process_death(results["process_death"]))
    if "mutation" in results or "accidents" in results:
        _write_block(SAFETY, *STRENGTH, strength(results))
    if "adversaries" in results:
        _write_block(SAFETY, *ADVERSARIES, section(results["adversaries"]))
    if "safety_price" in results:
        _write_block(SAFETY, *PRICE, price_table(results["safety_price"]))
    flown = [results[name] for name in ("faults", "faults_realtime") if name in results]
    if flown:
        _write_block(SAFETY, *FAULTS, "\n\n".join(fault_campaign(result) for result in flown))
    _write_block(GATEWAY, *FAULT_KINDS, fault_kinds())
    if "clients" in results:
        _write_block(GATEWAY, *CLIENTS, client_tables(results["clients"]))


def results_block(results: dict[str, dict[str, Any]]) -> str:
    """README's section: the policies in lockstep, the article's figures, the flights in real time, the safety layer."""
    note = f"The article: {PAPER_UNSEEN_SUCCESS} success in unseen worlds (31 flights), path efficiency {PAPER_PATH_EFFICIENCY}."
    flown = evaluations(results)
    return "\n\n".join([evaluation_table(flown), note, commands(flown), table(realtime_rows(results) + safety_rows(results))])


def fault_campaign(result: dict[str, Any]) -> str:
    """The reactions of one campaign, and what was wrong."""
    wrong = "".join(f"\n- {item['fault']} {item['scene']}, seed {item['seed']}: {item['problem']}" for item in result["wrong"])
    counts = f"{result['faults']} faults, {result['runs']} runs, {result['right']} with the right reaction in time"
    total = f"`{result['command']}`: {counts}."
    slack = f" Bounds are those of the table above and {1e3 * result['slack_s']:.0f} ms." if "slack_s" in result else ""
    return f"{total}{slack}{wrong}\n\n{fault_table(result)}"


def fault_kinds() -> str:
    """The kinds of fault that the gateway makes."""
    rows = [f"| {kind.group} | `{name}` | {kind.does} | {_parameters(kind)} |" for name, kind in KINDS.items()]
    return "\n".join(["| group | kind | what happens | parameters, defaults |", "|---|---|---|---|", *rows])


def _parameters(kind: Kind) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in kind.defaults.items()) or ("at once" if kind.once else "")


def process_death(result: dict[str, Any]) -> str:
    """The process-death matrix and its sum."""
    total = (
        f"`{result['command']}`: {result['good']} of {result['runs']} runs good, {result['late_moving_setpoints']} moving "
        f"setpoints too late, {result['contacts']} contacts; load average at the end {result['load_average_at_end']}."
    )
    return f"{markdown(result)}\n\n{total}"


def _write_block(path: Path, begin: str, end: str, block: str) -> None:
    """Replace what stands between two marks, or add it at the end."""
    before, _, rest = path.read_text().partition(begin)
    _, found, after = rest.partition(end)
    path.write_text(f"{before}{begin}\n{block}\n{end}" + (after if found else rest))


if __name__ == "__main__":
    run_command("publish", main, PolicyError, ValueError)
