"""The scan as MAVLink OBSTACLE_DISTANCE: 72 sectors of 5 degrees, clockwise from ahead, in the body frame.

Per sector the nearest return; 65535 where the scanner does not look, the maximum plus 1 where it sees nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import development as mav

from sim_gateway.readings import Scan

SECTORS, SECTOR_DEG = 72, 5
UNKNOWN = 65_535


def sector_distances_cm(scan: Scan) -> NDArray[np.int64]:
    """Distances [72], cm. Sector k is centred 5 k degrees clockwise from ahead."""
    clockwise_deg = -np.degrees(scan.angle_min_rad + scan.angle_increment_rad * np.arange(scan.ranges_m.size))
    sector = np.rint(clockwise_deg / SECTOR_DEG).astype(np.int64) % SECTORS
    nothing = round(100.0 * scan.range_max_m) + 1
    ranges = scan.ranges_m.astype(np.float64)
    seen = np.where(np.isfinite(ranges), np.rint(100.0 * np.where(np.isfinite(ranges), ranges, 0.0)), nothing).astype(np.int64)
    distances = np.full(SECTORS, UNKNOWN, dtype=np.int64)
    np.minimum.at(distances, sector, np.minimum(seen, nothing))
    return distances


def obstacle_distance(scan: Scan) -> Any:
    """The message (pymavlink publishes no types)."""
    return mav.MAVLink_obstacle_distance_message(
        round(1e6 * scan.time_s),
        mav.MAV_DISTANCE_SENSOR_LASER,
        sector_distances_cm(scan).tolist(),
        SECTOR_DEG,
        round(100.0 * scan.range_min_m),
        round(100.0 * scan.range_max_m),
        float(SECTOR_DEG),
        0.0,
        mav.MAV_FRAME_BODY_FRD,
    )
