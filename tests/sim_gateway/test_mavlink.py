"""The MAVLink side over real UDP sockets, with the vehicle in lockstep. Expected values: px4_reference recordings."""

from __future__ import annotations

import math
import os
import random
import struct
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mavlink_bench import Bench, Client
from pymavlink.dialects.v20 import development as mav

from sim_gateway.autopilot_output import StatusText
from sim_gateway.flight_modes import FlightMode, Result
from sim_gateway.mavlink_links import PortInUseError
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.newer_messages import NEWER_IDS
from sim_gateway.stream_rates import GROUND, ONBOARD, STREAM_RATES_HZ
from sim_gateway.telemetry import Telemetry

ACCEPTED, REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.run(3.5)
    bench.onboard.seen.clear()
    bench.ground.seen.clear()
    yield bench
    bench.close()


def test_rates_are_those_of_the_recorded_links(bench: Bench) -> None:
    seconds = 20.0
    bench.run(seconds)
    for client, column in ((bench.onboard, ONBOARD), (bench.ground, GROUND)):
        counts = Counter(message.get_type() for message in client.seen)
        for name, rates in STREAM_RATES_HZ.items():
            if name == "POSITION_TARGET_GLOBAL_INT":
                continue  # only while there is a position target: see test_conformance
            seen = f"UNKNOWN_{NEWER_IDS[name]}" if name in NEWER_IDS else name  # this client's library lacks them
            assert counts.pop(seen, 0) == pytest.approx(rates[column] * seconds, abs=1.01 + 0.01 * rates[column] * seconds), name
        assert not counts


def test_start_up_order_and_times() -> None:
    bench = Bench(ready_after_s=None)
    first: dict[str, float] = {}
    while bench.vehicle.time_s < 5.0:
        bench.run(0.02)
        for message in bench.onboard.seen:
            first.setdefault(message.get_type(), bench.vehicle.time_s)
        bench.onboard.seen.clear()
    bench.close()
    recorded = {
        "GPS_RAW_INT": 0.75,
        "LOCAL_POSITION_NED": 0.78,
        "HEARTBEAT": 1.76,
        "HOME_POSITION": 2.76,
        "GLOBAL_POSITION_INT": 3.29,
    }
    for name, time_s in recorded.items():
        assert first[name] == pytest.approx(time_s, abs=0.5), name


def test_heartbeat_values_of_the_recorded_modes(bench: Bench) -> None:
    def heartbeat() -> tuple[int, int, int]:
        bench.onboard.seen.clear()
        bench.run(1.1)
        beat = bench.onboard.named("HEARTBEAT")[-1]
        assert (beat.type, beat.autopilot, beat.mavlink_version) == (2, 12, 3)
        return beat.base_mode, beat.custom_mode, beat.system_status

    assert heartbeat() == (29, 0x3040000, 3)
    bench.pilot.arm()
    assert heartbeat() == (157, 0x3040000, 4)
    bench.pilot.takeoff()
    assert heartbeat() == (157, 0x2040000, 4)
    bench.run(8.0)
    assert heartbeat() == (157, 0x3040000, 4)
    bench.pilot.land()
    assert heartbeat() == (157, 0x6040000, 4)
    bench.pilot.return_to_launch()
    assert heartbeat() == (157, 0x5040000, 4)


def test_set_mode_gets_two_acks_and_others_one(bench: Bench) -> None:
    assert bench.acks(176, 1, 6) == [ACCEPTED, ACCEPTED]  # OFFBOARD while disarmed
    assert bench.acks(400, 1) == [REJECTED]  # no stream
    assert bench.acks(176, 1, 4, 3) == [ACCEPTED, ACCEPTED]
    assert bench.acks(400, 1) == [ACCEPTED]
    assert bench.acks(22, math.nan, 0, 0, math.nan, math.nan, math.nan, math.nan) == [ACCEPTED]
    bench.run(8.0)
    assert bench.pilot.mode is FlightMode.LOITER
    assert bench.acks(400, 0) == [REJECTED]
    assert bench.acks(176, 1, 6) == [ACCEPTED, REJECTED]
    assert bench.acks(176, 1, 3) == [ACCEPTED, REJECTED]
    assert bench.acks(176, 1, 4, 99) == [ACCEPTED, REJECTED]
    assert bench.acks(176, 1, 77) == [ACCEPTED, ACCEPTED]
    assert bench.acks(20) == [ACCEPTED]
    assert bench.pilot.mode is FlightMode.RTL
    assert bench.acks(21) == [ACCEPTED]
    assert bench.acks(192, -1, 0, 0, math.nan, math.nan, math.nan, math.nan) == [ACCEPTED]
    assert bench.pilot.mode is FlightMode.LOITER
    assert bench.acks(400, 0, 21196) == [ACCEPTED]


