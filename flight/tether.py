"""`--tether`: the mission with reduced speed, height and distance, for first flights on a line.

Only limits shrink: fence, speeds, heights and times of the result are never wider than the mission's own. The goal is drawn back
along the straight line from the takeoff point until it lies inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flight.errors import RefusedError
from flight.fence_outline import clipped
from flight.mission import Mission, TetherSection, goal_problem, takeoff_point_problem
from flight.preparation import Place
from safety.config import Fence, SafetyConfig
from safety.fence_rules import fence_problem
from safety.frames import CorridorVector

_SLACK_M = 0.01
GOAL_STEPS = 2001  # places tried between goal and start


def tethered(mission: Mission, place: Place) -> tuple[Mission, Place, list[str]]:
    """Reduced mission and place, and what was reduced, in words. Raises `RefusedError` when nothing flyable is left."""
    tether = mission.tether
    safety = _safety(mission, place)
    low_z, high_z = safety.keep_in_z()
    height_m = min(mission.takeoff_height_m, high_z - _SLACK_M)
    if height_m < low_z or takeoff_point_problem(place.takeoff_point, safety) is not None:
        raise RefusedError(
            f"tether: max_height_m {tether.max_height_m:g} and max_distance_m {tether.max_distance_m:g} leave no room for the "
            "takeoff inside safety.fence; raise them"
        )
    goal = _goal_inside(CorridorVector(*place.takeoff_point, height_m), place.goal, safety)
    timeouts = mission.timeouts.model_copy(update={"flight_s": min(mission.timeouts.flight_s, tether.max_flight_s)})
    reduced = mission.model_copy(update={"safety": safety, "takeoff_height_m": height_m, "timeouts": timeouts})
    return reduced, Place(place.takeoff_point, place.start_yaw_rad, goal), _notes(mission, reduced, place.goal, goal)


def _safety(mission: Mission, place: Place) -> SafetyConfig:
    tether, safety = mission.tether, mission.safety
    speed = min(safety.max_horizontal_speed_m_s, tether.max_horizontal_speed_m_s)
    climb = min(safety.max_vertical_speed_m_s, tether.max_vertical_speed_m_s)
    back = min(safety.return_speed_m_s, speed)
    try:
        fence = _fence(safety.fence, place.takeoff_point, tether)
        changes: dict[str, Any] = {
            "fence": fence,
            "max_horizontal_speed_m_s": speed,
            "max_vertical_speed_m_s": climb,
            "max_yaw_rate_rad_s": min(safety.max_yaw_rate_rad_s, tether.max_yaw_rate_rad_s),
            "return_speed_m_s": back,
            "hold_off_speed_m_s": min(safety.hold_off_speed_m_s, back, climb),
        }
        return SafetyConfig.model_validate({**safety.model_dump(), **changes})
    except ValueError as error:
        first = str(error).splitlines()[2].strip() if len(str(error).splitlines()) > 2 else str(error)
        raise RefusedError(f"tether: the reduced limits do not fit the mission's fence ({first}); raise them") from None


def _fence(fence: Fence, takeoff_point: tuple[float, float], tether: TetherSection) -> Fence:
    """The part of the fence within reach. Raises `ValueError` where that is no simple polygon."""
    inclusion, reach = fence.polygon, tether.max_distance_m
    for normal in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        inclusion = clipped(inclusion, normal, normal[0] * takeoff_point[0] + normal[1] * takeoff_point[1] - reach)
    return Fence(
        floor_m=fence.low_m[2],
        ceiling_m=min(fence.high_m[2], tether.max_height_m),
        inclusion=inclusion,
        exclusion=tuple(ring for ring in fence.exclusion if fence_problem(inclusion, [ring]) is None),
    )


def _goal_inside(start: CorridorVector, goal: CorridorVector, safety: SafetyConfig) -> CorridorVector:
    """The point of the line start -> goal that is nearest to the goal and inside the eroded fence; the start is inside."""
    if goal_problem(goal, safety) is None:
        return goal
    a, b, (low_z, high_z) = np.array((start.x, start.y, start.z)), np.array((goal.x, goal.y, goal.z)), safety.keep_in_z()
    points = b + np.linspace(0.0, 1.0, GOAL_STEPS)[:, None] * (a - b)
    room = np.minimum(safety.eroded_fence().room_m(points[:, :2]), np.minimum(points[:, 2] - low_z, high_z - points[:, 2]))
    inside = np.flatnonzero(room >= 0.0)
    return CorridorVector(*map(float, points[inside[0]])) if inside.shape[0] else start


def _notes(mission: Mission, reduced: Mission, goal: CorridorVector, new_goal: CorridorVector) -> list[str]:
    before, after = mission.safety, reduced.safety
    notes = [
        f"{after.max_horizontal_speed_m_s:g} m/s, {after.max_vertical_speed_m_s:g} m/s up and down (mission: "
        f"{before.max_horizontal_speed_m_s:g}, {before.max_vertical_speed_m_s:g}), at most {after.fence.high_m[2]:g} m high",
    ]
    if new_goal != goal:
        notes.append(f"goal drawn back to ({new_goal.x:.2f}, {new_goal.y:.2f}, {new_goal.z:.2f})")
    return notes
