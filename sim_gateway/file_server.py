"""MAVLink FTP, read only: the vehicle's logs as files, where PX4 keeps them on its card.

Everything else is refused as PX4 refuses it: no such file, or (whatever would change something) protected. A client that asks for
files that are not there, such as MAVProxy for packed parameters, so learns at once that it has to ask in another way.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import development as mav

from sim_gateway.telemetry import Message
from sim_gateway.vehicle_log import VehicleLog

_HEADER = struct.Struct("<HBBBBBBI")  # sequence, session, opcode, size, opcode asked for, burst complete, padding, offset
DATA_BYTES = 239
_BURST_BYTES, _PIECES_PER_POLL = 64 << 10, 4
SESSION = 0  # there is one
# opcodes
NONE, TERMINATE, RESET, LIST, OPEN_READ, READ, CHECKSUM, BURST = 0, 1, 2, 3, 4, 5, 14, 15
_CHANGES = (6, 7, 8, 9, 10, 11, 12, 13)  # create, write, remove, make and remove folders, open to write, truncate, rename
ACK, NAK = 128, 129
# errors
INVALID_SIZE, INVALID_SESSION, END_OF_FILE, UNKNOWN_COMMAND, PROTECTED, NOT_FOUND = 3, 4, 6, 7, 9, 10

LOG_FOLDER = "/fs/microsd/log"
_FOLDERS = {"/": ("Dfs",), "/fs": ("Dmicrosd",), "/fs/microsd": ("Dlog",)}

Send = Callable[[Message], None]


@dataclass(frozen=True, slots=True)
class Request:
    """One request. `size`: of `data`, or bytes wanted."""

    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes

    @property
    def path(self) -> str:
        """The path that `data` names, without a slash at its end."""
        return "/" + self.data.split(b"\0")[0].decode("ascii", "replace").strip("/")


@dataclass(slots=True)
class _Burst:
    request: Request
    position: int
    sequence: int
    answer: Callable[[bytes], None]


class _RefusedError(Exception):
    """The answer is a NAK with this error number."""


class FileServer:
    """Answers file requests; `poll` goes on with a burst. One session at a time, the newest opening replaces it."""

    def __init__(self, vehicle_log: VehicleLog) -> None:
        self._vehicle_log = vehicle_log
        self._open: bytes | None = None
        self._burst: _Burst | None = None
        self._handlers: dict[int, Callable[[Request], bytes]] = {
            NONE: lambda _: b"",
            TERMINATE: self._close,
            RESET: self._close,
            LIST: self._list,
            OPEN_READ: self._open_file,
            READ: self._read,
            CHECKSUM: lambda request: struct.pack("<I", binascii.crc32(self._file(request.path))),
        }

    def on_request(self, m: Message, send: Send) -> None:
        """FILE_TRANSFER_PROTOCOL: exactly one answer, but for a burst."""
        payload = bytes(m.payload)
        sequence, session, opcode, size, *_, offset = _HEADER.unpack_from(payload)
        data = payload[_HEADER.size : _HEADER.size + size] if size <= DATA_BYTES else b""
        request = Request(sequence, session, opcode, size, offset, data)

        def answer(frame: bytes) -> None:
            padded = list(frame.ljust(_HEADER.size + DATA_BYTES, b"\0"))
            send(mav.MAVLink_file_transfer_protocol_message(0, m.get_srcSystem(), m.get_srcComponent(), padded))

        try:
            if size > DATA_BYTES:
                raise _RefusedError(INVALID_SIZE)
            if opcode == BURST:
                self._opened(request)
                self._burst = _Burst(request, offset, sequence + 1, answer)
                return
            answer(_frame(request, ACK, sequence + 1, offset, self._handle(request)))
        except _RefusedError as refused:
            answer(_frame(request, NAK, sequence + 1, offset, bytes(refused.args)))

    def _handle(self, request: Request) -> bytes:
        if request.opcode in _CHANGES:
            raise _RefusedError(PROTECTED)
        if request.opcode not in self._handlers:
            raise _RefusedError(UNKNOWN_COMMAND)
        return self._handlers[request.opcode](request)

    def poll(self) -> None:
        """Send the next pieces of a burst; its end is said by an "end of file"."""
        for _ in range(_PIECES_PER_POLL):
            burst = self._burst
            if burst is None or self._open is None:
                return
            piece = self._open[burst.position : burst.position + DATA_BYTES]
            last = burst.position + len(piece) - burst.request.offset >= _BURST_BYTES
            if piece:
                burst.answer(_frame(burst.request, ACK, burst.sequence, burst.position, piece, complete=last))
            else:
                burst.answer(_frame(burst.request, NAK, burst.sequence, burst.position, bytes([END_OF_FILE])))
            burst.position, burst.sequence = burst.position + len(piece), burst.sequence + 1
            if last or not piece:
                self._burst = None

    def _file(self, path: str) -> bytes:
        for log in self._vehicle_log.logs:
            if path == f"{LOG_FOLDER}/{_name(log.number)}":
                return bytes(log.data)
        raise _RefusedError(NOT_FOUND)

    def _opened(self, request: Request) -> bytes:
        if self._open is None or request.session != SESSION:
            raise _RefusedError(INVALID_SESSION)
        return self._open

    def _close(self, _: Request) -> bytes:
        self._open = self._burst = None
        return b""

    def _open_file(self, request: Request) -> bytes:
        self._open, self._burst = self._file(request.path), None
        return struct.pack("<I", len(self._open))

    def _read(self, request: Request) -> bytes:
        piece = self._opened(request)[request.offset : request.offset + request.size]
        if not piece:
            raise _RefusedError(END_OF_FILE)
        return piece

    def _list(self, request: Request) -> bytes:
        """Entries from the given number on, as many as fit; behind the last one, "end of file"."""
        logs = self._vehicle_log.logs
        folders = {**_FOLDERS, LOG_FOLDER: tuple(f"F{_name(log.number)}\t{len(log.data)}" for log in logs)}
        if request.path not in folders:
            raise _RefusedError(NOT_FOUND)
        listing = b""
        for entry in folders[request.path][request.offset :]:
            if len(listing) + len(entry) + 1 > DATA_BYTES:
                break
            listing += entry.encode("ascii") + b"\0"
        if not listing:
            raise _RefusedError(END_OF_FILE)
        return listing


def _name(number: int) -> str:
    return f"log{number:03d}.ulg"


def _frame(request: Request, opcode: int, sequence: int, offset: int, data: bytes, *, complete: bool = False) -> bytes:
    session = (
        SESSION if opcode == ACK else request.session
    )  # PX4 answers in place: only opening a file gives its session's number
    header = (sequence & 0xFFFF, session, opcode, len(data), request.opcode, int(complete), 0, offset)
    return _HEADER.pack(*header) + data
