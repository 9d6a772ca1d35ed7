"""An unmodified MAVSDK 4 client flies the gateway in real time: what a user's own program would do."""

from __future__ import annotations

import asyncio
import json
import math
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync, MavlinkMessage
from mavsdk.asyncio.plugins.offboard import OffboardAsync, VelocityBodyYawspeed, VelocityNedYaw
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import FlightMode, LandedState, TelemetryAsync

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.gateway import Gateway, GatewayConfig, warm_up

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(120)]

VELOCITY_AND_YAW_RATE = 0x5C7


def _free_udp_base() -> int:
    """A port p of which p and p + 40 are free."""
    for port in range(24540, 26000, 7):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as b:
            try:
                a.bind(("127.0.0.1", port))
                b.bind(("127.0.0.1", port + 40))
            except OSError:
                continue
            return port
    raise RuntimeError("no free UDP ports")


@pytest.fixture
def running(tmp_path: Path) -> Iterator[tuple[Gateway, Path]]:
    world = generate_corridor(1, CorridorConfig())
    warm_up(world)
    report = tmp_path / "report.json"
    port = _free_udp_base()
    with Gateway(world, GatewayConfig(onboard_port=port, gcs_port=0, lidar_port=0, report=report, seed=3)) as gateway:
        stop = threading.Event()
        thread = threading.Thread(target=gateway.run, args=(stop,))
        thread.start()
        yield gateway, report
        stop.set()
        thread.join(5.0)
        assert not thread.is_alive()


class Client:
    """Verbs with deadlines for one connected vehicle."""

    def __init__(self, system: Any) -> None:
        self.action = ActionAsync(system)
        self.telemetry = TelemetryAsync(system)
        self.offboard = OffboardAsync(system)
        self.direct = MavlinkDirectAsync(system)
        self.param = ParamAsync(system)

    async def until(self, read: Callable[[], Awaitable[Any]], wanted: Callable[[Any], bool], within_s: float) -> Any:
        async def poll() -> Any:
            while not wanted(value := await read()):  # noqa: ASYNC110  (the client offers no event for this)
                await asyncio.sleep(0.05)
            return value

        return await asyncio.wait_for(poll(), within_s)

    async def mode(self, wanted: FlightMode, within_s: float = 2.0) -> None:
        await self.until(self.telemetry.flight_mode, lambda mode: mode == wanted, within_s)

    async def velocity(self) -> Any:
        return (await self.telemetry.position_velocity_ned()).velocity

    async def command_offboard(self) -> None:
        fields = {"target_system": 1, "target_component": 1, "command": 176, "confirmation": 0}
        fields |= {f"param{i}": value for i, value in enumerate((1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0), 1)}
        await self.direct.send_message(MavlinkMessage("COMMAND_LONG", 245, 190, 1, 1, json.dumps(fields)))
        await self.mode(FlightMode.OFFBOARD)

    async def stream_velocity(self, north: float, yaw_rate: float, seconds: float) -> None:
        fields = dict.fromkeys(("time_boot_ms", "x", "y", "z", "vy", "vz", "afx", "afy", "afz", "yaw"), 0.0)
        fields |= {"target_system": 1, "target_component": 1, "coordinate_frame": 1, "type_mask": VELOCITY_AND_YAW_RATE}
        fields |= {"vx": north, "yaw_rate": yaw_rate}
        message = MavlinkMessage("SET_POSITION_TARGET_LOCAL_NED", 245, 190, 1, 1, json.dumps(fields))
        for _ in range(round(seconds * 20)):
            await self.direct.send_message(message)
            await asyncio.sleep(0.05)


@asynccontextmanager
async def connected(port: int) -> Any:
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await mavsdk.first_autopilot(timeout_s=10.0)
        assert system is not None, "the gateway was not discovered within 10 s"
        yield Client(system)


async def _fly_card(client: Client) -> None:
    await client.until(client.telemetry.health_all_ok, bool, 8.0)
    assert await client.param.get_param_int("COM_OBL_RC_ACT") == 0
    await client.action.set_takeoff_altitude(2.0)
    assert await client.param.get_param_float("MIS_TAKEOFF_ALT") == 2.0

    await client.action.arm()
    await client.action.takeoff()
    await client.mode(FlightMode.TAKEOFF)
    await client.mode(FlightMode.HOLD, within_s=10.0)
    assert await client.telemetry.in_air()

    # OFFBOARD by the plugin: NED, then body frame
    await client.offboard.set_velocity_ned(VelocityNedYaw(0.6, 0.0, 0.0, 0.0))
    await client.offboard.start()
    await client.mode(FlightMode.OFFBOARD)
    await client.until(client.velocity, lambda v: v.north_m_s > 0.4, 4.0)
    await client.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, -0.4, 0.0, 0.0))
    await client.until(client.velocity, lambda v: v.east_m_s < -0.25, 4.0)
    await client.offboard.stop()
    await client.mode(FlightMode.HOLD)

    # OFFBOARD by raw setpoints
    await client.stream_velocity(0.5, 0.3, 0.5)
    start = asyncio.create_task(client.command_offboard())
    await client.stream_velocity(0.5, 0.3, 1.5)
    await start
    assert (await client.velocity()).north_m_s > 0.25
    assert math.radians((await client.telemetry.attitude_euler()).yaw_deg) > 0.2
    await client.action.hold()
    await client.mode(FlightMode.HOLD)

    await client.action.return_to_launch()
    await client.mode(FlightMode.RETURN_TO_LAUNCH)
    await client.action.land()
    await client.mode(FlightMode.LAND)
    await client.until(client.telemetry.landed_state, lambda s: s == LandedState.ON_GROUND, 15.0)
    await client.until(client.telemetry.armed, lambda armed: not armed, 5.0)


def test_flight_card(running: tuple[Gateway, Path]) -> None:
    gateway, report = running

    async def card() -> None:
        async with connected(gateway.config.onboard_port) as client:
            await _fly_card(client)

    asyncio.run(card())
    truth = json.loads(report.read_text())
    assert [e["mode"] for e in truth["events"]][-1] == "AUTO.LOITER"
    assert not truth["events"][-1]["armed"]
    assert truth["min_clearance_m"] is not None
    assert max(row[3] for row in truth["trajectory"]["rows"]) > 1.5
    assert truth["real_time_factor"] == pytest.approx(1.0, abs=0.1)
