"""The mission's fence in PX4, as a second line: larger than the mission's own by PX4's measured overshoot, and read back.

PX4 notices a breach after it has happened. So its fence must lie outside the mission's, by at least what it needs to stop: else
it would end flights that stay inside their own fence, and it must not be much larger, or it protects nothing.

The overshoot is the largest one recorded on PX4 v1.17 (SITL) with GF_ACTION Hold and PX4's default limits: 2.034 m horizontally
(inclusion polygon, three flights crossing at 1.71 to 1.82 m/s), 1.568 m upwards (two flights at 1.42 to 1.44 m/s).
"""

from __future__ import annotations

import json
import math
import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from flight.checks.facts import Fields
from flight.connection import OWN_COMPONENT_ID, OWN_SYSTEM_ID
from flight.errors import VehicleCommandError
from flight.fence_outline import grown, shrunk
from flight.link import VehicleLink
from flight.preparation import Place
from safety.config import SafetyConfig
from safety.fence import Ring
from safety.frames import CorridorFrame, CorridorVector, NedVector

OVERSHOOT_HORIZONTAL_M, OVERSHOOT_VERTICAL_M = 2.034, 1.568
OVERSHOOT_SPEED_M_S = 1.82
OVERSHOOT_SOURCE = "largest overshoot of PX4 v1.17's Hold at its fence: 2.034 m at 1.8 m/s, 1.568 m upwards at 1.4 m/s"
EARTH_RADIUS_M = 6371000.0  # of PX4's own projection
FENCE_TYPE = 1  # MAV_MISSION_TYPE_FENCE
VERTEX_INCLUSION, VERTEX_EXCLUSION = 5001, 5002  # MAV_CMD_NAV_FENCE_POLYGON_VERTEX_...
FRAME_GLOBAL = 0
ACCEPTED = 0
DEADLINE_S, ANSWER_S = 10.0, 0.5
MAX_ITEMS = 100
_MESSAGES = ("MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK", "MISSION_COUNT", "MISSION_ITEM_INT")

LatLonE7 = tuple[int, int]


@dataclass(frozen=True, slots=True)
class GeoPoint:
    """The same instant in both of PX4's frames: local NED (m) and WGS84 (degrees)."""

    ned: NedVector
    latitude_deg: float
    longitude_deg: float

    def of_ned(self, point: NedVector) -> LatLonE7:
        """Latitude and longitude of a local point, 1e-7 degrees (PX4's azimuthal projection, near its origin)."""
        scale = math.degrees(1.0 / EARTH_RADIUS_M)
        latitude = self.latitude_deg + scale * (point.x - self.ned.x)
        longitude = self.longitude_deg + scale * (point.y - self.ned.y) / math.cos(math.radians(self.latitude_deg))
        return round(latitude * 1e7), round(longitude * 1e7)

    def to_ned(self, place: LatLonE7) -> NedVector:
        """Inverse of `of_ned`, at height 0."""
        north = math.radians(place[0] * 1e-7 - self.latitude_deg) * EARTH_RADIUS_M
        east = math.radians(place[1] * 1e-7 - self.longitude_deg) * EARTH_RADIUS_M * math.cos(math.radians(self.latitude_deg))
        return NedVector(self.ned.x + north, self.ned.y + east, 0.0)


@dataclass(frozen=True, slots=True)
class FenceVertex:
    """One stored item: vertices of one polygon follow each other, each with the polygon's number of vertices."""

    command: int
    polygon_size: int
    place: LatLonE7


@dataclass(frozen=True, slots=True)
class OuterFence:
    """PX4's fence for a mission. `corners_ned`, `exclusions_ned`: horizontal corners in order; distances from home, m.

    `too_small`: exclusions of the mission of which nothing is left for PX4; the mission's own fence alone keeps them.
    """

    corners_ned: tuple[NedVector, ...]
    exclusions_ned: tuple[tuple[NedVector, ...], ...]
    too_small: int
    max_horizontal_m: float
    max_vertical_m: float

    def items(self, geo: GeoPoint) -> list[FenceVertex]:
        """The corners as PX4 stores them."""
        polygons = [(VERTEX_INCLUSION, self.corners_ned), *((VERTEX_EXCLUSION, ring) for ring in self.exclusions_ned)]
        return [FenceVertex(command, len(ring), geo.of_ned(corner)) for command, ring in polygons for corner in ring]


def outer_fence(safety: SafetyConfig, frame: CorridorFrame, place: Place) -> OuterFence:
    """The mission's fence, moved out by the measured overshoot: the inclusion grown, exclusions shrunk."""
    fence = safety.fence
    smaller = [shrunk(ring, OVERSHOOT_HORIZONTAL_M) for ring in fence.exclusion]
    exclusions = [ring for ring in smaller if ring is not None]
    outline = grown(fence.polygon, OVERSHOOT_HORIZONTAL_M, MAX_ITEMS - sum(map(len, exclusions)))
    return OuterFence(
        ring_to_ned(outline, frame),
        tuple(ring_to_ned(ring, frame) for ring in exclusions),
        smaller.count(None),
        max(math.dist(corner, place.takeoff_point) for corner in outline),
        fence.high_m[2] + OVERSHOOT_VERTICAL_M,
    )


