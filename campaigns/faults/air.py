"""The world outside the flight computer, in lockstep: vehicle, autopilot, its MAVLink server, the SCIP device, and both wires.

Nothing here is made for the campaign but the clock and the wires: the gateway's own parts, with delays in place of cables.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flight.telemetry import MESSAGES
from sim_gateway.faults import Fault
from sim_gateway.flight_modes import FlightMode
from sim_gateway.gateway import connect_faults
from sim_gateway.lidar import LidarConfig
from sim_gateway.link_faults import RawBytes
from sim_gateway.mavlink_links import MemoryLink
from sim_gateway.mavlink_server import MavlinkServer
from sim_gateway.parameters import ParameterStore
from sim_gateway.piloted import PilotedVehicle
from sim_gateway.scene import World
from sim_gateway.scip_device import ScipDevice
from sim_gateway.simulation import Simulation, step_at
from sim_gateway.stream_rates import ONBOARD
from sim_gateway.telemetry import Telemetry

DOWNLINK_S, UPLINK_S, SCAN_S = 0.004, 0.008, 0.016
BOOTED_S = -60.0  # the autopilot has been on for a while
STREAMED = frozenset(MESSAGES)
POLL_STEPS = 2
PARAMETERS = {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 5.0, "COM_RC_OVERRIDE": 3.0}  # as `fly` and its users set them


@dataclass(frozen=True, slots=True)
class Setpoint:
    """A velocity setpoint as it reached the autopilot: vehicle time, NED m/s, clockwise rad/s, sender's component."""

    time_s: float
    velocity: tuple[float, float, float]
    yaw_rate_rad_s: float
    component: int

    @property
    def moving(self) -> bool:
        """Whether it asks for any motion."""
        return any(self.velocity) or self.yaw_rate_rad_s != 0.0


class Air:
    """Everything outside. `step` lets 4 ms pass; what arrives at the computer waits in `downlink` and `lidar_bytes`."""

    def __init__(self, world: World, estimate: str, seed: int, height_m: float, faults: tuple[Fault, ...]) -> None:
        self.simulation = Simulation(world, lidar=LidarConfig.device(), estimate=estimate, seed=seed, hover_height_m=height_m)
        self.vehicle = PilotedVehicle(self.simulation, ParameterStore(PARAMETERS), ready_after_s=0.0)
        self.autopilot = self.vehicle.autopilot
        self.telemetry = Telemetry(self.autopilot, self.vehicle.frame, self.vehicle.snapshot, lambda: self.time_s)
        self.telemetry.booted_s = BOOTED_S
        self.link = MemoryLink("onboard", ONBOARD, lambda: self.time_s)
        for name in set(self.link.streams) - STREAMED:
            self.link.set_interval(name, -1)
        self.server = MavlinkServer(self.autopilot, self.vehicle.frame, self.telemetry, links=[self.link])
        self.incidents = connect_faults(self.vehicle, self.server, self.telemetry, seed)
        self.device = ScipDevice(lambda: self.time_s)
        self.downlink: deque[tuple[float, Any]] = deque()
        self.uplink: deque[tuple[float, Any]] = deque()
        self.lidar_bytes: deque[tuple[float, bytes]] = deque()
        self.setpoints: list[Setpoint] = []
        self.modes: list[tuple[float, FlightMode, bool]] = []
        self.watch: Callable[[], None] = lambda: None
        self.scan_times_s: list[float] = []
        self._scans = 0
        for fault in faults:
            self.simulation.inject(fault)
        self._take_off()

    def _take_off(self) -> None:
        """It hovers already: armed, in the air, in Hold."""
        self.autopilot.step(self.vehicle.ned_state())
        self.autopilot.arm(force=True)
        self.autopilot.landed = False

    @property
    def time_s(self) -> float:
        """Vehicle time."""
        return self.simulation.time_s

    def send_up(self, message: Any) -> None:
        """A packed message from the computer, on its way to the autopilot."""
        self.uplink.append((self.time_s + UPLINK_S, message))

    def step(self) -> None:
        """One physics step with everything that hangs on it."""
        self.vehicle.advance(1)
        if self.simulation.steps >= step_at(self._scans * 0.05):
            self._scan()
        self.incidents.step()
        if self.simulation.steps % POLL_STEPS == 0:
            self._exchange()
        while self.autopilot.mode_changes:
            change = self.autopilot.mode_changes.popleft()
            self.modes.append((change.time_s, change.mode, change.failsafe))
        self.watch()

    def _scan(self) -> None:
        self._scans += 1
        self.scan_times_s.append(self.time_s)
        for scan in self.simulation.device_scans():
            data = self.device.new_scan(scan.time_s, self.device.geometry.sent_codes(scan.ranges_m))
            if data:
                self.lidar_bytes.append((self.time_s + SCAN_S, data))

    def _exchange(self) -> None:
        """Messages up that have come through the cable, then whatever the autopilot has to say."""
        while self.uplink and self.uplink[0][0] <= self.time_s:
            self.link.inbox.append(self.uplink.popleft()[1])
        self.server.poll()
        while self.server.wire_log.entries:
            item = self.server.wire_log.entries.popleft()
            if item.velocity is not None:
                north, east, down, yaw_rate = item.velocity
                self.setpoints.append(Setpoint(item.time_s, (north, east, down), yaw_rate, item.sender[1]))
        while self.link.outbox:
            message = self.link.outbox.popleft()
            if isinstance(message, RawBytes) or message.get_type() in STREAMED or message.get_type() == "COMMAND_ACK":
                self.downlink.append((self.time_s + DOWNLINK_S, message))
