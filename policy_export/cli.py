"""`export-policy`: a checkpoint to a policy file, and tools for such files."""

from __future__ import annotations

import json
import math
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from policy_export.contract import PolicyMetadata
from policy_export.errors import PolicyError
from strict_yaml import ConfigError

_EXAMPLES = """
Turn a training checkpoint into one verified, self-describing ONNX file, and check such files. Reads checkpoints of
train-policy (.pt) and models of Stable-Baselines3 and sb3-contrib (.zip: RecurrentPPO, PPO, A2C); runs nothing in them.

\b
Examples:
  export-policy runs/train/last.pt -o policies/corridor.onnx
  export-policy runs/train/last.pt -o policies/corridor.onnx --evaluation results.json
  export-policy ppo_lstm.zip -o policy.onnx --layout layout.yaml --normalize stats.npz
  export-policy verify policies/corridor.onnx --checkpoint runs/train/last.pt
  export-policy inspect policies/corridor.onnx
  export-policy bench policies/corridor.onnx
"""

app = typer.Typer(
    add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False, help=_EXAMPLES
)

_COMMANDS = {"checkpoint", "verify", "inspect", "bench"}


class MemoryForm(StrEnum):
    """How the LSTM is written into the graph."""

    fused = "fused"
    gates = "gates"


_LAYOUT_HELP = "SB3 only: YAML that says what observation and action mean; or 'paper' (if not given) or 'heading', built in"
_SPACE_HELP = "SB3 only: limits of the trained action space, where the archive does not show them, as -1,-1,-1,-1"

NormalizeOption = Annotated[
    Path | None, typer.Option(help="SB3 only: VecNormalize statistics, .npz or .json (docs/export_sb3.md)")
]
ActivationOption = Annotated[str | None, typer.Option(help="SB3 only: activation, where the archive does not name a known one")]
LowOption = Annotated[str | None, typer.Option("--action-low", help=_SPACE_HELP)]
HighOption = Annotated[str | None, typer.Option("--action-high", help="SB3 only: see --action-low")]
SquashOption = Annotated[
    bool | None, typer.Option("--squash/--clip", help="SB3 only: tanh squashing or clipping, where the archive does not say it")
]
RescaleOption = Annotated[
    bool, typer.Option("--rescale-action", help="SB3 only: the layout's limits are another scale of the trained action space")
]
JsonFlag = Annotated[bool, typer.Option("--json", help="one JSON object on stdout, messages on stderr")]
FileArgument = Annotated[Path, typer.Argument(help="policy file (.onnx)")]


