"""The least that a 20 Hz loop can be, in a process of its own: sleep to the next absolute time, look how late it is.

`python -m benchmarks._bare_loop SECONDS`: the loop runs under the same real-time settings as `fly`, with nothing else in its
process; prints its latenesses in ms as one JSON list. `python -m benchmarks._bare_loop busy SECONDS` keeps a core busy instead.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time

from flight.realtime import RealTimeConfig, real_time

PERIOD_S = 0.05


def bare_loop(seconds: float) -> list[float]:
    """Lateness of every wake-up, ms."""
    lateness_ms = []
    deadline_s = time.monotonic()
    end_s = deadline_s + seconds
    while deadline_s < end_s:
        remaining_s = deadline_s - time.monotonic()
        if remaining_s > 0.0:
            time.sleep(remaining_s)
        lateness_ms.append(1e3 * max(0.0, time.monotonic() - deadline_s))
        deadline_s += PERIOD_S
    return lateness_ms


def _keep_busy(seconds: float) -> None:
    """Arithmetic until the time is up, or until the benchmark that asked for it is gone."""
    parent, end_s = os.getppid(), time.monotonic() + seconds
    while time.monotonic() < end_s and os.getppid() == parent:
        sum(range(200_000))


def main() -> None:
    """Command line, for the benchmark only."""
    if sys.argv[1] == "busy":
        _keep_busy(float(sys.argv[2]))
        return
    gc.freeze()
    gc.disable()
    with real_time(RealTimeConfig(), warn=lambda text: print(text, file=sys.stderr)):
        lateness_ms = bare_loop(float(sys.argv[1]))
    print(json.dumps(lateness_ms))


if __name__ == "__main__":
    main()
