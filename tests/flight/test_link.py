"""Vehicle link: what PX4 says becomes a dated state, what we say reaches it once and is answered, against the real gateway."""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from stand import Stand

from flight.errors import MissionError, NoVehicleError, RefusedError, VehicleCommandError
from flight.link import VehicleLink
from flight.mavsdk_support import check_port_is_free
from flight.px4 import FlightMode, mode_name, mode_of
from flight.telemetry import MAX_DRIFT, MESSAGES, Attitude, BootClock, Imu, Telemetry, acceleration_ned
from safety.frames import CorridorFrame, CorridorVector, NedVector
from safety.messages import SafeCommand

NORTH = CorridorFrame(NedVector(0.0, 0.0, 0.0), 0.0)
EAST = CorridorFrame(NedVector(0.0, 0.0, 0.0), math.pi / 2)


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Iterator[Stand]:
    stand = Stand(tmp_path_factory.mktemp("link"), seeker_policy)
    gateway = stand.gateway()
    yield stand
    gateway.stop()


@pytest.fixture(scope="module")
def link(stand: Stand) -> Iterator[VehicleLink]:
    with VehicleLink(f"udpin://127.0.0.1:{stand.onboard_port}") as link:
        link.connect(15.0)
        link.request_stream_rates(50.0)
        assert link.wait_until(lambda: link.state(NORTH) is not None, 10.0)
        yield link


def test_state_is_fresh_and_at_rest_on_the_ground(link: VehicleLink) -> None:
    state = link.state(NORTH)
    assert state is not None
    assert -0.005 <= time.monotonic() - state.time_s < 0.2
    assert math.hypot(state.velocity.x, state.velocity.y, state.velocity.z) < 0.5
    assert math.hypot(state.acceleration.x, state.acceleration.y, state.acceleration.z) < 1.0
    assert link.armed is False


def test_stream_rates_are_raised(link: VehicleLink) -> None:
    before = dict(link.telemetry.counts)
    time.sleep(2.0)
    for name in ("LOCAL_POSITION_NED", "ATTITUDE", "HIGHRES_IMU"):
        rate_hz = (link.telemetry.counts[name] - before[name]) / 2.0
        assert 35.0 < rate_hz < 60.0, (name, rate_hz)


def test_parameters_are_written_and_read_back(link: VehicleLink) -> None:
    link.set_parameter("COM_OF_LOSS_T", 0.5)
    link.set_parameter("COM_OBL_RC_ACT", 5)
    assert link.get_parameter("COM_OF_LOSS_T", float) == pytest.approx(0.5)
    assert link.get_parameter("COM_OBL_RC_ACT", int) == 5


def test_a_parameter_that_does_not_exist_is_refused_by_name(link: VehicleLink) -> None:
    with pytest.raises(VehicleCommandError, match="NO_SUCH_PARAM"):
        link.set_parameter("NO_SUCH_PARAM", 1.0)


def test_a_refused_command_says_so(link: VehicleLink) -> None:
    with pytest.raises(VehicleCommandError, match=r"refused a nonsense command: unsupported"):
        link.command_long(31999, what="a nonsense command")


