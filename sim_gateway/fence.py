"""The MAVLink mission protocol for fences, missions and rally points: upload, download, clear, as PX4 answers it (geofence.json).

`geofence_monitor` watches a stored fence, `mission` flies a stored mission; rally points are kept for those who ask.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pymavlink.dialects.v20 import development as mav

from sim_gateway.geofence_monitor import Circle, Polygon, Shape
from sim_gateway.local_frame import LocalFrame
from sim_gateway.mission import Leg
from sim_gateway.telemetry import Message

FENCE, MISSION, RALLY = mav.MAV_MISSION_TYPE_FENCE, mav.MAV_MISSION_TYPE_MISSION, mav.MAV_MISSION_TYPE_RALLY
MAX_ITEMS = 100
REQUEST_AGAIN_S, GIVE_UP_S = 0.25, 5.0
_COMMANDS = range(mav.MAV_CMD_NAV_FENCE_RETURN_POINT, mav.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION + 1)
_VERTICES = (mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, mav.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION)
_CIRCLES = (mav.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, mav.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION)
_INCLUSIONS = (_VERTICES[0], _CIRCLES[0])
_RELATIVE_FRAMES = (3, 6)
_FRAMES = (0, 5, 3, 6)  # MAV_FRAME_GLOBAL and GLOBAL_RELATIVE_ALT, as float and as scaled integers
_SCALED_LIMITS = (900_000_000, 1_800_000_000)  # latitude and longitude, 1e-7 degrees
_NOWHERE = ((0, 0), (2**31 - 1, 2**31 - 1))  # an item without a place of its own


@dataclass(frozen=True, slots=True)
class Item:
    """One vertex, circle or mission item. `params`: 1 to 4 of it; latitude and longitude in 1e-7 degrees."""

    command: int
    frame: int
    params: tuple[float, float, float, float]
    latitude_e7: int
    longitude_e7: int
    altitude_m: float = 0.0


@dataclass(slots=True)
class _Upload:
    partner: tuple[int, int]
    count: int
    items: list[Item]
    asked_s: float
    heard_s: float
    send: Callable[[Message], None]


class ItemStore:
    """The fence, mission or rally points of one vehicle, and the protocol. `uploads`, `downloads`, `clears`: completed ones."""

    def __init__(
        self,
        now_s: Callable[[], float],
        changed: Callable[[tuple[Item, ...]], None] = lambda _: None,
        mission_type: int = FENCE,
    ) -> None:
        """`changed` is called with everything that is stored, whenever that changes."""
        self.mission_type = mission_type
        self._changed = changed
        self.items: tuple[Item, ...] = ()
        self.uploads = self.downloads = self.clears = 0
        self._now_s = now_s
        self._upload: _Upload | None = None

    def on_count(self, message: Message, send: Callable[[Message], None]) -> None:
        """MISSION_COUNT: an upload begins (0 items: clears), each item is asked for in turn."""
        partner = _sender(message)
        if message.count > MAX_ITEMS:
            send(self._ack(partner, mav.MAV_MISSION_NO_SPACE))
            return
        if message.count == 0:
            self.on_clear(message, send)
            return
        now_s = self._now_s()
        self._upload = _Upload(partner, message.count, [], now_s, now_s, send)
        self._ask(self._upload)

    def on_item(self, message: Message, send: Callable[[Message], None]) -> None:
        """MISSION_ITEM_INT of an upload: the expected one is kept, another one makes it ask again."""
        upload, partner = self._upload, _sender(message)
        if upload is None or upload.partner != partner:
            send(self._ack(partner, mav.MAV_MISSION_INVALID_SEQUENCE if upload is None else mav.MAV_MISSION_DENIED))
            return
        upload.heard_s = self._now_s()
        if message.seq != len(upload.items):
            self._ask(upload)
            return
        problem = _PROBLEMS[self.mission_type](message)
        if problem is not None:
            self._upload = None
            send(self._ack(partner, problem))
            return
        params = (message.param1, message.param2, message.param3, message.param4)
        upload.items.append(Item(message.command, message.frame, params, message.x, message.y, message.z))
        if len(upload.items) < upload.count:
            self._ask(upload)
            return
        self.items, self._upload = tuple(upload.items), None
        self.uploads += 1
        self._changed(self.items)
        send(self._ack(partner, mav.MAV_MISSION_ACCEPTED))

    def on_list(self, message: Message, send: Callable[[Message], None]) -> None:
        """MISSION_REQUEST_LIST: how many items there are."""
        send(mav.MAVLink_mission_count_message(*_sender(message), len(self.items), self.mission_type))

    def on_request(self, message: Message, send: Callable[[Message], None]) -> None:
        """MISSION_REQUEST_INT: one item of a download."""
        partner = _sender(message)
        if message.seq >= len(self.items):
            send(self._ack(partner, mav.MAV_MISSION_INVALID_SEQUENCE))
            return
        item = self.items[message.seq]
        place = (item.latitude_e7, item.longitude_e7, item.altitude_m)
        send(
            mav.MAVLink_mission_item_int_message(
                *partner, message.seq, item.frame, item.command, 0, 1, *item.params, *place, self.mission_type
            )
        )

    def on_ack(self, _message: Message, _send: Callable[[Message], None]) -> None:
        """MISSION_ACK: a client has everything it asked for."""
        self.downloads += 1

    def on_clear(self, message: Message, send: Callable[[Message], None]) -> None:
        """MISSION_CLEAR_ALL: nothing is left."""
        self.clear()
        send(self._ack(_sender(message), mav.MAV_MISSION_ACCEPTED))

    def clear(self) -> None:
        """Forget what is stored and what is being uploaded."""
        self.items, self._upload = (), None
        self.clears += 1
        self._changed(())

    def poll(self) -> None:
        """Ask again for an item that does not come; give an upload up that has fallen silent."""
        upload = self._upload
        if upload is None:
            return
        now_s = self._now_s()
        if now_s - upload.heard_s > GIVE_UP_S:
            self._upload = None
            upload.send(self._ack(upload.partner, mav.MAV_MISSION_OPERATION_CANCELLED))
        elif now_s - upload.asked_s > REQUEST_AGAIN_S:
            self._ask(upload)

    def _ack(self, partner: tuple[int, int], result: int) -> Message:
        return mav.MAVLink_mission_ack_message(*partner, result, self.mission_type)

    def _ask(self, upload: _Upload) -> None:
        upload.asked_s = self._now_s()
        upload.send(mav.MAVLink_mission_request_int_message(*upload.partner, len(upload.items), self.mission_type))


def shapes(items: tuple[Item, ...], frame: LocalFrame) -> list[Shape]:
    """The items in local coordinates: a polygon is as many vertices in a row as the first one's parameter 1 says."""
    found: list[Shape] = []
    rest = list(items)
    while rest:
        item, count = rest[0], 1
        inclusion = item.command in _INCLUSIONS
        corners = [_place(vertex, frame) for vertex in rest]
        if item.command in _CIRCLES:
            found.append(Circle(inclusion, corners[0], item.params[0]))
        elif item.command in _VERTICES:
            count = max(int(item.params[0]), 1)
            found.append(Polygon(inclusion, tuple(corners[:count])))
        del rest[:count]
    return found


