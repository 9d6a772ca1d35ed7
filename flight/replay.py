"""`fly replay FILE`: recorded inputs through policy and safety filter once more, compared bit for bit; or through another policy.

The same `Pilot.tick` as in flight gets the same scans, states and times. Its records must then be the same in every bit:
whatever differs is a change in policy, filter, libraries or processor, and the first difference says where to look.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flight.recording_reader import Recording
from flight.recording_schema import UNMEASURED, RecordingError, TickSample, leaves, same_bits, this_machine
from flight.tick import Pilot, TickRecord
from policy_export.errors import PolicyError
from policy_export.policy_file import check_policy_bytes
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter
from safety.messages import VelocityCommand

NOTICEABLE_M_S = 0.05
"""From this difference of the wanted velocity on, another policy counts as deciding differently."""
NOTICEABLE_RAD_S = 0.1
"""The same for its yaw rate."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first value that a replay does not reproduce. `field`: its dotted name in `TickRecord`."""

    tick: int
    time_s: float
    field: str
    recorded: Any
    replayed: Any

    def describe(self) -> str:
        """One line for the user."""
        return (
            f"first difference at tick {self.tick} ({self.time_s:.2f} s): {self.field} recorded {self.recorded!r}, "
            f"replayed {self.replayed!r}"
        )


@dataclass(slots=True)
class Comparison:
    """A replay with the recorded policy. `differing_ticks` counts up to `ticks`; `fields`: how often each name differed.

    `missing_ticks`: after the first tick that was flown but not recorded, memory cannot be known, and comparison ends.
    `same_machine`: whether processor and libraries are those of the recording.
    """

    ticks: int = 0
    differing_ticks: int = 0
    missing_ticks: int = 0
    first: Difference | None = None
    fields: dict[str, int] = field(default_factory=dict)
    same_machine: bool = True

    @property
    def identical(self) -> bool:
        """Whether every compared tick came out the same in every bit, and every recorded tick was compared."""
        return self.first is None and self.ticks > 0 and self.missing_ticks == 0

    def as_dict(self) -> dict[str, object]:
        """For --json."""
        return {"identical": self.identical, **dataclasses.asdict(self)}


@dataclass(slots=True)
class PolicyComparison:
    """How another policy would have decided on the same inputs (it flies nothing: the inputs stay those of the recorded flight).

    Differences of the wanted command over the ticks where both policies were asked: velocity in m/s (length of the
    difference), yaw rate in rad/s. `first_tick`: the first with a noticeable difference. `braking`: ticks in which the
    safety filter would have braked, recorded and other; `rules`: ticks per rule.
    """

    policy: str
    sha256: str
    ticks: int = 0
    compared: int = 0
    noticeable: int = 0
    first_tick: int | None = None
    first_time_s: float | None = None
    velocity_m_s: dict[str, float] = field(default_factory=dict)
    yaw_rate_rad_s: dict[str, float] = field(default_factory=dict)
    sent_velocity_m_s: dict[str, float] = field(default_factory=dict)
    braking: tuple[int, int] = (0, 0)
    rules: dict[str, tuple[int, int]] = field(default_factory=dict)


def recorded_policy(recording: Recording) -> PolicyRunner:
    """The policy that flew, from the recording itself. Raises `RecordingError`."""
    header, data = recording.header, recording.policy
    if data is None:
        raise RecordingError("the recording holds no policy file; it was cut before its first second, or not made by fly")
    if hashlib.sha256(data).hexdigest() != header.policy_sha256:
        raise RecordingError("the policy file in the recording is not the one that flew (SHA-256 differs)")
    try:
        return PolicyRunner(check_policy_bytes(data))
    except PolicyError as error:
        raise RecordingError(f"the recorded policy cannot be run here: {error}") from None


def pilot_of(recording: Recording, policy: PolicyRunner) -> Pilot:
    """Policy and safety filter as they stood at OFFBOARD entry."""
    header = recording.header
    safety, level = SafetyFilter(header.safety), header.level_scans
    pilot = Pilot(policy, safety, header.goal, header.goal_radius_m, level_scans=level)
    pilot.reset()
    return pilot


def replayed(recording: Recording, policy: PolicyRunner) -> Iterator[tuple[TickSample, TickRecord]]:
    """Each recorded tick with what comes out now, up to the first tick that is missing."""
    pilot = pilot_of(recording, policy)
    for number, sample in enumerate(recording.ticks):
        if sample.tick != number:
            return
        pilot.set_goal(sample.goal)
        yield sample, pilot.tick(sample.scan, sample.state, sample.record.now_s, sample.record.health)


