"""MAVSDK 4 flies two vehicles of one gateway at once; the table of what clients saw."""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from campaigns.clients import card
from campaigns.clients.native import connected
from campaigns.clients.report import markdown
from sim_gateway.fleet import Fleet
from sim_gateway.gateway import GatewayConfig, warm_up
from sim_gateway.world import load_world

FIELD = Path(__file__).parents[2] / "configs" / "worlds" / "open_field.yaml"
PORT = 24740


@pytest.fixture
def two_vehicles() -> Iterator[Fleet]:
    world = load_world(FIELD)
    warm_up(world)
    with Fleet(world, GatewayConfig(onboard_port=PORT, gcs_port=0, lidar_port=0, seed=3), 2) as fleet:
        stop = threading.Event()
        thread = threading.Thread(target=fleet.run, args=(stop,))
        thread.start()
        yield fleet
        stop.set()
        thread.join(5.0)
        assert not thread.is_alive()


@pytest.mark.realtime
@pytest.mark.timeout(120)
def test_two_vehicles_are_flown_at_once_and_apart(two_vehicles: Fleet) -> None:
    first = {"health": card.health, "takeoff": card.takeoff, "velocity": card.velocity_ned, "body": card.velocity_body}
    first |= {"stop": card.offboard_stop, "mission": card.mission}
    second = {"health": card.health, "parameters": card.parameters, "takeoff": card.takeoff, "fence": card.geofence}
    second |= {"land": card.land}

    async def fly(port: int, verbs: dict[str, card.Verb]) -> tuple[list[dict[str, Any]], float]:
        async with connected(f"udpin://127.0.0.1:{port}") as drone:
            height = await drone.param.get_param_float("RTL_RETURN_ALT")
            return await card.perform(drone, verbs), height

    two_vehicles.gateways[1].vehicle.autopilot.parameters.set("RTL_RETURN_ALT", 21.0)

    async def both() -> list[tuple[list[dict[str, Any]], float]]:
        return await asyncio.gather(fly(PORT, first), fly(PORT + 1, second))

    (one, height_one), (two, height_two) = asyncio.run(both())
    for step in (*one, *two):
        assert step["ok"], step
    assert (height_one, height_two) == (30.0, 21.0)
    places = [gateway.vehicle.simulation.truth_position_m for gateway in two_vehicles.gateways]
    assert math.dist(*places) > 5.0


def test_clients_with_the_same_verbs_share_a_table() -> None:
    good = {"verb": "takeoff", "ok": True, "seen": "Hold at 2.3 m", "seconds": 8.0}
    bad = {"verb": "takeoff", "ok": False, "seen": "a | b", "seconds": 8.0}
    other = {"verb": "connect", "ok": True, "seen": "there", "seconds": 1.0}
    text = markdown({"command": "c", "world": "w", "clients": {"x 1": [good], "y 2": [bad], "z 3": [other]}})
    assert "| verb | x 1 | y 2 |" in text
    assert "| takeoff | Hold at 2.3 m | **failed**: a / b |" in text
    assert "| verb | z 3 |" in text
