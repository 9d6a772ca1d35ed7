"""Vehicles that fly OFFBOARD under their autopilots as fast as the machine goes: what `benchmarks.gateway` measures.

`python -m benchmarks._gateway_flight MINUTES` flies one vehicle with all its links for so many simulated minutes and prints its
resident memory, MiB, every twelfth of the time, as one JSON list.
"""

from __future__ import annotations

import gc
import json
import math
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from sim_gateway.corridor import CorridorConfig, generate_corridor
from sim_gateway.fleet import Fleet
from sim_gateway.flight_modes import FlightMode, Result
from sim_gateway.gateway import GatewayConfig, step_all
from sim_gateway.open_links import GROUND_PORT_OFFSET, ONBOARD_PORT_OFFSET
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.setpoints import OffboardSetpoint
from sim_gateway.simulation import Simulation

WORLD = generate_corridor(7, CorridorConfig())
STEPS_PER_S = 250
_TICK_STEPS = 12
_SAMPLES = 12


def take_off(vehicles: list[PilotedVehicle], advance: Callable[[int], None]) -> None:
    """From start-up to Hold at takeoff height, then to OFFBOARD. `advance`: lets steps pass for all."""
    advance(10 * STEPS_PER_S)
    for vehicle in vehicles:
        assert vehicle.autopilot.arm() is Result.ACCEPTED
        assert vehicle.autopilot.takeoff() is Result.ACCEPTED
    advance(10 * STEPS_PER_S)
    _stream(vehicles)
    advance(_TICK_STEPS)
    for vehicle in vehicles:
        assert vehicle.autopilot.set_mode(FlightMode.OFFBOARD) is Result.ACCEPTED


def fly(vehicles: list[PilotedVehicle], advance: Callable[[int], None], seconds: float, each_tick: Callable[[], object]) -> None:
    """Weave to and fro under setpoints at 20 Hz."""
    for _ in range(round(seconds * STEPS_PER_S / _TICK_STEPS)):
        _stream(vehicles)
        advance(_TICK_STEPS)
        each_tick()
    assert all(vehicle.autopilot.mode is FlightMode.OFFBOARD for vehicle in vehicles)


def _stream(vehicles: list[PilotedVehicle]) -> None:
    for vehicle in vehicles:
        phase = 0.3 * vehicle.time_s
        velocity = (0.8 * math.sin(phase), 0.3 * math.cos(2.0 * phase), 0.0)
        vehicle.autopilot.set_setpoint(OffboardSetpoint(velocity=velocity, yaw_rate_rad_s=0.3 * math.sin(phase)))


def single(dynamics: str) -> PilotedVehicle:
    """A vehicle with autopilot and the policy's LiDAR, in OFFBOARD, without links."""
    vehicle = PilotedVehicle(Simulation(WORLD, dynamics=dynamics))
    take_off([vehicle], vehicle.advance)
    return vehicle


@contextmanager
def fleet(count: int) -> Iterator[tuple[list[PilotedVehicle], Callable[[int], None]]]:
    """Vehicles with all their links, in OFFBOARD, and what lets steps pass for them. Clients listen, and read nothing."""
    onboard, ground = _free_ports(count)
    config = GatewayConfig(onboard_port=onboard, gcs_port=ground, lidar_port=0)
    with ExitStack() as stack:
        for port in (*range(onboard, onboard + count), ground):
            stack.enter_context(_bound(port))
        gateways = stack.enter_context(Fleet(WORLD, config, count)).gateways
        vehicles = [gateway.vehicle for gateway in gateways]

        def advance(steps: int) -> None:
            for _ in range(steps):
                step_all(gateways)

        take_off(vehicles, advance)
        yield vehicles, advance


def _free_ports(count: int) -> tuple[int, int]:
    """First onboard port and ground station port, of which all and the gateway's own are free."""
    for base in range(21000, 26000, 2 * ONBOARD_PORT_OFFSET):
        ground = base - 1
        ports = [base + i for i in range(count)] + [base + ONBOARD_PORT_OFFSET + i for i in range(count)]
        ports += [ground] + [ground + GROUND_PORT_OFFSET + i for i in range(count)]
        try:
            with ExitStack() as stack:
                for port in ports:
                    stack.enter_context(_bound(port))
        except OSError:
            continue
        return base, ground
    raise RuntimeError("no free UDP ports between 21000 and 30000")


def _bound(port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.bind(("127.0.0.1", port))
    except OSError:
        sock.close()
        raise
    return sock


def resident_mib() -> float:
    """Resident memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


def main() -> None:
    """See the module."""
    minutes, resident = float(sys.argv[1]), []
    with fleet(1) as (vehicles, advance):
        for _ in range(_SAMPLES):
            fly(vehicles, advance, 60.0 * minutes / _SAMPLES, lambda: None)
            gc.collect()
            resident.append(resident_mib())
    print(json.dumps(resident))


if __name__ == "__main__":
    main()
