"""Faults that must be refused before anything is armed: mission file, policy file, the vehicle's parameters and version.

Each entry makes five variants; each is given to the very code that `fly` calls, and must end in a refusal that names the mistake.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mavsdk import MavsdkError

from flight.checks.vehicle import check_version
from flight.errors import FlyError, VehicleCommandError
from flight.link import VehicleLink
from flight.mission import load_mission
from flight.preflight import Level
from policy_export.errors import PolicyError
from policy_export.runner import PolicyRunner

VARIANTS = 5
BASE = """\
name: ground
vehicle: {connection: "udpin://127.0.0.1:14540"}
policy: {path: policy.onnx}
frame: {takeoff_point_m: [1.0, 0.0], heading_deg: 0}
takeoff_height_m: 2.0
goal: {position_m: [20.0, 0.0, 2.0], radius_m: 0.3}
safety:
  fence: {min_m: [-0.5, -4.0, 0.5], max_m: [25.0, 4.0, 4.0]}
"""
Attempt = Callable[[int, Path, Path], str | None]


@dataclass(frozen=True, slots=True)
class GroundEntry:
    """`attempt(variant, folder, policy)`: what was said, None when accepted. `names`: what that must speak of, per variant."""

    id: str
    title: str
    attempt: Attempt
    names: tuple[str, ...]


def refused(entry: GroundEntry, variant: int, policy: Path) -> str | None:
    """What is wrong with the reaction to one variant; None when it was refused by name."""
    with TemporaryDirectory(prefix="ground-") as folder:
        said = entry.attempt(variant, Path(folder), policy)
    if said is None:
        return "accepted"
    wanted = entry.names[variant % len(entry.names)]
    return None if re.search(wanted, said) else f"refused, but without {wanted!r}: {said[:120]}"


def _load(text: str, folder: Path) -> str | None:
    path = folder / "mission.yaml"
    path.write_text(text)
    try:
        load_mission(path)
    except FlyError as error:
        return str(error)
    return None


def _changed(*changes: tuple[str, str]) -> Attempt:
    """Mission files in which one text is replaced by another."""

    def attempt(variant: int, folder: Path, _policy: Path) -> str | None:
        old, new = changes[variant % len(changes)]
        if old not in BASE:
            raise ValueError(f"the base mission has no {old!r}")
        return _load(BASE.replace(old, new), folder)

    return attempt


_FENCE = "{min_m: [-0.5, -4.0, 0.5], max_m: [25.0, 4.0, 4.0]}"


def _bombs(variant: int, folder: Path, _policy: Path) -> str | None:
    texts = (
        "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n" + BASE,
        BASE + "#" * 300_000,
        BASE.replace("name: ground", "name: !!python/object/apply:os.system [echo]"),
        BASE.replace("takeoff_height_m: 2.0", "takeoff_height_m: .nan"),
        BASE.replace("takeoff_height_m: 2.0", 'takeoff_height_m: "1e0x"'),
    )
    return _load(texts[variant % len(texts)], folder)


def _policy_file(variant: int, folder: Path, policy: Path) -> str | None:
    data, path = policy.read_bytes(), folder / "policy.onnx"
    digest = "0" * 64 if variant == 3 else None
    written = (None, data[: len(data) // 2], data[:3000] + bytes(64) + data[3064:], data, b"not an ONNX file")[variant]
    if written is not None:
        path.write_bytes(written)
    try:
        PolicyRunner.load(path, rate_hz=20.0, expected_sha256=digest)
    except (PolicyError, OSError) as error:
        return f"{type(error).__name__}: {error}"
    return None


class _StubbornParameters:
    """A vehicle whose parameters keep, drop or refuse what is written."""

    def __init__(self, variant: int) -> None:
        self._variant = variant
        self._held: dict[str, float] = {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 0}

    def set_param_float(self, name: str, value: float) -> None:
        self._set(name, value * (2.0 if self._variant == 1 else 1.0))

    def set_param_int(self, name: str, value: int) -> None:
        self._set(name, 1 - value if self._variant == 2 else value)

    def _set(self, name: str, value: float) -> None:
        if self._variant == 3:
            raise MavsdkError("TIMEOUT", name)
        if not (self._variant == 0 or (self._variant == 4 and name == "COM_OBL_RC_ACT")):
            self._held[name] = value

    def get_param_float(self, name: str) -> float:
        return float(self._held[name])

    def get_param_int(self, name: str) -> int:
        return int(self._held[name])


def _parameters(variant: int, _folder: Path, _policy: Path) -> str | None:
    link = VehicleLink("ground")
    link._param = _StubbornParameters(variant)
    try:
        link.set_parameter("COM_OF_LOSS_T", 0.5)
        link.set_parameter("COM_OBL_RC_ACT", 5)
    except VehicleCommandError as error:
        return str(error)
    return None


def _version(variant: int, _folder: Path, _policy: Path) -> str | None:
    """PX4 1.13.3, 1.9, nothing told, 0.0, and 1.13 as `fly check` sees them; it is the check that a new vehicle goes through."""
    numbers = (0x010D03FF, 0x010900FF, None, 0, 0x010D0000)
    number = numbers[variant]
    checks = check_version(None if number is None else {"flight_sw_version": number})
    failed = [check for check in checks if check.level is Level.FAIL]
    return f"{failed[0].name}: {failed[0].seen}; {failed[0].advice}" if failed else None


GROUND: tuple[GroundEntry, ...] = (
    GroundEntry(
        "G1",
        "missing, mistyped, unknown or duplicate key",
        _changed(
            ("takeoff_height_m: 2.0\n", ""),
            ("takeoff_height_m: 2.0", "takeoff_height_m: high"),
            ("takeoff_height_m: 2.0", "takeoff_height_m: 2.0\ntakeof: 1"),
            ("name: ground", "name: ground\nname: twice"),
            ("  fence:", "  fense:"),
        ),
        ("takeoff_height_m: required", "takeoff_height_m", "takeof: unknown key", "name: key given twice", "fense|fence"),
    ),
    GroundEntry(
        "G2",
        "contradictory limits",
        _changed(
            ("min_m: [-0.5,", "min_m: [30.0,"),
            ("  fence:", "  lag_min_s: 0.7\n  fence:"),
            ("  fence:", "  margin_m: 3.0\n  vehicle_radius_m: 2.0\n  fence:"),
            ("  fence:", "  return_speed_m_s: 2.0\n  fence:"),
            ("  fence:", "  memory_hold_s: 30.0\n  fence:"),
        ),
        ("fence x", "lag_min_s", "fence", "return_speed_m_s", "memory_hold_s"),
    ),
    GroundEntry(
        "G3",
        "fence without the start, the height or the goal, or too narrow",
        _changed(
            ("takeoff_point_m: [1.0, 0.0]", "takeoff_point_m: [-0.3, 0.0]"),
            ("takeoff_point_m: [1.0, 0.0]", "takeoff_point_m: [1.0, 3.9]"),
            ("takeoff_height_m: 2.0", "takeoff_height_m: 3.9"),
            ("position_m: [20.0, 0.0, 2.0]", "position_m: [26.0, 0.0, 2.0]"),
            (_FENCE, "{min_m: [-0.5, -0.4, 0.5], max_m: [25.0, 0.4, 4.0]}"),
        ),
        ("takeoff_point_m", "takeoff_point_m", "takeoff_height_m", "position_m", "fence y|of the fence"),
    ),
    GroundEntry(
        "G4",
        "fence that is no fence: flat, NaN, too few numbers, swapped, polygon with two corners",
        _changed(
            (_FENCE, "{min_m: [-0.5, -4.0, 0.5], max_m: [-0.5, 4.0, 4.0]}"),
            (_FENCE, "{min_m: [-0.5, -4.0, .nan], max_m: [25.0, 4.0, 4.0]}"),
            (_FENCE, "{min_m: [-0.5, -4.0], max_m: [25.0, 4.0, 4.0]}"),
            (_FENCE, "{min_m: [25.0, 4.0, 4.0], max_m: [-0.5, -4.0, 0.5]}"),
            (_FENCE, "{min_m: [47.4, 8.5, 0.5], max_m: [47.4, 8.6, 4.0]}"),
        ),
        ("fence", "finite", "min_m", "fence x", "fence x"),
    ),
    GroundEntry(
        "G5",
        "other units: up as down, feet, degrees, millimetres, km/h",
        _changed(
            (_FENCE, "{min_m: [-0.5, -4.0, -4.0], max_m: [25.0, 4.0, -0.5]}"),
            ("takeoff_height_m: 2.0", "takeoff_height_m: 6.6"),
            ("heading_deg: 0", "heading_deg: 4000"),
            ("position_m: [20.0, 0.0, 2.0]", "position_m: [20000.0, 0.0, 2000.0]"),
            ("  fence:", "  max_yaw_rate_deg_s: 57\n  fence:"),
        ),
        ("takeoff_height_m", "takeoff_height_m", "heading_deg", "position_m", "max_yaw_rate_deg_s"),
    ),
    GroundEntry("G6", "YAML bomb, huge file, tag, NaN, text for a number", _bombs,
                ("aliases|unknown key", "larger", "tag|valid string", "finite", "takeoff_height_m")),
    GroundEntry("G7", "vehicle parameters that do not take", _parameters, ("COM_OF_LOSS_T|COM_OBL_RC_ACT",)),
    GroundEntry("G8", "unknown or old PX4", _version, ("PX4",)),
    GroundEntry("P8", "policy file missing, cut, altered, of another digest, no ONNX", _policy_file, ("Policy|No such file",)),
)  # fmt: skip
