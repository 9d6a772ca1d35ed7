"""Messages that the MAVLink library lacks: their checksums are those of MAVLink's own generator, and they make whole frames."""

from __future__ import annotations

import struct

import pytest
from pymavlink.dialects.v20 import development as mav

from sim_gateway.census_messages import current_event_sequence, link_node_status, time_estimate_to_target
from sim_gateway.newer_messages import (
    CurrentEventSequence,
    LinkNodeStatus,
    NewerMessage,
    TimeEstimateToTarget,
    _fields,
    crc_extra,
)


@pytest.mark.parametrize(("kind", "expected"), [(LinkNodeStatus, 117), (TimeEstimateToTarget, 232), (CurrentEventSequence, 106)])
def test_checksum_byte_is_that_of_the_official_headers(kind: type[NewerMessage], expected: int) -> None:
    assert crc_extra(kind.msgname, _fields(kind.definition)) == expected


def test_the_rule_gives_the_checksum_of_a_message_that_the_library_knows() -> None:
    known = "uint8_t standard_mode, uint32_t custom_mode, uint32_t intended_custom_mode"
    assert crc_extra("CURRENT_MODE", _fields(known)) == mav.MAVLink_current_mode_message.crc_extra


def test_frames_carry_id_and_fields() -> None:
    packer = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    frame = time_estimate_to_target().pack(packer)
    assert int.from_bytes(frame[7:10], "little") == 380
    assert struct.unpack("<5i", frame[10:30]) == (-1, -1, -1, -1, -1)
    assert struct.unpack("<Q", link_node_status(123456).pack(packer)[10:18].ljust(8, b"\0"))[0] & 0xFFFFFF == 123456
    assert current_event_sequence().pack(packer)[10:12] == b"\xff\xff"
