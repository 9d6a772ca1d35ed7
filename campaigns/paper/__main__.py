"""Train PPO and PPO-LSTM from several seeds and write the article's Table 2 and figures 4 to 9, theirs beside ours.

    python -m campaigns.paper --out results/paper

Whatever is finished is kept: stop it at any time and give the same command again. `--decisions` sets the volume of each run; the
article's is 27,000 episodes of about 170 steps, 4.6 million decisions. `--ppo configs/training/paper_ppo.yaml --lstm
configs/training/paper_ppo_lstm.yaml --decisions 4.6e6 --runs runs/paper_settings --out results/paper_settings` compares the
article's own settings, which take ten times as long and had not reached a goal when stopped: docs/training.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from campaigns.command_line import positive, prepare_output, run_command
from campaigns.paper.figures import draw_bars, draw_curves, draw_flights
from campaigns.paper.measures import flown_measures, read_curves, training_measures, write_json
from campaigns.paper.report import article, make_table, markdown
from campaigns.paper.runs import Run, study_runs, train_all
from campaigns.splits import Split, load_splits
from flight.mission import load_mission
from safety.config import SafetyConfig
from strict_yaml import load_config
from training.checkpoint import CheckpointError
from training.config import TrainingConfig

TABLE = "table_2.json"
SPLITS = ("static", "unseen", "dynamic")
DECISIONS = 1.5e6  # half an hour on two cores; enough for the tuned presets to settle


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    chosen = _parser().parse_args(arguments)
    presets = {"PPO": chosen.ppo, "PPO-LSTM": chosen.lstm}
    algorithms = {name: load_config(path, TrainingConfig) for name, path in presets.items()}
    runs = study_runs(algorithms, chosen.seeds, int(chosen.decisions), chosen.runs)
    splits, safety = load_splits(list(SPLITS), chosen.splits), load_mission(chosen.mission).safety
    prepare_output(chosen.out / TABLE)
    train_all(runs, chosen.workers)
    write_study(runs, chosen, splits, safety)
    return 0


def write_study(runs: list[Run], chosen: argparse.Namespace, splits: dict[str, Split], safety: SafetyConfig) -> None:
    """Fly the trained policies, then write table, figures and reading."""
    out: Path = chosen.out
    names = list(dict.fromkeys(run.algorithm for run in runs))
    curves = {name: [read_curves(run) for run in runs if run.algorithm == name] for name in names}
    measured = {
        name: [
            training_measures(read_curves(run)) | flown_measures(run, splits, safety, chosen.episodes, chosen.workers)
            for run in runs
            if run.algorithm == name
        ]
        for name in names
    }
    table = make_table(measured)
    command = (
        f"python -m campaigns.paper --ppo {chosen.ppo} --lstm {chosen.lstm} --seeds {chosen.seeds} "
        f"--decisions {chosen.decisions:g} --episodes {chosen.episodes} --runs {chosen.runs} --out {out}"
    )
    write_json(out / TABLE, table | {"command": command})
    (out / "README.md").write_text(markdown(table, command), encoding="utf-8")
    draw_curves(out, curves, article())
    draw_flights(out, runs[: len(names)], splits["dynamic"], safety)
    draw_bars(out, table)
    sys.stdout.write(f"{out}/README.md\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.paper", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results/paper"))
    parser.add_argument("--runs", type=Path, default=Path("runs/paper"), help="folder of the training runs")
    parser.add_argument("--ppo", type=Path, default=Path("configs/training/ppo.yaml"), help="preset without memory")
    parser.add_argument("--lstm", type=Path, default=Path("configs/training/ppo_lstm.yaml"), help="preset with memory")
    parser.add_argument("--seeds", type=positive, default=5)
    parser.add_argument("--decisions", type=float, default=DECISIONS, help="of each run")
    parser.add_argument("--episodes", type=positive, default=60, help="flights per policy and split")
    parser.add_argument("--workers", type=positive, help="processes; default: all cores")
    parser.add_argument("--mission", type=Path, default=Path("configs/corridor.yaml"))
    parser.add_argument("--splits", type=Path, default=Path("configs/evaluation.yaml"))
    return parser


if __name__ == "__main__":
    run_command("paper", main, CheckpointError)
