"""Frames out of a stream of bytes, whatever else is in it."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v10 import common as mav1
from pymavlink.dialects.v20 import development as mav

from sim_gateway.frame_reader import FrameReader, decode

MESSAGES = [
    mav.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3),
    mav.MAVLink_hil_actuator_controls_message(4000, [0.5] * 4 + [0.0] * 12, 129, 1),
    mav.MAVLink_attitude_message(1000, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0),
]


def _packed(*messages: mav.MAVLink_message) -> bytes:
    return b"".join(message.pack(mav.MAVLink(None, srcSystem=7, srcComponent=9)) for message in messages)


@settings(deadline=None)
@given(st.lists(st.integers(1, 40), max_size=20))
def test_frames_come_whole_from_pieces_of_any_size(cuts: list[int]) -> None:
    data, reader, found = _packed(*MESSAGES), FrameReader(), []
    for cut in cuts:
        found += reader.feed(data[:cut])
        data = data[cut:]
    found += reader.feed(data)
    assert [frame.number for frame in found] == [0, 93, 30]
    assert {(frame.system, frame.component) for frame in found} == {(7, 9)}
    assert abs(decode(found[2]).yaw - 0.3) < 1e-6


@settings(deadline=None)
@given(st.binary(max_size=300), st.binary(max_size=600))
def test_garbage_before_and_between_loses_no_frame_for_good(before: bytes, between: bytes) -> None:
    """A start byte in the garbage may hide what follows, but not for longer than the longest frame."""
    reader = FrameReader()
    reader.feed(before + _packed(MESSAGES[0]) + between)
    filler = bytes(600)
    assert [frame.number for frame in reader.feed(filler + _packed(MESSAGES[2]))][-1:] == [30]


def test_wrong_checksum_unknown_message_and_flags_are_skipped() -> None:
    good = _packed(MESSAGES[0])
    broken = bytearray(good)
    broken[12] ^= 1
    unknown = bytearray(good)
    unknown[7:10] = (0xFF, 0xFF, 0x7F)
    flagged = bytearray(good)
    flagged[2] = 0x80
    reader = FrameReader()
    assert reader.feed(bytes(broken) + bytes(unknown) + bytes(flagged)) == []
    assert [frame.number for frame in reader.feed(bytes(300) + good)] == [0]


def test_what_is_kept_is_bounded() -> None:
    reader = FrameReader()
    for _ in range(50):
        reader.feed(b"\xfd" * 4096)
    assert len(reader._rest) <= 300


def test_first_version_of_the_protocol() -> None:
    message = mav1.MAVLink_heartbeat_message(2, 12, 81, 0, 4, 3)
    (frame,) = FrameReader().feed(message.pack(mav1.MAVLink(None, srcSystem=3, srcComponent=4)))
    assert (frame.number, frame.system, frame.component) == (0, 3, 4)
    assert decode(frame).autopilot == 12
