"""LiDARs of the running gateway, as a mission finds them: OBSTACLE_DISTANCE over MAVLink, flights on an LD06."""

from __future__ import annotations

import math
import os
import select
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from air import corridor
from stand import Program, Stand, free_port

from flight.lidar import BeamReducer, LidarSource, open_lidar
from flight.lidar.clock import OneWayClock
from flight.lidar.from_link import feed_from_link
from flight.lidar.ld06 import LD06_POINTS_PER_S, Ld06Decoder
from flight.link import VehicleLink
from sim_gateway.gateway import Gateway, GatewayConfig
from sim_gateway.pace import Pace

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(400)]


@pytest.fixture
def stand(tmp_path: Path, seeker_policy: Path) -> Iterator[Stand]:
    """A stand whose gateway also has an LD06, at `folder/serial`."""
    stand = Stand(tmp_path, seeker_policy)
    stand.mission()
    world = tmp_path / "world.yaml"
    world.write_text(world.read_text().replace("4.1, 2.0]", "2.6, 2.0]"))  # walls that the shortest-sighted of them sees
    ports = ["--onboard-port", str(stand.onboard_port), "--gcs-port", str(stand.gcs_port), "--lidar-port", str(stand.lidar_port)]
    serial = ["--serial-lidar", "ld06", "--serial-link", str(tmp_path / "serial")]
    gateway = Program("sim_gateway", "--world", str(tmp_path / "world.yaml"), *ports, *serial)
    gateway.wait_for('"ready": true', 300.0)
    yield stand
    gateway.stop()


def policy_beams(config: LidarSource, link: VehicleLink | None = None) -> tuple[np.ndarray, float]:
    """The policy's 180 beams from one of the gateway's LiDARs, and the scan's age when it was taken."""
    with open_lidar(config) as driver:
        if link is not None:
            feed_from_link(driver, config, link)
        for _ in range(20):
            scan = driver.wait_for_scan(10.0)
        assert scan is not None, driver.health()
        return BeamReducer(180, math.pi, 4.0).reduce(scan), driver.health().age_s


def test_three_lidars_of_one_gateway_agree(stand: Stand) -> None:
    with VehicleLink(f"udpin://127.0.0.1:{stand.onboard_port}") as link:
        link.connect(15.0)
        over_mavlink, mavlink_age_s = policy_beams(LidarSource(driver="mavlink", blind_sectors_deg=((95.0, -95.0),)), link)
    over_scip, scip_age_s = policy_beams(LidarSource(port=stand.lidar_port))
    over_serial, serial_age_s = policy_beams(LidarSource(driver="ld06", device=str(stand.folder / "serial")))
    both = np.isfinite(over_scip) & np.isfinite(over_serial)
    assert both.sum() > 40, "the walls beside the start"
    assert np.percentile(np.abs(over_scip[both] - over_serial[both]), 95) < 0.2
    near = np.isfinite(over_scip) & np.isfinite(over_mavlink)
    assert near.sum() > 40
    assert (over_mavlink[near] <= over_scip[near] + 0.1).all(), "a bin of 5 degrees holds the nearest of its beams"
    assert scip_age_s < 0.15
    assert mavlink_age_s < 0.2
    assert serial_age_s < 0.25


def test_a_flight_on_an_ld06(stand: Stand) -> None:
    section = f"lidar:\n  driver: ld06\n  device: {stand.folder / 'serial'}\n  range_max_m: 4.0\n  no_return: nothing\n"
    section += "  motion_compensation: true\n"

    def on_the_line(text: str) -> str:
        text = text.replace(f"lidar:\n  port: {stand.lidar_port}\n", section).replace(
            "connection: sim", f"connection: udpin://127.0.0.1:{stand.onboard_port}"
        )
        text = text.replace("takeoff_point_m: world", "takeoff_point_m: [1.0, 0.0]").replace(
            "position_m: world", "position_m: [4.5, 0.3, 1.2]"
        )
        return text[: text.index("sim:\n")]

    flight = stand.fly("--yes", change=on_the_line)
    assert flight.finish(120.0) == 0, flight.out + flight.err
    summary = stand.summary()
    assert summary["goal_reached"]


def test_frames_stay_fresh_on_a_gateway_that_is_too_slow() -> None:
    """Vehicle time falls ever further behind the clock. Nobody can ask an LD06 for its clock: a lag that grew there once ended
    flights on a busy computer as `scan_stale`."""
    config = GatewayConfig(onboard_port=free_port(socket.SOCK_DGRAM), gcs_port=0, lidar_port=0, serial_lidar="ld06")
    decoder, clock = Ld06Decoder(LD06_POINTS_PER_S), OneWayClock(wrap_s=30.0)
    ages_s = []
    with Gateway(corridor(), config) as gateway:
        gateway.carry = lambda _: ((1.0, 0.0, 1.0), 0.0)
        gateway.pace = Pace(1.0, 0.0)
        line = os.open(gateway.ready_message()["serial_lidar"], os.O_RDONLY | os.O_NONBLOCK)
        try:
            for now_s in np.arange(0.0, 20.0, 0.006).tolist():  # this computer takes 6 ms for a step of 4 ms
                if gateway.pace.behind_s(now_s, gateway.vehicle.time_s) >= 0.004:
                    gateway.step()
                    points = decoder.feed(os.read(line, 4096) if select.select([line], [], [], 0.0)[0] else b"")
                    ages_s += [now_s - clock.measured_at(1e-3 * stamp, now_s) for stamp in points.stamp_ms[-1:].tolist()]
        finally:
            os.close(line)
        assert gateway.pace.dropped_s > 6.0, "it was too slow indeed"
        assert gateway.device_time_s == pytest.approx(20.0, abs=0.2)
    assert decoder.bad_checksums == 0
    assert len(ages_s) > 3000
    assert max(ages_s) < 0.12
