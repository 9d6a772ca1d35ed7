"""Faults on demand: what can go wrong, when, and how strongly, as records.

A fault is `{kind, start_s, duration_s, after, parameters}`: in a scenario file, as `kind@start+duration:name=value,...` on the
command line, or through `Simulation.inject`. What a kind does is in the module of its group: `scan_faults`, `motion_faults`,
`report_faults`, `link_faults`, `incidents`. Times are vehicle time; the same faults with the same seed give the same bytes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from strict_yaml import load_config

MAX_FAULTS = 1000
Event = Literal["start", "armed", "offboard"]
EVENTS: tuple[Event, ...] = ("start", "armed", "offboard")


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: its group, its parameters with defaults (unit in the name), and what it does."""

    group: str
    does: str
    defaults: dict[str, float]
    once: bool = False  # happens at the start; a duration means nothing


def _kind(group: str, does: str, *, once: bool = False, **defaults: float) -> Kind:
    return Kind(group, does, defaults, once)


SCAN, MOTION, REPORT, LINK, INCIDENT = "LiDAR", "motion", "report", "link", "incident"
KINDS: dict[str, Kind] = {
    "lidar_silent": _kind(SCAN, "sends no scan"),
    "lidar_freeze": _kind(SCAN, "repeats its last scan with new stamps"),
    "lidar_freeze_old": _kind(SCAN, "repeats its last scan with its old stamp"),
    "lidar_noise": _kind(SCAN, "adds Gaussian noise to every range", sigma_m=0.3),
    "lidar_speckle": _kind(SCAN, "returns at random near ranges in a share of beams", share=0.05, near_m=0.3, far_m=3.0),
    "lidar_lost_beams": _kind(SCAN, "no return in a random share of beams", share=0.3),
    "lidar_phantom": _kind(SCAN, "an obstacle that is not there", distance_m=0.5, bearing_deg=0.0, width_deg=20.0),
    "lidar_vanish": _kind(SCAN, "what stands in a sector is gone", bearing_deg=0.0, width_deg=150.0),
    "lidar_sector": _kind(SCAN, "a sector reads NaN", bearing_deg=0.0, width_deg=60.0),
    "lidar_blocked": _kind(SCAN, "something fixed to the vehicle in a sector", distance_m=0.12, bearing_deg=60.0, width_deg=10.0),
    "lidar_slow": _kind(SCAN, "sends one scan of `every`", every=2.0),
    "lidar_mirror": _kind(SCAN, "beams in reverse order"),
    "lidar_turned": _kind(SCAN, "beams shifted by an angle", angle_deg=30.0),
    "lidar_max": _kind(SCAN, "every beam sees nothing"),
    "lidar_min": _kind(SCAN, "every beam is too near"),
    "lidar_nan": _kind(SCAN, "NaN in a random share of beams", share=1.0),
    "lidar_value": _kind(SCAN, "one value in a random share of beams", value_m=65.535, share=1.0),
    "lidar_delay": _kind(SCAN, "scans leave the device late, with true stamps", delay_s=0.3),
    "lidar_beams": _kind(SCAN, "scans break off after so many beams", beams=180.0),
    "lidar_clock": _kind(SCAN, "stamps off by an offset (positive: ahead) that grows", offset_s=-0.5, rate_s_s=0.0),
    "estimate_jump": _kind(MOTION, "the position estimate is off at once", x_m=0.0, y_m=1.0, z_m=0.0),
    "estimate_drift": _kind(MOTION, "position and velocity estimate drift away together", x_m_s=0.0, y_m_s=0.2, z_m_s=0.0),
    "estimate_velocity": _kind(MOTION, "the velocity estimate is off", x_m_s=0.0, y_m_s=1.5, z_m_s=0.0),
    "estimate_yaw": _kind(MOTION, "the yaw estimate is off", offset_deg=90.0),
    "gps_loss": _kind(MOTION, "no GPS: the estimate drifts, and PX4 descends after 5 s", drift_m_s2=0.03),
    "wind": _kind(MOTION, "more wind, world frame", x_m_s=3.0, y_m_s=0.0, z_m_s=0.0),
    "gust": _kind(MOTION, "one gust, half a sine long", x_m_s=8.0, y_m_s=0.0, z_m_s=0.0),
    "motor_weak": _kind(MOTION, "all motors give a share of their thrust", share=0.7),
    "sluggish": _kind(MOTION, "the velocity loop has a share of its gain", share=0.4),
    "heavy": _kind(MOTION, "more drag: the commanded speed is not reached", factor=6.0),
    "report_freeze": _kind(REPORT, "position and velocity stand still, with new stamps"),
    "report_stale": _kind(REPORT, "position and velocity are repeated with old stamps"),
    "report_silent": _kind(REPORT, "no position, attitude and IMU messages"),
    "report_nan": _kind(REPORT, "NaN in the position"),
    "report_attitude": _kind(REPORT, "NaN in the attitude, as from a quaternion of zeros"),
    "report_velocity": _kind(REPORT, "a velocity that is not that of the position", x_m_s=0.0, y_m_s=2.0, z_m_s=0.0),
    "report_backwards": _kind(REPORT, "stamps step back", step_s=0.3),
    "report_clock": _kind(REPORT, "boot time steps back or ahead for good", step_s=-20.0),
    "report_reset": _kind(REPORT, "the estimator moves its origin and counts a reset", once=True, x_m=0.0, y_m=1.0, z_m=0.0),
    "report_invalid": _kind(REPORT, "ESTIMATOR_STATUS says that velocity is not valid"),
    "report_landed": _kind(REPORT, "EXTENDED_SYS_STATE says on the ground"),
    "link_down": _kind(LINK, "nothing from the vehicle arrives at its clients"),
    "link_up": _kind(LINK, "nothing from clients arrives at the vehicle"),
    "link_loss": _kind(LINK, "a random share of messages is lost, both ways", share=0.3),
    "link_burst": _kind(LINK, "both ways dead for `burst_s` of every `period_s`", burst_s=0.5, period_s=1.5),
    "link_delay": _kind(LINK, "messages come late, both ways", delay_s=0.3),
    "link_duplicate": _kind(LINK, "a random share of messages comes twice", share=0.5, later_s=0.1),
    "link_reorder": _kind(LINK, "a random share of messages is overtaken", share=0.3, later_s=0.08),
    "link_garbage": _kind(LINK, "malformed messages among the good ones", rate_hz=50.0),
    "link_flood": _kind(LINK, "a flood of valid messages to the client", rate_hz=10_000.0),
    "link_foreign": _kind(LINK, "a second vehicle with the same ids speaks on the link", rate_hz=50.0),
    "pilot_mode": _kind(INCIDENT, "the pilot changes the mode (PX4's main and sub mode numbers)", once=True, main=4.0, sub=3.0),
    "pilot_sticks": _kind(INCIDENT, "the pilot holds and moves the sticks", ahead=0.0, right=0.6),
    "disarm": _kind(INCIDENT, "kill switch", once=True),
    "px4_failsafe": _kind(INCIDENT, "PX4's own failsafe changes the mode", once=True, main=4.0, sub=5.0),
    "refuse_offboard": _kind(INCIDENT, "PX4 refuses OFFBOARD"),
    "reboot": _kind(INCIDENT, "the autopilot restarts: motors off, its boot time begins anew", once=True),
    "battery": _kind(INCIDENT, "the battery is down to a fraction (`slowly`=1: shown late)", once=True, fraction=0.1, slowly=0.0),
    "rogue": _kind(INCIDENT, "another program sends velocity setpoints", x_m_s=0.5, y_m_s=0.0, rate_hz=20.0),
    "rogue_mode": _kind(INCIDENT, "another program changes the mode", once=True, main=4.0, sub=6.0),
}
_TEXT = re.compile(r"(?P<kind>[a-z0-9_]+)@((?P<after>[a-z]+):)?(?P<start>[0-9.]+)(\+(?P<duration>[0-9.]+))?(:(?P<rest>.+))?$")


