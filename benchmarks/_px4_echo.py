"""Stands in for PX4 on its simulator interface and costs next to nothing: answers every HIL_SENSOR at once, hovering.

python -m benchmarks._px4_echo PORT
"""

from __future__ import annotations

import socket
import struct
import sys

from pymavlink.dialects.v20 import development as mav

from sim_gateway.frame_reader import FrameReader
from sim_gateway.mavlink_frame import FramePacker

_SENSOR, _ARMED = 107, 129


def main(port: int) -> None:
    """Answer until the simulator closes the connection."""
    packer, reader = FramePacker(1, 1), FrameReader()
    with socket.create_connection(("127.0.0.1", port), timeout=30.0) as sock:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while data := sock.recv(8192):
            for frame in reader.feed(data):
                if frame.number == _SENSOR:
                    (time_us,) = struct.unpack_from("<Q", frame.payload)
                    sock.sendall(
                        packer.pack(mav.MAVLink_hil_actuator_controls_message(time_us, [0.5] * 4 + [0.0] * 12, _ARMED, 1))
                    )


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]))
    except ConnectionError:
        sys.exit(0)
