"""Ports for gateways that a campaign starts."""

from __future__ import annotations

import socket

HIGHEST_PORT = 61_000
"""The gateway also binds 40 and 4020 above an onboard or ground port."""


def free_port(kind: socket.SocketKind) -> int:
    """A port that nothing uses now, low enough for the gateway's own ones above it."""
    while True:
        with socket.socket(socket.AF_INET, kind) as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        if port < HIGHEST_PORT:
            return port
