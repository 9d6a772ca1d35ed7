"""One case of the campaign: an entry of the catalogue in a scene with a seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from campaigns.faults.catalogue import LASTS_S, Entry
from campaigns.faults.oracle import Verdict, judge
from campaigns.faults.scenes import ENGAGE_S, SCENES
from campaigns.faults.stage import Stage, Trace, felt_s
from flight.mission import Mission
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter

OBSERVED_S = 3.8


@dataclass(frozen=True, slots=True)
class Case:
    """What is run."""

    entry: str
    scene: str
    seed: int


def play(
    entry: Entry,
    scene: str,
    seed: int,
    mission: Mission,
    runner: PolicyRunner,
    make_filter: Callable[..., SafetyFilter] = SafetyFilter,
) -> tuple[Trace, Verdict]:
    """Fly it and judge it."""
    duration_s = OBSERVED_S + entry.felt_after_s + (ENGAGE_S if SCENES[scene].before_offboard else 0.0)
    stage = Stage(SCENES[scene], mission, runner, seed, entry.faults, duration_s=duration_s, make_filter=make_filter)
    if entry.inject is not None:
        entry.inject(stage)
    trace = stage.play()
    trace.felt_s = felt_s(stage, entry.felt_with) + entry.felt_after_s
    if SCENES[scene].before_offboard and trace.records:
        trace.felt_s = max(trace.felt_s, trace.records[0][0])
    trace.over_s = trace.begin_s + max((fault.duration_s or math.inf for fault in entry.faults), default=LASTS_S)
    return trace, judge(trace, entry.expects(scene))
