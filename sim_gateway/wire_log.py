"""What came over the wire: every message counted by kind and sender, and a log of what moves, arms or configures the vehicle."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import development as mav

from sim_gateway.telemetry import Message

_LOGGED = 20_000  # a quarter of an hour of setpoints at 20 Hz
_SENDERS = 1_000  # kinds of message and sender that are counted
_COMMANDS_LOGGED = {
    mav.MAV_CMD_DO_SET_MODE: "DO_SET_MODE",
    mav.MAV_CMD_COMPONENT_ARM_DISARM: "ARM_DISARM",
    mav.MAV_CMD_NAV_TAKEOFF: "NAV_TAKEOFF",
    mav.MAV_CMD_NAV_LAND: "NAV_LAND",
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: "NAV_RETURN_TO_LAUNCH",
    mav.MAV_CMD_DO_REPOSITION: "DO_REPOSITION",
}
_SETPOINTS_LOGGED = (
    "SET_POSITION_TARGET_LOCAL_NED",
    "SET_POSITION_TARGET_GLOBAL_INT",
    "SET_ATTITUDE_TARGET",
    "SET_ACTUATOR_CONTROL_TARGET",
    "SET_MODE",
    "PARAM_SET",
)


@dataclass(frozen=True, slots=True)
class Received:
    """One message that moves, arms or configures the vehicle, as it came off the wire. `what`: message or command name.

    `velocity`: of a local velocity setpoint, NED m/s and clockwise rad/s.
    """

    time_s: float
    what: str
    sender: tuple[int, int]
    velocity: tuple[float, float, float, float] | None = None


class WireLog:
    """`counts`: messages by (name, system, component). `entries`: the newest of what moves, arms or configures the vehicle."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self.counts: Counter[tuple[str, int, int]] = Counter()
        self.entries: deque[Received] = deque(maxlen=_LOGGED)
        self._now_s = now_s

    def note(self, message: Message) -> None:
        """Take note of a message for this vehicle."""
        name, sender = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if (name, *sender) in self.counts or len(self.counts) < _SENDERS:
            self.counts[name, *sender] += 1
        command = _COMMANDS_LOGGED.get(message.command) if name in ("COMMAND_LONG", "COMMAND_INT") else None
        if name in _SETPOINTS_LOGGED or command is not None:
            self.entries.append(Received(self._now_s(), command or name, sender, _velocity(message, name)))


def _velocity(m: Message, name: str) -> tuple[float, float, float, float] | None:
    """What a velocity setpoint asks for; None for other messages and for what is not finite."""
    if name != "SET_POSITION_TARGET_LOCAL_NED":
        return None
    values = (m.vx, m.vy, m.vz, m.yaw_rate)
    return values if all(map(math.isfinite, values)) else None
