"""A world for a vehicle that is elsewhere: its pose on our clock, and the scans it would have here."""

from __future__ import annotations

import math
import os
import pty
import socket
import threading
import time
import tty
from bisect import bisect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mav

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.follow_gateway import FollowConfig, FollowedDynamics, FollowGateway, warm_up
from sim_gateway.gateway import Gateway, GatewayConfig
from sim_gateway.gateway import warm_up as warm_up_gateway
from sim_gateway.local_frame import LocalFrame
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.pose_source import FollowUrlError, open_source
from sim_gateway.pose_tracker import PoseTracker
from sim_gateway.serial_port import SerialPortError
from sim_gateway.simulation import Simulation
from sim_gateway.telemetry import Telemetry
from tests.sim_gateway.mavlink_bench import EMPTY, Client, free_port

pytestmark = pytest.mark.timeout(120)

ZERO = (0.0, 0.0, 0.0)
SPEED, TURN = 2.0, 0.8  # of the vehicle below, m/s north and rad/s clockwise


def _sent(message: Any, system: int = 1) -> Any:
    """The message as it comes out of the wire."""
    data = message.pack(mav.MAVLink(None, srcSystem=system, srcComponent=1))
    return mav.MAVLink(None).decode(bytearray(data))


def _place(boot_s: float) -> Any:
    return mav.MAVLink_local_position_ned_message(round(1e3 * boot_s), SPEED * boot_s, 0.0, -2.0, SPEED, 0.0, 0.0)


def _attitude(boot_s: float) -> Any:
    yaw = math.remainder(TURN * boot_s, 2 * math.pi)
    return mav.MAVLink_attitude_message(round(1e3 * boot_s), 0.0, 0.0, yaw, 0.0, 0.0, TURN)


def _odometry(boot_s: float) -> Any:
    half = 0.5 * TURN * boot_s
    q = [math.cos(half), 0.0, 0.0, math.sin(half)]
    body = (SPEED * math.cos(2 * half), -SPEED * math.sin(2 * half), 0.0)
    nan = [math.nan] * 21
    rest = (0.0, 0.0, TURN, nan, nan, 0, 1, 90)
    return mav.MAVLink_odometry_message(round(1e6 * boot_s), 1, 12, SPEED * boot_s, 0.0, -2.0, q, *body, *rest)


def _flown(
    tracker: PoseTracker, delay: Callable[[int], float], *, ask: bool, odometry: bool = False
) -> list[tuple[float, float]]:
    """Errors (north m, yaw rad) of the tracked pose over 6 s of messages at 50 Hz that arrive late; clocks 1000 s apart."""
    arrivals: list[tuple[float, int, Any]] = []
    for index in range(300):
        boot_s = 100.0 + 0.02 * index
        messages = (_odometry(boot_s),) if odometry else (_place(boot_s), _attitude(boot_s))
        arrivals += [(1000.0 + boot_s + delay(index), index, _sent(message)) for message in messages]
    errors, now_s = [], 1100.0
    for step in range(1500):
        now_s = 1100.0 + 0.004 * step
        while arrivals and min(arrivals, key=lambda item: item[0])[0] <= now_s:
            arrivals.sort(key=lambda item: item[0])
            tracker.take(arrivals.pop(0)[2], now_s)
        if ask and step % 50 == 0:
            ours = tracker.ask(now_s - 0.1)
            tracker.take(_sent(mav.MAVLink_timesync_message(round((now_s - 0.05 - 1000.0) * 1e9), ours)), now_s)
        pose = tracker.pose(now_s)
        if step > 500 and pose is not None:
            w, _, _, z = pose.attitude
            yaw = math.remainder(2.0 * math.atan2(z, w) - TURN * (now_s - 1000.0), 2 * math.pi)
            errors.append((pose.position_m[0] - SPEED * (now_s - 1000.0), yaw))
    assert len(errors) > 900
    return errors


def _late(index: int) -> float:
    return 0.05 + 0.04 * (index * 7 % 10) / 10.0


@pytest.mark.parametrize("odometry", [False, True])
def test_delay_is_made_up_for_with_velocity_and_turn_rate(odometry: bool) -> None:
    for tracker, ask in ((PoseTracker(), True), (PoseTracker(latency_s=0.05), False)):
        errors = np.abs(_flown(tracker, _late, ask=ask, odometry=odometry)).max(axis=0)
        assert errors[0] < 0.012 * SPEED, "stamps in ms and steps of 4 ms are all that is left"
        assert errors[1] < 0.012 * TURN


def test_without_an_answer_only_the_least_delay_remains() -> None:
    errors = _flown(PoseTracker(), _late, ask=False)
    assert np.median([error for error, _ in errors]) == pytest.approx(-0.05 * SPEED, abs=0.01 * SPEED)


