"""MAVLink OBSTACLE_DISTANCE (330) as MAVSDK's direct messages give it: JSON fields in, one scan out. No I/O.

Bins run clockwise from `angle_offset` (body frame, 0 ahead); `increment_f` wins over `increment` if it is not 0, and is negative
for counter-clockwise. Values in cm: 65535 unknown, above the maximum nothing seen, 0 touching.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NAME = "OBSTACLE_DISTANCE"
BODY_FRD = 12
BINS = 72
_UNKNOWN = 65_535
_MAX_JSON = 8192


class ObstacleDistanceError(ValueError):
    """A message that cannot be used; the text says why."""


@dataclass(frozen=True, slots=True)
class ObstacleScan:
    """Beams by increasing bearing, positive left. `ranges_m`: inf nothing, nan unknown, 0 touching. `stamp_s`: sender's clock."""

    angle_min_rad: float
    angle_increment_rad: float
    ranges_m: NDArray[np.float32]
    range_min_m: float
    range_max_m: float
    stamp_s: float


def decode_obstacle_distance(fields_json: str) -> ObstacleScan:
    """The scan of one message. Raises `ObstacleDistanceError`."""
    try:
        fields = json.loads(fields_json[:_MAX_JSON])
        distances = np.array([_whole(value) for value in fields["distances"]], dtype=np.int64)
        frame = _whole(fields.get("frame", 0))
        increment_deg = _real(fields.get("increment_f", 0.0)) or float(_whole(fields["increment"]))
        offset_deg = _real(fields.get("angle_offset", 0.0))
        limits_cm = _whole(fields["min_distance"]), _whole(fields["max_distance"])
        stamp_s = 1e-6 * _whole(fields.get("time_usec", 0))
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
        raise ObstacleDistanceError(f"{NAME} with a missing or impossible field: {error}") from None
    if frame != BODY_FRD:
        raise ObstacleDistanceError(f"{NAME} in frame {frame}: set the sender to MAV_FRAME_BODY_FRD (12)")
    _check(distances, increment_deg, offset_deg, limits_cm)
    return _scan(_used(distances, increment_deg), increment_deg, offset_deg, limits_cm, stamp_s)


def _used(distances: NDArray[np.int64], increment_deg: float) -> NDArray[np.int64]:
    """No more bins than a turn holds: a sender with a coarse increment leaves the rest of the 72 unused."""
    return distances[: max(1, int(360.0 / abs(increment_deg) + 1e-6))]


def _check(distances: NDArray[np.int64], increment_deg: float, offset_deg: float, limits_cm: tuple[int, int]) -> None:
    if distances.shape != (BINS,) or distances.min() < 0 or distances.max() > _UNKNOWN:
        raise ObstacleDistanceError(f"{NAME} wants {BINS} distances of 0..65535 cm")
    if not 0.1 <= abs(increment_deg) <= 90.0:
        raise ObstacleDistanceError(f"{NAME} with an increment of {increment_deg:g} degrees")
    if not -360.0 <= offset_deg <= 360.0:
        raise ObstacleDistanceError(f"{NAME} with an angle offset of {offset_deg:g} degrees")
    if not 0 <= limits_cm[0] < limits_cm[1] < _UNKNOWN:
        raise ObstacleDistanceError(f"{NAME} with limits {limits_cm[0]}..{limits_cm[1]} cm")


def _scan(
    distances: NDArray[np.int64], increment_deg: float, offset_deg: float, limits_cm: tuple[int, int], stamp_s: float
) -> ObstacleScan:
    low_cm, high_cm = limits_cm
    ranges = (0.01 * distances).astype(np.float32)
    ranges[distances < low_cm] = 0.0
    ranges[distances > high_cm] = np.inf
    ranges[distances == _UNKNOWN] = np.nan
    last_deg = offset_deg + increment_deg * (distances.size - 1)
    first_left_deg = -last_deg if increment_deg > 0.0 else -offset_deg
    return ObstacleScan(
        angle_min_rad=math.radians(math.remainder(first_left_deg, 360.0)),
        angle_increment_rad=math.radians(abs(increment_deg)),
        ranges_m=ranges[::-1].copy() if increment_deg > 0.0 else ranges,
        range_min_m=0.01 * low_cm,
        range_max_m=0.01 * high_cm,
        stamp_s=stamp_s,
    )


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise ValueError(f"{str(value)[:20]!r} is not a whole number")
    return int(value)


def _real(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{str(value)[:20]!r} is not a number")
    return float(value)
