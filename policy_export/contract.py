"""The policy file's contract: what the metadata inside the ONNX file says, and what may be said. See docs/policy_file.md.

Every model is frozen, refuses unknown keys and non-finite numbers, and checks itself when it is made, so that an object of
one of these types is always a layout that can be flown.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, model_validator

from policy_export.errors import PolicyFileError

SCHEMA_VERSION = 1
METADATA_KEY = "lstm_pilot"
"""Key of the JSON document in the ONNX file's `metadata_props`."""
DIGEST_KEY = "lstm_pilot_sha256"
"""Key of the digest over the whole file (docs/policy_file.md, "Digests")."""
MAX_METADATA_BYTES = 256 * 1024

ChannelName = Annotated[
    str, Field(pattern=r"^(lidar|goal_offset|position|velocity|acceleration|yaw|other(_[a-z0-9]+)*)$", max_length=64)
]
ChannelFrame = Literal["sensor", "heading", "corridor", "none"]
Unit = Annotated[str, Field(min_length=1, max_length=32)]
ResetReason = Literal["offboard_entry", "goal_change", "policy_change", "gap"]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ActionName = Annotated[str, Field(pattern=r"^(vx|vy|vz|yaw_rate|other(_[a-z0-9]+)*)$", max_length=64)]
Limits = Annotated[tuple[float, ...], Field(min_length=1, max_length=64)]

VELOCITY_ACTION = ("vx", "vy", "vz", "yaw_rate")
"""The action that a drone flies; every other is only carried."""
MAX_LAYERS = 8

_CHANNEL_UNITS: dict[str, str] = {
    "lidar": "m",
    "goal_offset": "m",
    "position": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "yaw": "rad",
}
_CHANNEL_FRAMES: dict[str, tuple[str, ...]] = {
    "lidar": ("sensor",),
    "goal_offset": ("heading", "corridor"),
    "position": ("corridor",),
    "velocity": ("heading", "corridor"),
    "acceleration": ("heading", "corridor"),
    "yaw": ("corridor",),
}


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ChannelSpec(_Model):
    """One named slice `start:stop` of the observation vector.

    `lidar`: ranges in beam order. `goal_offset`: goal minus own position. `position`: own position in the corridor frame.
    `velocity`, `acceleration` (gravity removed): of the vehicle. `yaw`: corridor yaw in [-pi, pi], counter-clockwise.
    `other` and `other_...`: anything else, of any width, unit and frame; only programs made for that policy can build it.
    """

    name: ChannelName
    unit: Unit
    frame: ChannelFrame
    start: int = Field(ge=0)
    stop: int = Field(gt=0)

    @model_validator(mode="after")
    def _meaningful(self) -> ChannelSpec:
        if self.stop <= self.start:
            raise ValueError(f"stop ({self.stop}) must be above start ({self.start})")
        if self.is_other:
            return self
        if self.unit != _CHANNEL_UNITS[self.name]:
            raise ValueError(f"unit of {self.name} must be {_CHANNEL_UNITS[self.name]}, not {self.unit}")
        if self.frame not in _CHANNEL_FRAMES[self.name]:
            raise ValueError(f"frame of {self.name} must be one of {', '.join(_CHANNEL_FRAMES[self.name])}, not {self.frame}")
        return self

    @property
    def is_other(self) -> bool:
        """Whether its meaning is outside this contract."""
        return is_other(self.name)

    @property
    def width(self) -> int:
        """Number of values."""
        return self.stop - self.start

    @property
    def span(self) -> slice:
        """The slice of the observation vector."""
        return slice(self.start, self.stop)


class LidarSpec(_Model):
    """The scan that the policy was trained on.

    Beam i looks at bearing `-fov/2 + (i + 0.5) * fov / beams` (0 ahead, positive to the left), in the vehicle's body plane.
    A beam without a return enters as `range_max_m`, one nearer than `range_min_m` as 0.
    """

    beams: int = Field(default=180, gt=0, le=4096)
    fov_rad: float = Field(default=math.pi, gt=0.0, le=2.0 * math.pi + 1e-9)
    range_min_m: float = Field(default=0.1, ge=0.0)
    range_max_m: float = Field(default=4.0, gt=0.0, le=1000.0)

    @model_validator(mode="after")
    def _ordered(self) -> LidarSpec:
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        return self


class ObservationLayout(_Model):
    """The whole observation: channels that cover `0:size` without gap or overlap. Without a `lidar` channel, `lidar` is idle."""

    size: int = Field(gt=0, le=8192)
    lidar: LidarSpec = LidarSpec()
    channels: tuple[ChannelSpec, ...] = Field(min_length=1, max_length=64)

    @model_validator(mode="after")
    def _covers(self) -> ObservationLayout:
        position = 0
        names: set[str] = set()
        for channel in self.channels:
            expected = channel.width if channel.is_other else channel_width(channel.name, self.lidar)
            if channel.start != position:
                raise ValueError(f"channel {channel.name} must start at {position}, not {channel.start}")
            if channel.width != expected:
                raise ValueError(f"channel {channel.name} must hold {expected} values, not {channel.width}")
            if channel.name in names:
                raise ValueError(f"channel {channel.name} appears twice")
            names.add(channel.name)
            position = channel.stop
        if position != self.size:
            raise ValueError(f"channels end at {position} but size is {self.size}")
        return self

    def channel(self, name: str) -> ChannelSpec | None:
        """The channel of that name, or None."""
        return next((channel for channel in self.channels if channel.name == name), None)


