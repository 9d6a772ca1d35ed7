"""The ticks of one flight, in columns allocated once: after an hour it takes no more memory than at the start."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from flight.scan_log import ScanLog
from flight.tick import TickRecord
from safety.frames import CorridorVector
from safety.messages import Intervention, LidarScan, SafeCommand, VehicleState, VelocityCommand, Verdict

MAX_INTERVENTIONS = 10
"""Interventions kept of one tick; the safety filter has fewer rules that can speak at once."""

_NUMBERS = 27
_SENT, _LATENESS = 25, 26
_POSITION, _VELOCITY, _WANTED, _BRAKING, _REACHED, _RESET = (1 << bit for bit in range(6))
_NO_RULE = 255
_NOTHING = (math.nan, math.nan, math.nan)


class FlightLog:
    """Ticks of one flight, oldest first. `max_ticks` bounds it (duration limit times rate); later ticks are only counted.

    `records` gives every `TickRecord` as it was appended, made anew from its row; `scans` what the LiDAR saw.
    """

    def __init__(self, max_ticks: int = 72_000) -> None:
        if max_ticks < 1:
            raise ValueError(f"max_ticks must be at least 1, not {max_ticks}")
        self.dropped = 0
        self.scans = ScanLog(max_ticks)
        self._count = 0
        self._numbers = np.zeros((max_ticks, _NUMBERS))
        self._flags = np.zeros((max_ticks, 2), dtype=np.uint8)
        self._rules = np.zeros((max_ticks, MAX_INTERVENTIONS), dtype=np.uint8)
        self._values = np.zeros((max_ticks, MAX_INTERVENTIONS, 2))
        self._names: list[str] = []
        self._codes: dict[str, int] = {}

    def reserve(self) -> None:
        """Touch all memory that the flight will need, before it starts."""
        self._numbers.fill(0.0)
        self._flags.fill(0)
        self._rules.fill(0)
        self._values.fill(0.0)
        self.scans.reserve()

    def append(self, record: TickRecord, sent_time_s: float, lateness_s: float = math.nan) -> None:
        """`sent_time_s`: when the setpoint had been handed to the link, on the clock of `record.now_s`.

        `lateness_s`: how late the tick began, where a clock of the real world knows it.
        """
        row = self._count
        if row >= len(self._numbers):
            self.dropped += 1
            return
        self._numbers[row] = _numbers_of(record, sent_time_s, lateness_s)
        fault = record.verdict.fault
        self._flags[row] = (_flags_of(record), _NO_RULE if fault is None else self._code(fault))
        self._rules[row] = _NO_RULE
        for column, intervention in enumerate(record.verdict.interventions[:MAX_INTERVENTIONS]):
            self._rules[row, column] = self._code(intervention.rule)
            self._values[row, column] = (intervention.value, intervention.limit)
        self._count += 1

    def see(self, scan: LidarScan | None, state: VehicleState | None) -> None:
        """Keep what the LiDAR saw, for the pictures."""
        self.scans.add(scan, state)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[tuple[TickRecord, float]]:
        return zip(self.records, self.sent_times_s.tolist(), strict=True)

    @property
    def records(self) -> Sequence[TickRecord]:
        """The ticks as they were appended."""
        return _Records(self)

    @property
    def sent_times_s(self) -> NDArray[np.float64]:
        """[n] when each tick's setpoint had been handed to the link."""
        return self._numbers[: self._count, _SENT]

    @property
    def lateness_s(self) -> NDArray[np.float64]:
        """[n] how late each tick began, NaN where nobody knows."""
        return self._numbers[: self._count, _LATENESS]

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """[n, 3] corridor positions of the ticks that had a state."""
        known = (self._flags[: self._count, 0] & _POSITION) != 0
        positions: NDArray[np.float64] = self._numbers[: self._count, 3:6][known]
        return positions

    @property
    def hit_points_m(self) -> NDArray[np.float64]:
        """[n, 2] corridor x, y of the cells in which the LiDAR saw something."""
        return self.scans.scans().hit_points_m()

    def record_at(self, row: int) -> TickRecord:
        """The tick of this row, 0 the oldest."""
        numbers: list[float] = self._numbers[row].tolist()
        flags = int(self._flags[row, 0])
        return TickRecord(
            now_s=numbers[0],
            scan_time_s=numbers[1],
            state_time_s=numbers[2],
            position=CorridorVector(*numbers[3:6]) if flags & _POSITION else None,
            velocity=CorridorVector(*numbers[6:9]) if flags & _VELOCITY else None,
            yaw_rad=numbers[9],
            wanted=VelocityCommand(CorridorVector(*numbers[10:13]), numbers[13]) if flags & _WANTED else None,
            sent=SafeCommand(CorridorVector(*numbers[14:17]), numbers[17]),
            verdict=self._verdict(row, numbers[18:22]),
            distance_to_goal_m=numbers[22],
            goal_reached=bool(flags & _REACHED),
            inference_s=numbers[23],
            hidden_norm=numbers[24],
            hidden_reset=bool(flags & _RESET),
        )

    def _verdict(self, row: int, measured: list[float]) -> Verdict:
        flags, fault = self._flags[row].tolist()
        rules, values = self._rules[row].tolist(), self._values[row].tolist()
        found = (Intervention(self._names[rule], *pair) for rule, pair in zip(rules, values, strict=True) if rule != _NO_RULE)
        scan_age_s, state_age_s, clearance_m, fence_margin_m = measured
        fault_rule = None if fault == _NO_RULE else self._names[fault]
        return Verdict(bool(flags & _BRAKING), tuple(found), scan_age_s, state_age_s, clearance_m, fence_margin_m, fault_rule)

    def _code(self, rule: str) -> int:
        code = self._codes.get(rule)
        if code is None:
            code = len(self._names)
            if code >= _NO_RULE:
                raise ValueError(f"more than {_NO_RULE} different rules; {rule} has no place")
            self._names.append(rule)
            self._codes[rule] = code
        return code