def test_a_stale_pose_is_none() -> None:
    tracker = PoseTracker(timeout_s=0.3)
    assert tracker.pose(5.0) is None
    tracker.take(_sent(_place(1.0)), 5.0)
    assert tracker.pose(5.0) is None, "a place alone is no pose"
    tracker.take(_sent(_attitude(1.0)), 5.0)
    assert tracker.pose(5.29) is not None
    assert tracker.pose(5.31) is None
    for index in range(20):
        tracker.take(_sent(_attitude(1.0 + 0.05 * index)), 5.0 + 0.05 * index)
    assert tracker.pose(5.95) is None, "a fresh attitude does not make an old place fresh"


def test_a_restarted_vehicle_is_followed_again_and_a_second_one_is_not() -> None:
    tracker = PoseTracker()
    for boot_s, now_s in ((100.0, 1.0), (0.5, 2.0)):
        tracker.take(_sent(_place(boot_s)), now_s)
        tracker.take(_sent(_attitude(boot_s)), now_s)
    tracker.take(_sent(_place(300.0), system=2), 2.0)
    pose = tracker.pose(2.1)
    assert pose is not None
    assert pose.position_m[0] == pytest.approx(SPEED * 0.6, abs=0.01)
    for message in (_place(300.0), _attitude(300.0)):
        tracker.take(_sent(message, system=2), 8.0)
    assert tracker.system_id == 2, "the first has been silent for long"


def test_what_is_no_pose_changes_nothing() -> None:
    tracker = PoseTracker()
    nan = math.nan
    tracker.take(_sent(mav.MAVLink_local_position_ned_message(1000, nan, 0, 0, 0, 0, 0)), 1.0)
    tracker.take(_sent(mav.MAVLink_attitude_message(1000, 0, nan, 0, 0, 0, 0)), 1.0)
    tracker.take(_sent(mav.MAVLink_attitude_quaternion_message(1000, 0, 0, 0, 0, 0, 0, 0)), 1.0)
    tracker.take(_sent(mav.MAVLink_timesync_message(5, 7)), 1.0)
    tracker.take(_sent(mav.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3)), 1.0)
    assert tracker.system_id is None
    assert tracker.pose(1.0) is None


speeds = st.floats(-3.0, 3.0)


@settings(deadline=None)
@given(st.floats(-6.0, 6.0), st.tuples(speeds, speeds, speeds), st.floats(-2.0, 2.0), st.integers(1, 300))
def test_a_pose_stands_in_the_corridor_as_the_gateways_own_telemetry_tells_it(
    heading: float, velocity: tuple[float, float, float], yaw_rate: float, steps: int
) -> None:
    """What our own vehicle reports of itself, followed with the same heading and origin, is where and how it stands."""
    simulation = Simulation(EMPTY, estimate="none", hover_height_m=5.0)
    simulation.advance(steps, velocity, yaw_rate)
    vehicle = PilotedVehicle(simulation, heading_rad=heading)
    telemetry = Telemetry(vehicle.autopilot, vehicle.frame, vehicle.snapshot, lambda: vehicle.time_s)
    tracker = PoseTracker()
    for name in ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"):
        tracker.take(_sent(telemetry.build(name)), 10.0)
    pose = tracker.pose(10.0)
    assert pose is not None
    dynamics = FollowedDynamics(LocalFrame(vehicle.frame.origin, heading))
    follower = Simulation(EMPTY, estimate="none", dynamics=dynamics)
    dynamics.pose = pose
    follower.advance(1, (0.0, 0.0, 0.0), 0.0)
    true, seen = simulation.truth, follower.truth
    assert seen.position_m == pytest.approx(true.position_m, abs=1e-4)
    assert seen.velocity_m_s == pytest.approx(true.velocity_m_s, abs=1e-4)
    turns = (true.roll_rad - seen.roll_rad, true.pitch_rad - seen.pitch_rad, true.yaw_rad - seen.yaw_rad)
    assert [math.remainder(turn, 2 * math.pi) for turn in turns] == pytest.approx([0.0] * 3, abs=1e-4)


@pytest.mark.parametrize(
    "url", ["", "14551", "udpin://", "udpin://127.0.0.1", "ftp://127.0.0.1:21", "udpin://nowhere.invalid:1", "serial:///dev/x"]
)
def test_urls_that_cannot_be_followed_say_what_to_write(url: str) -> None:
    with pytest.raises(FollowUrlError, match="udpin://127"):
        open_source(url)


