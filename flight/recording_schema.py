"""What a recording holds, without a word about files: the flight's header, the samples of a tick, and their exact JSON.

Two kinds of channel lie side by side in a recording. Those under `/replay` are lossless: float64 as the shortest decimal
that reads back to the same bits, float32 ranges as base64 of their bytes, so that a replay can be compared bit for bit.
All others are for people and their viewers (`flight.recording_channels`).
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import platform
import struct
import types
import typing
from collections.abc import Hashable, Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from flight.errors import FlyError
from flight.tick import TickRecord
from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.messages import LidarScan, SafeCommand, VehicleState

HEADER_TOPIC = "/flight"
SCAN_TOPIC = "/replay/scan"
TICK_TOPIC = "/replay/tick"
EVENT_TOPIC = "/replay/event"
POLICY_ATTACHMENT = "policy.onnx"
MAX_BEAMS = 16_384
UNMEASURED = ("inference_s",)
"""Fields of a `TickRecord` that measure the computer, not the flight: recorded, never compared."""

_SIMD = frozenset(
    ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512_vnni", "avx512_bf16", "amx_tile", "asimd", "asimddp", "sve")
)
_LIBRARIES = ("lstm-pilot", "numpy", "onnxruntime")

_LATEST_NS = (2**32 - 1) * 1_000_000_000
"""Foxglove's timestamps have 32 bits of seconds."""

T = TypeVar("T")


class RecordingError(FlyError):
    """A recording cannot be read, or lacks what was asked of it. The message is one line and says what to do."""


class Machine(BaseModel):
    """Where it was recorded. Another processor may round the last bit differently (other vector instructions)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    python: str
    architecture: str
    simd: tuple[str, ...]
    libraries: dict[str, str]

    def computes_like(self, other: Machine) -> bool:
        """Whether bit-identical results can be expected: same instructions, same numpy and onnxruntime."""
        mine, theirs = ((m.architecture, m.simd, m.libraries.get("numpy"), m.libraries.get("onnxruntime")) for m in (self, other))
        return mine == theirs


class FlightHeader(BaseModel):
    """What a replay must know besides the samples. Corridor frame, SI units.

    `clock_offset_ns`: Unix time in ns less the flight's monotonic clock, at the start. `boxes_m`: obstacles that a simulator
    knows (xmin, ymin, zmin, xmax, ymax, zmax); None on a real vehicle. `origin_ned_m`, `heading_rad`: the corridor frame in
    PX4's local frame.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: Literal[1] = 1
    mission: str = Field(max_length=100)
    clock_offset_ns: int
    rate_hz: float
    goal_m: tuple[float, float, float]
    goal_radius_m: float
    level_scans: bool = False
    safety: SafetyConfig
    policy_path: str
    policy_sha256: str
    dynamics: str = "vehicle"
    seed: int | None = None
    origin_ned_m: tuple[float, float, float] | None = None
    heading_rad: float | None = None
    boxes_m: tuple[tuple[float, float, float, float, float, float], ...] | None = None
    machine: Machine

    @property
    def goal(self) -> CorridorVector:
        """Where the flight wanted to."""
        return CorridorVector(*self.goal_m)

    def unix_ns(self, time_s: float) -> int:
        """Unix time, ns, of a time on the flight's own clock; 0 where there is none, and no later than a viewer can show."""
        elapsed_ns = 1e9 * time_s
        return min(max(0, self.clock_offset_ns + round(elapsed_ns)), _LATEST_NS) if math.isfinite(elapsed_ns) else 0


@dataclass(frozen=True, slots=True)
class TickSample:
    """One tick as it goes into a recording.

    `tick`: counts from 0, gaps are ticks that were not recorded. `scan`, `state`: what the tick was given. `record`: what
    `Pilot.tick` made of it; `sent`: what really went out at `sent_time_s` (an escalation may have stopped the
    vehicle), None and NaN where nothing did. `lateness_s`: how late the tick woke up. `deadline_misses`, `dropped`: so far.
    """

    tick: int
    record: TickRecord
    scan: LidarScan | None
    state: VehicleState | None
    sent: SafeCommand | None
    sent_time_s: float
    goal: CorridorVector
    lateness_s: float = 0.0
    deadline_misses: int = 0
    dropped: int = 0


# -- lossless JSON ----------------------------------------------------------------------------------------------


def encode_scan(scan: LidarScan, number: int) -> str:
    """A scan, exactly. `number`: how a tick refers to it."""
    ranges = np.ascontiguousarray(scan.ranges_m, dtype="<f4")
    document = {name: to_plain(getattr(scan, name)) for name in _scan_scalars()}
    return _dumps({"scan": number, **document, "ranges_f32": base64.b64encode(ranges.tobytes()).decode("ascii")})


