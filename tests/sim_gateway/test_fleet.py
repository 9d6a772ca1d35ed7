"""Several vehicles in one process: their own ids and ports, one world, one pace; two clients that each fly theirs."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mavlink_bench import Client, free_port
from pymavlink.dialects.v20 import development as mav

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.errors import DivergedError
from sim_gateway.fleet import SPACING_M, Fleet, NoRoomError, start_places
from sim_gateway.gateway import GatewayConfig
from sim_gateway.mavlink_links import PortInUseError
from sim_gateway.open_links import ONBOARD_PORT_OFFSET
from sim_gateway.scene import World

WORLD = generate_corridor(1, CorridorConfig())
TAKEOFF, ARM = 22, 400


def config(**changes: object) -> GatewayConfig:
    ports = {"onboard_port": _low_port(), "gcs_port": 0, "lidar_port": 0}
    return GatewayConfig(**{**ports, "estimate": "none", **changes})  # type: ignore[arg-type]


def _low_port() -> int:
    """With room for the gateway's own port above it."""
    return free_port() % 20000 + 30000


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(WORLD, config(), 2) as fleet:
        yield fleet


class Pilot:
    """A client of one vehicle, who flies it by messages only."""

    def __init__(self, port: int, system_id: int) -> None:
        self.client, self.system_id = Client(port + ONBOARD_PORT_OFFSET), system_id

    def command(self, number: int, *params: float) -> None:
        values = (*params, *[0.0] * (7 - len(params)))
        self.client.send(mav.MAVLink_command_long_message(self.system_id, 1, number, 0, *values))

    def position(self) -> tuple[float, float, float]:
        last = self.client.named("LOCAL_POSITION_NED")[-1]
        return last.x, last.y, last.z

    def close(self) -> None:
        self.client.socket.close()


def run(fleet: Fleet, pilots: list[Pilot], seconds: float) -> None:
    for _ in range(round(seconds / 0.004)):
        for gateway in fleet.gateways:
            gateway.step()
        for pilot in pilots:
            pilot.client.drain()


def test_two_clients_each_arm_and_fly_their_own_vehicle(fleet: Fleet) -> None:
    ports = [gateway.config.onboard_port for gateway in fleet.gateways]
    pilots = [Pilot(port, index + 1) for index, port in enumerate(ports)]
    for pilot in pilots:
        pilot.client.send(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    run(fleet, pilots, 8.0)
    for pilot, height_m in zip(pilots, (2.0, 4.0), strict=True):
        pilot.client.seen.clear()
        pilot.command(ARM, 1.0)
        altitude = fleet.gateways[0].vehicle.frame.altitude_m + height_m
        pilot.command(TAKEOFF, math.nan, 0.0, 0.0, math.nan, math.nan, math.nan, altitude)
    run(fleet, pilots, 8.0)
    for pilot, height_m in zip(pilots, (2.0, 4.0), strict=True):
        assert [ack.result for ack in pilot.client.named("COMMAND_ACK")] == [0, 0]
        known = [message for message in pilot.client.seen if not message.get_type().startswith("UNKNOWN")]
        assert {message.get_srcSystem() for message in known} == {pilot.system_id}
        assert -pilot.position()[2] == pytest.approx(height_m, abs=0.3)
        pilot.close()


def test_a_command_for_another_vehicle_is_not_taken(fleet: Fleet) -> None:
    run(fleet, [], 8.0)
    pilot = Pilot(fleet.gateways[1].config.onboard_port, 1)  # the second's port, the first's id
    pilot.command(ARM, 1.0)
    run(fleet, [pilot], 0.2)
    assert not any(gateway.vehicle.autopilot.armed for gateway in fleet.gateways)
    assert pilot.client.named("COMMAND_ACK") == []
    pilot.close()


def test_ids_ports_and_starts_are_told() -> None:
    with Fleet(WORLD, config(), 3) as fleet:
        message = fleet.ready_message()
        lidars = [gateway.lidar.port for gateway in fleet.gateways]
    first = message["onboard_port"]
    assert [vehicle["onboard_port"] for vehicle in message["vehicles"]] == [first, first + 1, first + 2]
    assert [vehicle["system_id"] for vehicle in message["vehicles"]] == [1, 2, 3]
    assert [vehicle["lidar_port"] for vehicle in message["vehicles"]] == lidars
    assert len(set(lidars)) == 3
    assert message["vehicles"][0]["start"] == message["start"] == list(WORLD.start)


def test_the_ground_station_has_one_port_for_all() -> None:
    ground = _low_port()
    with Fleet(WORLD, config(gcs_port=ground), 2) as fleet:
        own = [gateway.server.links[1].socket.getsockname()[1] for gateway in fleet.gateways]  # type: ignore[attr-defined]
    assert own == [ground + 4020, ground + 4021]


@pytest.mark.parametrize("seed", range(20))
def test_starts_lie_apart_and_free(seed: int) -> None:
    world = generate_corridor(seed, CorridorConfig())
    places = np.array(start_places(world, 10))
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 10.0 * np.eye(10)
    assert apart.min() >= SPACING_M - 1e-9
    for box in world.static_boxes:
        outside = np.maximum(np.maximum(box[:3] - places, places - box[3:]), 0.0)
        assert np.linalg.norm(outside, axis=1)[1:].min() > 0.49
    assert (np.abs(places[:, 1]) < 0.5 * world.width_m).all()


def test_too_many_for_the_room_are_refused() -> None:
    room = World("room", 0, 4.0, 4.0, 3.0, np.empty((0, 6)), (), (2.0, 0.0, 0.0), 0.0, (3.0, 0.0, 1.0))
    assert len(start_places(room, 9)) == 9
    with pytest.raises(NoRoomError, match="9 of 10"):
        start_places(room, 10)


def test_a_taken_port_leaves_no_port_open() -> None:
    taken = config()
    overlapping = replace(taken, onboard_port=taken.onboard_port - 1)
    with Fleet(WORLD, taken, 2), pytest.raises(PortInUseError):
        Fleet(WORLD, overlapping, 2)
    with Fleet(WORLD, overlapping, 2) as fleet:
        assert len(fleet.gateways) == 2


def test_a_diverged_vehicle_ends_the_run_with_all_reports(tmp_path: Path) -> None:
    with Fleet(WORLD, config(report=tmp_path / "truth.json", dynamics="jsbsim", max_time_s=5.0), 2) as fleet:
        second = fleet.gateways[1]
        second.vehicle.simulation.carry((5.0, math.nan, 1.0), 0.0)
        second.vehicle.simulation._state[20] = 0.0  # in the air
        with pytest.raises(DivergedError, match="position is nan"):
            fleet.run(threading.Event())
    first, broken = (json.loads((tmp_path / name).read_text()) for name in ("truth.json", "truth-2.json"))
    assert first["ended"] is None
    assert "JSBSim diverged" in broken["ended"]
    assert (first["dynamics"], first["vehicle"], broken["system_id"]) == ("jsbsim", "iris", 2)
