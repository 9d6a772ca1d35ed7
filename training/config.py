"""Configuration of a training run (YAML under ``configs/training/``), checked on load; unknown keys are errors."""

from __future__ import annotations

import hashlib
import json
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

# Corridors with seeds at or above this number are for evaluation and tests only; training never draws one.
EVALUATION_SEED_START = 1_000_000
# Training corridors come from [TRAINING_SEED_START, EVALUATION_SEED_START).
TRAINING_SEED_START = 0

Range = tuple[float, float]


class StrictModel(BaseModel):
    """Base of every section: no unknown keys, no NaN, no change after load."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RewardConfig(StrictModel):
    """Weights of the reward's terms; rates are per second, so that they do not depend on the decision rate."""

    scale: float = Field(default=0.2, gt=0, description="multiplies the sum of all terms, to keep returns of order one")
    progress_per_m: float = Field(default=0.5, description="per metre by which the distance to the goal shrank")
    goal: float = Field(default=10.0, description="on reaching the goal")
    contact: float = Field(default=-10.0, description="on contact or on leaving the altitude band")
    time_per_s: float = Field(default=-0.1, description="for every second")
    proximity_per_s: float = Field(default=-3.0, description="times (1 - clearance/range)^2 inside proximity_range_m")
    proximity_range_m: float = Field(default=0.7, gt=0)
    smoothness: float = Field(default=-0.03, description="times the squared change of the normalised action between decisions")
    blind_motion_per_s: float = Field(
        default=-0.5, description="times the squared speed (m/s) by which sideways exceeds forward motion"
    )
    path_deviation_per_m_s: float = Field(
        default=0.0, description="per metre of distance to the line from start to goal (the article's term)"
    )
    velocity_change_per_mps: float = Field(
        default=0.0, description="per m/s by which the velocity changed between decisions (the article's smoothness term)"
    )


class VehicleRandomisation(StrictModel):
    """Relative half-widths by which vehicle parameters vary from episode to episode, and delays."""

    relative: float = Field(
        default=0.15, ge=0, le=0.5, description="mass, inertia, thrust, drag and lag each vary by +- this share"
    )
    command_delay_steps: tuple[int, int] = Field(default=(0, 12), description="4 ms steps by which a command takes effect late")
    scan_age_steps: tuple[int, int] = Field(default=(0, 12), description="4 ms steps by which the scan is older than the tick")
    wind_mps: Range = Field(default=(0.0, 1.5), description="speed of the constant horizontal wind")


class EstimateRandomisation(StrictModel):
    """Size of the estimate's errors: most episodes near ``nominal``, some up to the harsh preset."""

    harsh_share: float = Field(default=0.25, ge=0, le=1, description="share of episodes with errors between nominal and harsh")
    nominal: str = "nominal"
    harsh: str = "px4_sih"


class EnvironmentConfig(StrictModel):
    """The corridor task as the policy sees it."""

    time_limit_s: float = Field(default=90.0, gt=0)
    goal_radius_m: float = Field(default=0.3, gt=0)
    vehicle_radius_m: float = Field(default=0.35, gt=0)
    altitude_band_m: Range = Field(default=(0.5, 4.5), description="leaving it ends the episode like a contact")
    start_altitude_m: Range = (1.5, 3.0)
    start_yaw_rad: float = Field(default=0.35, ge=0, description="start yaw is uniform within +- this")
    spread_start_share: float = Field(
        default=0.5, ge=0, le=1, description="episodes that start at a free point along the corridor"
    )
    dropout: Range = (0.0, 0.02)
    lidar_noise_m: float = Field(default=0.01, ge=0)
    pillars: tuple[int, int] = (4, 12)
    moving_share: float = Field(default=0.0, ge=0, le=1, description="share of corridors with moving pillars")
    moving_pillars: tuple[int, int] = (2, 4)
    mover_speed_max_mps: float = Field(default=0.5, gt=0)
    world_pool: int = Field(default=2048, ge=1, le=65536, description="corridors kept ready")
    world_renewal_episodes: int = Field(default=4, ge=1, description="after so many episodes the oldest corridor is replaced")
    vehicle: VehicleRandomisation = VehicleRandomisation()
    estimate: EstimateRandomisation = EstimateRandomisation()
    reward: RewardConfig = RewardConfig()


class HoldStage(StrictModel):
    """From ``share`` of all decisions on, every action is held for ``ticks`` ticks."""

    share: float = Field(ge=0, le=1)
    ticks: int = Field(ge=1, le=8)


class PpoConfig(StrictModel):
    """The learner: proximal policy optimisation over whole sequences (Schulman et al. 2017)."""

    environments: int = Field(default=256, ge=1)
    steps: int = Field(
        default=64, ge=1, description="decisions per environment and update; the length of back-propagation through time"
    )
    sequence: int | None = Field(
        default=None, ge=1, description="cut rollouts into sequences of so many decisions to learn from; null: not at all"
    )
    epochs: int = Field(default=4, ge=1)
    minibatches: int = Field(default=4, ge=1)
    gamma_per_tick: float = Field(default=0.995, gt=0, le=1)
    gae_lambda: float = Field(default=0.95, ge=0, le=1)
    clip: float = Field(default=0.2, gt=0)
    value_coefficient: float = Field(default=0.5, ge=0)
    entropy_coefficient: Range = Field(default=(0.003, 0.0), description="first and last value, linear in between")
    max_grad_norm: float = Field(default=0.5, gt=0)
    learning_rate: float = Field(default=3e-4, gt=0)
    learning_rate_bounds: Range = (2e-5, 2e-3)
    target_kl: float | None = Field(default=0.01, description="adapts the learning rate; null keeps it fixed")
    noise_correlation_per_tick: float = Field(default=0.9, ge=0, lt=1, description="AR(1) exploration noise; 0 is white noise")
    log_std_bounds: Range = (-2.5, 0.5)
    hold: tuple[HoldStage, ...] = (HoldStage(share=0.0, ticks=4), HoldStage(share=0.35, ticks=2), HoldStage(share=0.6, ticks=1))

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.environments % self.minibatches:
            raise ValueError("environments must be a multiple of minibatches: minibatches are whole sequences")
        if self.steps % (self.sequence or self.steps):
            raise ValueError("steps must be a multiple of sequence: a rollout is cut into whole sequences")
        if not self.hold or self.hold[0].share != 0.0 or list(self.hold) != sorted(self.hold, key=lambda stage: stage.share):
            raise ValueError("hold must start at share 0.0 and have increasing shares")
        return self


class EvaluationConfig(StrictModel):
    """Deterministic flights at 20 Hz on held-out corridors, during and after training."""

    every_decisions: int = Field(default=1_000_000, ge=1)
    episodes: int = Field(default=200, ge=1)
    seed: int = Field(default=EVALUATION_SEED_START, ge=EVALUATION_SEED_START)
    estimate: str = "nominal"


class TrainingConfig(StrictModel):
    """Everything that decides the result of a run, apart from the machine."""

    seed: int = Field(default=1, ge=0)
    decisions: int = Field(default=30_000_000, ge=1)
    checkpoint_every_updates: int = Field(default=1, ge=1, description="a killed run loses at most so many updates")
    environment: EnvironmentConfig = EnvironmentConfig()
    network: dict[str, Any] = Field(default_factory=dict, description="overrides of policy_export.network.NetworkConfig")
    memory: Literal["lstm", "gru", "stack", "none"] = "lstm"
    layout: Literal["default", "paper"] = "default"
    ppo: PpoConfig = PpoConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    def digest(self) -> str:
        """Short SHA-256 of the configuration, for the policy file's metadata."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]
