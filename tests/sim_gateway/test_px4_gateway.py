"""The simulator of a real PX4, flown by a stand-in for PX4 in lockstep; and its serial line to a flight controller."""

from __future__ import annotations

import json
import math
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav

from sim_gateway.faults import Fault, FaultError
from sim_gateway.frame_reader import FrameReader, decode
from sim_gateway.hil_sensors import INERTIAL, MAGNETIC, PRESSURE
from sim_gateway.mavlink_frame import FramePacker
from sim_gateway.px4_gateway import Px4Config, Px4Gateway, warm_up
from sim_gateway.px4_wire import Px4LineError, open_line
from sim_gateway.scene import World
from tests.sim_gateway.px4_stand_in import HOVER, STARTING_STEPS, StandIn, Step

BOX = np.array([[9.0, -1.0, 0.0, 10.0, 1.0, 10.0]])
WORLD = World("one box", 0, 20.0, 8.0, 10.0, BOX, (), (5.0, 0.5, 0.0), 0.0, (18.0, 0.0, 2.0))

pytestmark = pytest.mark.timeout(120)


@contextmanager
def _running(**settings: Any) -> Iterator[tuple[Px4Gateway, threading.Thread, threading.Event]]:
    """A gateway for PX4 on free ports in a thread, as fast as it goes."""
    warm_up(WORLD)
    config = Px4Config(**{"address": "tcp:0", "lidar_port": 0, "speed": 0.0, **settings})
    stop = threading.Event()
    with Px4Gateway(WORLD, config) as gateway:
        thread = threading.Thread(target=gateway.run, args=(stop,))
        thread.start()
        try:
            yield gateway, thread, stop
        finally:
            stop.set()
            thread.join(20.0)
    assert not thread.is_alive()


@contextmanager
def _flown(**settings: Any) -> Iterator[tuple[Px4Gateway, StandIn]]:
    with _running(**settings) as (gateway, thread, _):
        stand_in = StandIn(int(gateway.ready_message()["px4"].removeprefix("tcp:")))
        try:
            yield gateway, stand_in
        finally:
            stand_in.close()
            thread.join(10.0)
        assert not thread.is_alive(), "the run ends when PX4 has gone"


def _position(stand_in: StandIn) -> tuple[float, float, float]:
    """North, east and up of the start, m, by the ground truth."""
    truth = stand_in.truth
    scale = math.radians(1e-7) * 6371000.0
    return (
        (truth.lat - 473977420) * scale,
        (truth.lon - 85455940) * scale * math.cos(math.radians(47.397742)),
        truth.alt * 1e-3 - 489.4,
    )