class ActionLayout(_Model):
    """vx, vy, vz in m/s and yaw rate in rad/s (counter-clockwise), within `low` and `high`.

    `heading`: x ahead, y left, z up, turned by the yaw of the tick. `corridor`: x along the corridor, y left, z up. An axis
    that the policy leaves alone has both limits 0. `none`: not a velocity command at all, `names` are `other...`; such a file
    is exported and checked like any other, but no vehicle of this project flies it.
    """

    frame: Literal["heading", "corridor", "none"] = "heading"
    names: Annotated[tuple[ActionName, ...], Field(min_length=1, max_length=64)] = VELOCITY_ACTION
    low: Limits = (-0.5, -0.5, -0.5, -1.0)
    high: Limits = (1.0, 0.5, 0.5, 1.0)

    @model_validator(mode="after")
    def _ordered(self) -> ActionLayout:
        bound = 50.0 if self.is_velocity else 1e6
        if not self.is_velocity and (self.frame != "none" or not all(is_other(name) for name in self.names)):
            raise ValueError(f"names must be {', '.join(VELOCITY_ACTION)}; in frame none they must all be other...")
        if self.is_velocity and self.frame == "none":
            raise ValueError("frame must be heading or corridor for a velocity command")
        if len(set(self.names)) != len(self.names) or not len(self.names) == len(self.low) == len(self.high):
            raise ValueError(f"names, low and high must be of one length ({len(self.names)}) and no name may repeat")
        for name, low, high in zip(self.names, self.low, self.high, strict=True):
            if not (-bound <= low < high <= bound or low == high == 0.0):
                raise ValueError(f"limits of {name} must satisfy -{bound:g} <= low < high <= {bound:g}, not {low} .. {high}")
        return self

    @property
    def is_velocity(self) -> bool:
        """Whether it is the command of four values that a vehicle flies."""
        return self.names == VELOCITY_ACTION

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.names)


class ResetRules(_Model):
    """When h and c must go back to zero: at each event in `on`, and (`gap`) after no step for longer than `max_gap_s`."""

    max_gap_s: float = Field(default=0.25, gt=0.0, le=10.0)
    on: tuple[ResetReason, ...] = ("offboard_entry", "goal_change", "policy_change", "gap")


class TrainingRecord(_Model):
    """Where the weights come from. `details` holds whatever else the trainer wants to keep."""

    config_hash: str | None = Field(default=None, max_length=128)
    seed: int | None = None
    steps: int | None = Field(default=None, ge=0)
    git_commit: str | None = Field(default=None, max_length=64)
    details: dict[str, JsonValue] = Field(default_factory=dict)


class VerificationRecord(_Model):
    """How closely the file's graph follows the trained network, measured before the file was written.

    `max_action_difference`: m/s or rad/s, each side carrying its own state. `max_abs_difference`: the largest over that and over
    h, c and value one step after a common state. `max_state_drift`: how far h, c and value came apart when each side carried its
    own (docs/policy_file.md says how each is measured); null in files that were written before it was kept.
    """

    steps: int = Field(gt=0)
    resets: int = Field(ge=0)
    batch: int = Field(gt=0)
    seed: int
    reference: str = Field(max_length=100)
    runtime: str = Field(max_length=100)
    tolerance: float = Field(gt=0.0)
    max_action_difference: float = Field(ge=0.0)
    max_abs_difference: float = Field(ge=0.0)
    max_state_drift: float | None = Field(default=None, ge=0.0)

    @model_validator(mode="after")
    def _passed(self) -> VerificationRecord:
        if self.max_abs_difference > self.tolerance:
            raise ValueError(f"max_abs_difference {self.max_abs_difference} exceeds the tolerance {self.tolerance}")
        return self


