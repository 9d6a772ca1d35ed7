"""The guard's state machine and its bytes: never a moving message older than the bound, silence is final, nobody else steers."""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mav

from flight.guard.core import STILL, Command, GuardCore, Reason, State
from flight.guard.wire import (
    STEERING,
    FrameStream,
    ModeReport,
    pack_setpoint,
    read_frames,
    read_mode,
    x25,
)

AHEAD = (1.0, 0.0, 0.0, 0.2)
OFFBOARD, HOLD = ModeReport(1, 6, True), ModeReport(1, 4)
TICK_S = 0.05


def command(sequence: int, stamp_s: float, setpoint: tuple[float, float, float, float] = AHEAD, engagement: int = 1) -> Command:
    return Command(engagement, sequence, stamp_s, setpoint)


def following(until_s: float = 1.0) -> tuple[GuardCore, int]:
    """A guard in OFFBOARD that has followed 20 Hz commands up to `until_s`; and the next sequence number."""
    core, sequence = GuardCore(), 0
    core.engage(1)
    core.heard(OFFBOARD)
    while (stamp_s := sequence * TICK_S) <= until_s + 1e-9:
        sequence += 1
        assert core.admit(command(sequence, stamp_s), stamp_s + 0.001)
    return core, sequence + 1


def brakes(core: GuardCore, from_s: float, to_s: float, step_s: float = 0.005) -> list[float]:
    """When the guard sends zero velocity by itself."""
    steps = round((to_s - from_s) / step_s)
    return [now_s for k in range(steps) if core.brake_due(now_s := from_s + k * step_s)]


# -- the beat -----------------------------------------------------------------------------------------------------------


def test_a_missed_beat_brakes_for_half_a_second_then_is_silent_for_good() -> None:
    core, sequence = following(1.0)
    times = brakes(core, 1.0, 5.0)
    assert times[0] == pytest.approx(1.101, abs=0.006)
    assert times[-1] <= 1.001 + core.timing.beat_s + core.timing.brake_s
    assert [b - a for a, b in pairwise(times)] == pytest.approx([TICK_S] * (len(times) - 1), abs=0.006)
    assert (core.state, core.reason) == (State.SILENT, Reason.MISSED_BEAT)
    assert not core.admit(command(sequence, 5.0), 5.0)
    assert brakes(core, 5.0, 8.0) == []


def test_a_loop_that_comes_back_in_time_is_followed_again() -> None:
    core, sequence = following(1.0)
    assert len(brakes(core, 1.0, 1.4)) >= 5
    assert core.admit(command(sequence, 1.4, STILL), 1.4)
    assert core.admit(command(sequence + 1, 1.45), 1.45)
    assert core.state is State.FOLLOW
    assert brakes(core, 1.45, 1.5) == []


def test_a_guard_that_was_itself_held_up_makes_up_for_nothing() -> None:
    core, sequence = following(1.0)
    assert not core.brake_due(6.0)
    assert core.state is State.SILENT
    assert not core.admit(command(sequence, 6.0), 6.0)
    core, _ = following(1.0)
    assert [core.brake_due(1.4), core.brake_due(1.4)] == [True, False]


def test_only_a_new_engagement_ends_the_silence() -> None:
    core, sequence = following(1.0)
    core.advance(9.0)
    core.engage(1)
    assert not core.admit(command(sequence, 9.0), 9.0)
    core.engage(2)
    assert not core.admit(command(sequence, 9.0), 9.0)
    assert core.admit(command(1, 9.0, engagement=2), 9.0)


@pytest.mark.parametrize(
    ("spoilt", "now_s"),
    [
        (command(99, 1.02), 1.121),
        (command(99, 1.08), 1.05),
        (command(99, 1.0), 1.05),
        (command(3, 1.05), 1.05),
        (command(99, 1.05, (math.nan, 0.0, 0.0, 0.0)), 1.05),
        (command(99, 1.05, (0.0, 0.0, 0.0, math.inf)), 1.05),
        (command(99, math.nan), 1.05),
        (command(99, 1.05, engagement=2), 1.05),
    ],
    ids=["old", "future", "not newer", "out of order", "nan", "inf", "nan stamp", "foreign engagement"],
)
def test_what_may_not_go_out(spoilt: Command, now_s: float) -> None:
    core, sequence = following(1.0)
    assert not core.admit(spoilt, now_s)
    assert core.admit(command(sequence, now_s), now_s)


