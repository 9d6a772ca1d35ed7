"""What loop and guard say to each other: small fixed messages over a SOCK_SEQPACKET pair. Its end tells that one is gone."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from flight.guard.core import Command, Reason, State

MAX_MESSAGE_BYTES = 512
_COMMAND = struct.Struct("<BIQd4d")
_ENGAGE = struct.Struct("<BIBB")
_ANSWER = struct.Struct("<BBBIQdI")


class Kind(IntEnum):
    """First byte of every message."""

    COMMAND = 1
    ENGAGE = 2
    DISENGAGE = 3
    ANSWER = 16
    READY = 17
    ERROR = 18


@dataclass(frozen=True, slots=True)
class Engage:
    """Follow this engagement; setpoints go to `target` (system, component)."""

    engagement: int
    target: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Answer:
    """State of the guard. `sequence`: the command it answers, or the last; `sent_s`: when that went out, NaN when it did not."""

    state: State
    reason: Reason
    engagement: int
    sequence: int
    sent_s: float
    braked: int


def pack_command(command: Command) -> bytes:
    """A setpoint for the guard."""
    return _COMMAND.pack(Kind.COMMAND, command.engagement, command.sequence, command.stamp_s, *command.setpoint)


def pack_engage(engage: Engage) -> bytes:
    """The beginning of an engagement."""
    return _ENGAGE.pack(Kind.ENGAGE, engage.engagement, *engage.target)


def pack_disengage() -> bytes:
    """Silence, now."""
    return bytes((Kind.DISENGAGE,))


def pack_answer(answer: Answer) -> bytes:
    """The guard's answer."""
    numbers = (answer.engagement, answer.sequence, answer.sent_s, answer.braked)
    return _ANSWER.pack(Kind.ANSWER, answer.state, answer.reason, *numbers)


def read_request(message: bytes) -> Command | Engage | None:
    """What the loop wants; None means silence: that is `disengage`, and whatever cannot be read."""
    kind = message[0] if message else 0
    if kind == Kind.COMMAND and len(message) == _COMMAND.size:
        _, engagement, sequence, stamp_s, *setpoint = _COMMAND.unpack(message)
        north, east, down, yaw_rate = setpoint
        return Command(engagement, sequence, stamp_s, (north, east, down, yaw_rate))
    if kind == Kind.ENGAGE and len(message) == _ENGAGE.size:
        _, engagement, system, component = _ENGAGE.unpack(message)
        return Engage(engagement, (system, component))
    return None


def read_answer(message: bytes) -> Answer | None:
    """The guard's answer; None for other kinds."""
    if not message or message[0] != Kind.ANSWER or len(message) != _ANSWER.size:
        return None
    _, state, reason, engagement, sequence, sent_s, braked = _ANSWER.unpack(message)
    return Answer(State(state), Reason(reason), engagement, sequence, sent_s, braked)