class PolicyMetadata(_Model):
    """Everything a program needs to fly the file. Kept as JSON in the ONNX file under `METADATA_KEY`.

    `memory` names the recurrent cell; a `gru` passes c through unchanged. `hidden_size` is 0 exactly when it is `none`, and
    then the graph has no state inputs.
    `layers`: stacked cells of `hidden_size` each; h and c are [layers, batch, hidden_size].
    """

    schema_version: Literal[1] = 1
    name: str = Field(default="policy", min_length=1, max_length=100)
    observation: ObservationLayout
    action: ActionLayout
    rate_hz: float = Field(default=20.0, gt=0.0, le=1000.0)
    memory: Literal["lstm", "gru", "none"]
    hidden_size: int = Field(ge=0, le=4096)
    layers: int = Field(default=1, ge=1, le=MAX_LAYERS)
    reset: ResetRules = ResetRules()
    training: TrainingRecord = TrainingRecord()
    evaluation: dict[str, JsonValue] = Field(default_factory=dict)
    verification: VerificationRecord
    weights_sha256: Sha256

    @model_validator(mode="after")
    def _state(self) -> PolicyMetadata:
        if (self.memory == "none") != (self.hidden_size == 0):
            raise ValueError("hidden_size must be 0 exactly when memory is none")
        if self.memory == "none" and self.layers != 1:
            raise ValueError("layers must be 1 when memory is none")
        return self

    def to_json(self) -> str:
        """The document as written to the file: compact, keys in declaration order."""
        text = json.dumps(self.model_dump(mode="json"), separators=(",", ":"), allow_nan=False)
        if len(text.encode()) > MAX_METADATA_BYTES:
            raise PolicyFileError("metadata", f"larger than {MAX_METADATA_BYTES} bytes; shorten training details or evaluation")
        return text


def is_other(name: str) -> bool:
    """Whether a channel's or action's name says that its meaning is outside this contract."""
    return name == "other" or name.startswith("other_")


def channel_width(name: str, lidar: LidarSpec) -> int:
    """Number of values of a channel that this contract knows."""
    return {"lidar": lidar.beams, "yaw": 1}.get(name, 3)


def channel_unit(name: str) -> str | None:
    """The unit of a channel that this contract knows; None for the others."""
    return _CHANNEL_UNITS.get(name)


def channel_frames(name: str) -> tuple[str, ...]:
    """The frames that a channel may be given in, the usual one first; empty for channels that this contract does not know."""
    return _CHANNEL_FRAMES.get(name, ())


def foreign_fields(metadata: PolicyMetadata) -> list[str]:
    """Fields that only a program made for this policy can honour: observation channels or actions called `other...`."""
    fields = [f"observation.channels.{k}.name {c.name}" for k, c in enumerate(metadata.observation.channels) if c.is_other]
    return fields if metadata.action.is_velocity else [*fields, f"action.names {', '.join(metadata.action.names)}"]


def default_layout(lidar: LidarSpec | None = None, frame: Literal["heading", "corridor"] = "heading") -> ObservationLayout:
    """LiDAR | goal minus position | velocity | acceleration | yaw: 190 values for the default LiDAR.

    `frame` is that of the goal offset and the velocity; the acceleration stays in the heading frame in both.
    """
    lidar = lidar or LidarSpec()
    n = lidar.beams
    channels = (
        ChannelSpec(name="lidar", unit="m", frame="sensor", start=0, stop=n),
        ChannelSpec(name="goal_offset", unit="m", frame=frame, start=n, stop=n + 3),
        ChannelSpec(name="velocity", unit="m/s", frame=frame, start=n + 3, stop=n + 6),
        ChannelSpec(name="acceleration", unit="m/s^2", frame="heading", start=n + 6, stop=n + 9),
        ChannelSpec(name="yaw", unit="rad", frame="corridor", start=n + 9, stop=n + 10),
    )
    return ObservationLayout(size=n + 10, lidar=lidar, channels=channels)


def paper_layout() -> ObservationLayout:
    """The article's set-up: goal offset and velocity in the corridor frame."""
    return default_layout(frame="corridor")


def first_problem(error: ValidationError) -> tuple[str, str]:
    """(dotted path, message) of the first thing pydantic found."""
    problem = error.errors(include_url=False, include_context=False)[0]
    path = ".".join(str(part) for part in problem["loc"]) or "document"
    return path, problem["msg"].removeprefix("Value error, ")


def parse_metadata(text: str) -> PolicyMetadata:
    """Read the JSON document of a policy file; raises `PolicyFileError` naming the field."""
    try:
        document = json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_unique_keys)
    except (ValueError, RecursionError) as error:
        raise PolicyFileError("metadata", f"not a JSON document ({error})") from None
    if not isinstance(document, dict):
        raise PolicyFileError("metadata", "must be a JSON object")
    version = document.get("schema_version")
    if version != SCHEMA_VERSION:
        message = f"this program reads version {SCHEMA_VERSION}, the file says {version!r}; export the policy again"
        raise PolicyFileError("metadata.schema_version", message)
    try:
        return PolicyMetadata.model_validate(document, strict=False)
    except ValidationError as error:
        path, message = first_problem(error)
        raise PolicyFileError(f"metadata.{path}", message) from None


def training_record(values: Mapping[str, Any]) -> TrainingRecord:
    """A checkpoint's `training` dict: known keys by name, all others under `details`."""
    known = {key: values[key] for key in ("config_hash", "seed", "steps", "git_commit") if key in values}
    details = {key: value for key, value in values.items() if key not in known}
    return TrainingRecord(**known, details=details)


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError("a key appears twice")
    return result
