"""An emulated spinning LiDAR on a pseudo-terminal, driven by the physics: one call per step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from sim_gateway.ld06 import LD06, STL27L, Ld06Device
from sim_gateway.pty_port import PtyPort
from sim_gateway.rplidar import A1, RplidarDevice
from sim_gateway.simulation import Simulation
from sim_gateway.spinning import Shots, SpinConfig, SpinningScanner


class _Device(Protocol):
    def handle(self, data: bytes) -> bytes: ...

    def take(self, shots: Shots) -> bytes: ...


KINDS: dict[str, tuple[SpinConfig, Callable[[SpinConfig], _Device]]] = {
    "ld06": (LD06, Ld06Device),
    "stl27l": (STL27L, Ld06Device),
    "rplidar": (A1, RplidarDevice),
}


class SerialLidar:
    """Head, device and line of one kind (`KINDS`). `path`: what a driver opens. Call `advance` after every physics step."""

    def __init__(self, kind: str, link: Path | None = None, seed: int = 0, config: SpinConfig | None = None) -> None:
        usual, build = KINDS[kind]
        self.kind = kind
        self.scanner = SpinningScanner(config or usual, seed)
        self.device = build(self.scanner.config)
        self.port = PtyPort(link)
        self.path = self.port.path

    def advance(self, simulation: Simulation, ahead_s: float = 0.0, *, seeing: bool = True) -> None:
        """Answer the client and send what the beams fired since the last call have seen, if it is `seeing` anything.

        `ahead_s`: the device's clock less vehicle time.
        """
        heard = self.port.read()
        answers = self.device.handle(heard) if heard else b""
        shots = self.scanner.fire(simulation)
        measured = self.device.take(replace(shots, time_s=shots.time_s + ahead_s)) if seeing else b""
        self.port.write(answers + measured)

    def close(self) -> None:
        """Take the line away."""
        self.port.close()
