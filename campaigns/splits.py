"""Named, seeded sets of test corridors (`configs/evaluation.yaml`). No seed here is ever trained or selected on."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from safety.config import Fence, SafetyConfig
from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.lidar import LidarConfig
from sim_gateway.scene import World
from sim_gateway.world import PaperConfig, paper_world
from strict_yaml import ConfigError, load_config

DEFAULT_FILE = Path("configs/evaluation.yaml")
ALL = "all"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Split(_Strict):
    """One set of corridors and the conditions they are flown under."""

    description: str
    first_seed: int = Field(ge=0)
    corridor: CorridorConfig | None = None
    paper: PaperConfig | None = None
    estimate: str = "nominal"
    dropout: float = Field(0.0, ge=0.0, le=1.0)
    fov_deg: float = Field(180.0, ge=10.0, le=180.0, description="what the scanner sees; beams beyond it are unknown")
    fence: Fence | None = Field(None, description="replaces the mission's, where the world is not the mission's corridor")
    wind_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust_sigma_m_s: float = Field(0.0, ge=0.0, le=10.0)
    takeoff_height_m: float = Field(2.0, gt=0.0, le=50.0)

    @model_validator(mode="after")
    def _one_world(self) -> Self:
        if self.corridor is not None and self.paper is not None:
            raise ValueError("give corridor or paper, not both")
        return self

    def world(self, index: int) -> World:
        """The `index`-th world of the split."""
        seed = self.first_seed + index
        return paper_world(seed, self.paper) if self.paper is not None else generate_corridor(seed, self.corridor)

    def lidar(self) -> LidarConfig:
        """The scanner's steps of half a degree that lie inside the field of view."""
        device = LidarConfig.device(self.dropout)
        steps = 2 * math.floor(0.5 * self.fov_deg / math.degrees(device.angle_increment_rad) + 1e-6)
        return device.model_copy(update={"beams": steps + 1, "fov_rad": steps * device.angle_increment_rad})

    def safety(self, mission: SafetyConfig) -> SafetyConfig:
        """The mission's safety layer, inside this split's fence."""
        return mission if self.fence is None else mission.model_copy(update={"fence": self.fence})


class Splits(_Strict):
    """The file: split name to split."""

    splits: dict[str, Split] = Field(min_length=1)


def load_split(name: str, file: Path = DEFAULT_FILE) -> Split:
    """The split called `name`. Raises `ConfigError` that lists the names there are."""
    return load_splits([name], file)[name]


def load_splits(names: list[str], file: Path = DEFAULT_FILE) -> dict[str, Split]:
    """The splits of these names, in this order; `all` is every one. Raises `ConfigError` that lists the names there are."""
    splits = load_config(file, Splits).splits
    for name in names:
        if name not in splits and name != ALL:
            raise ConfigError(f"{file}: no split {name!r}; there are: {', '.join(sorted(splits))}")
    return dict(splits) if ALL in names else {name: splits[name] for name in names}