def test_other_commands(bench: Bench) -> None:
    expected = {
        (31999,): UNSUPPORTED,
        (17,): UNSUPPORTED,
        (193,): UNSUPPORTED,
        (512, 148): ACCEPTED,
        (512, 147): ACCEPTED,
        (512, 60001): DENIED,
        (512, math.nan): DENIED,
        (520, 1): ACCEPTED,
        (511, 60001, 20000): FAILED,
        (511, 0, 20000): FAILED,
        (178, 1, 3): ACCEPTED,
        (179, 1): ACCEPTED,
        (185, 0): DENIED,
    }
    for command, result in expected.items():
        assert bench.acks(*command) == [result], command
    assert bench.pilot.parameters.get("MPC_XY_CRUISE") == 3.0


def test_autopilot_version_follows_its_request(bench: Bench) -> None:
    bench.acks(512, 148)
    version = bench.onboard.named("AUTOPILOT_VERSION")[0]
    assert (version.capabilities, version.flight_sw_version) == (59647, 17891328)


def test_message_interval(bench: Bench) -> None:
    assert bench.acks(511, 32, 20000) == [ACCEPTED]
    bench.onboard.seen.clear()
    bench.run(2.0)
    assert len(bench.onboard.named("LOCAL_POSITION_NED")) == pytest.approx(100, abs=2)
    assert len(bench.ground.named("LOCAL_POSITION_NED")) > 50
    bench.acks(510, 32)
    reply = bench.onboard.named("MESSAGE_INTERVAL")[0]
    assert (reply.message_id, reply.interval_us) == (32, 20000)
    bench.acks(511, 32, -1)
    bench.onboard.seen.clear()
    bench.run(0.5)
    assert not bench.onboard.named("LOCAL_POSITION_NED")
    bench.acks(511, 32, 0)
    bench.run(1.0)
    assert len(bench.onboard.named("LOCAL_POSITION_NED")) == pytest.approx(33, abs=3)