def ring_to_ned(ring: Ring, frame: CorridorFrame) -> tuple[NedVector, ...]:
    """Horizontal corners of a polygon in local NED."""
    return tuple(frame.point_to_ned(CorridorVector(x, y, 0.0)) for x, y in ring)


class FenceClient:
    """Uploads and downloads PX4's fence by the MAVLink mission protocol (`mission_type` FENCE), with deadlines."""

    def __init__(self, link: VehicleLink, clock: Callable[[], float] = time.monotonic) -> None:
        self._link, self._clock = link, clock
        self._inbox: queue.Queue[tuple[str, Fields]] = queue.Queue(maxsize=1000)
        for name in _MESSAGES:
            link.listen(name, self._taker(name))

    def _taker(self, name: str) -> Callable[[Fields], None]:
        def take(fields: Fields) -> None:
            mine = (fields["target_system"], fields["target_component"]) == (OWN_SYSTEM_ID, OWN_COMPONENT_ID)
            if mine and fields.get("mission_type") == FENCE_TYPE and not self._inbox.full():
                self._inbox.put_nowait((name, fields))

        return take

    def upload(self, items: Sequence[FenceVertex]) -> None:
        """Replace PX4's fence. Raises `VehicleCommandError` when PX4 does not take it."""
        self._drain()
        deadline = self._clock() + DEADLINE_S
        started = False
        self._send("MISSION_COUNT", count=len(items))
        while (left_s := deadline - self._clock()) > 0.0:
            answer = self._next(min(ANSWER_S, left_s))
            if answer is None and not started:
                self._send("MISSION_COUNT", count=len(items))
            elif answer is not None and answer[0] in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
                started = True
                self._send_vertex(int(answer[1]["seq"]), items)
            elif answer is not None and answer[0] == "MISSION_ACK":
                _require_accepted(int(answer[1]["type"]))
                return
        raise VehicleCommandError(f"PX4 did not finish taking the fence within {DEADLINE_S:g} s")

    def download(self) -> list[FenceVertex]:
        """The fence PX4 holds. Raises `VehicleCommandError` when it cannot be read."""
        self._drain()
        self._send("MISSION_REQUEST_LIST")
        count = int(self._await("MISSION_COUNT", lambda: self._send("MISSION_REQUEST_LIST"))["count"])
        if count > MAX_ITEMS:
            raise VehicleCommandError(f"PX4 holds {count} fence items: clear its fence in QGroundControl")
        found = []
        for seq in range(count):
            self._send("MISSION_REQUEST_INT", seq=seq)
            item = self._await("MISSION_ITEM_INT", partial(self._send, "MISSION_REQUEST_INT", seq=seq), seq)
            found.append(FenceVertex(int(item["command"]), round(float(item["param1"])), (int(item["x"]), int(item["y"]))))
        self._send("MISSION_ACK", type=ACCEPTED)
        return found

    def clear(self) -> None:
        """Remove PX4's fence. Raises `VehicleCommandError` when PX4 does not confirm."""
        self._drain()
        self._send("MISSION_CLEAR_ALL")
        _require_accepted(int(self._await("MISSION_ACK", lambda: self._send("MISSION_CLEAR_ALL"))["type"]))

    def _send_vertex(self, seq: int, items: Sequence[FenceVertex]) -> None:
        if not 0 <= seq < len(items):
            raise VehicleCommandError(f"PX4 asked for fence vertex {seq} of {len(items)}")
        item = items[seq]
        latitude, longitude = item.place
        numbers = {"param1": float(item.polygon_size), "param2": 0.0, "param3": 0.0, "param4": 0.0, "z": 0.0}
        self._send(
            "MISSION_ITEM_INT",
            seq=seq, frame=FRAME_GLOBAL, command=item.command, current=0, autocontinue=1, x=latitude, y=longitude, **numbers,
        )  # fmt: skip

    def _send(self, name: str, **fields: float) -> None:
        system, component = self._link.target
        body = {"target_system": system, "target_component": component, **fields, "mission_type": FENCE_TYPE}
        self._link.send_message(name, json.dumps(body))

    def _await(self, name: str, again: Callable[[], None], seq: int | None = None) -> Fields:
        deadline = self._clock() + DEADLINE_S
        while (left_s := deadline - self._clock()) > 0.0:
            answer = self._next(min(ANSWER_S, left_s))
            if answer is None:
                again()
            elif answer[0] == name and (seq is None or int(answer[1]["seq"]) == seq):
                return answer[1]
            elif answer[0] == "MISSION_ACK":
                _require_accepted(int(answer[1]["type"]))
        raise VehicleCommandError(f"PX4 does not answer about its fence ({name}) within {DEADLINE_S:g} s")

    def _next(self, timeout_s: float) -> tuple[str, Fields] | None:
        try:
            return self._inbox.get(timeout=max(timeout_s, 0.01))
        except queue.Empty:
            return None

    def _drain(self) -> None:
        while self._next(0.0) is not None:
            continue


def _require_accepted(result: int) -> None:
    if result != ACCEPTED:
        raise VehicleCommandError(
            f"PX4 refused the fence (MAV_MISSION_RESULT {result}); clear its fence in QGroundControl and retry"
        )
