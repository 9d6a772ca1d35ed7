"""Wake-up lateness of the rate keeper next to a bare absolute-time loop, both in this run, at 20 Hz.

The two take turns in blocks of two seconds, so that both meet the same machine. Each tick does the same small work.
The garbage collector is frozen and off for both, as in flight. Steal (the host taking the CPU away) is reported beside
the figures: no loop can do anything about it.
"""

from __future__ import annotations

import gc
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from flight.rate_keeper import RateKeeper

RATE_HZ = 20.0
BLOCKS = 5
BLOCK_TICKS = 40
P99_RATIO = 1.5
"""The keeper's p99 may be at most this many times the bare loop's."""
P99_SLACK_US = 50.0
"""Added to the limit: what the clock and 200 samples leave open on a quiet machine."""
RATE_TOLERANCE = 0.005

Figure = dict[str, Any]


def run(json: bool) -> list[Figure]:
    """p50, p99 and maximum of the lateness in us, and the mean rate. Takes 20 s."""
    gc.collect()
    gc.freeze()
    gc.disable()
    steal_before = _steal_ticks()
    try:
        kept_us, bare_us, rates = _take_turns()
    finally:
        gc.enable()
        gc.unfreeze()
    if not json:
        print(f"   steal during the run: {_steal_ticks() - steal_before} jiffies", file=sys.stderr)
    return [*_lateness_figures(kept_us, bare_us), _rate_figure(rates)]


def _take_turns() -> tuple[list[float], list[float], list[float]]:
    kept_us: list[float] = []
    bare_us: list[float] = []
    rates: list[float] = []
    for block in range(BLOCKS):
        print(f"   block {block + 1} of {BLOCKS}", file=sys.stderr, flush=True)
        keeper = RateKeeper(RATE_HZ)
        for _ in range(BLOCK_TICKS):
            keeper.wait()
            kept_us.append(1e6 * keeper.lateness_s)
            _work()
        rates.append(keeper.statistics().rate_hz)
        bare_us += _bare_loop()
    return kept_us, bare_us, rates


def _bare_loop() -> list[float]:
    """The least that can be done: sleep to the next absolute time, look how late it is."""
    lateness_us = []
    deadline_s = time.monotonic()
    for _ in range(BLOCK_TICKS):
        remaining_s = deadline_s - time.monotonic()
        if remaining_s > 0.0:
            time.sleep(remaining_s)
        lateness_us.append(1e6 * max(0.0, time.monotonic() - deadline_s))
        _work()
        deadline_s += 1.0 / RATE_HZ
    return lateness_us


def _work() -> float:
    """About 0.3 ms of arithmetic, as much as a tick."""
    values = np.arange(20_000, dtype=np.float64)
    return float(np.sqrt(values).sum())


def _lateness_figures(kept_us: list[float], bare_us: list[float]) -> list[Figure]:
    figures = []
    for name, percent in (("p50", 50.0), ("p99", 99.0), ("max", 100.0)):
        value, peer = (float(np.percentile(samples, percent)) for samples in (kept_us, bare_us))
        judged = name == "p99"
        figures.append(
            {
                "name": f"wake-up lateness {name}",
                "value": value,
                "unit": "us",
                "peer": peer,
                "ratio": value / peer if peer > 0.0 else None,
                "target": P99_RATIO if judged else None,
                "ok": value <= P99_RATIO * peer + P99_SLACK_US if judged else None,
            }
        )
    return figures


def _rate_figure(rates: list[float]) -> Figure:
    rate_hz = float(np.mean(rates))
    error = abs(rate_hz / RATE_HZ - 1.0)
    return {
        "name": "mean rate",
        "value": rate_hz,
        "unit": "Hz",
        "peer": RATE_HZ,
        "ratio": rate_hz / RATE_HZ,
        "target": f"within {RATE_TOLERANCE:.1%}",
        "ok": error <= RATE_TOLERANCE,
    }


def _steal_ticks() -> int:
    """Jiffies that the host took from this machine so far; 0 where /proc/stat is not there."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    except OSError:
        return 0
    return int(fields[8]) if len(fields) > 8 else 0