class FaultError(ValueError):
    """A fault that cannot be understood; the message says what to write instead."""


class Fault(BaseModel):
    """One fault. It begins `start_s` after the event `after` and lasts `duration_s` (None: to the end)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: str
    start_s: float = Field(default=0.0, ge=0.0, le=86_400.0)
    duration_s: float | None = Field(default=None, gt=0.0, le=86_400.0)
    after: Event = Field(default="start", description="start of the simulation, first arming, first OFFBOARD")
    parameters: dict[str, Annotated[float, Field(ge=-1e6, le=1e6)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known(self) -> Self:
        if self.kind not in KINDS:
            raise ValueError(f"no fault is called {self.kind!r}; there are: {', '.join(KINDS)}")
        kind = KINDS[self.kind]
        unknown = set(self.parameters) - set(kind.defaults)
        if unknown:
            raise ValueError(f"{self.kind} has no parameter {sorted(unknown)[0]!r}; it has: {', '.join(kind.defaults) or 'none'}")
        if kind.once and self.duration_s is not None:
            raise ValueError(f"{self.kind} happens at once: leave duration_s out")
        return self

    def __getitem__(self, name: str) -> float:
        """A parameter's value, its default where it was not given."""
        return self.parameters.get(name, KINDS[self.kind].defaults[name])

    @classmethod
    def parse(cls, text: str) -> Fault:
        """`lidar_freeze@12+3`, `estimate_jump@offboard:5:y_m=1`, `battery@20:fraction=0.05`. Raises `FaultError`."""
        match = _TEXT.match(text)
        if match is None:
            raise FaultError(f"fault {text!r}: write kind@start+duration:name=value,... such as lidar_freeze@12+3")
        parts = match.groupdict()
        try:
            pairs = [item.split("=", 1) for item in (parts["rest"] or "").split(",") if item]
            given = {name: float(value) for name, value in pairs}
            start, duration = float(parts["start"]), parts["duration"]
        except ValueError:
            raise FaultError(f"fault {text!r}: a number is not a number, or a parameter is not name=value") from None
        record = {"kind": parts["kind"], "start_s": start, "parameters": given, "after": parts["after"] or "start"}
        try:
            return cls.model_validate(record | {"duration_s": float(duration) if duration else None})
        except (ValidationError, ValueError) as error:
            raise FaultError(f"fault {text!r}: {_first_message(error)}") from None