def test_a_taken_port_and_a_missing_device_are_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(FollowUrlError, match="cannot be listened to"):
            open_source(f"udpin://127.0.0.1:{taken.getsockname()[1]}")
    with pytest.raises(SerialPortError, match="cannot be opened"):
        open_source("serial:///dev/nothing_here:57600")


def test_sources_over_tcp_and_serial_bring_what_was_sent() -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    tcp = open_source(f"tcp://127.0.0.1:{listener.getsockname()[1]}")
    line = open_source(f"serial://{os.ttyname(theirs)}:57600")
    tcp.read(0.0)
    server, _ = listener.accept()
    server.sendall(b"abc")
    os.write(ours, b"def")
    time.sleep(0.1)
    assert (tcp.read(0.1), line.read(0.1)) == ([b"abc"], [b"def"])
    tcp.send(b"x")
    line.send(b"y")
    assert (server.recv(10), os.read(ours, 10)) == (b"x", b"y")
    server.close()
    time.sleep(0.1)
    assert tcp.read(0.2) == []
    assert not tcp.watched()
    tcp.read(2.0)
    again, _ = listener.accept()
    again.sendall(b"back")
    time.sleep(0.1)
    assert tcp.read(2.1) == [b"back"]
    for item in (again, listener, tcp, line):
        item.close()
    os.close(ours)
    os.close(theirs)


# ---- two gateways in real time


class Watched:
    """A gateway in a thread, and its scans with the times at which they left."""

    def __init__(self, gateway: Gateway | FollowGateway) -> None:
        self.gateway, self.scans = gateway, []
        gateway.alter_scan = self._note
        self._stop = threading.Event()
        self._thread = threading.Thread(target=gateway.run, args=(self._stop,))

    def _note(self, ranges: np.ndarray) -> np.ndarray:
        self.scans.append((time.monotonic(), ranges.copy()))
        return ranges

    @contextmanager
    def running(self) -> Iterator[Watched]:
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join(10.0)
            self.gateway.close()
        assert not self._thread.is_alive()


def _fly(client: Client, seconds: float, velocity: tuple[float, float, float], yaw_rate: float) -> None:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        client.send(
            mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x5C7, 0, 0, 0, *velocity, 0, 0, 0, 0, yaw_rate)
        )
        client.drain()
        time.sleep(0.05)


def _differences(first: list[tuple[float, np.ndarray]], second: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Of each scan of the second, against those of the first just before and after it, as far as both see something."""
    times, found = [at for at, _ in first], []
    for at, ranges in second:
        i = bisect(times, at)
        if 0 < i < len(times) and times[i] - times[i - 1] < 0.1:
            share = (at - times[i - 1]) / (times[i] - times[i - 1])
            between = (1.0 - share) * first[i - 1][1] + share * first[i][1]
            both = np.isfinite(between) & np.isfinite(ranges) & (ranges > 0.0)
            found.append(np.abs(between[both] - ranges[both]))
    return np.concatenate(found)


@pytest.mark.realtime
def test_a_second_gateway_sees_what_the_flown_one_sees_until_that_is_gone() -> None:
    world = generate_corridor(1, CorridorConfig())
    warm_up_gateway(world)
    warm_up(world)
    port = free_port()
    flown = Watched(Gateway(world, GatewayConfig(onboard_port=port, gcs_port=0, lidar_port=0, estimate="none", seed=1)))
    follower = Watched(FollowGateway(world, FollowConfig(f"udpout://127.0.0.1:{port + 40}", seed=2, lidar_port=0)))
    client = Client(port + 40)
    with follower.running():
        with flown.running():
            deadline_s = time.monotonic() + 30.0
            while not flown.gateway.vehicle.autopilot.armed:
                _fly(client, 0.5, (0.0, 0.0, -1.0), 0.0)
                client.command(176, 1, 6)
                client.command(400, 1)
                assert time.monotonic() < deadline_s
            _fly(client, 3.0, (0.0, 0.0, -1.0), 0.0)
            flown.scans.clear()
            follower.scans.clear()
            _fly(client, 4.0, (1.0, 0.2, 0.0), 0.3)
            assert len(follower.scans) == pytest.approx(len(flown.scans), abs=6)
            differences = _differences(flown.scans, follower.scans)
        assert np.median(differences) < 0.025, "two scanners' noise of 0.01 m, and some motion"
        assert np.mean(differences < 0.1) > 0.9, "edges of boxes excepted"
        time.sleep(0.8)
        follower.scans.clear()
        time.sleep(0.5)
        assert not follower.scans, "no pose, no scans"
    assert [event["pose"] for event in follower.gateway.recorder.events][:1] == [True]
    assert follower.gateway.recorder.events[-1]["pose"] is False
