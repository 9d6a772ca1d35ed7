"""PX4's stored fence against the mission's own: there, around it, and read back as uploaded."""

from __future__ import annotations

from collections.abc import Sequence

from flight.errors import VehicleCommandError
from flight.fence_outline import cuts_into
from flight.fence_upload import (
    OVERSHOOT_HORIZONTAL_M,
    OVERSHOOT_SOURCE,
    OVERSHOOT_SPEED_M_S,
    OVERSHOOT_VERTICAL_M,
    VERTEX_EXCLUSION,
    VERTEX_INCLUSION,
    FenceClient,
    FenceVertex,
    GeoPoint,
    OuterFence,
    ring_to_ned,
)
from flight.preflight import Check, Level
from safety.config import SafetyConfig
from safety.fence import Ring
from safety.fence_rules import ring_problem
from safety.frames import CorridorFrame, NedVector

NAME = "fence in PX4"
NO_GLOBAL = "PX4 has no global position, so it cannot check a fence: set its origin, or rely on the mission's fence alone"

ONLY_OWN = "PX4 stops late, so an exclusion narrower than that cannot be its second line: the mission's own fence keeps it alone"


def apply_fence(client: FenceClient, fence: OuterFence, geo: GeoPoint | None) -> list[Check]:
    """Upload, read back, compare exactly."""
    if geo is None:
        return [Check(NAME, Level.WARN, "not uploaded", NO_GLOBAL)]
    wanted = fence.items(geo)
    try:
        client.upload(wanted)
        held = client.download()
    except VehicleCommandError as error:
        return [Check(NAME, Level.FAIL, str(error), "upload a fence by hand in QGroundControl")]
    if held != wanted:
        return [Check(NAME, Level.FAIL, f"{len(held)} items read back differ from those sent", "try again, or update PX4")]
    seen = f"{len(held)} vertices uploaded and read back, {_size()}"
    if fence.too_small:
        return [Check(NAME, Level.WARN, f"{seen}; {fence.too_small} exclusions are too small for PX4", ONLY_OWN)]
    return [Check(NAME, Level.PASS, seen)]


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
    polygons = _polygons(held, geo)
    if polygons is None:
        return [Check(NAME, Level.WARN, f"{len(held)} items, not all of polygons", "look at it in QGroundControl, or --apply")]
    own, *exclusions = (_flat(ring_to_ned(ring, frame)) for ring in (safety.fence.polygon, *safety.fence.exclusion))
    if cuts_into(polygons[VERTEX_INCLUSION], polygons[VERTEX_EXCLUSION], own, exclusions):
        return [
            Check(NAME, Level.FAIL, f"{len(held)} vertices cut into the mission's fence", "--apply replaces it by one around it")
        ]
    return [Check(NAME, Level.PASS, f"{len(held)} vertices around the mission's fence")]


def _polygons(held: Sequence[FenceVertex], geo: GeoPoint) -> dict[int, list[Ring]] | None:
    """Stored polygons in local NED by their command, or None when the items are no polygons."""
    polygons: dict[int, list[Ring]] = {VERTEX_INCLUSION: [], VERTEX_EXCLUSION: []}
    rest = list(held)
    while rest:
        size = max(rest[0].polygon_size, 1)
        ring, rest = rest[:size], rest[size:]
        corners = _flat([geo.to_ned(item.place) for item in ring])
        if len({item.command for item in ring}) > 1 or ring[0].command not in polygons or ring_problem(corners) is not None:
            return None
        polygons[ring[0].command].append(corners)
    return polygons


def _flat(corners: Sequence[NedVector]) -> Ring:
    return tuple((corner.x, corner.y) for corner in corners)


def check_overshoot(safety: SafetyConfig) -> list[Check]:
    """Whether the measured overshoot covers the mission's speed."""
    speed = safety.max_horizontal_speed_m_s
    if speed <= OVERSHOOT_SPEED_M_S:
        return [Check("fence overshoot", Level.PASS, f"{_size()} ({OVERSHOOT_SOURCE})")]
    seen = f"measured up to {OVERSHOOT_SPEED_M_S:g} m/s, the mission flies {speed:g} m/s"
    return [Check("fence overshoot", Level.WARN, seen, "PX4 may stop further outside: keep more room around the fence")]


def _size() -> str:
    return f"{OVERSHOOT_HORIZONTAL_M:.2f} m further out, {OVERSHOOT_VERTICAL_M:.2f} m higher"
