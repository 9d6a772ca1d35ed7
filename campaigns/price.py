"""What the safety layer costs a policy: the same corridors flown with it and without it.

    python -m campaigns.price --episodes 200 --out results/safety_price.json

Exit code 1 when clean success falls by more than one point or the mean speed by more than a tenth.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

from campaigns.command_line import positive, prepare_output, run_command
from campaigns.evaluate import Campaign, run_campaign
from campaigns.splits import load_split
from campaigns.statistics import EpisodeResult, mean, proportion
from flight.mission import load_mission

MOST_SUCCESS_LOST = 0.01
MOST_SPEED_LOST = 0.10
ROUNDING = 1e-9


def figures(results: list[EpisodeResult]) -> dict[str, Any]:
    """Clean success over all episodes; speed and path efficiency over the successful ones."""
    done = [r for r in results if r.success]
    return {
        "clean_success": proportion([r.clean_success for r in results]),
        "collisions_per_episode": mean([float(r.contacts) for r in results]),
        "mean_speed_m_s": mean([r.path_length_m / r.duration_s for r in done]),
        "path_efficiency": mean([r.path_efficiency for r in done]),
        "clean": [r.clean_success for r in results],
    }


def price(on: dict[str, Any], off: dict[str, Any]) -> dict[str, Any]:
    """Differences, on minus off. `only_on`, `only_off`: corridors that only one of the two flew cleanly."""
    pairs = list(zip(on["clean"], off["clean"], strict=True))
    return {
        "clean_success_difference": on["clean_success"]["rate"] - off["clean_success"]["rate"],
        "only_on": sum(a and not b for a, b in pairs),
        "only_off": sum(b and not a for a, b in pairs),
        "mean_speed_ratio": on["mean_speed_m_s"] / off["mean_speed_m_s"],
    }


def acceptable(found: dict[str, Any]) -> bool:
    """Whether both differences are inside their bounds."""
    lost, ratio = -float(found["clean_success_difference"]), float(found["mean_speed_ratio"])
    return lost <= MOST_SUCCESS_LOST + ROUNDING and ratio >= 1.0 - MOST_SPEED_LOST


def markdown(report: dict[str, Any]) -> str:
    """The comparison as a table."""
    rows = ["| same corridors | safety on | safety off |", "|---|---|---|"]
    on, off, found = report["on"], report["off"], report["price"]
    rows.append("| clean success | " + " | ".join(f"{100 * side['clean_success']['rate']:.1f} %" for side in (on, off)) + " |")
    rows.append("| collisions per episode | " + " | ".join(f"{side['collisions_per_episode']:.3f}" for side in (on, off)) + " |")
    rows.append("| mean speed | " + " | ".join(f"{side['mean_speed_m_s']:.3f} m/s" for side in (on, off)) + " |")
    rows.append("| path efficiency | " + " | ".join(f"{side['path_efficiency']:.3f}" for side in (on, off)) + " |")
    speed, n = 100.0 * (found["mean_speed_ratio"] - 1.0), on["clean_success"]["n"]
    points = 100.0 * found["clean_success_difference"]
    note = (
        f"Clean success {points:+.1f} points (of {n} corridors {found['only_on']} were clean only with it, "
        f"{found['only_off']} only without); mean speed {speed:+.1f} %."
    )
    return "\n".join([*rows, "", note])


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.price", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", type=Path, default=Path("policies/corridor_ppo_lstm.onnx"))
    parser.add_argument("--split", default="unseen")
    parser.add_argument("--episodes", type=positive, default=200)
    parser.add_argument("--mission", type=Path, default=Path("configs/corridor.yaml"))
    parser.add_argument("--jobs", type=positive, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("results/safety_price.json"))
    chosen = parser.parse_args()
    prepare_output(chosen.out)
    mission, split = load_mission(chosen.mission), load_split(chosen.split)
    sides = {
        name: figures(
            run_campaign(
                Campaign(chosen.policy, split, mission.safety, filtered, mission.goal.radius_m), chosen.episodes, chosen.jobs
            )
        )
        for name, filtered in (("on", True), ("off", False))
    }
    found = price(sides["on"], sides["off"])
    report = {
        "command": f"python -m campaigns.price --split {chosen.split} --episodes {chosen.episodes} --out {chosen.out}",
        "policy": str(chosen.policy),
        "price": found,
        **sides,
    }
    chosen.out.write_text(json.dumps(report, indent=1) + "\n")
    print(markdown(report))
    return 0 if acceptable(found) else 1


if __name__ == "__main__":
    run_command("price", main)
