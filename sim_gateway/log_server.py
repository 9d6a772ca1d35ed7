"""The MAVLink log protocol: a client lists the vehicle's logs, asks for their bytes in pieces, and may erase them.

Sizes are those at the moment of listing, so that a log that still grows can be fetched. Data go out a few pieces a poll, as over
a link of limited speed; one request at a time, a new one replaces the old.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import development as mav

from sim_gateway.telemetry import Message
from sim_gateway.vehicle_log import Log, VehicleLog

PIECE_BYTES = 90
_PIECES_PER_POLL = 10

Send = Callable[[Message], None]


@dataclass(slots=True)
class _Transfer:
    log: Log
    position: int
    end: int
    send: Send


class LogServer:
    """Answers for the logs of `vehicle_log`. `poll` sends what is due; nothing blocks."""

    def __init__(self, vehicle_log: VehicleLog) -> None:
        self._vehicle_log = vehicle_log
        self._listed: dict[int, int] = {}
        self._transfer: _Transfer | None = None

    def on_list(self, m: Message, send: Send) -> None:
        """LOG_REQUEST_LIST: an entry for each log from `start` to `end`; where there is none, one that says so."""
        logs = list(self._vehicle_log.logs)
        last = logs[-1].number if logs else 0
        self._listed = {log.number: len(log.data) for log in logs}
        if not logs:
            send(mav.MAVLink_log_entry_message(0, 0, 0, 0, 0))
        for log in logs:
            if m.start <= log.number <= m.end:
                size = self._listed[log.number]
                send(mav.MAVLink_log_entry_message(log.number, len(logs), last, log.utc_s, size))

    def on_data(self, m: Message, send: Send) -> None:
        """LOG_REQUEST_DATA: `count` bytes from `ofs`. A piece shorter than 90 bytes says that the log ends with it."""
        log = next((log for log in self._vehicle_log.logs if log.number == m.id), None)
        if log is None:
            return
        size = self._listed.get(log.number, len(log.data))
        self._transfer = _Transfer(log, m.ofs, min(m.ofs + m.count, size), send)
        if m.ofs >= size:
            self._send_piece(self._transfer)

    def on_end(self, _: Message, __: Send) -> None:
        """LOG_REQUEST_END: the client has what it wants."""
        self._transfer = None

    def on_erase(self, _: Message, __: Send) -> None:
        """LOG_ERASE."""
        self._transfer = None
        self._vehicle_log.erase()

    def poll(self) -> None:
        """Send the next pieces of what was asked for."""
        transfer = self._transfer
        for _ in range(_PIECES_PER_POLL if transfer is not None else 0):
            if transfer is None or transfer.position >= transfer.end:
                self._transfer = None
                return
            self._send_piece(transfer)

    @staticmethod
    def _send_piece(transfer: _Transfer) -> None:
        start = transfer.position
        data = bytes(transfer.log.data[start : min(start + PIECE_BYTES, transfer.end)])
        transfer.position += max(len(data), 1)
        padded = list(data.ljust(PIECE_BYTES, b"\0"))
        transfer.send(mav.MAVLink_log_data_message(transfer.log.number, start, len(data), padded))
