"""MAVLink FTP over the wire: folders, a flight's log by pieces and by burst, refusals."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mavlink_bench import Bench
from pymavlink.dialects.v20 import development as mav

from sim_gateway import file_server as fs

HEADER = struct.Struct("<HBBBBBBI")


@dataclass(frozen=True)
class Answer:
    sequence: int
    session: int
    opcode: int
    asked: int
    complete: int
    offset: int
    data: bytes


class Files:
    """A client of the file protocol."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.sequence = 0

    def ask(self, opcode: int, data: bytes = b"", *, offset: int = 0, size: int | None = None, session: int = 0) -> list[Answer]:
        self.bench.onboard.seen.clear()
        head = HEADER.pack(self.sequence, session, opcode, len(data) if size is None else size, 0, 0, 0, offset)
        self.sequence += 2
        payload = list((head + data).ljust(251, b"\0"))
        self.bench.onboard.send(mav.MAVLink_file_transfer_protocol_message(0, 1, 1, payload))
        self.bench.run(0.06)
        answers = []
        for message in self.bench.onboard.named("FILE_TRANSFER_PROTOCOL"):
            raw = bytes(message.payload)
            sequence, given, answer, length, asked, complete, _, place = HEADER.unpack_from(raw)
            answers.append(Answer(sequence, given, answer, asked, complete, place, raw[12 : 12 + length]))
        return answers

    def one(self, opcode: int, data: bytes = b"", **more: int) -> Answer:
        (answer,) = self.ask(opcode, data, **more)
        assert (answer.asked, answer.sequence) == (opcode, self.sequence - 1)
        return answer

    def refusal(self, opcode: int, data: bytes = b"", **more: int) -> int:
        answer = self.one(opcode, data, **more)
        assert answer.opcode == fs.NAK
        return answer.data[0]


@pytest.fixture(scope="module")
def flown() -> Iterator[Bench]:
    bench = Bench()
    bench.run(1.0)
    bench.pilot.arm()
    bench.run(4.0)
    bench.pilot.disarm()
    bench.run(0.5)
    yield bench
    bench.close()


def test_folders_lead_to_the_log(flown: Bench) -> None:
    files = Files(flown)
    assert files.one(fs.LIST, b"/").data == b"Dfs\0"
    assert files.one(fs.LIST, b"/fs/").data == b"Dmicrosd\0"
    size = len(flown.server.vehicle_log.logs[0].data)
    assert files.one(fs.LIST, b"/fs/microsd/log").data == f"Flog000.ulg\t{size}\0".encode()
    assert files.refusal(fs.LIST, b"/fs/microsd/log", offset=1) == fs.END_OF_FILE
    assert files.refusal(fs.LIST, b"/etc") == fs.NOT_FOUND


def test_a_log_read_in_pieces_and_by_burst_is_the_log(flown: Bench) -> None:
    files, log = Files(flown), bytes(flown.server.vehicle_log.logs[0].data)
    opened = files.one(fs.OPEN_READ, b"/fs/microsd/log/log000.ulg")
    assert struct.unpack("<I", opened.data)[0] == len(log)
    pieces = [files.one(fs.READ, offset=at, size=239).data for at in range(0, len(log), 239)]
    assert b"".join(pieces) == log
    assert files.refusal(fs.READ, offset=len(log), size=239) == fs.END_OF_FILE
    *burst, end = files.ask(fs.BURST, size=239)
    assert b"".join(answer.data for answer in burst) == log
    assert (end.opcode, end.data) == (fs.NAK, bytes([fs.END_OF_FILE]))
    assert files.one(fs.CHECKSUM, b"/fs/microsd/log/log000.ulg").opcode == fs.ACK
    files.one(fs.TERMINATE)
    assert files.refusal(fs.READ, size=10) == fs.INVALID_SESSION


def test_packed_parameters_are_not_there_and_nothing_can_be_changed(flown: Bench) -> None:
    files = Files(flown)
    refused = files.one(fs.OPEN_READ, b"@PARAM/param.pck", session=41)
    assert (refused.opcode, refused.data, refused.session) == (
        fs.NAK,
        bytes([fs.NOT_FOUND]),
        41,
    )  # else it is not heeded
    assert files.refusal(8, b"/fs/microsd/log/log000.ulg") == fs.PROTECTED
    assert files.refusal(77) == fs.UNKNOWN_COMMAND
    assert files.refusal(fs.READ, size=240) == fs.INVALID_SIZE
    assert files.refusal(fs.BURST, session=3, size=239) == fs.INVALID_SESSION


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 2**32 - 1), st.binary(max_size=239))
def test_whatever_is_asked_gets_one_answer_or_a_burst(flown: Bench, opcode: int, size: int, offset: int, data: bytes) -> None:
    answers = Files(flown).ask(opcode, data, offset=offset, size=size)
    assert answers if opcode == fs.BURST else len(answers) == 1