# -- pilot first --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("report", [HOLD, ModeReport(1, 3, True), ModeReport(1, 6, False)], ids=["hold", "position", "disarmed"])
def test_after_the_vehicle_left_offboard_not_even_a_brake_is_sent(report: ModeReport) -> None:
    core, sequence = following(1.0)
    core.heard(report)
    assert brakes(core, 1.0, 3.0) == []
    assert not core.admit(command(sequence, 1.05), 1.05)
    core.heard(OFFBOARD)
    assert not core.admit(command(sequence + 1, 1.1), 1.1)


def test_a_mode_change_stops_a_brake_that_has_begun() -> None:
    core, _ = following(1.0)
    assert len(brakes(core, 1.0, 1.2)) == 2
    core.heard(HOLD)
    assert brakes(core, 1.2, 3.0) == []


def test_disengaged_is_silent_at_once() -> None:
    core, sequence = following(1.0)
    core.disengage()
    assert not core.admit(command(sequence, 1.05), 1.05)
    assert brakes(core, 1.0, 3.0) == []
    assert core.next_s() == math.inf


def test_before_offboard_there_is_nothing_to_brake() -> None:
    core = GuardCore()
    core.engage(1)
    core.heard(HOLD)
    assert core.admit(command(1, 0.0, STILL), 0.0)
    assert brakes(core, 0.0, 2.0) == []


# -- death and termination ----------------------------------------------------------------------------------------------


def test_an_orphan_brakes_at_once_and_is_finished() -> None:
    core, sequence = following(1.0)
    core.orphan(1.02)
    times = brakes(core, 1.02, 3.0)
    assert times[0] == pytest.approx(1.02)
    assert 0.4 < times[-1] - times[0] <= core.timing.brake_s
    assert not core.admit(command(sequence, 1.05), 1.05)
    core.engage(2)
    assert core.finished
    assert core.state is State.SILENT


def test_an_orphan_that_was_not_engaged_is_finished_at_once() -> None:
    core = GuardCore()
    core.orphan(1.0)
    assert core.finished


def test_told_to_end_it_lets_only_standing_still_through() -> None:
    core, sequence = following(1.0)
    core.terminate(1.01)
    assert core.brake_due(1.01)
    assert not core.admit(command(sequence, 1.05), 1.05)
    assert core.admit(command(sequence + 1, 1.1, STILL), 1.1)
    assert core.reason is Reason.TERMINATED
    core.disengage()
    core.engage(2)
    assert not core.admit(command(1, 1.2, STILL, engagement=2), 1.2)


def test_a_stop_between_check_and_send_ends_the_engagement() -> None:
    core, sequence = following(1.0)
    late = command(sequence, 1.05)
    assert core.admit(late, 1.05)
    assert not core.overran(late, 1.06)
    assert core.overran(late, 3.0)
    assert core.state is State.SILENT


# -- any order of events ------------------------------------------------------------------------------------------------

EVENTS = st.lists(
    st.tuples(
        st.floats(0.0, 0.3),
        st.sampled_from(["command", "old", "brake", "hold", "offboard", "disengage", "engage", "orphan", "terminate"]),
        st.booleans(),
    ),
    max_size=80,
)


@given(EVENTS)
def test_in_any_order_nothing_old_moves_and_silence_is_final(events: list[tuple[float, str, bool]]) -> None:
    core, now_s, sequence, engagement, silent = GuardCore(), 100.0, 0, 0, False
    for pause_s, what, moving in events:
        now_s += pause_s
        if what in ("command", "old"):
            sequence += 1
            stamp_s = now_s - (0.3 if what == "old" else 0.01)
            sent = core.admit(command(sequence, stamp_s, AHEAD if moving else STILL, engagement), now_s)
            assert not (sent and (silent or now_s - stamp_s > core.timing.max_age_s))
        elif what == "brake":
            assert not (core.brake_due(now_s) and silent)
        elif what == "engage":
            engagement += 1
            core.engage(engagement)
        elif what in ("hold", "offboard"):
            core.heard(OFFBOARD if what == "offboard" else HOLD)
        elif what == "disengage":
            core.disengage()
        else:
            getattr(core, what)(now_s)
        silent = core.state in (State.SILENT, State.IDLE)
        assert not silent or core.next_s() == math.inf