def compare(recording: Recording, tolerance: float = 0.0) -> Comparison:
    """Replay with the recorded policy. Raises `RecordingError`.

    `tolerance`: numbers this near to each other (absolute) count as equal; 0 compares every bit.
    """
    _require_ticks(recording)
    result = Comparison(same_machine=this_machine().computes_like(recording.header.machine))
    counts: Counter[str] = Counter()
    for sample, record in replayed(recording, recorded_policy(recording)):
        result.ticks += 1
        found = list(differences(sample.record, record, tolerance))
        if not found:
            continue
        result.differing_ticks += 1
        counts.update(name for name, _, _ in found)
        if result.first is None:
            result.first = Difference(sample.tick, _elapsed_s(recording, sample), *found[0])
    result.missing_ticks = recording.ticks[-1].tick + 1 - result.ticks
    result.fields = dict(counts.most_common())
    return result


def differences(a: TickRecord, b: TickRecord, tolerance: float = 0.0) -> Iterator[tuple[str, Any, Any]]:
    """(name, value of a, value of b) of every field that differs, but for what measures the computer."""
    ours, theirs = dict(leaves(a)), dict(leaves(b))
    for name in [*ours, *(name for name in theirs if name not in ours)]:
        if name not in UNMEASURED and not _equal(ours.get(name), theirs.get(name), tolerance):
            yield name, ours.get(name), theirs.get(name)


def _equal(a: Any, b: Any, tolerance: float) -> bool:
    if same_bits(a, b):
        return True
    return tolerance > 0.0 and isinstance(a, float) and isinstance(b, float) and abs(a - b) <= tolerance


def compare_policy(recording: Recording, path: Path, rate_hz: float) -> PolicyComparison:
    """Feed the recorded inputs to the policy in `path`. Raises `RecordingError`; `MissionError`-like refusals name the field."""
    _require_ticks(recording)
    try:
        runner = PolicyRunner.load(path, rate_hz=rate_hz)
    except PolicyError as error:
        raise RecordingError(f"--policy {path}: {error}") from None
    result = PolicyComparison(str(path), runner.sha256)
    velocity, yaw_rate, sent = [], [], []
    rules: tuple[Counter[str], Counter[str]] = (Counter(), Counter())
    braking = [0, 0]
    for sample, record in replayed(recording, runner):
        result.ticks += 1
        for which, one in enumerate((sample.record, record)):
            braking[which] += one.verdict.braking
            rules[which].update({i.rule for i in one.verdict.interventions})
        sent.append(math.dist(_xyz(sample.record.sent), _xyz(record.sent)))
        if sample.record.wanted is None or record.wanted is None:
            continue
        velocity.append(math.dist(_xyz(sample.record.wanted), _xyz(record.wanted)))
        yaw_rate.append(abs(sample.record.wanted.yaw_rate_rad_s - record.wanted.yaw_rate_rad_s))
        if velocity[-1] >= NOTICEABLE_M_S or yaw_rate[-1] >= NOTICEABLE_RAD_S:
            result.noticeable += 1
            if result.first_tick is None:
                result.first_tick, result.first_time_s = sample.tick, _elapsed_s(recording, sample)
    result.compared = len(velocity)
    result.velocity_m_s, result.yaw_rate_rad_s, result.sent_velocity_m_s = map(_spread, (velocity, yaw_rate, sent))
    result.braking = (braking[0], braking[1])
    result.rules = {rule: (rules[0][rule], rules[1][rule]) for rule in sorted(rules[0] | rules[1])}
    return result


def _require_ticks(recording: Recording) -> None:
    if not recording.ticks:
        raise RecordingError("the recording holds no tick: nothing was flown under the policy")


def _elapsed_s(recording: Recording, sample: TickSample) -> float:
    return sample.record.now_s - recording.ticks[0].record.now_s


def _xyz(command: VelocityCommand | Any) -> tuple[float, float, float]:
    return command.velocity.x, command.velocity.y, command.velocity.z


def _spread(values: list[float]) -> dict[str, float]:
    if not values:
        return {}
    return {"mean": float(np.mean(values)), "p95": float(np.percentile(values, 95)), "max": float(np.max(values))}
