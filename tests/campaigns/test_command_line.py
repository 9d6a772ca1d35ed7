"""What the campaigns' commands do with mistakes: one line, exit code 2, before anything is flown."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest

from campaigns.command_line import STOPPED, positive, prepare_output, run_command
from campaigns.errors import OutputError
from strict_yaml import ConfigError

ROOT = Path(__file__).resolve().parents[2]


def ended(main, *mistakes: type[Exception]) -> int:
    with pytest.raises(SystemExit) as end:
        run_command("name", main, *mistakes)
    return int(end.value.code or 0)


def fail(error: BaseException) -> NoReturn:
    raise error


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ConfigError("m.yaml:1: x: wrong"), 2, "name: m.yaml:1: x: wrong\n"),
        (FileNotFoundError(2, "No such file or directory", "p.onnx"), 2, "name: p.onnx: No such file or directory\n"),
        (KeyError("case"), 2, "name: 'case'\n"),
        (KeyboardInterrupt(), STOPPED, "name: stopped\n"),
    ],
)
def test_mistakes_are_one_line(error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert ended(lambda: fail(error), KeyError) == code
    assert capsys.readouterr().err == line


def test_results_are_exit_codes_and_our_own_errors_keep_their_traceback() -> None:
    assert [ended(lambda value=value: value) for value in (None, 0, 1)] == [0, 0, 1]
    with pytest.raises(BrokenPipeError):
        run_command("name", lambda: fail(BrokenPipeError("no file in it")))


def test_a_result_that_could_not_be_written_is_told_before_flying(tmp_path: Path) -> None:
    prepare_output(tmp_path / "new" / "result.json")
    assert (tmp_path / "new").is_dir()
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "result.json"):
        with pytest.raises(OutputError, match="--out"):
            prepare_output(path)
    with pytest.raises(OutputError, match=r"\.json"):
        prepare_output(tmp_path / "result.md", beside=(".md",))


@pytest.mark.parametrize("text", ["0", "-3", "many", "1.5", ""])
def test_counts_are_positive(text: str) -> None:
    assert positive("12") == 12
    with pytest.raises(argparse.ArgumentTypeError, match="1 or more"):
        positive(text)


@pytest.mark.parametrize(
    "arguments",
    [
        ["campaigns.realtime", "--flights", "0"],
        ["campaigns.realtime", "--out", "docs"],
        ["campaigns.price", "--episodes", "0"],
        ["campaigns.price", "--out", "README.md/x.json"],
        ["campaigns.faults", "--out", "runs/faults.md"],
        ["campaigns.process_death", "--repeats", "none"],
        ["campaigns.process_death", "--only", "no such cell"],
        ["campaigns.mutation", "--module", "safety/nowhere.py"],
        ["campaigns.realtime", "--mission", "no-such-file.yaml"],
        ["campaigns.paper", "--mission", "no-such-file.yaml"],
        ["campaigns.faults", "--realtime", "--only", "L99"],
        ["campaigns.adversaries", "--out", "results/a.png"],
        ["campaigns.cli", "policies/corridor_ppo_lstm.onnx", "--out", "runs/tables.md"],
        ["campaigns.cli", "no-such-file.onnx"],
        ["campaigns.cli", "--episodes", "0"],
    ],
    ids=" ".join,
)
def test_commands_refuse_in_a_line(arguments: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr.strip()
