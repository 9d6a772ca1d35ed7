"""The simulated 2D LiDAR: which way its beams point, and what noise, limits and drop-outs make of the true ranges."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from sim_gateway.raycast import beam_table, cast_beams

Array = NDArray[np.float64]


class LidarConfig(BaseModel):
    """Geometry and faults of a horizontal scanner. Bearing 0 is straight ahead, positive left.

    Without `endpoints` beam i looks along the middle of its sector, -fov/2 + (i + 0.5) fov/beams, as the policy expects.
    With `endpoints` the first and last beams lie on the edges of the field of view, as a scanning device numbers its steps.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    beams: int = Field(default=180, ge=2, le=10_000)
    fov_rad: float = Field(default=math.pi, gt=0.0, le=2.0 * math.pi)
    endpoints: bool = False
    range_min_m: float = Field(default=0.1, ge=0.0, le=10.0)
    range_max_m: float = Field(default=4.0, gt=0.0, le=1000.0)
    noise_sigma_m: float = Field(default=0.01, ge=0.0, le=10.0)
    dropout_probability: float = Field(default=0.0, ge=0.0, le=1.0)
    rate_hz: float = Field(default=20.0, gt=0.0, le=1000.0)

    @staticmethod
    def device(dropout_probability: float = 0.0) -> LidarConfig:
        """The scanner that the SCIP emulator plays: 361 steps of half a degree over 180 degrees, 20 Hz."""
        return LidarConfig(beams=361, endpoints=True, dropout_probability=dropout_probability)

    @property
    def angle_increment_rad(self) -> float:
        """Angle between two beams."""
        return self.fov_rad / (self.beams - 1 if self.endpoints else self.beams)

    @property
    def angle_min_rad(self) -> float:
        """Bearing of beam 0, the rightmost."""
        return -0.5 * self.fov_rad + (0.0 if self.endpoints else 0.5 * self.angle_increment_rad)

    @cached_property
    def bearings_rad(self) -> Array:
        """Bearing of each beam [beams], increasing: right to left."""
        return np.asarray(self.angle_min_rad + self.angle_increment_rad * np.arange(self.beams), dtype=np.float64)


@njit(cache=True)
def apply_sensor(
    ranges: Array,
    normals: Array,
    uniforms: Array,
    noise_sigma_m: float,
    dropout_probability: float,
    range_min_m: float,
    range_max_m: float,
    out: Array,
) -> None:
    """Turn true ranges [k] into measured ones, `out` [k] (may be `ranges` itself).

    Nothing within `range_max_m`, or a drop-out (`uniforms` [k] in [0, 1) below the probability): +inf. Nearer than
    `range_min_m`: 0. Else the range plus Gaussian noise (`normals` [k], standard).
    """
    for k in range(ranges.shape[0]):
        measured = ranges[k] + noise_sigma_m * normals[k]
        if ranges[k] >= range_max_m or measured >= range_max_m or uniforms[k] < dropout_probability:
            out[k] = math.inf
        else:
            out[k] = measured if measured >= range_min_m else 0.0


def measure(config: LidarConfig, true_ranges_m: Array, generator: np.random.Generator) -> Array:
    """Measured ranges [k] of true ones [k] (`range_max_m` or more = nothing there); see `apply_sensor`."""
    ranges = np.ascontiguousarray(true_ranges_m, dtype=np.float64)
    normals, uniforms = generator.standard_normal(len(ranges)), generator.random(len(ranges))
    limits = (config.noise_sigma_m, config.dropout_probability, config.range_min_m, config.range_max_m)
    out = np.empty_like(ranges)
    apply_sensor(ranges, normals, uniforms, *limits, out)
    return out


class Lidar:
    """A scanner of one configuration, its beam table made once."""

    def __init__(self, config: LidarConfig) -> None:
        self.config = config
        self._beams = beam_table(config.bearings_rad)

    def scan(self, boxes: Array, origin: Array, rotation: Array, generator: np.random.Generator) -> Array:
        """Measured ranges [beams] among `boxes` [m, 6] from `origin` [3] with body-to-world `rotation` [3, 3]."""
        true_ranges = np.empty(self.config.beams)
        cast_beams(boxes, len(boxes), origin, rotation, self._beams, self.config.range_max_m, true_ranges)
        return measure(self.config, true_ranges, generator)
