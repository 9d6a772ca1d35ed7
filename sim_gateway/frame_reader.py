"""Whole, intact MAVLink frames out of a stream of bytes: TCP and serial lines, where nothing marks where a message begins.

Wrong checksums, unknown messages and garbage are skipped; what is kept is bounded by one frame.
"""

from __future__ import annotations

import logging
import struct
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as mav

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER, _V2_HEADER = 6, 10
_CHECKSUM, _SIGNATURE = 2, 13
_SIGNED = 0x01

_log = logging.getLogger("sim_gateway.mavlink")


@dataclass(frozen=True, slots=True)
class Frame:
    """One intact frame: message number, sender, payload as it came (trailing zeros may be cut), all of its bytes."""

    number: int
    system: int
    component: int
    payload: bytes
    data: bytes


class FrameReader:
    """Feed it what arrives, in pieces of any size."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that are complete now."""
        data = self._rest + data
        frames, at = [], 0
        while True:
            at = _next_start(data, at)
            length = _frame_length(data, at)
            if length is None or at + length > len(data):
                break
            frame = _intact(data[at : at + length]) if length else None
            at += 1 if frame is None else length
            if frame is not None:
                frames.append(frame)
        self._rest = data[at:]
        return frames


def decode(frame: Frame) -> Any | None:
    """The frame as pymavlink's message; None if its payload cannot be read."""
    try:
        return mav.MAVLink(None).decode(bytearray(frame.data))
    except (mav.MAVError, struct.error, ValueError, IndexError) as error:
        _log.debug("message %d dropped: %s", frame.number, error)
        return None


def _next_start(data: bytes, at: int) -> int:
    """Where the next byte is with which a frame may begin; the end of the data if there is none."""
    places = [place for place in (data.find(_V2, at), data.find(_V1, at)) if place >= 0]
    return min(places, default=len(data))


def _frame_length(data: bytes, at: int) -> int | None:
    """Length of the frame that may begin there: None if that is not known yet, 0 if none can begin there."""
    if at + 3 > len(data):
        return None
    payload = data[at + 1]
    if data[at] == _V1:
        return _V1_HEADER + payload + _CHECKSUM
    if data[at + 2] & ~_SIGNED:
        return 0
    return _V2_HEADER + payload + _CHECKSUM + (_SIGNATURE if data[at + 2] & _SIGNED else 0)


def _intact(data: bytes) -> Frame | None:
    """The frame, if its message is known and its checksum right."""
    first = data[0] == _V1
    header = _V1_HEADER if first else _V2_HEADER
    number = data[5] if first else int.from_bytes(data[7:10], "little")
    end = header + data[1]
    kind = mav.mavlink_map.get(number)
    if kind is None:
        return None
    crc = mav.x25crc(data[1:end] + bytes((kind.crc_extra,))).crc
    if crc != int.from_bytes(data[end : end + _CHECKSUM], "little"):
        return None
    system, component = (data[3], data[4]) if first else (data[5], data[6])
    return Frame(number, system, component, data[header:end], data)
