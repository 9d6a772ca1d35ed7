"""Our frames are pymavlink's, byte for byte, but for the sequence number that they count."""

from __future__ import annotations

import struct

import pytest
from mavlink_bench import Bench
from pymavlink.dialects.v20 import development as mav

from sim_gateway.mavlink_frame import FramePacker
from sim_gateway.stream_rates import STREAM_RATES_HZ


def _samples() -> list[object]:
    bench = Bench()
    bench.run(4.0)
    telemetry = bench.server._telemetry
    messages = [telemetry.build(name) for name in (*STREAM_RATES_HZ, "AUTOPILOT_VERSION") if telemetry.available(name)]
    bench.close()
    return [
        *messages,
        mav.MAVLink_statustext_message(6, b"takeoff detected"),
        mav.MAVLink_param_value_message(b"COM_OF_LOSS_T", 1.0, 9, 875, 284),
        mav.MAVLink_command_ack_message(0, 0, 0, 0, 0, 0),
        mav.MAVLink_log_data_message(1, 90, 3, [7] * 90),
        mav.MAVLink_obstacle_distance_message(5, 0, [100] * 72, 5, 10, 400, 0.0, -90.0, 12),
    ]


def test_frames_are_those_of_pymavlink() -> None:
    ours, theirs = FramePacker(3, 1), mav.MAVLink(None, srcSystem=3, srcComponent=1)
    samples = _samples()
    assert len(samples) > 30
    for index, message in enumerate(samples * 9):
        theirs.seq = index & 0xFF
        frame = ours.pack(message)
        assert frame == message.pack(theirs), message
    decoded = mav.MAVLink(None).parse_buffer(bytearray(ours.pack(samples[0])))
    assert decoded is not None
    assert decoded[0].get_type() == samples[0].get_type()


def test_a_value_outside_its_field_is_refused() -> None:
    packer = FramePacker(1, 1)
    with pytest.raises(struct.error):
        packer.pack(mav.MAVLink_command_ack_message(-1, 0, 0, 0, 0, 0))
    assert packer.pack(mav.MAVLink_command_ack_message(1, 0, 0, 0, 0, 0))[4] == 0, "nothing was sent before"
