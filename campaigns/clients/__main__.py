"""Fly public MAVLink clients against `sim-gateway`, unmodified, each with a gateway of its own, and write what they saw.

    python -m campaigns.clients --mavsdk-grpc-python PATH --mavproxy PATH --out results/clients.json

PATH: the Python of an environment that has `mavsdk-grpc` (or `mavsdk<4`), and the `mavproxy.py` of one that has MAVProxy; each
may be left out. MAVSDK 4 is in this environment. Then `python -m campaigns.publish` writes the table into docs/gateway.md.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from campaigns.clients import mavproxy
from campaigns.clients.report import markdown
from campaigns.command_line import prepare_output, run_command
from campaigns.ports import free_port
from flight.gateway_process import GatewayProcess

ROOT = Path(__file__).resolve().parent.parent.parent
WORLD = ROOT / "configs" / "worlds" / "open_field.yaml"
START_S, CARD_S = 60.0, 900.0

Shown = list[dict[str, Any]]


def with_gateway(fly: Callable[[int, int, Path], Shown]) -> Shown:
    """Start a gateway, hand `fly` its onboard and ground station ports and a folder, stop it."""
    onboard, ground = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ports = ["--onboard-port", str(onboard), "--gcs-port", str(ground), "--lidar-port", "0"]
        with GatewayProcess(["--world", str(WORLD), *ports], folder / "truth.json") as gateway:
            gateway.start(START_S)
            return fly(onboard, ground, folder)


def by_script(python: str, module: str, *arguments: str) -> Shown:
    """What a script of this package printed last, run by that interpreter."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [python, "-m", f"campaigns.clients.{module}", *arguments]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=CARD_S, check=False)
    lines = done.stdout.strip().splitlines()
    if done.returncode or not lines:
        return [{"verb": "run", "ok": False, "seen": done.stderr.strip()[-200:], "seconds": 0.0}]
    shown: Shown = json.loads(lines[-1])
    return shown


def version_in(python: str, *distributions: str) -> str:
    """Name and version of the first of these that an environment has."""
    code = "import importlib.metadata as m, sys; print(*(f'{d.name} {d.version}' for d in m.distributions()), sep='\\n')"
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True, timeout=START_S)
    installed = {line.split()[0].lower().replace("_", "-"): line for line in done.stdout.splitlines()}
    found = next((installed[name.lower()] for name in distributions if name.lower() in installed), None)
    if found is None:
        raise SystemExit(f"{python} has none of {', '.join(distributions)}: install it there")
    return found


def over_grpc(python: str) -> Callable[[int, int, Path], Shown]:
    """MAVSDK's gRPC package in the environment of this Python."""

    def perform(port: int, _ground: int, _folder: Path) -> Shown:
        return by_script(python, "over_grpc", f"udpin://127.0.0.1:{port}", str(free_port(socket.SOCK_STREAM)))

    return perform


def chosen(arguments: argparse.Namespace) -> dict[str, Callable[[int, int, Path], Shown]]:
    """The clients that can be flown here, by name and version."""
    clients: dict[str, Callable[[int, int, Path], Shown]] = {
        f"mavsdk {version('mavsdk')}": lambda port, _, __: by_script(sys.executable, "native", f"udpin://127.0.0.1:{port}")
    }
    for python in arguments.mavsdk_grpc_python:
        clients[f"{version_in(python, 'mavsdk-grpc', 'mavsdk')} (gRPC)"] = over_grpc(python)
    if arguments.mavproxy is not None:
        name = version_in(str(arguments.mavproxy.parent / "python"), "MAVProxy")
        clients[name] = lambda _, ground, folder: mavproxy.perform(arguments.mavproxy, ground, folder)
    return clients


def main() -> int:
    """Command line; exit code 1 when a client saw something that a vehicle would not show it."""
    parser = argparse.ArgumentParser(
        prog="python -m campaigns.clients", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mavsdk-grpc-python", action="append", default=[], help="a Python that has mavsdk-grpc; repeatable")
    parser.add_argument("--mavproxy", type=Path, help="mavproxy.py of an environment that has MAVProxy")
    parser.add_argument("--out", type=Path, required=True, help="result (JSON)")
    arguments = parser.parse_args()
    prepare_output(arguments.out)
    clients = {name: with_gateway(fly) for name, fly in chosen(arguments).items()}
    command = "python -m campaigns.clients --mavsdk-grpc-python PATH --mavproxy PATH --out results/clients.json"
    result = {"command": command, "world": WORLD.name, "clients": clients}
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    sys.stdout.write(markdown(result) + "\n")
    return 0 if all(step["ok"] for shown in clients.values() for step in shown) else 1


if __name__ == "__main__":
    run_command("clients", main)
