"""What link faults make of the messages of one link: lost, late, twice, overtaken, drowned, or made up."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sim_gateway.faults import LINK, Active, FaultSchedule
from sim_gateway.mavlink_frame import FramePacker
from sim_gateway.telemetry import COMPONENT_ID, SYSTEM_ID, Message

_KEPT = 50_000
_FLOOD_PER_CALL = 500
_FLOOD_PER_DATAGRAM = 20
_FOREIGN_BOOT_MS = 5_000_000  # the second vehicle has been on for longer


@dataclass(frozen=True, slots=True)
class RawBytes:
    """Bytes for the wire as they are, a message or not."""

    data: bytes


def _flood_frames() -> list[bytes]:
    packer, text = FramePacker(SYSTEM_ID, COMPONENT_ID), mav.MAVLink_statustext_message(6, b"flood")
    return [packer.pack(text) for _ in range(_FLOOD_PER_CALL)]


_FLOOD = _flood_frames()  # packed once, and sent many at a time: it is the client's to bear, vehicle time must not stand still


class LinkFaults:
    """One link's faults, both ways. Messages out and in are handed over when they shall go on."""

    def __init__(self, schedule: FaultSchedule, seed: int) -> None:
        self._schedule = schedule
        self._generator = np.random.Generator(np.random.PCG64([seed, 77]))
        self._late: dict[str, list[tuple[float, int, Message]]] = {"out": [], "in": []}
        self._count = 0
        self._made_s: dict[int, float] = {}

    def out(self, message: Message, now_s: float) -> list[Message]:
        """What a message from the vehicle becomes now."""
        return self._pass("out", message, now_s, self._schedule.group(LINK, now_s)) if self._schedule.has(LINK) else [message]

    def due_out(self, now_s: float) -> list[Message | RawBytes]:
        """Messages from the vehicle whose delay is over, and what faults add by themselves."""
        if not self._schedule.has(LINK):
            return []
        added = [made for item in self._schedule.group(LINK, now_s) for made in self._made(item, now_s)]
        return [*self._due("out", now_s), *added]

    def into(self, arrived: list[Message], now_s: float) -> list[Message]:
        """What reaches the vehicle now of all that has arrived, delayed earlier messages included."""
        if not self._schedule.has(LINK):
            return arrived
        active = self._schedule.group(LINK, now_s)
        passed = [kept for message in arrived for kept in self._pass("in", message, now_s, active)]
        return [*self._due("in", now_s), *passed]

    def _pass(self, way: str, message: Message, now_s: float, active: list[Active]) -> list[Message]:
        delay_s = 0.0
        for item in active:
            if self._lost(item, way, now_s):
                return []
            if item.kind == "link_delay":
                delay_s += item["delay_s"]
            elif item.kind == "link_reorder" and self._generator.random() < item["share"]:
                delay_s += item["later_s"]
            elif item.kind == "link_duplicate" and self._generator.random() < item["share"]:
                self._keep(way, now_s + delay_s + item["later_s"], message)
        if delay_s == 0.0:
            return [message]
        self._keep(way, now_s + delay_s, message)
        return []

    def _lost(self, item: Active, way: str, now_s: float) -> bool:
        if item.kind == {"out": "link_down", "in": "link_up"}[way]:
            return True
        if item.kind == "link_burst":
            return math.fmod(now_s - item.begin_s, item["period_s"]) < item["burst_s"]
        return item.kind == "link_loss" and bool(self._generator.random() < item["share"])

    def _keep(self, way: str, due_s: float, message: Message) -> None:
        if len(self._late[way]) < _KEPT:
            self._count += 1
            heapq.heappush(self._late[way], (due_s, self._count, message))

    def _due(self, way: str, now_s: float) -> list[Message]:
        late, due = self._late[way], []
        while late and late[0][0] <= now_s + 1e-9:
            due.append(heapq.heappop(late)[2])
        return due

    def _made(self, item: Active, now_s: float) -> list[Message | RawBytes]:
        """Messages that a fault makes up, at its own rate since the last call."""
        make = _MAKERS.get(item.kind)
        if make is None:
            return []
        last_s = self._made_s.setdefault(item.number, item.begin_s)
        number = min(int((now_s - last_s) * item["rate_hz"] + 1e-9), _FLOOD_PER_CALL)
        if number == 0:
            return []
        self._made_s[item.number] = now_s
        return make(self._generator, now_s, number)


def _garbage(generator: np.random.Generator, _now_s: float, number: int) -> list[Message | RawBytes]:
    return [RawBytes(b"\xfd" + generator.bytes(int(generator.integers(1, 280)))) for _ in range(number)]


def _flood(_generator: np.random.Generator, _now_s: float, number: int) -> list[Message | RawBytes]:
    return [RawBytes(b"".join(_FLOOD[k : min(k + _FLOOD_PER_DATAGRAM, number)])) for k in range(0, number, _FLOOD_PER_DATAGRAM)]


def _foreign(_generator: np.random.Generator, now_s: float, number: int) -> list[Message | RawBytes]:
    """Position, attitude and heartbeat of a disarmed vehicle far away that uses the same system id."""
    boot_ms = _FOREIGN_BOOT_MS + round(1e3 * now_s)
    place = mav.MAVLink_local_position_ned_message(boot_ms, 150.0, -80.0, 0.0, 0.0, 0.0, 0.0)
    attitude = mav.MAVLink_attitude_message(boot_ms, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0)
    beat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, 29, 0x03040000, 3, 3)
    return [place, attitude, beat][: 3 * number]


_MAKERS: dict[str, Callable[[np.random.Generator, float, int], list[Message | RawBytes]]] = {
    "link_garbage": _garbage,
    "link_flood": _flood,
    "link_foreign": _foreign,
}
