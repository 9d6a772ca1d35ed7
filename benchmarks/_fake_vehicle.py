"""The vehicle's end of a wire, as a process: `python -m benchmarks._fake_vehicle PORT SECONDS`. It writes down what came when.

Prints one JSON object: `setpoints` [[east velocity m/s, monotonic s], ...], `attitudes` [[number, monotonic s], ...].
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from contextlib import suppress

from pymavlink.dialects.v20 import development as mav

OFFBOARD_ARMED = (mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4, 0x81, 6 << 16, mav.MAV_STATE_ACTIVE, 3)
HEARTBEAT_S, ATTITUDE_S, WAIT_S = 0.5, 0.02, 0.005
PRIORITY = 40


def main(port: int, seconds: float) -> dict[str, list[tuple[float, float]]]:
    """Stream heartbeats and attitudes to a port of this machine, and record setpoints."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    setpoints: list[tuple[float, float]] = []
    attitudes: list[tuple[float, float]] = []
    packer, to = mav.MAVLink(None, 1, 1), ("127.0.0.1", port)
    end_s = time.monotonic() + seconds
    heartbeat_s = attitude_s = 0.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(WAIT_S)
        while (now_s := time.monotonic()) < end_s:
            if now_s > heartbeat_s:
                sock.sendto(mav.MAVLink_heartbeat_message(*OFFBOARD_ARMED).pack(packer), to)
                heartbeat_s = now_s + HEARTBEAT_S
            if now_s > attitude_s:
                attitudes.append((len(attitudes) + 1, time.monotonic()))
                sock.sendto(mav.MAVLink_attitude_message(len(attitudes), 0, 0, 0, 0, 0, 0).pack(packer), to)
                attitude_s = now_s + ATTITUDE_S
            with suppress(TimeoutError):
                data, arrived_s = sock.recv(500), time.monotonic()
                found = mav.MAVLink(None).parse_buffer(data) or []
                setpoints += [(m.vy, arrived_s) for m in found if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
    return {"setpoints": setpoints, "attitudes": attitudes}


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), float(sys.argv[2]))))
