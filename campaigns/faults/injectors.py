"""Faults that the gateway cannot make: of policy, process and computer. Each reaches into a `Stage` before it plays."""

from __future__ import annotations

import dataclasses
import math
import resource
import signal
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from campaigns.faults.computer import CLOCK_OFFSET_S
from campaigns.faults.stage import ProcessDeathError, Stage
from policy_export.errors import PolicyOutputError
from safety.messages import LidarScan

LASTS_S = 3.0
_FAR = 100_000  # the other device has been on for longer
Action = NDArray[np.float32]


def _lasting(stage: Stage, change: Any) -> None:
    """Let `change` have the policy's action while the fault lasts."""

    def upset(action: Action, now_s: float) -> Action:
        since_s = now_s - CLOCK_OFFSET_S - stage.begin_s
        changed: Action = change(action, since_s) if 0.0 <= since_s < LASTS_S else action
        return changed

    stage.policy.upset = upset


def second_scanner(stage: Stage) -> None:
    """Every other scan is that of a device that stands somewhere else and counts for itself."""
    lidar, own, other = stage.lidar, stage.lidar.latest, iter(range(10**6))

    def latest() -> LidarScan | None:
        scan = own()
        number = next(other)
        if scan is None or not 0.0 <= stage.air.time_s - stage.begin_s < LASTS_S or number % 2:
            return scan
        return dataclasses.replace(scan, ranges_m=np.full_like(scan.ranges_m, 3.0), sequence=_FAR + number)

    lidar.latest = latest  # type: ignore[method-assign]


def old_observation(stage: Stage) -> None:
    """The loop is given the scan from the fault's begin again and again."""
    lidar, own = stage.lidar, stage.lidar.latest
    kept: list[LidarScan | None] = []

    def latest() -> LidarScan | None:
        scan = own()
        if not 0.0 <= stage.air.time_s - stage.begin_s < LASTS_S:
            return scan
        kept.append(scan)
        return kept[0]

    lidar.latest = latest  # type: ignore[method-assign]


# -- policy


def policy_not_finite(stage: Stage) -> None:
    """As the runner tells of an output with NaN."""

    def change(_action: Action, _since_s: float) -> Action:
        raise PolicyOutputError("the policy's output is not finite")

    _lasting(stage, change)


def policy_saturated(stage: Stage) -> None:
    """Everything at its limit."""
    _lasting(stage, lambda _action, _since_s: np.array((1.0, 0.5, 0.5, 1.0), dtype=np.float32))


def policy_aims(stage: Stage) -> None:
    """Full speed at whatever is nearest, by the scan."""

    def change(action: Action, _since_s: float) -> Action:
        scan = stage.lidar.latest()
        if scan is None or not np.isfinite(scan.ranges_m).any():
            return action
        bearing = scan.angle_min_rad + scan.angle_increment_rad * int(np.nanargmin(scan.ranges_m))
        return np.array((math.cos(bearing), 0.5 * math.sin(bearing), 0.0, 0.0), dtype=np.float32)

    _lasting(stage, change)


def policy_alternates(stage: Stage) -> None:
    """From one limit to the other at every tick."""
    count = iter(range(10**6))

    def change(_action: Action, _since_s: float) -> Action:
        sign = 1.0 if next(count) % 2 else -1.0
        return np.array((0.5 * sign, 0.5 * sign, 0.5 * sign, sign), dtype=np.float32)

    _lasting(stage, change)


def policy_raises(stage: Stage) -> None:
    """An exception that nobody expects."""

    def change(_action: Action, _since_s: float) -> Action:
        raise RuntimeError("a bug")

    _lasting(stage, change)


def hidden_not_finite(stage: Stage) -> None:
    """A bit has flipped in the recurrent state."""
    stage.at(0.0, stage.policy.poison)


def hidden_explodes(stage: Stage) -> None:
    """The recurrent state has a norm that training never saw."""
    stage.at(0.0, lambda: setattr(stage.policy, "extra_norm", 100.0))
    stage.at(LASTS_S, lambda: setattr(stage.policy, "extra_norm", 0.0))


def _inference_takes(stage: Stage, seconds: float, lasts_s: float) -> None:
    done: list[float] = []

    def change(action: Action, since_s: float) -> Action:
        if not done or since_s < lasts_s:
            done.append(since_s)
            stage.computer.pass_time(seconds)
        return action

    _lasting(stage, change)


def inference_late(stage: Stage) -> None:
    """Once."""
    _inference_takes(stage, 0.04, 0.0)


def inference_hangs(stage: Stage) -> None:
    """Once, for longer than anybody waits."""
    _inference_takes(stage, 2.0, 0.0)


def slow_computer(stage: Stage) -> None:
    """Every step of the policy takes 70 ms."""
    _inference_takes(stage, 0.07, LASTS_S)


# -- process and computer


def process_dies(stage: Stage) -> None:
    """The loop's process is gone: nothing of it runs any more, its socket to the guard closes."""

    def die(_now_s: float) -> float:
        if stage.air.time_s >= stage.begin_s:
            raise ProcessDeathError
        return 0.0

    stage.computer.oversleep = die


def _held(stage: Stage, seconds: float) -> None:
    done: list[float] = []

    def late(now_s: float) -> float:
        if now_s < stage.begin_s or done:
            return 0.0
        done.append(now_s)
        return seconds

    stage.computer.oversleep = late


def process_stopped(stage: Stage) -> None:
    """All threads of the loop's process stand still."""
    _held(stage, 2.5)


def interpreter_held(stage: Stage) -> None:
    """One C call keeps the interpreter."""
    _held(stage, 0.25)


def starved(stage: Stage) -> None:
    """Other programs take the processor."""
    generator = np.random.default_rng([stage.seed, 8])
    computer = stage.computer
    computer.oversleep = lambda now_s: float(generator.uniform(0.06, 0.12)) if 0.0 <= now_s - stage.begin_s < LASTS_S else 0.0


def signalled(stage: Stage) -> None:
    """systemd stops the service."""
    stage.at(0.0, lambda: stage.interrupt._on_signal(signal.SIGTERM, None))


def disk_full(stage: Stage) -> None:
    """The real recorder writes, and from the fault on no file may grow."""
    stage.record()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    stage.at(0.0, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1, limits[1])))
    stage.afterwards(lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits))


def wall_clock_jumps(stage: Stage) -> None:
    """NTP sets the clock an hour ahead."""
    real = time.time
    stage.at(0.0, lambda: setattr(time, "time", lambda: real() + 3600.0))
    stage.afterwards(lambda: setattr(time, "time", real))
