"""What every use of MAVSDK needs around it: a free port named first, its log off standard output, answers to commands."""

from __future__ import annotations

import json
import logging
import socket
import threading
from typing import Any
from urllib.parse import urlsplit

from flight.errors import RefusedError
from flight.px4 import RESULT_ACCEPTED, RESULT_NAMES

log = logging.getLogger("flight.mavsdk_support")


class Answer:
    """The answer to one command, filled on MAVSDK's thread."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.result = -1
        self.text = "no answer"

    def on_ack(self, result: Any, ack: Any, _user_data: Any) -> None:
        """Final COMMAND_ACK of a direct command."""
        if result.name == "SUCCESS":
            self.result = int(json.loads(ack.fields_json).get("result", -1))
            self.text = RESULT_NAMES.get(self.result, f"result {self.result}")
        else:
            self.text = str(result.name).lower().replace("_", " ")
        self.done.set()

    def on_action(self, result: Any, _user_data: Any) -> None:
        """Result of an Action plugin call."""
        self.result = RESULT_ACCEPTED if result.name == "SUCCESS" else -1
        self.text = str(result.name).lower().replace("_", " ")
        self.done.set()


def check_port_is_free(url: str) -> None:
    """For a listening UDP URL: bind its port once, so that a busy one is named before anything else starts."""
    parts = urlsplit(url)
    if parts.scheme not in ("udp", "udpin"):
        return
    host, port = parts.hostname or "0.0.0.0", parts.port or 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, port))
        except OSError as error:
            raise RefusedError(
                f"cannot listen on {url}: {error.strerror}; stop the program that uses UDP port {port} or change the "
                "connection in the mission"
            ) from None


_log_routed = False


def route_mavsdk_log() -> None:
    """Send MAVSDK's own log to Python logging: its default writes to standard output, which belongs to `--json`."""
    global _log_routed  # noqa: PLW0603  (MAVSDK's log has one subscriber per process)
    if _log_routed:
        return
    from mavsdk import log_subscribe  # noqa: PLC0415

    def forward(level: Any, message: str, _file: str | None, _line: int) -> bool:
        log.log(10 * min(int(level) + 1, 4) if int(level) >= 2 else logging.DEBUG, "mavsdk: %s", message)
        return True

    log_subscribe(forward)
    _log_routed = True
