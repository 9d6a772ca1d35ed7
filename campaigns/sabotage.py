"""`fly`, with a fault built in from outside: on SIGUSR1 the loop hangs, dies silently, or holds the interpreter's lock.

    python -m campaigns.sabotage hang --mission configs/corridor.yaml

The flight code itself knows nothing of this.
"""

from __future__ import annotations

import ctypes
import signal
import sys
import time
from collections.abc import Callable
from types import FrameType

from flight.cli import main
from flight.offboard import Ending, OffboardFlight

FAULT_S = 20.0


class SwallowedError(BaseException):
    """Ends the loop wherever it stands."""


def hang(_number: int, _frame: FrameType | None) -> None:
    """A call that does not come back, in the loop's own thread; all other threads run on."""
    time.sleep(FAULT_S)


def hold_gil(_number: int, _frame: FrameType | None) -> None:
    """A C call that keeps the interpreter's lock: no Python code runs in any thread."""
    ctypes.PyDLL(None).sleep(ctypes.c_uint(int(FAULT_S)))


def end_loop(_number: int, _frame: FrameType | None) -> None:
    """An exception in the loop ..."""
    raise SwallowedError


def swallow() -> None:
    """... that something around the loop swallows: the program lives on without it."""
    run = OffboardFlight.run

    def careless(self: OffboardFlight) -> Ending:
        try:
            return run(self)
        except SwallowedError:
            time.sleep(FAULT_S)
            raise

    OffboardFlight.run = careless  # type: ignore[method-assign]


FAULTS: dict[str, Callable[[int, FrameType | None], None]] = {"hang": hang, "gil": hold_gil, "swallowed": end_loop}

if __name__ == "__main__":
    fault = sys.argv.pop(1)
    if fault == "swallowed":
        swallow()
    signal.signal(signal.SIGUSR1, FAULTS[fault])
    main()