class _Records(Sequence[TickRecord]):
    """The ticks as a sequence; each access makes the record anew."""

    def __init__(self, log: FlightLog) -> None:
        self._log = log

    def __len__(self) -> int:
        return len(self._log)

    @overload
    def __getitem__(self, index: int) -> TickRecord: ...
    @overload
    def __getitem__(self, index: slice) -> list[TickRecord]: ...
    def __getitem__(self, index: int | slice) -> TickRecord | list[TickRecord]:
        rows = range(len(self._log))[index]
        return self._log.record_at(rows) if isinstance(rows, int) else [self._log.record_at(row) for row in rows]


def _numbers_of(record: TickRecord, sent_time_s: float, lateness_s: float) -> tuple[float, ...]:
    wanted, sent, verdict = record.wanted, record.sent, record.verdict
    return (
        record.now_s,
        record.scan_time_s,
        record.state_time_s,
        *_xyz(record.position),
        *_xyz(record.velocity),
        record.yaw_rad,
        *(_xyz(wanted.velocity) if wanted is not None else _NOTHING),
        wanted.yaw_rate_rad_s if wanted is not None else math.nan,
        *_xyz(sent.velocity),
        sent.yaw_rate_rad_s,
        verdict.scan_age_s,
        verdict.state_age_s,
        verdict.clearance_m,
        verdict.fence_margin_m,
        record.distance_to_goal_m,
        record.inference_s,
        record.hidden_norm,
        sent_time_s,
        lateness_s,
    )


def _xyz(vector: CorridorVector | None) -> tuple[float, float, float]:
    return _NOTHING if vector is None else (vector.x, vector.y, vector.z)


def _flags_of(record: TickRecord) -> int:
    return (
        _POSITION * (record.position is not None)
        | _VELOCITY * (record.velocity is not None)
        | _WANTED * (record.wanted is not None)
        | _BRAKING * record.verdict.braking
        | _REACHED * bool(record.goal_reached)
        | _RESET * record.hidden_reset
    )
