"""PX4's stored fence against the mission's own: there, around it, and read back as uploaded."""

from __future__ import annotations

from flight.errors import VehicleCommandError
from flight.fence_upload import (
    OVERSHOOT_HORIZONTAL_M,
    OVERSHOOT_SOURCE,
    OVERSHOOT_SPEED_M_S,
    OVERSHOOT_VERTICAL_M,
    VERTEX_INCLUSION,
    FenceClient,
    FenceVertex,
    GeoPoint,
    OuterFence,
    inner_corners_ned,
    inside,
)
from flight.preflight import Check, Level
from safety.config import SafetyConfig
from safety.frames import CorridorFrame

NAME = "fence in PX4"
NO_GLOBAL = "PX4 has no global position, so it cannot check a fence: set its origin, or rely on the mission's fence alone"


def apply_fence(client: FenceClient, fence: OuterFence, geo: GeoPoint | None) -> list[Check]:
    """Upload, read back, compare exactly."""
    if geo is None:
        return [Check(NAME, Level.WARN, "not uploaded", NO_GLOBAL)]
    vertices = fence.vertices(geo)
    try:
        client.upload(vertices)
        held = client.download()
    except VehicleCommandError as error:
        return [Check(NAME, Level.FAIL, str(error), "upload a fence by hand in QGroundControl")]
    wanted = [FenceVertex(VERTEX_INCLUSION, len(vertices), place) for place in vertices]
    if held != wanted:
        return [Check(NAME, Level.FAIL, f"{len(held)} items read back differ from those sent", "try again, or update PX4")]
    return [Check(NAME, Level.PASS, f"{len(held)} vertices uploaded and read back, {_size()}")]


def check_fence(client: FenceClient, safety: SafetyConfig, frame: CorridorFrame, geo: GeoPoint | None) -> list[Check]:
    """What PX4 holds now: a second line around the mission's fence, none, or one that cuts into it."""
    try:
        held = client.download()
    except VehicleCommandError as error:
        return [Check(NAME, Level.WARN, str(error), "look at the fence in QGroundControl")]
    if not held:
        return [Check(NAME, Level.WARN, "none", f"--apply uploads the mission's fence {_size()}")]
    if geo is None:
        return [Check(NAME, Level.WARN, f"{len(held)} items", NO_GLOBAL)]
    if any(item.command != VERTEX_INCLUSION for item in held):
        return [Check(NAME, Level.WARN, f"{len(held)} items, not all of one polygon", "look at it in QGroundControl, or --apply")]
    corners = [geo.to_ned(item.place) for item in held]
    if not all(inside(corner, corners) for corner in inner_corners_ned(safety, frame)):
        return [
            Check(NAME, Level.FAIL, f"{len(held)} vertices cut into the mission's fence", "--apply replaces it by one around it")
        ]
    return [Check(NAME, Level.PASS, f"{len(held)} vertices around the mission's fence")]


def check_overshoot(safety: SafetyConfig) -> list[Check]:
    """Whether the measured overshoot covers the mission's speed."""
    speed = safety.max_horizontal_speed_m_s
    if speed <= OVERSHOOT_SPEED_M_S:
        return [Check("fence overshoot", Level.PASS, f"{_size()} ({OVERSHOOT_SOURCE})")]
    seen = f"measured up to {OVERSHOOT_SPEED_M_S:g} m/s, the mission flies {speed:g} m/s"
    return [Check("fence overshoot", Level.WARN, seen, "PX4 may stop further outside: keep more room around the fence")]


def _size() -> str:
    return f"{OVERSHOOT_HORIZONTAL_M:.2f} m further out, {OVERSHOOT_VERTICAL_M:.2f} m higher"
