"""The flight card with the gRPC wrapper (PyPI `mavsdk-grpc`, or `mavsdk` before 4), run by an interpreter that has it.

`PYTHON -m campaigns.clients.over_grpc URL GRPC_PORT` prints what was seen as JSON.
"""

from __future__ import annotations

import asyncio
import importlib
import importlib.util
import json
import sys
from types import SimpleNamespace
from typing import Any

from campaigns.clients.card import VERBS, perform

PACKAGE = "mavsdk_grpc" if importlib.util.find_spec("mavsdk_grpc") else "mavsdk"
_TYPES_OF = ("geofence", "mission", "offboard")


class GrpcDrone:
    """`card.Drone` over a gRPC `System`."""

    action: Any
    geofence: Any
    log_files: Any
    mission: Any
    offboard: Any
    param: Any

    def __init__(self, system: Any) -> None:
        self._system = system
        self.types = SimpleNamespace()
        for name in ("action", "geofence", "log_files", "mission", "offboard", "param"):
            setattr(self, name, getattr(system, name))
        for name in _TYPES_OF:
            vars(self.types).update(vars(importlib.import_module(f"{PACKAGE}.{name}")))

    async def read(self, name: str) -> Any:
        """The next value of that stream."""
        return await anext(aiter(getattr(self._system.telemetry, name)()))

    async def progress(self) -> Any:
        """MissionProgress."""
        return await anext(aiter(self._system.mission.mission_progress()))


async def _main(url: str, port: int) -> None:
    system = importlib.import_module(PACKAGE).System(port=port)
    await system.connect(system_address=url)
    sys.stdout.write(json.dumps(await perform(GrpcDrone(system), VERBS)))


if __name__ == "__main__":
    asyncio.run(_main(sys.argv[1], int(sys.argv[2])))
