"""The flight card with MAVSDK 4 (PyPI `mavsdk`): `python -m campaigns.clients.native URL` prints what was seen as JSON."""

from __future__ import annotations

import asyncio
import importlib
import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk

from campaigns.clients.card import VERBS, perform

_PLUGINS = ("action", "geofence", "log_files", "mission", "offboard", "param", "telemetry")
_FOUND_WITHIN_S = 15.0


class NativeDrone:
    """`card.Drone` over a MAVSDK 4 system."""

    action: Any
    geofence: Any
    log_files: Any
    mission: Any
    offboard: Any
    param: Any
    telemetry: Any

    def __init__(self, system: Any) -> None:
        self.types = SimpleNamespace()
        for name in _PLUGINS:
            module = importlib.import_module(f"mavsdk.asyncio.plugins.{name}")
            plugin = "".join(part.capitalize() for part in name.split("_"))
            setattr(self, name, getattr(module, f"{plugin}Async")(system))
            vars(self.types).update(vars(importlib.import_module(f"mavsdk.plugins.{name}")))

    async def read(self, name: str) -> Any:
        """The newest value of that name."""
        return await getattr(self.telemetry, name)()

    async def progress(self) -> Any:
        """MissionProgress."""
        return await self.mission.mission_progress()


@asynccontextmanager
async def connected(url: str) -> AsyncIterator[NativeDrone]:
    """The vehicle on that connection, as a ground station sees it."""
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        await mavsdk.add_any_connection(url)
        system = await mavsdk.first_autopilot(timeout_s=_FOUND_WITHIN_S)
        if system is None:
            raise TimeoutError(f"no vehicle on {url} within {_FOUND_WITHIN_S:g} s")
        yield NativeDrone(system)


async def _main(url: str) -> None:
    async with connected(url) as drone:
        sys.stdout.write(json.dumps(await perform(drone, VERBS)))


if __name__ == "__main__":
    asyncio.run(_main(sys.argv[1]))
