"""What the campaigns' commands do alike: one line for a user's mistake or Ctrl-C, checks before hours of flying."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import typer

from campaigns.errors import USER_ERRORS, OutputError

STOPPED = 130  # 128 and SIGINT, as shells have it


def run_command(name: str, main: Callable[[], int | None], *mistakes: type[Exception]) -> NoReturn:
    """Run `main` and end the program with its exit code; 2 and one line for a user's mistake, 130 for Ctrl-C.

    `mistakes`: exceptions of this command that are the user's, beside those of all.
    """
    the_users: tuple[type[Exception], ...] = (*USER_ERRORS, *mistakes)
    try:
        sys.exit(main())
    except the_users as mistake:
        _end(f"{name}: {mistake}", 2)
    except OSError as error:
        if error.filename is None:  # not about a file that somebody named
            raise
        _end(f"{name}: {error.filename}: {error.strerror}", 2)
    except (KeyboardInterrupt, typer.Abort):
        _end(f"{name}: stopped", STOPPED)
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's usage errors have no public base class
            raise
        _end(f"{name}: {error.format_message().rstrip('.')}; see {name} --help", 2)


def _end(line: str, code: int) -> NoReturn:
    sys.stderr.write(f"{line}\n")
    sys.exit(code)


def prepare_output(path: Path, beside: tuple[str, ...] = ()) -> None:
    """Make the folder of a result and see that the file can be written, before anything is flown. Raises `OutputError`.

    `beside`: suffixes of what is written next to it, which the file itself must not have.
    """
    if path.suffix in beside:
        raise OutputError(f"{path}: {' and '.join(beside)} are written beside the result: give a .json file with --out")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path.parent}: {error.strerror}; give another file with --out") from None
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise OutputError(f"{path} cannot be written: give another file with --out")


def positive(text: str) -> int:
    """For argparse: an integer of 1 or more."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number of 1 or more")
    return number
