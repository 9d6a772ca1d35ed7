"""Why `fly` refuses or stops, each with its exit code. Every message is one line and says what to change."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of `fly`.

    USAGE: the command line, or a file it names, is wrong. REFUSED: the files are fine, but the vehicle, a sensor or the
    computer is not ready, and nothing was armed.
    """

    GOAL_REACHED = 0
    NOT_REACHED = 1
    USAGE = 2
    REFUSED = 3
    SAFETY_ENDED = 4


class FlyError(Exception):
    """A mistake or condition that ends `fly` before anything is armed. The message is one line for the user."""

    exit_code = ExitCode.USAGE


class MissionError(FlyError):
    """The mission cannot be flown as written: a value, a file it names, or two values that contradict each other."""


class RefusedError(FlyError):
    """Preflight says no: vehicle, sensor, world or computer is not ready."""

    exit_code = ExitCode.REFUSED


class NoVehicleError(RefusedError):
    """Nothing answered on the vehicle connection in time."""


class GatewayError(RefusedError):
    """The simulator's gateway did not start, or died."""


class VehicleCommandError(RefusedError):
    """The vehicle refused a command or did not answer it in time."""