def test_takeoff_move_and_landing_in_lockstep(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    with _flown(report=report) as (gateway, px4):
        px4.start()
        steps = px4.fly(1.0)
        assert [step.sensor.time_usec for step in steps] == [4000 * (STARTING_STEPS + 1 + i) for i in range(250)]
        px4.controller.armed = True
        px4.controller.velocity = (0.0, 0.0, -1.0)
        px4.fly(2.5)
        px4.controller.velocity = (0.0, 0.0, 0.0)
        px4.fly(2.0)
        assert _position(px4)[2] == pytest.approx(2.0, abs=0.4)
        hovering = px4.fly(1.0)
        assert np.mean([step.sensor.zacc for step in hovering]) == pytest.approx(-9.81, abs=0.1)
        px4.controller.velocity, px4.controller.yaw = (0.5, 1.0, 0.0), 0.4
        px4.fly(3.0)
        north, east, _ = _position(px4)
        assert (north, east) == (pytest.approx(1.3, abs=0.4), pytest.approx(2.5, abs=0.4))
        px4.controller.velocity = (0.0, 0.0, 0.5)
        px4.fly(5.0)
        px4.controller.armed = False
        resting = px4.fly(1.0)
        assert abs(_position(px4)[2]) < 0.01
        assert gateway.simulation.landed
        assert np.mean([step.sensor.zacc for step in resting[-100:]]) == pytest.approx(-9.81, abs=0.05)
        px4.step()
        assert gateway.answered_steps == px4.answers
    written = json.loads(report.read_text())
    assert [event["armed"] for event in written["events"]] == [True, False]
    assert written["contacts"] == 0
    assert "PX4 has closed the connection" in written["ended"]
    x, y, _ = written["trajectory"]["rows"][-1][1:4]
    assert (x - 5.0, y - 0.5) == (pytest.approx(north, abs=0.5), pytest.approx(-east, abs=0.5)), "east is the corridor's right"


def test_sensor_groups_their_rates_and_order() -> None:
    with _flown() as (_, px4):
        steps = px4.start() + px4.fly(2.0)
    kinds = [[message.get_type() for message in step.before] for step in steps]
    assert all(kind[-1] == "HIL_STATE_QUATERNION" for kind in kinds), "the truth belongs to the same step"
    assert sum("HIL_GPS" in kind for kind in kinds) == len(steps) // 25
    flags = [step.sensor.fields_updated for step in steps]
    assert {flag & INERTIAL for flag in flags} == {INERTIAL}
    assert {flag & MAGNETIC for flag in flags} == {0, MAGNETIC}
    assert {flag & PRESSURE for flag in flags} == {0, PRESSURE}
    assert sum(bool(flag & MAGNETIC) for flag in flags) == len(steps) // 2
    assert sum(bool(flag & PRESSURE) for flag in flags) == len(steps) // 5
    assert {step.sensor.id for step in steps} == {0}
    gps = [message for step in steps for message in step.before if message.get_type() == "HIL_GPS"]
    assert {(m.fix_type, m.satellites_visible, m.eph, m.epv) for m in gps} == {(3, 12, 30, 40)}


def test_noise_on_the_ground_and_a_field_that_never_stands_still() -> None:
    with _flown(seed=3) as (_, px4):
        sensors = [step.sensor for step in px4.start() + px4.fly(4.0)]
    spread = {name: np.std([getattr(s, name) for s in sensors]) for name in ("xacc", "zgyro", "ymag", "abs_pressure")}
    assert spread == {
        "xacc": pytest.approx(0.05, rel=0.1),
        "zgyro": pytest.approx(0.002, rel=0.1),
        "ymag": pytest.approx(0.002, rel=0.1),
        "abs_pressure": pytest.approx(0.01, rel=0.1),
    }
    field = [(s.xmag, s.ymag, s.zmag) for s in sensors]
    assert len(set(field)) == len(field)
    assert np.mean(field, axis=0) == pytest.approx((0.2107, 0.0130, 0.4320), abs=3e-4)
    assert np.mean([s.abs_pressure for s in sensors]) == pytest.approx(955.8, abs=0.1)  # 489.4 m


def test_the_same_seed_gives_the_same_bytes() -> None:
    def flight(seed: int) -> list[Step]:
        with _flown(seed=seed) as (_, px4):
            px4.start()
            px4.controller.armed, px4.controller.velocity = True, (0.3, 0.0, -1.0)
            return px4.fly(1.0)

    def bytes_of(steps: list[Step]) -> list[bytes]:
        return [bytes(message.get_msgbuf()) for step in steps for message in (*step.before, step.sensor)]

    first, again, other = (bytes_of(flight(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_without_gps_vision_tells_where_it_is() -> None:
    with _flown(gps=False) as (_, px4):
        px4.start()
        px4.controller.armed, px4.controller.velocity = True, (0.0, 1.0, -0.5)
        steps = px4.fly(3.0)
        north, east, up = _position(px4)
    messages = [message for step in steps for message in step.before]
    vision = [message for message in messages if message.get_type() == "ODOMETRY"]
    assert not [message for message in messages if message.get_type() == "HIL_GPS"]
    assert len(vision) == pytest.approx(90, abs=1)
    newest = vision[-1]
    assert (newest.x, newest.y, newest.z) == pytest.approx((north, east, -up), abs=0.15)
    speed = math.hypot(px4.truth.vx, px4.truth.vy, px4.truth.vz) / 100.0
    assert math.hypot(newest.vx, newest.vy, newest.vz) == pytest.approx(speed, abs=0.1)
    assert (newest.frame_id, newest.child_frame_id, newest.estimator_type, newest.quality) == (1, 12, 3, 90)
    assert [newest.pose_covariance[i] for i in (0, 6, 11, 15)] == pytest.approx([4e-4] * 3 + [1e-4])


def test_gps_can_be_lost_and_faults_of_our_own_autopilot_are_refused() -> None:
    with _flown(faults=(Fault.parse("gps_loss@armed:1+2"),)) as (_, px4):
        px4.start()
        px4.fly(0.5)
        px4.controller.armed = True
        steps = px4.fly(4.0)
    fixes = [message.time_usec * 1e-6 for step in steps for message in step.before if message.get_type() == "HIL_GPS"]
    gaps = np.diff(fixes)
    assert max(gaps) == pytest.approx(2.1, abs=0.11)
    assert sorted(gaps)[-2] == pytest.approx(0.1)
    for text, word in (("refuse_offboard@1", "refuse_offboard cannot happen"), ("wind@offboard:1", "wait for: start, armed")):
        with pytest.raises(FaultError, match=word):
            Px4Gateway(WORLD, Px4Config(address="tcp:0", lidar_port=0, faults=(Fault.parse(text),)))


def test_wrong_checksums_and_garbage_move_no_motor_and_break_nothing() -> None:
    with _flown() as (gateway, px4):
        px4.start()
        packer = FramePacker(1, 1)
        for step in px4.fly(0.5)[:20]:
            full = bytearray(packer.pack(mav.MAVLink_hil_actuator_controls_message(step.sensor.time_usec, [1.0] * 16, 129, 1)))
            full[-1] ^= 0x55
            px4.socket.sendall(os.urandom(300) + bytes(full))
        px4.socket.sendall(bytes(300))
        px4.fly(0.5)
        px4.answer(px4.step(), [math.nan, math.inf, -math.inf, 7.0])
        px4.answer(px4.step(), [0.0] * 4)
        px4.fly(0.2)
        assert not gateway.recorder.events
        assert gateway.simulation.landed
        assert np.isfinite(gateway.simulation.state_row).all()


def test_lidar_is_served_from_the_same_truth() -> None:
    with _flown() as (gateway, px4):
        ranges = []
        px4.start()
        with socket.create_connection(("127.0.0.1", gateway.lidars.scip.port), timeout=5.0) as lidar:
            lidar.sendall(b"BM\n")
            px4.fly(0.5)
            lidar.sendall(b"GD0360036000\n")  # straight ahead
            px4.fly(0.2)
            text = lidar.recv(4096).decode().split("\n")
            code = text[text.index("GD0360036000") + 3][:3]
            ranges.append(sum((ord(c) - 0x30) << shift for c, shift in zip(code, (12, 6, 0), strict=True)))
    assert ranges[0] == pytest.approx(4000, abs=60), "the box stands 4 m ahead"


def test_px4_that_starts_slowly_or_loses_an_answer_gets_further_steps() -> None:
    with _flown() as (gateway, px4):
        px4.start()
        px4.fly(0.1)
        lost = px4.step()
        started_s = time.monotonic()
        following = px4.step()
        assert time.monotonic() - started_s > 0.5, "PX4 may think for a while before time goes on"
        assert following.sensor.time_usec == lost.sensor.time_usec + 4000
        px4.answer(following)
        px4.fly(0.1)
        px4.step()
        assert gateway.answered_steps == px4.answers


def test_the_port_is_free_again_when_px4_has_gone() -> None:
    with _flown() as (gateway, px4):
        px4.start()
    open_line(gateway.ready_message()["px4"]).close()


_REFUSED = ["tcp:", "tcp:x", "tcp:70000", "udp:14540", "serial:", "serial:/dev/nothing_here,57600", "serial:/dev/null,0"]


@pytest.mark.parametrize("address", _REFUSED)
def test_addresses_that_are_refused(address: str) -> None:
    with pytest.raises(Px4LineError, match=r"give|cannot be opened"):
        open_line(address)


def test_a_flight_controller_is_not_hurried() -> None:
    controller = _Controller()
    with pytest.raises(Px4LineError, match="its own time"):
        Px4Gateway(WORLD, Px4Config(address=f"serial:{controller.path},921600", speed=0.0))


# ---- a flight controller on a serial line


class _Controller:
    """The far end of a serial line."""

    def __init__(self) -> None:
        self._ours, theirs = pty.openpty()
        tty.setraw(theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(theirs)
        self.reader, self.packer, self.seen = FrameReader(), FramePacker(1, 1), []

    def listen(self, seconds: float, motors: float | None = None) -> list[Any]:
        """What arrives within that time; meanwhile motor commands at 200 Hz."""
        end_s, seen = time.monotonic() + seconds, []
        while time.monotonic() < end_s:
            try:
                seen += [decode(frame) for frame in self.reader.feed(os.read(self._ours, 4096))]
            except BlockingIOError:
                time.sleep(0.005)
            if motors is not None:
                commands = mav.MAVLink_hil_actuator_controls_message(1, [motors] * 4 + [0.0] * 12, 129, 0)
                os.write(self._ours, self.packer.pack(commands))
        return seen

    def unplug(self) -> None:
        os.close(self._ours)


@pytest.mark.realtime
def test_hitl_over_a_serial_line_flies_in_real_time(tmp_path: Path) -> None:
    controller, report = _Controller(), tmp_path / "report.json"
    with _running(address=f"serial:{controller.path},921600", speed=1.0, report=report) as (gateway, thread, _):
        controller.listen(0.3)
        seen = controller.listen(2.0, 0.0)
        kinds = {kind: sum(message.get_type() == kind for message in seen) for kind in ("HIL_SENSOR", "HIL_GPS", "HEARTBEAT")}
        assert kinds["HIL_SENSOR"] == pytest.approx(500, rel=0.15)
        assert kinds["HIL_GPS"] == pytest.approx(20, abs=3)
        assert kinds["HEARTBEAT"] in (1, 2, 3)
        assert "HIL_STATE_QUATERNION" not in {message.get_type() for message in seen}, "PX4 would take it for its estimate"
        controller.listen(1.0, HOVER + 0.1)
        assert not gateway.simulation.landed
        controller.listen(0.8)
        assert not gateway.dynamics.commands.any(), "motors stop when the controller is silent"
        controller.unplug()
        thread.join(5.0)
        assert not thread.is_alive()
    written = json.loads(report.read_text())
    assert "has gone" in written["ended"]
    assert written["real_time_factor"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.realtime
def test_a_line_too_slow_for_the_sensors_loses_messages_not_time() -> None:
    controller = _Controller()
    with _running(address=f"serial:{controller.path},57600", speed=1.0) as (gateway, _, _stop):
        seen = controller.listen(2.0)
        arrived = sum(message.get_type() == "HIL_SENSOR" for message in seen)
        assert arrived * 70 < 2.2 * 5760, "no more than the line carries"
        assert arrived > 50
        assert gateway.line.lost_messages > 250
        assert seen[-1].time_usec * 1e-6 > gateway.simulation.time_s - 0.5, "and it is fresh"
