"""The vehicle's own log of each flight, from arming to disarming, as a small ULog file in memory.

It holds what the autopilot believed: local position at 10 Hz, its modes, and the changes of mode as text. Nothing in it comes
from the simulated truth, and its `sys_name` says that a gateway wrote it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from sim_gateway import ulog
from sim_gateway.autopilot import Autopilot
from sim_gateway.flight_modes import FlightMode

PERIOD_S = 0.1
MAX_LOGS = 4
MAX_BYTES = 4 << 20
"""Two hours; a longer flight's log ends there."""

POSITION = ulog.Topic("vehicle_local_position", tuple(("float", name) for name in ("x", "y", "z", "vx", "vy", "vz", "heading")))
STATUS = ulog.Topic("vehicle_status", (("uint8_t", "arming_state"), ("uint8_t", "nav_state"), ("bool", "failsafe")))
TOPICS = (POSITION, STATUS)
_DISARMED, _ARMED = 1, 2
_NOTICE = 5
_NAV_STATE = {  # as PX4 numbers its modes in vehicle_status
    FlightMode.MANUAL: 0,
    FlightMode.ALTCTL: 1,
    FlightMode.POSCTL: 2,
    FlightMode.MISSION: 3,
    FlightMode.LOITER: 4,
    FlightMode.RTL: 5,
    FlightMode.OFFBOARD: 14,
    FlightMode.TAKEOFF: 17,
    FlightMode.LAND: 18,
}


@dataclass(slots=True)
class Log:
    """One flight's file. `utc_s`: Unix time of arming."""

    number: int
    utc_s: int
    data: bytearray = field(default_factory=bytearray)


class VehicleLog:
    """Call `watch` often. `logs`: the newest `MAX_LOGS` flights, oldest first; the last one may still grow."""

    def __init__(self, autopilot: Autopilot, utc_s: Callable[[], float] = time.time) -> None:
        self.logs: deque[Log] = deque(maxlen=MAX_LOGS)
        self._autopilot = autopilot
        self._utc_s = utc_s
        self._open: Log | None = None
        self._flights = 0
        self._due_s = 0.0
        self._shown: FlightMode | None = None

    def watch(self) -> None:
        """Begin, go on with or end a log, as the vehicle is armed or not."""
        armed, now_s = self._autopilot.armed, self._autopilot.now_s
        if armed and self._open is None:
            self._begin(now_s)
        if self._open is not None and (now_s >= self._due_s or not armed):
            self._due_s = now_s + PERIOD_S
            self._add(self._open, round(1e6 * now_s))
        if not armed:
            self._open = None

    def erase(self) -> None:
        """Forget all flights but the one that is under way."""
        self.logs.clear()
        if self._open is not None:
            self.logs.append(self._open)

    def _begin(self, now_s: float) -> None:
        self._open = Log(self._flights, int(self._utc_s()))
        self._flights += 1
        self._due_s, self._shown = now_s, None
        self._open.data += ulog.head(round(1e6 * now_s), {"sys_name": "sim-gateway", "ver_hw": "simulated"}, TOPICS)
        self.logs.append(self._open)

    def _add(self, log: Log, time_us: int) -> None:
        if len(log.data) >= MAX_BYTES:
            return
        pilot = self._autopilot
        state, mode = pilot.state, pilot.mode
        if mode is not self._shown:
            self._shown = mode
            log.data += ulog.text(time_us, _NOTICE, f"mode {mode.px4_name}")
        log.data += ulog.sample(0, POSITION.pack(time_us, *state.position, *state.velocity, state.yaw_rad))
        arming = _ARMED if pilot.armed else _DISARMED
        log.data += ulog.sample(1, STATUS.pack(time_us, arming, _NAV_STATE[mode], pilot.failsafe))
