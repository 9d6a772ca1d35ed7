"""Distance between the vehicle, taken as a sphere, and axis-aligned boxes."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Row = NDArray[np.float64]


@njit(cache=True)
def clearance_m(boxes: Row, position: Row, radius_m: float) -> float:
    """Distance from a sphere to the nearest box surface, m; negative when the sphere cuts a box; +inf without boxes.

    `boxes`: float64[m, 6] (xmin, ymin, zmin, xmax, ymax, zmax), world. `position`: float64[>=3], sphere centre.
    With the centre inside a box the depth to its nearest face counts as negative distance.
    """
    nearest = math.inf
    for i in range(boxes.shape[0]):
        outside_sq = 0.0
        inside = -math.inf  # largest signed distance to a face pair: negative means between both faces
        for axis in range(3):
            gap = max(boxes[i, axis] - position[axis], position[axis] - boxes[i, axis + 3])
            inside = max(inside, gap)
            if gap > 0.0:
                outside_sq += gap * gap
        nearest = min(nearest, math.sqrt(outside_sq) if inside > 0.0 else inside)
    return nearest - radius_m