def decode_scan(text: bytes) -> tuple[int, LidarScan]:
    """Inverse of `encode_scan`. Raises `RecordingError`."""
    document = _loads(text, "scan")
    try:
        data = base64.b64decode(document["ranges_f32"], validate=True)
        if len(data) % 4 or len(data) > 4 * MAX_BEAMS:
            raise RecordingError(f"a recorded scan has {len(data)} bytes of ranges; at most {4 * MAX_BEAMS} are read")
        scalars: dict[str, Any] = {name: (int if name == "sequence" else float)(document[name]) for name in _scan_scalars()}
        ranges = np.frombuffer(data, dtype="<f4").astype(np.float32, copy=False)
        return int(document["scan"]), LidarScan(ranges_m=ranges, **scalars)
    except (KeyError, TypeError, ValueError, OverflowError, binascii.Error) as error:
        raise RecordingError(f"a recorded scan is damaged ({type(error).__name__}: {error})") from None


@cache
def _scan_scalars() -> tuple[str, ...]:
    return tuple(field.name for field in fields(LidarScan) if field.name != "ranges_m")


def encode_tick(sample: TickSample, scan_number: int | None) -> str:
    """Everything of a tick but its scan, exactly."""
    document = {field.name: to_plain(getattr(sample, field.name)) for field in fields(sample) if field.name != "scan"}
    return _dumps({**document, "scan": scan_number})


def decode_tick(text: bytes) -> tuple[TickSample, int | None]:
    """Inverse of `encode_tick`: the sample without its scan, and the scan's number. Raises `RecordingError`."""
    document = _loads(text, "tick")
    number = document.pop("scan", None)
    try:
        return from_plain(TickSample, {**document, "scan": None}), None if number is None else int(number)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RecordingError(f"a recorded tick is damaged ({type(error).__name__}: {error})") from None


def encode_event(text: str) -> str:
    """One line of what happened."""
    return _dumps({"text": text})


def decode_event(text: bytes) -> str:
    """Inverse of `encode_event`. Raises `RecordingError`."""
    return str(_loads(text, "event").get("text", ""))


def to_plain(value: Any) -> Any:
    """A message as JSON has it: dataclasses become objects, and a float that JSON lacks becomes the string nan, inf or -inf."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else repr(float(value))
    if isinstance(value, tuple):
        return [to_plain(item) for item in value]
    return {name: to_plain(getattr(value, name)) for name in value.__dataclass_fields__}


def from_plain(kind: type[T], value: Any) -> T:
    """Inverse of `to_plain` for a dataclass of messages. Raises `KeyError`, `TypeError` or `ValueError`.

    A field that has a default may be missing: an older recording does not know it.
    """
    hints = _hints(typing.cast(Hashable, kind))
    known = {name: value[name] for name in hints if name in value or name not in _defaults(typing.cast(Hashable, kind))}
    return kind(**{name: _read(hints[name], item) for name, item in known.items()})


def _read(hint: Any, value: Any) -> Any:
    if isinstance(hint, types.UnionType):
        if value is None:
            return None
        hint = next(kind for kind in typing.get_args(hint) if kind is not types.NoneType)
    if typing.get_origin(hint) is tuple:
        return tuple(_read(typing.get_args(hint)[0], item) for item in value)
    if is_dataclass(hint):
        return from_plain(typing.cast(type, hint), value)
    if hint is float:
        return float(value)
    if type(value) is not hint:
        raise TypeError(f"{value!r} is not {hint.__name__}")
    return value


@cache
def _hints(kind: Hashable) -> dict[str, Any]:
    return typing.get_type_hints(typing.cast(type, kind))


@cache
def _defaults(kind: Hashable) -> frozenset[str]:
    """Fields of a message that may be missing."""
    return frozenset(field.name for field in fields(typing.cast(Any, kind)) if field.default is not MISSING)


def _dumps(document: dict[str, Any]) -> str:
    return json.dumps(document, separators=(",", ":"), allow_nan=False)


def _loads(text: bytes, what: str) -> dict[str, Any]:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"a recorded {what} is damaged ({error})") from None
    if not isinstance(document, dict):
        raise RecordingError(f"a recorded {what} is damaged (not an object)")
    return document


# -- comparison -------------------------------------------------------------------------------------------------


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every number and word of a message with its dotted name, in the order of its fields."""
    if is_dataclass(value):
        for field in fields(value):
            yield from leaves(getattr(value, field.name), f"{name}.{field.name}" if name else field.name)
    elif isinstance(value, tuple):
        yield f"{name}.length", len(value)
        for index, item in enumerate(value):
            yield from leaves(item, f"{name}[{index}]")
    else:
        yield name, value.item() if isinstance(value, np.generic) else value


def same_bits(a: Any, b: Any) -> bool:
    """Equal in type and in every bit; one NaN is as good as another."""
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("<d", a) == struct.pack("<d", b) or (math.isnan(a) and math.isnan(b))
    return type(a) is type(b) and bool(a == b)


# -- the machine ------------------------------------------------------------------------------------------------


def this_machine() -> Machine:
    """What a header says about this computer."""
    return Machine(
        python=platform.python_version(),
        architecture=platform.machine(),
        simd=_simd(),
        libraries={name: version for name in _LIBRARIES if (version := _version(name)) is not None},
    )


def _version(library: str) -> str | None:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return None


def _simd() -> tuple[str, ...]:
    """Vector instructions of the processor, those of `_SIMD` that it has; empty where /proc/cpuinfo is not there."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ()
    words = next((line.partition(":")[2].split() for line in lines if line.lower().startswith(("flags", "features"))), [])
    return tuple(sorted(_SIMD.intersection(words)))
