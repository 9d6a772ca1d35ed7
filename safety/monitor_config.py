"""Thresholds of the monitors, section `monitors` of `SafetyConfig`. Each is the first value that is still accepted."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0.0, le=1000.0)]
NotNegative = Annotated[float, Field(ge=0.0, le=1000.0)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]
Remembered = Annotated[float, Field(ge=0.1, le=3.0)]
"""A time over which samples are compared: two ticks at least, and at most what 64 samples at 20 Hz span."""


class MonitorConfig(BaseModel):
    """SI units. The defaults raise nothing on recorded flights of PX4's estimator, noisier by far than what A4 assumes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    position_jump_m: Positive = Field(0.25, description="E1: horizontal step of the position that velocity does not explain")
    altitude_jump_m: Positive = Field(0.25, description="E9: the same, vertically")
    velocity_mismatch_m_s: Positive = Field(1.6, description="E6: mean difference of velocity and change of position")
    velocity_window_s: Remembered = Field(0.4, description="E6: time over which that mean is taken")
    jumps_window_s: Positive = Field(5.0, description="E1: a second jump within this time makes HOLD")
    frozen_state_s: Positive = Field(0.2, description="E2: position and velocity may stay the same in every bit this long")
    frozen_command_m_s: Positive = Field(0.3, description="E2: while at least this speed is commanded")
    direction_speed_m_s: Positive = Field(
        0.4, description="E7: speed expected from the commands from which their direction counts"
    )
    direction_error_m_s: Positive = Field(0.4, description="E7: speed across or against that direction ...")
    direction_s: Positive = Field(0.7, description="E7: ... and how long it may last")
    accuracy_m: Positive = Field(1.0, description="E5: horizontal accuracy that the autopilot may report (one sigma)")
    accuracy_s: Positive = Field(1.0, description="E5: how long a worse one may last")
    tilt_rad: Positive = Field(0.95, description="tilt beyond what the autopilot ever commands (45 degrees, and overshoot)")
    tumbling_rad: Positive = Field(1.4, description="V9: tilt from which nothing that we send can help")

    mask_s: Positive = Field(
        0.5, description="L15: a return inside the hull at a fixed bearing this long is part of the vehicle ..."
    )
    mask_motion_m: Positive = Field(
        0.2, description="... once the vehicle has moved this far, or turned as many radians, meanwhile"
    )
    mirror_turn_rad: Positive = Field(0.15, description="L9: scans are compared after this much turning")
    mirror_votes: int = Field(4, ge=1, le=100, description="L9: comparisons in a row that must say that left is right")

    hidden_norm_max: Positive = Field(9.0, description="P5: norm of the recurrent state")
    bad_commands: int = Field(3, ge=2, le=20, description="P1: so many missing or broken commands within a second make HOLD")
    inference_late_s: Positive = Field(0.03, description="P6: a step of the policy that took longer adds to the delay")
    inference_hung_s: Positive = Field(0.05, description="P7: a step that took longer than this is not believed")
    saturated_s: Positive = Field(2.0, description="P2: a policy at its limits for this long is told")
    oscillation_m_s: Positive = Field(0.3, description="P10: steps larger than this that change sign at every tick ...")
    oscillation_ticks: int = Field(10, ge=2, le=1000, description="... for so many ticks are told")

    late_s: Positive = Field(0.05, description="C8: a tick that begins later than this after its time is missed")
    late_ticks: int = Field(3, ge=1, le=20, description="C8: so many missed ticks within a second make HOLD")
    gap_s: Positive = Field(0.25, description="C4: after a longer pause between two calls the first command brakes")
    link_delay_s: Positive = Field(0.5, description="K4: round trip of the link that may not be exceeded ...")
    link_delay_lasts_s: NotNegative = Field(0.4, description="... for longer than this")
    echo_error_m_s: Positive = Field(
        0.25, description="K6: the autopilot's own setpoint may differ this much from all that we sent"
    )
    echo_s: Annotated[float, Field(gt=0.0, le=1.0)] = Field(
        0.6, description="K6: for this long, within a second; and how far back what we sent is looked for"
    )
    battery_low: Share = Field(0.15, description="V6: charge below which the flight ends in HOLD (PX4: BAT_LOW_THR)")
    battery_critical: Share = Field(0.07, description="V6: charge below which the vehicle lands (PX4: BAT_CRIT_THR)")

    nominal_state_age_s: Positive = Field(0.08, description="A3: age of the estimate from which on the cap falls")
    nominal_scan_age_s: Positive = Field(0.12, description="A3: age of the scan from which on the cap falls")
    nominal_late_s: Positive = Field(0.02, description="A3: lateness of the tick from which on the cap falls")
    nominal_link_delay_s: Positive = Field(0.1, description="A3: round trip from which on the cap falls")
    braking_horizon_s: Remembered = Field(0.6, description="A1: motion is compared with what was expected this long ago")
    braking_memory_s: Positive = Field(2.0, description="A1: time constant with which braking seen is forgotten")
    braking_weak: Share = Field(0.9, description="A1: share of the expected slowing down from which on the cap falls")
    braking_healthy: Share = Field(1.0, description="A1: share from which on it rises again")
    braking_failed: Share = Field(0.7, description="V7: share that, lasting, makes LAND")
    braking_failed_s: Positive = Field(0.5, description="V7: time of braking, not of flying, for which it may last")
    cap_least: Share = Field(0.25, description="the cap never falls below this share of the speed limit: the way out stays open")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for low, high in (
            ("tilt_rad", "tumbling_rad"),
            ("inference_late_s", "inference_hung_s"),
            ("battery_critical", "battery_low"),
            ("nominal_late_s", "late_s"),
            ("nominal_link_delay_s", "link_delay_s"),
            ("braking_failed", "braking_weak"),
            ("braking_weak", "braking_healthy"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} {getattr(self, low)} must not exceed {high} {getattr(self, high)}")
        return self