def only_possible(faults: Iterable[Fault], possible: Collection[str], events: Collection[str], role: str) -> None:
    """Raise `FaultError` unless all kinds and events of these faults exist in a role of the gateway."""
    for fault in faults:
        if fault.kind not in possible:
            raise FaultError(f"{fault.kind} cannot happen with {role}; there are: {', '.join(possible)}")
        if fault.after not in events:
            raise FaultError(f"{fault.kind}: with {role} a fault can wait for: {', '.join(events)}")


class Scenario(BaseModel):
    """A scenario file: a list of faults."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    faults: tuple[Fault, ...] = Field(max_length=MAX_FAULTS)


def load_faults(path: str | Path) -> tuple[Fault, ...]:
    """The faults of a scenario file. Raises `strict_yaml.ConfigError`, one line per mistake."""
    return load_config(path, Scenario).faults


def _first_message(error: Exception) -> str:
    text = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
    return text.removeprefix("Value error, ")


@dataclass(frozen=True, slots=True)
class Active:
    """A fault at work: when it began and ends, vehicle time; `number` tells equal faults apart."""

    fault: Fault
    begin_s: float
    end_s: float
    number: int

    def __getitem__(self, name: str) -> float:
        return self.fault[name]

    @property
    def kind(self) -> str:
        """The fault's kind."""
        return self.fault.kind

    def at(self, time_s: float) -> bool:
        """Whether it works at this time."""
        return self.begin_s <= time_s < self.end_s


class FaultSchedule:
    """All faults of one simulation and the events they wait for. Asked at every step; free when there are none."""

    def __init__(self) -> None:
        self._events: dict[str, float] = {"start": 0.0}
        self._waiting: list[Fault] = []
        self._placed: list[Active] = []
        self._count = 0

    def add(self, fault: Fault) -> None:
        """Take in a fault. One whose event is over begins counted from that event."""
        if self._count >= MAX_FAULTS:
            raise FaultError(f"more than {MAX_FAULTS} faults in one simulation")
        self._waiting.append(fault)
        self._place()

    def happened(self, event: Event, time_s: float) -> None:
        """The first arming or the first OFFBOARD; later ones change nothing."""
        if event not in self._events:
            self._events[event] = time_s
            self._place()

    def end(self, kind: str, time_s: float) -> None:
        """Every fault of a kind that is at work ends now."""
        self._placed = [replace(item, end_s=time_s) if item.kind == kind and item.at(time_s) else item for item in self._placed]

    def _place(self) -> None:
        ready = [fault for fault in self._waiting if fault.after in self._events]
        self._waiting = [fault for fault in self._waiting if fault.after not in self._events]
        for fault in ready:
            begin_s = self._events[fault.after] + fault.start_s
            end_s = begin_s + fault.duration_s if fault.duration_s is not None else math.inf
            self._placed.append(Active(fault, begin_s, end_s, self._count))
            self._count += 1

    @property
    def placed(self) -> tuple[Active, ...]:
        """All faults whose times are known."""
        return tuple(self._placed)

    def active(self, kind: str, time_s: float) -> Active | None:
        """The newest fault of a kind at work at `time_s`."""
        return next((item for item in reversed(self._placed) if item.kind == kind and item.at(time_s)), None)

    def group(self, group: str, time_s: float) -> list[Active]:
        """All faults of a group at work at `time_s`, in the order they were injected."""
        return [item for item in self._placed if item.at(time_s) and KINDS[item.kind].group == group]

    def has(self, group: str) -> bool:
        """Whether any fault of a group has a time."""
        return bool(self._placed) and any(KINDS[item.kind].group == group for item in self._placed)

    def next_edge_s(self, group: str, time_s: float) -> float:
        """The next time after `time_s` at which a fault of a group begins or ends."""
        edges = (edge for item in self._placed if KINDS[item.kind].group == group for edge in (item.begin_s, item.end_s))
        return min((edge for edge in edges if edge > time_s), default=math.inf)
