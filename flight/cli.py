"""The `fly` command."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from flight.errors import ExitCode, FlyError, MissionError

_EPILOG = """
Examples:

fly --mission configs/corridor.yaml

fly --mission configs/corridor.yaml --seed 17 --out runs/seed17 --json

fly replay runs/seed17/flight.mcap

Exit codes: 0 goal reached and landed, 1 ended safely without reaching the goal, 2 usage or configuration,
3 preflight refused (nothing armed), 4 safety ended the flight. Ctrl-C brakes, holds and lands.
"""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording: flight.mcap of a run folder.")]


@app.callback(invoke_without_command=True, epilog=_EPILOG)
def fly(
    context: typer.Context,
    mission: Annotated[Path | None, typer.Option(help="Mission file (YAML), see docs/mission.md.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default runs/<time>-<name>.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Replaces sim.seed: another corridor.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json on stdout; everything else goes to stderr.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before arming a real vehicle.")] = False,
    shadow: Annotated[
        bool, typer.Option("--shadow", help="The pilot flies; what fly would do is logged, nothing is sent.")
    ] = False,
    tether: Annotated[bool, typer.Option("--tether", help="First flights: the mission's reduced limits.")] = False,
) -> None:
    """Check, arm, take off, fly the policy to the goal in OFFBOARD, land, and write one folder of results."""
    if context.invoked_subcommand is None:
        if mission is None:
            raise MissionError("what is to be flown? Give a mission with --mission; see fly --help")
        raise typer.Exit(_fly(mission, out, seed, as_json, yes, shadow=shadow, tether=tether))
    if mission is not None or out is not None or seed is not None or as_json or yes or shadow or tether:
        raise MissionError(f"options of `fly {context.invoked_subcommand}` come after its name; see its --help")


@app.command(epilog="Example:\n\nfly check --mission configs/corridor.yaml --json")
def check(
    mission: Annotated[Path, typer.Option(help="Mission file (YAML), see docs/mission.md.")],
    apply: Annotated[bool, typer.Option("--apply", help="Also set the parameters that are wrong, and upload the fence.")] = False,
    motion: Annotated[bool, typer.Option("--motion", help="Also move and turn the vehicle by hand: do all axes agree?")] = False,
    tether: Annotated[bool, typer.Option("--tether", help="Check against the mission's reduced limits.")] = False,
    as_json: Json = False,
) -> None:
    """Check everything that can be checked without arming, and say what to do about it."""
    from flight.check_command import run_check

    raise typer.Exit(run_check(mission, apply, as_json, motion=motion, tether=tether))


@app.command(epilog="Example:\n\nfly report runs/seed17")
def report(folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The run folder of a flight.")]) -> None:
    """Write report.html of a flight into its folder. After a SIGKILL or a power cut, also what the flight could not write.

    That is summary.json, trajectory.csv, timing.csv, scans.npz and trajectory.png, made from the recording in the folder
    (flight.mcap, cut as it is, or flight-recovered.mcap). What is there is not replaced, but report.html.
    """
    from flight.broken_off import complete
    from flight.report import write_report

    note = complete(folder)
    if note is not None:
        print(f"fly: {note}", file=sys.stderr)
    print(write_report(folder))


@app.command(epilog="Example:\n\nfly recover runs/20261122-101500-corridor/flight.mcap")
def recover(
    file: RecordingFile,
    out: Annotated[Path | None, typer.Option(help="The new file; default: FILE with -recovered in its name.")] = None,
    as_json: Json = False,
) -> None:
    """Make an indexed recording from one that a power cut or a SIGKILL left without its end. FILE is not changed."""
    from flight import recover as recovery

    result = recovery.recover(file, out)
    print(json.dumps(result.as_dict()) if as_json else result.describe())


@app.command(epilog="Examples:\n\nfly replay runs/seed17/flight.mcap\n\nfly replay runs/seed17/flight.mcap --policy other.onnx")
def replay(
    file: RecordingFile,
    policy: Annotated[Path | None, typer.Option(help="Show where this policy would have decided otherwise.")] = None,
    tolerance: Annotated[float, typer.Option(min=0.0, help="Numbers this near count as equal; 0 compares every bit.")] = 0.0,
    as_json: Json = False,
) -> None:
    """Feed recorded inputs through policy and safety filter again, and compare. Exit code 1 when something differs."""
    from flight.replay_command import run_replay

    raise typer.Exit(run_replay(file, policy, tolerance, as_json))


def _fly(mission_path: Path, out: Path | None, seed: int | None, as_json: bool, yes: bool, *, shadow: bool, tether: bool) -> int:
    from flight.interrupt import Interrupt, Interrupted
    from flight.mission import load_mission
    from flight.results import make_run_folder, remove_if_empty
    from flight.session import FlightSession
    from flight.status import Status

    mission = load_mission(mission_path, seed)
    if not mission.simulated and not shadow:
        _confirm(mission.vehicle.connection, yes)
    folder = make_run_folder(out, mission.name)
    with Status(machine_output=as_json) as status, Interrupt(lambda name: status.phase(f"{name}: stopping")) as interrupt:
        try:
            result = FlightSession(mission, folder, status, interrupt, shadow=shadow, tether=tether).run()
        except Interrupted:
            print(f"fly: stopped by {interrupt.name} before arming", file=sys.stderr)
            return ExitCode.NOT_REACHED
        finally:
            remove_if_empty(folder)
        status.phase(f"{result.outcome}: {result.message}; results in {result.folder}")
    if as_json:
        print(json.dumps(json.loads((result.folder / "summary.json").read_text(encoding="utf-8"))))
    return result.exit_code


def _confirm(connection: str, yes: bool) -> None:
    """A real vehicle is armed only after a yes. Raises `MissionError` where nobody can be asked."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise MissionError(f"about to arm a real vehicle on {connection}: add --yes to fly without being asked")
    if not typer.confirm(f"Arm the vehicle on {connection} and take off?", default=False, err=True):
        raise MissionError("not flown: the answer was no")


def main() -> None:
    """Entry point: errors are one line on stderr, without a traceback."""
    logging.basicConfig(level=logging.WARNING, format="fly: %(message)s", stream=sys.stderr)
    logging.getLogger("flight").setLevel(logging.ERROR)  # before arming, what matters ends in the one line below
    try:
        code = app(standalone_mode=False)
    except FlyError as error:
        print(f"fly: {error}", file=sys.stderr)
        code = error.exit_code
    except typer.Abort:
        code = ExitCode.NOT_REACHED
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's usage errors have no public base class
            raise
        print(f"fly: {error.format_message().rstrip('.')}; see fly --help", file=sys.stderr)
        code = ExitCode.USAGE
    sys.exit(int(code or 0))