def test_statustext_goes_to_ground_stations_only_in_chunks(bench: Bench) -> None:
    bench.pilot.say(6, "nobody listens yet")
    bench.run(0.1)
    bench.ground.send(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    bench.run(0.1)
    for text in ("short", "x" * 50, "y" * 51):
        bench.pilot.say(2, text)
    bench.run(0.1)
    texts = [(t.text, t.chunk_seq, t.id != 0) for t in bench.ground.named("STATUSTEXT")]
    assert texts == [("short", 0, False), ("x" * 50, 0, True), ("", 1, True), ("y" * 50, 0, True), ("y", 1, True)]
    assert not bench.onboard.named("STATUSTEXT")
    bench.run(6.0)
    bench.pilot.say(6, "gone")
    bench.run(0.1)
    assert "gone" not in [t.text for t in bench.ground.named("STATUSTEXT")]


def test_mode_and_landed_state_are_sent_at_once(bench: Bench) -> None:
    bench.run(1.0)
    bench.onboard.seen.clear()
    bench.pilot.set_mode(FlightMode.OFFBOARD)
    bench.run(0.008)
    assert [m.custom_mode for m in bench.onboard.named("CURRENT_MODE")] == [0x60000]


def test_wrong_target_is_ignored(bench: Bench) -> None:
    for system, component in ((2, 1), (1, 77)):
        bench.onboard.send(mav.MAVLink_command_long_message(system, component, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    bench.run(0.2)
    assert not bench.onboard.named("COMMAND_ACK")
    assert not bench.pilot.armed


def _setpoint(target: int = 1, frame: int = 1, vx: float = 0.5) -> Any:
    zero = (0.0,) * 3
    return mav.MAVLink_set_position_target_local_ned_message(0, target, 1, frame, 0x5C7, *zero, vx, 0, 0, *zero, 0, 0.0)


def test_setpoints_and_their_echo(bench: Bench) -> None:
    bench.pilot.arm()
    bench.pilot.takeoff()
    bench.run(8.0)
    for _ in range(20):
        bench.onboard.send(_setpoint())
        bench.run(0.05)
    assert bench.acks(176, 1, 6) == [ACCEPTED, ACCEPTED]
    for _ in range(40):
        bench.onboard.send(_setpoint(target=0))
        bench.run(0.05)
    echo = bench.onboard.named("POSITION_TARGET_LOCAL_NED")[-1]
    assert (echo.type_mask, echo.coordinate_frame, echo.vx) == (7, 1, 0.5)
    assert math.isnan(echo.x)
    velocity = bench.onboard.named("LOCAL_POSITION_NED")[-1]
    assert velocity.vx == pytest.approx(0.5, abs=0.15)
    for _ in range(26):
        bench.onboard.send(_setpoint(target=99))
        bench.run(0.05)
    assert bench.pilot.mode is FlightMode.RTL


def test_parameter_list_is_complete_and_paced(bench: Bench) -> None:
    for _ in range(3):  # repeated requests must not multiply the answer
        bench.onboard.send(mav.MAVLink_param_request_list_message(1, 1))
    bench.run(1.2)
    values = bench.onboard.named("PARAM_VALUE")
    assert len({value.param_id for value in values}) == len(values) == 876
    assert {value.param_count for value in values} == {875}
    by_name = {value.param_id: value for value in values}
    assert by_name["COM_OF_LOSS_T"].param_index == 284
    assert by_name["_HASH_CHECK"].param_index == 65535
    assert struct.unpack("<i", struct.pack("<f", by_name["SYS_AUTOSTART"].param_value))[0] == 10040


def test_parameter_read_and_set(bench: Bench) -> None:
    def replies(message: Any) -> list[float]:
        bench.onboard.seen.clear()
        bench.onboard.send(message)
        bench.run(0.1)
        return [value.param_value for value in bench.onboard.named("PARAM_VALUE")]

    assert replies(mav.MAVLink_param_request_read_message(1, 1, b"COM_OF_LOSS_T", -1)) == [1.0]
    assert replies(mav.MAVLink_param_request_read_message(1, 1, b"", 284)) == [1.0]
    assert replies(mav.MAVLink_param_request_read_message(1, 1, b"NO_SUCH_PARAM", -1)) == []
    assert replies(mav.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 0.5, 9)) == [0.5]
    assert replies(mav.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", 2.0, 9)) == []
    assert replies(mav.MAVLink_param_set_message(1, 1, b"NO_SUCH_PARAM", 1.0, 9)) == []
    assert bench.pilot.parameters.get("COM_OF_LOSS_T") == 0.5


def test_mission_timesync_and_ping_are_answered(bench: Bench) -> None:
    bench.onboard.send(mav.MAVLink_mission_request_list_message(1, 1, 0))
    bench.onboard.send(mav.MAVLink_timesync_message(0, 1234))
    bench.onboard.send(mav.MAVLink_ping_message(5, 77, 0, 0))
    bench.run(0.1)
    assert [m.count for m in bench.onboard.named("MISSION_COUNT")] == [0]
    assert [m.ts1 for m in bench.onboard.named("TIMESYNC") if m.tc1 != 0] == [1234]
    assert [m.seq for m in bench.onboard.named("PING") if m.target_system == 245] == [77]


def test_a_client_on_another_port_is_answered_too(bench: Bench) -> None:
    other = Client(bench.onboard.vehicle[1], 1 + 99, 1)
    other.command(512, 148)
    bench.run(0.2)
    other.drain()
    assert [ack.result for ack in other.named("COMMAND_ACK")] == [ACCEPTED]
    assert other.named("AUTOPILOT_VERSION")
    assert bench.onboard.named("ATTITUDE")
    bench.run(11.0)
    other.drain()
    other.seen.clear()
    bench.run(0.5)
    other.drain()
    assert not other.seen  # silent for 10 s: forgotten
    other.socket.close()


def test_port_in_use_is_named(bench: Bench) -> None:
    telemetry = Telemetry(bench.pilot, bench.vehicle.frame, bench.vehicle.snapshot, lambda: 0.0)
    port = bench.onboard.vehicle[1]
    with pytest.raises(PortInUseError, match=str(port)):
        MavlinkServer(bench.pilot, bench.vehicle.frame, telemetry, (port, 1), None)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(noise=st.lists(st.binary(max_size=400), max_size=8), cut=st.integers(1, 60), flip=st.integers(0, 60))
def test_bad_bytes_change_nothing(bench: Bench, noise: list[bytes], cut: int, flip: int) -> None:
    good = bytearray(mav.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0).pack(bench.onboard.mav))
    broken = bytearray(good)
    broken[flip % len(good)] ^= 0x55
    for data in (*noise, bytes(good[: min(cut, len(good) - 1)]), bytes(broken)):
        bench.onboard.socket.sendto(data, bench.onboard.vehicle)
    bench.run(0.02)
    assert not bench.pilot.armed
    assert bench.acks(512, 148) == [ACCEPTED]


def test_a_flood_neither_stops_the_vehicle_nor_grows_memory(bench: Bench) -> None:
    random.seed(1)
    frames = [
        os.urandom(200),
        _setpoint().pack(bench.ground.mav),
        mav.MAVLink_param_request_list_message(1, 1).pack(bench.ground.mav),
    ]
    for _ in range(50):
        for _ in range(200):
            bench.ground.socket.sendto(random.choice(frames), bench.ground.vehicle)
        bench.run(0.02)
        assert all(len(link.parameter_queue) <= 876 for link in bench.server.links)
    assert bench.acks(512, 148) == [ACCEPTED]
    for index in range(30):  # many clients: the table of peers stays small
        stranger = Client(bench.onboard.vehicle[1], 10 + index, 1)
        stranger.send(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        stranger.socket.close()
    bench.run(0.1)
    assert all(len(link._peers) <= 8 for link in bench.server.links)
    for _ in range(1000):
        bench.pilot.texts.append(StatusText(0.0, 6, "x"))
    assert len(bench.pilot.texts) <= 200
    assert bench.pilot.arm() is Result.ACCEPTED
