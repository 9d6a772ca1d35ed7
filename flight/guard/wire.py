"""The little MAVLink that the guard itself needs: one message out, frame boundaries, and the vehicle's mode in.

Standard library only, like the whole guard: it must start at once, stay small, and import nothing that could hang it. Frame
layouts: MAVLink 1 and 2 (mavlink.io/en/guide/serialization.html); checksum X.25 over all but the magic byte, plus CRC_EXTRA.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
SIGNED = 0x01
SIGNATURE_BYTES = 13
MAX_FRAME_BYTES = 10 + 255 + 2 + SIGNATURE_BYTES

HEARTBEAT, CURRENT_MODE, SET_POSITION_TARGET_LOCAL_NED = 0, 436, 84
_CRC_EXTRA = {HEARTBEAT: 50, CURRENT_MODE: 193, SET_POSITION_TARGET_LOCAL_NED: 143}
STEERING = frozenset({69, 70, 82, 84, 86, 139})
"""What steers: MANUAL_CONTROL, RC_CHANNELS_OVERRIDE, SET_ATTITUDE_TARGET, SET_POSITION_TARGET_*, SET_ACTUATOR_CONTROL_TARGET."""

_AUTOPILOT_COMPONENT = 1
_AUTOPILOT_INVALID = 8
_ARMED = 0x80
_FRAME_LOCAL_NED = 1
_TYPE_MASK_VELOCITY_YAW_RATE = 0x5C7
_SETPOINT = struct.Struct("<I11fHBBB")
_NO_POSITION = (0.0, 0.0, 0.0)


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
        table.append(crc)
    return tuple(table)


_TABLE = _crc_table()


def x25(data: bytes, crc_extra: int) -> int:
    """CRC-16/MCRF4XX of `data` and one more byte, as MAVLink frames end with."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc >> 8 ^ _TABLE[(crc ^ crc_extra) & 0xFF]


@dataclass(frozen=True, slots=True)
class Frame:
    """One whole frame. `payload` as on the wire: MAVLink 2 leaves out zero bytes at its end."""

    message_id: int
    system: int
    component: int
    payload: bytes
    raw: bytes


def pack_setpoint(
    sequence: int,
    time_boot_ms: int,
    source: tuple[int, int],
    target: tuple[int, int],
    velocity: tuple[float, ...],
    yaw_rate: float,
) -> bytes:
    """SET_POSITION_TARGET_LOCAL_NED, MAVLink 2: velocity north, east, down (m/s) and yaw rate (rad/s, clockwise)."""
    mask, none = _TYPE_MASK_VELOCITY_YAW_RATE, _NO_POSITION
    fields = (time_boot_ms & 0xFFFFFFFF, *none, *velocity, *none, 0.0, yaw_rate, mask, *target, _FRAME_LOCAL_NED)
    payload = _SETPOINT.pack(*fields)  # its last byte is not zero: nothing to truncate
    number = SET_POSITION_TARGET_LOCAL_NED
    header = bytes((MAGIC_V2, len(payload), 0, 0, sequence & 0xFF, *source, number & 0xFF, number >> 8 & 0xFF, number >> 16))
    return header + payload + x25(header[1:] + payload, _CRC_EXTRA[number]).to_bytes(2, "little")


def read_frames(data: bytes) -> tuple[list[Frame], int]:
    """The whole frames in `data`, other bytes skipped; and how much of `data` is dealt with (the rest may be half a frame)."""
    frames: list[Frame] = []
    at, size = 0, len(data)
    while at < size:
        magic = data[at]
        if magic not in (MAGIC_V1, MAGIC_V2):
            at += 1
            continue
        end = _frame_end(data, at)
        if end > size:
            break
        frames.append(_frame(data[at:end]))
        at = end
    return frames, at


def _frame_end(data: bytes, at: int) -> int:
    """Where the frame that begins at `at` ends; beyond the data when its header is not there yet."""
    if at + 3 > len(data):
        return len(data) + 1
    if data[at] == MAGIC_V1:
        return at + 8 + data[at + 1]
    return at + 12 + data[at + 1] + (SIGNATURE_BYTES if data[at + 2] & SIGNED else 0)


def _frame(raw: bytes) -> Frame:
    if raw[0] == MAGIC_V1:
        return Frame(raw[5], raw[3], raw[4], raw[6 : 6 + raw[1]], raw)
    return Frame(int.from_bytes(raw[7:10], "little"), raw[5], raw[6], raw[10 : 10 + raw[1]], raw)


class FrameStream:
    """Cuts a stream of bytes (serial, TCP) into whole frames. Holds less than one frame between calls."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that `data` completes."""
        data = self._rest + data
        frames, used = read_frames(data)
        self._rest = data[used:]
        return frames


@dataclass(frozen=True, slots=True)
class ModeReport:
    """What an autopilot says about itself: PX4's main mode (6 is OFFBOARD), and armed where the message tells."""

    system: int
    main_mode: int
    armed: bool | None = None


def read_mode(frame: Frame) -> ModeReport | None:
    """The mode in an autopilot's HEARTBEAT or CURRENT_MODE; None for other frames, other components and wrong checksums."""
    if frame.message_id not in (HEARTBEAT, CURRENT_MODE) or frame.component != _AUTOPILOT_COMPONENT or not _intact(frame):
        return None
    payload = frame.payload.ljust(9, b"\0")
    main_mode = payload[2]  # custom_mode is main << 16 | sub << 24
    if frame.message_id == CURRENT_MODE:
        return ModeReport(frame.system, main_mode)
    if payload[5] == _AUTOPILOT_INVALID:
        return None
    return ModeReport(frame.system, main_mode, bool(payload[6] & _ARMED))


def _intact(frame: Frame) -> bool:
    raw = frame.raw
    body = raw[: len(raw) - SIGNATURE_BYTES] if raw[0] == MAGIC_V2 and raw[2] & SIGNED else raw
    return x25(body[1:-2], _CRC_EXTRA[frame.message_id]).to_bytes(2, "little") == body[-2:]