def _place(item: Item, frame: LocalFrame) -> tuple[float, float]:
    north, east, _ = frame.from_global(item.latitude_e7 * 1e-7, item.longitude_e7 * 1e-7, 0.0)
    return north, east


def legs(items: tuple[Item, ...], frame: LocalFrame) -> tuple[Leg, ...]:
    """Mission items in local coordinates; without a place or height of their own they are where the vehicle is."""
    found = []
    for item in items:
        nowhere = item.frame == mav.MAV_FRAME_MISSION or (item.latitude_e7, item.longitude_e7) in _NOWHERE
        north, east = (math.nan, math.nan) if nowhere else _place(item, frame)
        above_home = item.frame in _RELATIVE_FRAMES
        altitude = item.altitude_m if above_home else item.altitude_m - frame.altitude_m
        found.append(Leg(item.command, north, east, altitude, above_home, item.params))
    return tuple(found)


def _mission_problem(message: Message) -> int | None:
    """MAV_MISSION_RESULT of an item that cannot be stored, or None. A height may be missing: a return needs none."""
    if message.frame not in (*_FRAMES, mav.MAV_FRAME_MISSION):
        return int(mav.MAV_MISSION_UNSUPPORTED_FRAME)
    return None if (message.x, message.y) in _NOWHERE or _on_earth(message) else int(mav.MAV_MISSION_INVALID)


def _on_earth(message: Message) -> bool:
    return bool(abs(message.x) <= _SCALED_LIMITS[0] and abs(message.y) <= _SCALED_LIMITS[1])


def _place_problem(message: Message, commands: Sequence[int]) -> int | None:
    """The same for items that are nothing but a place."""
    if message.command not in commands:
        return int(mav.MAV_MISSION_UNSUPPORTED)
    if message.frame not in _FRAMES:
        return int(mav.MAV_MISSION_UNSUPPORTED_FRAME)
    return None if _on_earth(message) and math.isfinite(message.param1) else int(mav.MAV_MISSION_INVALID)


_PROBLEMS: dict[int, Callable[[Message], int | None]] = {
    FENCE: lambda message: _place_problem(message, _COMMANDS),
    MISSION: _mission_problem,
    RALLY: lambda message: _place_problem(message, (mav.MAV_CMD_NAV_RALLY_POINT,)),
}


def _sender(message: Message) -> tuple[int, int]:
    return int(message.get_srcSystem()), int(message.get_srcComponent())