@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=60))
def test_between_two_messages_of_a_living_guard_lies_never_more_than_the_beat(pauses: list[float]) -> None:
    """Polled at its own deadlines, an engaged guard in OFFBOARD either follows, brakes, or has fallen silent."""
    core, sequence = following(1.0)
    now_s = last_s = 1.001
    for pause_s in pauses:
        until_s = now_s + pause_s
        while (due_s := core.next_s()) <= until_s:
            now_s = max(now_s, due_s + 1e-6)
            if core.brake_due(now_s):
                assert now_s - last_s <= core.timing.beat_s + 0.001
                last_s = now_s
        now_s = max(now_s, until_s)
        if core.admit(command(sequence, now_s), now_s):
            assert now_s - last_s <= core.timing.beat_s + 0.001
            last_s = now_s
        sequence += 1


# -- bytes --------------------------------------------------------------------------------------------------------------

floats = st.floats(-50.0, 50.0, width=32)


@given(st.integers(0, 300), st.integers(0, 2**33), st.tuples(floats, floats, floats), floats)
def test_the_setpoint_is_what_pymavlink_packs(sequence: int, boot_ms: int, velocity: tuple[float, ...], yaw_rate: float) -> None:
    packer = mav.MAVLink(None, srcSystem=245, srcComponent=192)
    packer.seq = sequence & 0xFF
    message = mav.MAVLink_set_position_target_local_ned_message(
        boot_ms & 0xFFFFFFFF, 1, 1, 1, 0x5C7, 0, 0, 0, *velocity, 0, 0, 0, 0, yaw_rate
    )
    assert pack_setpoint(sequence, boot_ms, (245, 192), (1, 1), velocity, yaw_rate) == bytes(message.pack(packer))


def test_steering_messages_are_known_by_their_numbers() -> None:
    names = ("set_position_target_local_ned", "set_position_target_global_int", "set_attitude_target", "manual_control")
    names += ("rc_channels_override", "set_actuator_control_target")
    assert {getattr(mav, f"MAVLink_{name}_message").id for name in names} == STEERING


def heartbeat(autopilot: int = 12, component: int = 1, custom_mode: int = 6 << 16, base_mode: int = 0x81) -> bytes:
    packer = mav.MAVLink(None, srcSystem=1, srcComponent=component)
    return bytes(mav.MAVLink_heartbeat_message(2, autopilot, base_mode, custom_mode, 4, 3).pack(packer))


def test_modes_are_read_from_an_autopilot_only() -> None:
    report = lambda data: read_mode(read_frames(data)[0][0])  # noqa: E731
    assert report(heartbeat()) == ModeReport(1, 6, True)
    assert report(heartbeat(custom_mode=4 << 16 | 3 << 24, base_mode=1)) == ModeReport(1, 4, False)
    assert report(heartbeat(autopilot=8)) is None
    assert report(heartbeat(component=190)) is None
    current = mav.MAVLink_current_mode_message(0, 3 << 16, 6 << 16).pack(mav.MAVLink(None, srcSystem=1, srcComponent=1))
    assert report(bytes(current)) == ModeReport(1, 3)
    old = mav.MAVLink_heartbeat_message(2, 12, 0x81, 6 << 16, 4, 3)
    assert report(bytes(old.pack(mav.MAVLink(None, 1, 1), force_mavlink1=True))) == ModeReport(1, 6, True)


@given(st.integers(10, 20), st.integers(1, 255))
def test_a_mode_with_a_wrong_checksum_is_not_believed(position: int, flip: int) -> None:
    data = bytearray(heartbeat())
    data[position] ^= flip
    frames, _ = read_frames(bytes(data))
    assert all(read_mode(frame) is None for frame in frames)


@given(st.binary(max_size=600))
def test_any_bytes_are_tolerated_and_little_is_kept(noise: bytes) -> None:
    frames, used = read_frames(noise)
    assert 0 <= used <= len(noise)
    assert len(noise) - used < 10 + 255 + 2 + 13
    assert sum(len(frame.raw) for frame in frames) <= used
    for frame in frames:
        read_mode(frame)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_a_stream_cut_anywhere_gives_the_same_frames(cuts: list[int]) -> None:
    data = heartbeat() + b"\x00noise" + pack_setpoint(1, 2, (245, 192), (1, 1), (1.0, 0.0, 0.0), 0.0) + heartbeat(component=7)
    stream, frames, at = FrameStream(), [], 0
    for size in [*cuts, len(data)]:
        frames += stream.feed(data[at : at + size])
        at += size
    assert [frame.message_id for frame in frames] == [0, 84, 0]


def test_the_checksum_is_the_published_one() -> None:
    """CRC-16/MCRF4XX of "123456789" is 0x6F91 (reveng catalogue)."""
    assert x25(b"12345678", ord("9")) == 0x6F91
    assert struct.unpack("<H", heartbeat()[-2:])[0] == x25(heartbeat()[1:-2], 50)
