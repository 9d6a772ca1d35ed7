"""`--tether`: the mission with reduced speed, height and distance, for first flights on a line.

Only limits shrink: fence, speeds, heights and times of the result are never wider than the mission's own. The goal is drawn back
along the straight line from the takeoff point until it lies inside.
"""

from __future__ import annotations

from typing import Any

from flight.errors import RefusedError
from flight.mission import Mission, goal_problem, takeoff_point_problem
from flight.preparation import Place
from safety.config import Fence, SafetyConfig
from safety.frames import CorridorVector

_SLACK_M = 0.01


def tethered(mission: Mission, place: Place) -> tuple[Mission, Place, list[str]]:
    """Reduced mission and place, and what was reduced, in words. Raises `RefusedError` when nothing flyable is left."""
    tether = mission.tether
    safety = _safety(mission, place)
    low, high = safety.keep_in()
    height_m = min(mission.takeoff_height_m, high[2] - _SLACK_M)
    if height_m < low[2] or takeoff_point_problem(place.takeoff_point, safety) is not None:
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
    reach = tether.max_distance_m
    (x0, y0, z0), (x1, y1, z1) = safety.fence.min_m, safety.fence.max_m
    x, y = place.takeoff_point
    fence: dict[str, Any] = {
        "min_m": (max(x0, x - reach), max(y0, y - reach), z0),
        "max_m": (min(x1, x + reach), min(y1, y + reach), min(z1, tether.max_height_m)),
    }
    changes: dict[str, Any] = {
        "max_horizontal_speed_m_s": speed,
        "max_vertical_speed_m_s": climb,
        "max_yaw_rate_rad_s": min(safety.max_yaw_rate_rad_s, tether.max_yaw_rate_rad_s),
        "return_speed_m_s": back,
        "hold_off_speed_m_s": min(safety.hold_off_speed_m_s, back, climb),
    }
    try:
        changes["fence"] = Fence.model_validate(fence)
        return SafetyConfig.model_validate({**safety.model_dump(), **changes})
    except ValueError as error:
        first = str(error).splitlines()[2].strip() if len(str(error).splitlines()) > 2 else str(error)
        raise RefusedError(f"tether: the reduced limits do not fit the mission's fence ({first}); raise them") from None


def _goal_inside(start: CorridorVector, goal: CorridorVector, safety: SafetyConfig) -> CorridorVector:
    """The point of the line start -> goal that is nearest to the goal and inside the eroded fence; the start is inside."""
    if goal_problem(goal, safety) is None:
        return goal
    low, high = safety.keep_in()
    share = 1.0
    for a, b, lowest, highest in zip((start.x, start.y, start.z), (goal.x, goal.y, goal.z), low, high, strict=True):
        if b > highest:
            share = min(share, (highest - _SLACK_M - a) / (b - a))
        elif b < lowest:
            share = min(share, (lowest + _SLACK_M - a) / (b - a))
    share = max(share, 0.0)
    return CorridorVector(
        start.x + share * (goal.x - start.x), start.y + share * (goal.y - start.y), start.z + share * (goal.z - start.z)
    )


def _notes(mission: Mission, reduced: Mission, goal: CorridorVector, new_goal: CorridorVector) -> list[str]:
    before, after = mission.safety, reduced.safety
    notes = [
        f"{after.max_horizontal_speed_m_s:g} m/s, {after.max_vertical_speed_m_s:g} m/s up and down (mission: "
        f"{before.max_horizontal_speed_m_s:g}, {before.max_vertical_speed_m_s:g}), at most {after.fence.max_m[2]:g} m high",
    ]
    if new_goal != goal:
        notes.append(f"goal drawn back to ({new_goal.x:.2f}, {new_goal.y:.2f}, {new_goal.z:.2f})")
    return notes