@app.command("checkpoint", epilog="The word 'checkpoint' may be left out: export-policy last.pt -o policy.onnx")
def export_command(
    checkpoint: Annotated[Path, typer.Argument(help="checkpoint of train-policy (.pt) or model of SB3 (.zip)")],
    output: Annotated[Path, typer.Option("--output", "-o", help="policy file to write; replaced only after verification")],
    evaluation: Annotated[Path | None, typer.Option(help="JSON written by evaluate-policy --json, kept in the file")] = None,
    name: Annotated[str | None, typer.Option(help="name kept in the file; the output's stem if not given")] = None,
    memory_form: Annotated[MemoryForm | None, typer.Option(help="how the LSTM is written; the faster one if not given")] = None,
    layout: Annotated[str | None, typer.Option(help=_LAYOUT_HELP)] = None,
    normalize: NormalizeOption = None,
    activation: ActivationOption = None,
    action_low: LowOption = None,
    action_high: HighOption = None,
    squash: SquashOption = None,
    rescale_action: RescaleOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Export a checkpoint to one verified policy file."""
    _say("loading the exporter ...")
    from policy_export.export import export_checkpoint, read_evaluation
    from policy_export.graph_writer import DEFAULT_MEMORY_FORM

    results = read_evaluation(evaluation) if evaluation else None
    form = memory_form.value if memory_form else DEFAULT_MEMORY_FORM
    options = _sb3_options(normalize, activation, action_low, action_high, squash, rescale_action)
    _say(f"exporting {checkpoint} and stepping it beside the network ...")
    metadata = export_checkpoint(
        checkpoint, output, name=name, evaluation=results, memory_form=form, layout=layout, options=options
    )
    _say_assumptions(metadata, layout)
    verification = metadata.verification
    if as_json:
        _print_json({"path": str(output), "sha256": _sha256(output), "metadata": metadata.model_dump(mode="json")})
    else:
        print(f"{output}: {output.stat().st_size} bytes, sha256 {_sha256(output)}")
        print(
            f"verified over {verification.steps} recurrent steps of {verification.batch} vehicles: action within "
            f"{verification.max_action_difference:.2g}, everything within {verification.max_abs_difference:.2g} "
            f"(allowed {verification.tolerance:g}) of {verification.reference}"
        )


@app.command("verify")
def verify_command(
    file: FileArgument,
    checkpoint: Annotated[Path | None, typer.Option(help="compare with this checkpoint's network, in float64")] = None,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="recurrent steps")] = 1000,
    seed: Annotated[int, typer.Option(help="seed of the random observations and resets")] = 1,
    normalize: NormalizeOption = None,
    activation: ActivationOption = None,
    action_low: LowOption = None,
    action_high: HighOption = None,
    squash: SquashOption = None,
    rescale_action: RescaleOption = False,
    as_json: JsonFlag = False,
) -> None:
    """Check a policy file: structure, digests, a recurrent run; with --checkpoint against the trained network."""
    from policy_export.runner import PolicyRunner

    runner = PolicyRunner.load(file, allow_other_rate=True, allow_foreign=True)
    stored = runner.metadata.verification
    result: dict[str, Any] = {"path": str(file), "sha256": runner.sha256, "ok": True, "stored": stored.model_dump(mode="json")}
    lines = [f"{file}: digests, weights, graph and metadata are sound; sha256 {runner.sha256}"]
    if checkpoint is None:
        from policy_export.verify import verify_consistency

        result["batch_difference"] = verify_consistency(file, seed=seed, steps=steps)
        lines.append(f"now: runner and batched graph agree within {result['batch_difference']:.2g} over {steps} steps")
    lines.append(f"at export: largest difference {stored.max_abs_difference:.2g} over {stored.steps} steps, {stored.reference}")
    if checkpoint is not None:
        _say("loading the checkpoint ...")
        from policy_export.export import load_for_file
        from policy_export.verify import verify_file

        options = _sb3_options(normalize, activation, action_low, action_high, squash, rescale_action)
        network = load_for_file(checkpoint, runner.metadata, options).network
        measured = verify_file(file, network, seed=seed, steps=steps)
        result["measured"] = measured.model_dump(mode="json")
        lines.append(f"now: largest difference {measured.max_abs_difference:.2g} over {steps} steps against {checkpoint}")
    _print_json(result) if as_json else print("\n".join(lines))


@app.command("inspect")
def inspect_command(file: FileArgument, as_json: JsonFlag = False) -> None:
    """Show what a policy file says about itself."""
    from policy_export.policy_file import read_policy_file

    found = read_policy_file(file)
    if as_json:
        _print_json({"path": str(file), "sha256": found.sha256, "metadata": found.metadata.model_dump(mode="json")})
        return
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.SIMPLE, show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for row in describe(found.metadata):
        table.add_row(*row)
    table.add_row("file", f"{len(found.data)} bytes, {len(found.model.operators)} operators, opset {found.model.opset}")
    table.add_row("sha256", found.sha256)
    Console().print(table)


@app.command("bench")
def bench_command(
    file: FileArgument,
    steps: Annotated[int, typer.Option(min=100, max=1_000_000, help="timed steps of each kind")] = 5000,
    as_json: JsonFlag = False,
) -> None:
    """Time one step of the runner, beside bare onnxruntime on the same graph in the same run."""
    from policy_export.bench import bench_file

    figures = bench_file(file, steps)
    if as_json:
        _print_json(figures)
        return
    for name, timing in figures["timings"].items():
        print(f"{name:<34} median {timing['median_us']:8.1f} us   p99 {timing['p99_us']:8.1f} us")
    print(f"runner to bare onnxruntime, ratio of medians: {figures['ratio']:.2f}")


def describe(metadata: PolicyMetadata) -> list[tuple[str, str]]:
    """(what, value) rows of a file's metadata, for people."""
    lidar, action = metadata.observation.lidar, metadata.action
    training, check = metadata.training, metadata.verification
    rows = [("name", f"{metadata.name} (schema {metadata.schema_version})")]
    rows += [(f"obs[{c.start}:{c.stop}]", f"{c.name}, {c.unit}, {c.frame} frame") for c in metadata.observation.channels]
    if metadata.observation.channel("lidar") is not None:
        reach = f"{lidar.range_min_m:g} to {lidar.range_max_m:g} m"
        rows.append(("lidar", f"{lidar.beams} beams over {lidar.fov_rad:.4f} rad, {reach}"))
    units = {"vx": " m/s", "vy": " m/s", "vz": " m/s", "yaw_rate": " rad/s"}
    for name, low, high in zip(action.names, action.low, action.high, strict=True):
        rows.append((f"action {name.replace('_', ' ')}", f"{low:g} to {high:g}{units.get(name, '')}, {action.frame} frame"))
    rows.append(("rate", f"{metadata.rate_hz:g} Hz"))
    rows.append(("memory", f"{metadata.memory}, {metadata.layers} layer(s), hidden size {metadata.hidden_size}"))
    rows.append(("reset", f"{', '.join(metadata.reset.on)}; gap over {metadata.reset.max_gap_s:g} s"))
    known = {"seed": training.seed, "steps": training.steps, "config": training.config_hash, "commit": training.git_commit}
    rows.append(("training", ", ".join(f"{key} {value}" for key, value in known.items() if value is not None) or "not stated"))
    rows.append(("evaluation", json.dumps(metadata.evaluation) if metadata.evaluation else "none stored"))
    rows.append(("verification", f"{check.max_abs_difference:.2g} over {check.steps} steps against {check.reference}"))
    rows.append(("weights sha256", metadata.weights_sha256))
    return rows


def _sb3_options(
    statistics: Path | None, activation: str | None, low: str | None, high: str | None, squash: bool | None, rescale: bool
) -> Any:
    from policy_export.sb3 import Sb3Options

    return Sb3Options(
        statistics=statistics,
        activation=activation,
        action_low=_numbers("--action-low", low),
        action_high=_numbers("--action-high", high),
        squash=squash,
        rescale_action=rescale,
    )


def _numbers(option: str, text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise PolicyError(f"{option} {text}: give numbers separated by commas, as in -1,-1,-1,-1") from None
    if not all(math.isfinite(number) for number in numbers):
        raise PolicyError(f"{option} {text}: give finite numbers")
    return numbers


def _say_assumptions(metadata: PolicyMetadata, layout: str | None) -> None:
    """What an SB3 archive leaves open and was taken as usual; a wrong guess here would fly."""
    details = metadata.training.details
    if "trainer" not in details:
        return
    if layout is None:
        _say("layout: the built-in 'paper' (corridor frame), 20 Hz; give --layout if the policy was trained otherwise")
    if not details["normalised"]:
        _say("normalisation: none; give --normalize if the policy was trained under VecNormalize")


def main(arguments: list[str] | None = None) -> None:
    """Entry point: exit code 0 on success, 2 with one line on stderr for anything the user can put right."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        app(args=with_command(arguments), prog_name="export-policy")
    except PolicyError as error:
        sys.exit(_fail(str(error)))
    except ImportError as error:
        sys.exit(
            _fail(f"{error.name or error} is not installed; exporting needs the train extra: pip install 'lstm-pilot[train]'")
        )
    except ConfigError as error:
        sys.exit(_fail(str(error)))
    except OSError as error:
        sys.exit(_fail(f"{error.filename or 'file'}: {error.strerror or error}"))


def with_command(arguments: list[str]) -> list[str]:
    """`export-policy last.pt -o x.onnx` means `export-policy checkpoint last.pt -o x.onnx`."""
    if not arguments or arguments[0] in _COMMANDS or arguments[0] in {"--help", "-h"}:
        return arguments
    return ["checkpoint", *arguments]


def _fail(message: str) -> int:
    _say(f"error: {' '.join(message.split())}")
    return 2


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)


def _print_json(document: dict[str, Any]) -> None:
    print(json.dumps(document, indent=1, allow_nan=False))


def _sha256(path: Path) -> str:
    from policy_export.policy_file import read_policy_file

    return read_policy_file(path).sha256
