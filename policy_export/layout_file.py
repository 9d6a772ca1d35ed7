"""The `--layout` file: what the observation and the action of a policy mean, where the checkpoint does not say it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from policy_export.contract import (
    VELOCITY_ACTION,
    ActionLayout,
    ChannelFrame,
    ChannelName,
    ChannelSpec,
    LidarSpec,
    Limits,
    ObservationLayout,
    ResetRules,
    Unit,
    channel_frames,
    channel_unit,
    channel_width,
    default_layout,
    first_problem,
    is_other,
    paper_layout,
)
from policy_export.errors import CheckpointError
from strict_yaml import load_config

BUILT_IN = ("paper", "heading")
_AXES = Annotated[tuple[str, ...], Field(min_length=1, max_length=64)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ChannelEntry(_Section):
    """One channel, in the order of the observation. Unit, frame and size are needed only for `other...` channels."""

    name: ChannelName
    unit: Unit | None = None
    frame: ChannelFrame | None = None
    size: int | None = Field(default=None, gt=0, le=8192)

    @model_validator(mode="after")
    def _stated(self) -> ChannelEntry:
        if is_other(self.name) and (self.unit is None or self.size is None):
            raise ValueError(f"channel {self.name} needs a unit and a size")
        return self


class ActionEntry(_Section):
    """The policy's actions in its own order, and the limits that they have in SI units (the policy's own if left out)."""

    frame: str = Field(default="heading", pattern=r"^(heading|corridor|none)$")
    order: _AXES = VELOCITY_ACTION
    low: Limits | None = None
    high: Limits | None = None

    @model_validator(mode="after")
    def _whole(self) -> ActionEntry:
        known = [name for name in self.order if name in VELOCITY_ACTION]
        if len(set(self.order)) != len(self.order):
            raise ValueError("order names an action twice")
        if known and len(known) != len(self.order):
            raise ValueError(f"order must hold only {', '.join(VELOCITY_ACTION)}, or only other... names with frame none")
        for name in ("low", "high"):
            values = getattr(self, name)
            if values is not None and len(values) != len(self.order):
                raise ValueError(f"{name} must hold {len(self.order)} values, one per name in order")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """The actions in the file: all four of a velocity command, or the policy's own."""
        return VELOCITY_ACTION if self.order[0] in VELOCITY_ACTION else self.order


class LayoutFile(_Section):
    """The whole file."""

    lidar: LidarSpec = LidarSpec()
    observation: tuple[ChannelEntry, ...] = Field(min_length=1, max_length=64)
    action: ActionEntry = ActionEntry()
    rate_hz: float = Field(default=20.0, gt=0.0, le=1000.0)
    reset: ResetRules = ResetRules()

    @model_validator(mode="after")
    def _lays_out(self) -> LayoutFile:
        try:
            self.observation_layout()
        except ValidationError as error:
            raise ValueError(": ".join(first_problem(error))) from None
        return self

    def observation_layout(self) -> ObservationLayout:
        """The channels with the places that their order gives them."""
        channels, start = [], 0
        for entry in self.observation:
            stop = start + (entry.size or channel_width(entry.name, self.lidar))
            frame = entry.frame or (channel_frames(entry.name) or ("none",))[0]
            unit = entry.unit or channel_unit(entry.name)
            channels.append(
                ChannelSpec.model_validate({"name": entry.name, "unit": unit, "frame": frame, "start": start, "stop": stop})
            )
            start = stop
        return ObservationLayout(size=start, lidar=self.lidar, channels=tuple(channels))


def read_layout(source: str | Path | None) -> LayoutFile:
    """A YAML file, or `paper` (the default) or `heading`: the built-in 190 values in the article's frames or in this project's.

    Raises `strict_yaml.ConfigError` naming line and field; `CheckpointError` where neither file nor built-in name was meant.
    """
    name = "paper" if source is None else str(source)
    if name in BUILT_IN:
        observation = paper_layout() if name == "paper" else default_layout()
        entries = tuple(ChannelEntry(name=c.name, frame=c.frame) for c in observation.channels)
        return LayoutFile(observation=entries, action=ActionEntry(frame="corridor" if name == "paper" else "heading"))
    if not Path(name).is_file():
        raise CheckpointError(f"--layout {name}: no such file; give a YAML file, or one of {', '.join(BUILT_IN)}")
    return load_config(name, LayoutFile)


def layout_of_file(observation: ObservationLayout, action: ActionLayout, rate_hz: float, reset: ResetRules) -> LayoutFile:
    """The layout of a finished policy file, as if it had been read from YAML; actions that are fixed at 0 are left out."""
    used = [k for k in range(action.size) if action.low[k] < action.high[k]]
    return LayoutFile(
        lidar=observation.lidar,
        observation=tuple(ChannelEntry(name=c.name, unit=c.unit, frame=c.frame, size=c.width) for c in observation.channels),
        action=ActionEntry(
            frame=action.frame,
            order=tuple(action.names[k] for k in used),
            low=tuple(action.low[k] for k in used),
            high=tuple(action.high[k] for k in used),
        ),
        rate_hz=rate_hz,
        reset=reset,
    )
