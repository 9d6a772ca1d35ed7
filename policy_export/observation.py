"""Builds the observation vector that a policy file's layout asks for, from one scan and one state estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from policy_export.contract import LidarSpec, ObservationLayout
from policy_export.errors import PolicyFileError, PolicyInputError

Vector = Sequence[float] | NDArray[np.float64] | NDArray[np.float32]


def beam_bearings_rad(lidar: LidarSpec) -> NDArray[np.float64]:
    """Bearing of each beam [beams], radians, 0 ahead, positive to the left, increasing."""
    centres = np.arange(lidar.beams, dtype=np.float64) + 0.5
    return np.asarray(centres * (lidar.fov_rad / lidar.beams) - 0.5 * lidar.fov_rad, dtype=np.float64)


class ObservationBuilder:
    """Fills one preallocated vector per tick. One builder serves one loop: `build` returns the same array each time."""

    def __init__(self, layout: ObservationLayout) -> None:
        """Raises `PolicyFileError` naming the first channel whose meaning this project does not know."""
        for k, channel in enumerate(layout.channels):
            if channel.is_other:
                raise PolicyFileError(f"metadata.observation.channels.{k}.name", f"{channel.name} cannot be built here")
        self.layout = layout
        self._observation = np.zeros(layout.size, dtype=np.float32)
        self._slices: dict[str, NDArray[np.float32]] = {
            channel.name: self._observation[channel.span] for channel in layout.channels
        }
        self._in_heading: dict[str, bool] = {channel.name: channel.frame == "heading" for channel in layout.channels}
        self._too_near = np.zeros(layout.lidar.beams, dtype=np.bool_)

    def build(
        self,
        ranges_m: NDArray[np.float32] | NDArray[np.float64],
        position_m: Vector,
        velocity_m_s: Vector,
        acceleration_m_s2: Vector,
        yaw_rad: float,
        goal_m: Vector,
    ) -> NDArray[np.float32]:
        """The observation, float32 [size], valid until the next call.

        `ranges_m` [beams]: metres in the layout's beam order, +inf for no return, 0 (or anything below range_min) for too
        near. The vectors [3] are in the corridor frame; the acceleration has gravity removed. `yaw_rad`: corridor yaw.
        NaN anywhere, or infinity anywhere but in `ranges_m`, raises `PolicyInputError` (a ValueError) and leaves no
        observation to be used.
        """
        yaw = _finite_scalar("yaw", yaw_rad)
        x, y, z = _finite_vector("position", position_m)
        goal_x, goal_y, goal_z = _finite_vector("goal", goal_m)
        cos, sin = math.cos(yaw), math.sin(yaw)
        self._put_lidar(ranges_m)
        self._put("goal_offset", (goal_x - x, goal_y - y, goal_z - z), cos, sin)
        self._put("position", (x, y, z), cos, sin)
        self._put("velocity", _finite_vector("velocity", velocity_m_s), cos, sin)
        self._put("acceleration", _finite_vector("acceleration", acceleration_m_s2), cos, sin)
        if (target := self._slices.get("yaw")) is not None:
            target[0] = math.remainder(yaw, 2.0 * math.pi)
        return self._observation

    def _put_lidar(self, ranges_m: NDArray[np.float32] | NDArray[np.float64]) -> None:
        lidar = self.layout.lidar
        if ranges_m.shape != (lidar.beams,):
            raise PolicyInputError(f"ranges must have shape ({lidar.beams},), not {ranges_m.shape}")
        if np.isnan(ranges_m).any():
            raise PolicyInputError("ranges hold NaN")
        if (target := self._slices.get("lidar")) is None:
            return
        np.clip(ranges_m, 0.0, lidar.range_max_m, out=target, casting="same_kind")
        np.less(ranges_m, lidar.range_min_m, out=self._too_near)
        target[self._too_near] = 0.0

    def _put(self, name: str, vector: tuple[float, float, float], cos: float, sin: float) -> None:
        if (target := self._slices.get(name)) is None:
            return
        x, y, z = vector
        if self._in_heading[name]:
            x, y = cos * x + sin * y, cos * y - sin * x
        target[0], target[1], target[2] = x, y, z


def _finite_scalar(name: str, value: float) -> float:
    value = float(value)
    if not math.isfinite(value):
        raise PolicyInputError(f"{name} is not finite")
    return value


def _finite_vector(name: str, vector: Vector) -> tuple[float, float, float]:
    if len(vector) != 3:
        raise PolicyInputError(f"{name} must have 3 components, not {len(vector)}")
    x, y, z = float(vector[0]), float(vector[1]), float(vector[2])
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        raise PolicyInputError(f"{name} is not finite")
    return x, y, z