@pytest.mark.realtime
def test_arms_streams_and_engages_offboard(link: VehicleLink) -> None:
    """On the ground with zero velocity: nothing lifts off. The stream is what keeps OFFBOARD alive."""
    still = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)
    deadline = time.monotonic() + 15.0
    while True:
        try:
            link.arm()
            break
        except VehicleCommandError:
            assert time.monotonic() < deadline
            time.sleep(0.3)
    sent = link.setpoints_sent
    link.open_stream()
    try:
        for _ in range(20):
            link.send_velocity(still, NORTH)
            time.sleep(0.05)
        link.set_mode(FlightMode.OFFBOARD, keep_alive=lambda: link.send_velocity(still, NORTH) and None)
        assert link.mode == FlightMode.OFFBOARD
        assert link.setpoints_sent >= sent + 20
        # PX4's first ack of a mode command always says accepted; Position mode needs sticks, and is not entered
        with pytest.raises(VehicleCommandError, match="POSCTL"):
            link.set_mode(FlightMode.POSCTL, keep_alive=lambda: link.send_velocity(still, NORTH) and None)
        assert link.mode == FlightMode.OFFBOARD
        # one-shot: without this program's sends PX4 leaves OFFBOARD by itself
        assert link.wait_until(lambda: link.mode != FlightMode.OFFBOARD, 3.0)
    finally:
        link.disarm()
    assert link.wait_until(lambda: not link.armed, 3.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_nothing_that_is_not_finite_goes_out(link: VehicleLink, bad: float) -> None:
    sent = link.setpoints_sent
    for command in (SafeCommand(CorridorVector(bad, 0.0, 0.0), 0.0), SafeCommand(CorridorVector(0.0, 0.0, 0.0), bad)):
        with pytest.raises(ValueError, match="not finite"):
            link.send_velocity(command, NORTH)
    assert link.setpoints_sent == sent


def test_no_vehicle(seeker_policy: Path, tmp_path: Path) -> None:
    port = Stand(tmp_path, seeker_policy).onboard_port
    started = time.monotonic()
    with VehicleLink(f"udpin://127.0.0.1:{port}") as link, pytest.raises(NoVehicleError, match=f"no vehicle answering.*{port}"):
        link.connect(1.0)
    assert time.monotonic() - started < 5.0


def test_a_listening_port_in_use_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(RefusedError, match=f"{port}.*in use"):
            check_port_is_free(f"udpin://127.0.0.1:{port}")
    check_port_is_free(f"udpin://127.0.0.1:{port}")
    check_port_is_free("serial:///dev/null:57600")


def test_an_impossible_device_is_refused() -> None:
    with VehicleLink("serial:///dev/no-such-device:57600") as link, pytest.raises((RefusedError, MissionError)):
        link.connect(1.0)


# -- telemetry, without a vehicle -------------------------------------------------------------------------------------


def fed(*messages: tuple[str, dict[str, object], float]) -> Telemetry:
    telemetry = Telemetry()
    for name, fields, arrival_s in messages:
        telemetry.feed(name, 1, json.dumps(fields), arrival_s)
    return telemetry


def position(boot_ms: int, x: float = 0.0) -> dict[str, object]:
    return {"time_boot_ms": boot_ms, "x": x, "y": 0.0, "z": -2.0, "vx": 1.0, "vy": 0.0, "vz": 0.0}


def attitude(boot_ms: int) -> dict[str, object]:
    return {"time_boot_ms": boot_ms, "roll": 0.0, "pitch": 0.0, "yaw": 0.0, "yawspeed": 0.1}


def imu(boot_ms: int) -> dict[str, object]:
    return {"time_usec": 1000 * boot_ms, "xacc": 0.0, "yacc": 0.0, "zacc": -9.80665}


def test_state_in_the_corridor_of_a_vehicle_facing_north() -> None:
    telemetry = fed(
        ("LOCAL_POSITION_NED", position(1000, x=3.0), 50.0),
        ("ATTITUDE", attitude(1010), 50.01),
        ("HIGHRES_IMU", imu(1010), 50.01),
    )
    state = telemetry.state(EAST)  # corridor x is east: north is to the left
    assert state is not None
    assert state.position.x == pytest.approx(0.0, abs=1e-9)
    assert state.position.y == pytest.approx(3.0)
    assert state.position.z == pytest.approx(2.0)
    assert state.velocity.y == pytest.approx(1.0)
    assert state.yaw_rad == pytest.approx(math.pi / 2)
    assert state.yaw_rate_rad_s == pytest.approx(-0.1)
    assert state.acceleration.z == pytest.approx(0.0, abs=1e-9)
    assert state.time_s == pytest.approx(50.0)


def test_a_state_is_as_old_as_its_oldest_part() -> None:
    telemetry = fed(
        ("LOCAL_POSITION_NED", position(1000), 50.0),
        ("ATTITUDE", attitude(1000), 50.0),
        ("HIGHRES_IMU", imu(1000), 50.0),
        ("ATTITUDE", attitude(1500), 50.5),
        ("HIGHRES_IMU", imu(1500), 50.5),
    )
    state = telemetry.state(NORTH)
    assert state is not None
    assert state.time_s == pytest.approx(50.0)


def test_duplicates_and_overtaken_samples_are_dropped() -> None:
    telemetry = fed(
        ("LOCAL_POSITION_NED", position(1000, x=1.0), 50.0),
        ("LOCAL_POSITION_NED", position(1020, x=2.0), 50.02),
        ("LOCAL_POSITION_NED", position(1020, x=9.0), 50.03),
        ("LOCAL_POSITION_NED", position(1000, x=9.0), 50.03),
    )
    assert telemetry.position is not None
    assert telemetry.position.position.x == 2.0
    assert telemetry.dropped == 2


def test_a_reboot_is_noticed() -> None:
    telemetry = fed(("LOCAL_POSITION_NED", position(90_000), 50.0), ("LOCAL_POSITION_NED", position(200, x=1.0), 51.0))
    assert telemetry.clock.reboots == 1
    assert telemetry.position is not None
    assert telemetry.position.position.x == 1.0


@pytest.mark.parametrize("bad", ["NaN", "Infinity", "null", '"1"', "true"])
def test_what_is_not_a_finite_number_is_dropped(bad: str) -> None:
    telemetry = Telemetry()
    telemetry.feed("LOCAL_POSITION_NED", 1, json.dumps(position(1000)).replace("-2.0", bad), 50.0)
    assert telemetry.position is None
    assert telemetry.dropped == 1


def test_another_component_is_not_the_autopilot() -> None:
    telemetry = Telemetry()
    telemetry.feed("HEARTBEAT", 191, '{"autopilot": 8, "base_mode": 0, "custom_mode": 0}', 1.0)
    assert telemetry.autopilot is None


@given(st.sampled_from(MESSAGES), st.text(max_size=60) | st.lists(st.floats() | st.text(max_size=5), max_size=5).map(repr))
def test_feed_never_raises(name: str, text: str) -> None:
    telemetry = Telemetry()
    telemetry.feed(name, 1, text, 1.0)
    assert telemetry.counts == {}


@given(
    st.lists(st.tuples(st.floats(0.001, 0.1), st.floats(0.0, 0.2)), min_size=2, max_size=60),
    st.floats(-1e4, 1e6),
)
def test_samples_are_never_dated_after_their_arrival(steps: list[tuple[float, float]], offset_s: float) -> None:
    clock, boot_s = BootClock(), 10.0
    for step_s, delay_s in steps:
        boot_s += step_s
        arrival_s = boot_s + offset_s + delay_s
        assert clock.to_monotonic(boot_s, arrival_s) <= arrival_s + 1e-9


def test_a_link_that_turns_slow_shows_as_age() -> None:
    clock = BootClock()
    for k in range(100):
        clock.to_monotonic(k * 0.02, 100.0 + k * 0.02)
    ages = []
    for k in range(100, 200):
        arrival_s = 100.0 + k * 0.02 + 0.3
        ages.append(arrival_s - clock.to_monotonic(k * 0.02, arrival_s))
    assert min(ages) > 0.3 - 3.0 * MAX_DRIFT
    assert ages[0] == pytest.approx(0.3, abs=2 * MAX_DRIFT)


def test_a_vehicle_clock_that_drifts_is_followed() -> None:
    """0.5 % slow, as no crystal is: the age after ten minutes is still that of the link."""
    clock = BootClock()
    for k in range(0, 30_000, 2):
        arrival_s = k * 0.02
        age_s = arrival_s - clock.to_monotonic(0.995 * arrival_s, arrival_s)
    assert age_s < 0.02


def test_acceleration_takes_gravity_and_tilt_out() -> None:
    """Pitched nose down in level unaccelerated flight the specific force is still straight up."""
    pitch = math.radians(-20.0)
    force = NedVector(9.80665 * math.sin(pitch), 0.0, -9.80665 * math.cos(pitch))
    level = acceleration_ned(Imu(0.0, force), Attitude(0.0, 0.0, pitch, 1.0, 0.0))
    assert max(abs(level.x), abs(level.y), abs(level.z)) < 1e-9
    ahead = acceleration_ned(Imu(0.0, NedVector(2.0, 0.0, -9.80665)), Attitude(0.0, 0.0, 0.0, math.pi / 2, 0.0))
    assert (ahead.x, ahead.y, ahead.z) == pytest.approx((0.0, 2.0, 0.0), abs=1e-9)


def test_modes_as_px4_packs_them() -> None:
    assert mode_of(393216) == FlightMode.OFFBOARD
    assert mode_of(50593792) == FlightMode.HOLD
    assert mode_of(100925440) == FlightMode.LAND
    assert mode_of(33816576) == FlightMode.TAKEOFF
    assert (FlightMode.LAND.main, FlightMode.LAND.sub) == (4, 6)
    assert mode_name(FlightMode.RTL) == "RTL"
    assert mode_name(4 | 9 << 8) == "mode 4.9"
    assert mode_name(None) == "unknown"


def test_a_clock_that_stood_still_is_caught_by_the_next_answer_and_a_slow_link_is_not_excused() -> None:
    clock = BootClock()
    for k in range(100):
        clock.to_monotonic(10.0 + 0.02 * k, 100.0 + 0.02 * k)
    # the simulator stood still for 0.6 s: without proof the samples look old ...
    assert 102.6 - clock.to_monotonic(12.0, 102.6) > 0.5
    # ... the answer to a question asked after the pause proves that the clock, not the link, is late
    clock.bound(12.05, 102.65)
    assert clock.slips == 1
    assert 0.0 <= 102.7 - clock.to_monotonic(12.1, 102.7) < 0.01
    # a link that delays the answer by 0.6 s proves nothing: the question was asked long ago
    clock.bound(12.2, 102.8)
    assert clock.slips == 1
    assert 103.5 - clock.to_monotonic(12.3, 103.5) > 0.5


@given(st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_no_answer_can_make_a_sample_look_younger_than_it_is(way_out_s: float, way_back_s: float) -> None:
    clock, true_offset_s = BootClock(), 90.0
    for k in range(50):
        clock.to_monotonic(10.0 + 0.02 * k, true_offset_s + 10.0 + 0.02 * k)
    asked_s = 101.5
    clock.bound(asked_s + way_out_s - true_offset_s, asked_s)
    boot_s = asked_s + way_out_s + way_back_s - true_offset_s
    assert clock.to_monotonic(boot_s, boot_s + true_offset_s) <= boot_s + true_offset_s + 1e-9
    assert clock.slips == 0


def test_the_vehicle_answers_the_question_for_its_time(link: VehicleLink) -> None:
    before = link.telemetry.counts.get("TIMESYNC", 0)
    for _ in range(5):
        link.ask_time()
        time.sleep(0.05)
    assert link.wait_until(lambda: link.telemetry.counts.get("TIMESYNC", 0) >= before + 5, 2.0)
    assert link.telemetry.clock.slips == 0
