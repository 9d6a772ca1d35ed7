"""The `lidar-view` command: what the LiDAR says, live in the terminal, before anything flies."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydantic import ValidationError
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from flight.lidar.config import LidarSource
from flight.lidar.devices import open_lidar
from flight.lidar.driver import LidarDriver, LidarHealth
from flight.lidar.polar import polar_plot
from flight.lidar.recording import write_npz
from safety.messages import LidarScan

_EPILOG = """
Examples:

lidar-view --mission configs/corridor.yaml

lidar-view --driver ld06 --device /dev/ttyUSB0

lidar-view --driver rplidar --device /dev/ttyUSB0 --set rplidar_mode=express --json --seconds 5

lidar-view --driver scip-tcp --host 192.168.0.10 --seconds 10 --record scans.npz

Exit codes: 0 scans came, 1 none came, 2 usage or configuration. Ctrl-C stops.
"""
_REFRESH_HZ = 10.0
_MAX_RECORDED = 20_000
_LOUD_AGE_S = 0.25

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


class _UsageError(Exception):
    """A mistake of the user's; one line that says what to change."""


@app.command(epilog=_EPILOG)
def view(
    mission: Annotated[Path | None, typer.Option(help="Take the `lidar` section of this mission file.")] = None,
    driver: Annotated[str | None, typer.Option(help="scip-tcp, scip-serial, ld06, ld19, stl27l, rplidar, recording.")] = None,
    device: Annotated[str | None, typer.Option(help="Serial device.")] = None,
    host: Annotated[str | None, typer.Option(help="Address of a network device.")] = None,
    path: Annotated[Path | None, typer.Option(help="Recording to play.")] = None,
    changes: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any other key of the section.")] = None,
    seconds: Annotated[float, typer.Option(min=0.0, help="Stop after this long; 0: on Ctrl-C.")] = 0.0,
    reach: Annotated[float, typer.Option(min=0.0, help="Range at the rim of the plot, m; 0: the device's, at most 12.")] = 0.0,
    record: Annotated[Path | None, typer.Option(help="Write the scans to this .npz file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="No plot; one JSON object on stdout at the end.")] = False,
) -> None:
    """Show rate, age, coverage and a live polar plot of a LiDAR: ahead is up, left is left, shaded is unknown."""
    given = {"driver": driver, "device": device, "host": host, "path": path}
    source = _source(mission, {key: value for key, value in given.items() if value is not None}, changes or [])
    if source.driver == "mavlink":
        raise _UsageError("driver mavlink gets its scans from the vehicle's link: fly check shows them")
    if as_json and seconds <= 0.0:
        seconds = 5.0
    watch = _Watch(record is not None)
    with open_lidar(source) as lidar:
        try:
            _look(lidar, watch, seconds, reach, quiet=as_json)
        except KeyboardInterrupt:
            print("lidar-view: stopped", file=sys.stderr)
        health, scan = lidar.health(), lidar.latest()
    if record is not None and watch.recorded:
        count = write_npz(record, watch.recorded)
        print(f"lidar-view: {count} scans in {record}", file=sys.stderr)
    if as_json:
        print(json.dumps(summary(health, scan, watch.ages_s)))
    if scan is None:
        print(f"lidar-view: no scan from {source.place}: {health.last_error or 'it is silent'}", file=sys.stderr)
        raise typer.Exit(1)


class _Watch:
    """Ages of the scans at their arrival, and the scans themselves if wanted."""

    def __init__(self, keep: bool) -> None:
        self.recorded: list[LidarScan] = []
        self.ages_s: list[float] = []
        self._keep = keep

    def note(self, scan: LidarScan) -> None:
        """One scan, as it arrives. What is kept is bounded."""
        if len(self.ages_s) < _MAX_RECORDED:
            self.ages_s.append(time.monotonic() - scan.time_s)
        if self._keep and len(self.recorded) < _MAX_RECORDED:
            self.recorded.append(scan)


def _look(lidar: LidarDriver, watch: _Watch, seconds: float, reach_m: float, *, quiet: bool) -> None:
    console = Console(stderr=quiet)
    end_s = time.monotonic() + seconds if seconds > 0.0 else math.inf
    shown_s = -math.inf
    live = Live(console=console, auto_refresh=False, transient=True) if not quiet and console.is_terminal else None
    with live or _Nothing():
        while time.monotonic() < end_s:
            scan = lidar.wait_for_scan(min(0.1, max(0.0, end_s - time.monotonic())))
            if scan is not None:
                watch.note(scan)
            health = lidar.health()
            if health.last_error == "the recording is over" and not health.connected:
                return
            if live is not None and time.monotonic() - shown_s >= 1.0 / _REFRESH_HZ:
                shown_s = time.monotonic()
                live.update(picture(health, lidar.latest(), console.width, console.height, reach_m), refresh=True)
    if not quiet:
        console.print(_status_line(lidar.health(), lidar.latest()))


class _Nothing:
    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...


def coverage(scan: LidarScan | None) -> float:
    """Share of the scan's bearings that are known: a return, nothing there, or too near."""
    return math.nan if scan is None else float(np.mean(~np.isnan(scan.ranges_m)))


def summary(health: LidarHealth, scan: LidarScan | None, ages_s: list[float]) -> dict[str, Any]:
    """What `--json` prints; null where it is not known."""
    facts: dict[str, Any] = {
        "model": health.model,
        "connected": health.connected,
        "scans": health.scans,
        "rate_hz": health.rate_hz,
        "age_ms": {"p50": _percentile_ms(ages_s, 50), "p99": _percentile_ms(ages_s, 99), "max": _percentile_ms(ages_s, 100)},
        "coverage": coverage(scan),
        "reconnects": health.reconnects,
        "bad_checksums": health.bad_checksums,
        "bad_frames": health.bad_frames,
        "clock_drift_ms": 1e3 * health.clock_drift_s,
        "last_error": health.last_error,
    }
    if scan is not None:
        known = scan.ranges_m[np.isfinite(scan.ranges_m)]
        last_rad = scan.angle_min_rad + scan.angle_increment_rad * (scan.ranges_m.size - 1)
        facts |= {
            "beams": int(scan.ranges_m.size),
            "bearings_deg": [math.degrees(scan.angle_min_rad), math.degrees(last_rad)],
            "range_limits_m": [scan.range_min_m, scan.range_max_m],
            "nearest_m": float(known.min()) if known.size else None,
        }
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in facts.items()}


def _percentile_ms(ages_s: list[float], percent: float) -> float | None:
    return round(1e3 * float(np.percentile(ages_s, percent)), 2) if ages_s else None


def picture(health: LidarHealth, scan: LidarScan | None, columns: int, rows: int, reach_m: float) -> Group:
    """The screen: one line of figures, then the plot."""
    line = _status_line(health, scan)
    if scan is None:
        return Group(line)
    reach = reach_m or min(12.0, scan.range_max_m)
    plot = polar_plot(scan, max(20, columns - 1), max(8, rows - 3), reach)
    return Group(line, *(Text(row, style="green", no_wrap=True, overflow="crop") for row in plot), Text(f"rim {reach:g} m"))


def _status_line(health: LidarHealth, scan: LidarScan | None) -> Text:
    if scan is None:
        return Text(f"no scan yet: {health.last_error or 'waiting'}", style="red")
    known = coverage(scan)
    text = (
        f"{health.model}  {health.rate_hz:.1f} Hz  age {1e3 * health.age_s:.0f} ms  {known:.0%} known  {health.scans} scans  "
        f"bad {health.bad_checksums}+{health.bad_frames}  reconnects {health.reconnects}"
    )
    if not health.connected:
        text += f"  LOST: {health.last_error}"
    return Text(text, style="bold" if health.connected and health.age_s < _LOUD_AGE_S else "bold red")


def _source(mission: Path | None, given: dict[str, Any], changes: list[str]) -> LidarSource:
    section: dict[str, Any] = {}
    if mission is not None:
        from flight.mission import load_mission  # noqa: PLC0415  (the whole flight's configuration)

        section = load_mission(mission).lidar.model_dump(exclude_unset=True)
    elif "driver" not in given and not given and not changes:
        raise _UsageError("which LiDAR? give --mission, or --driver with --device, --host or --path")
    section |= given
    for change in changes:
        key, separator, value = change.partition("=")
        if not separator:
            raise _UsageError(f"--set {change!r}: write KEY=VALUE")
        section[key] = _value(value)
    try:
        return LidarSource.model_validate(section)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "lidar"
        unknown = first["type"] == "extra_forbidden"
        what = "unknown key; see docs/lidar.md" if unknown else first["msg"].removeprefix("Value error, ")
        raise _UsageError(f"{where}: {what}") from None


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def main() -> None:
    """Entry point: a user's mistake is one line on stderr and exit code 2."""
    from flight.errors import FlyError  # noqa: PLC0415

    logging.basicConfig(level=logging.ERROR, format="lidar-view: %(message)s", stream=sys.stderr)
    try:
        code = app(standalone_mode=False)
    except (_UsageError, FlyError) as error:
        print(f"lidar-view: {error}", file=sys.stderr)
        code = 2
    except Exception as error:
        if not hasattr(error, "format_message"):  # typer's usage errors have no public base class
            raise
        print(f"lidar-view: {error.format_message().rstrip('.')}; see lidar-view --help", file=sys.stderr)
        code = 2
    sys.exit(int(code or 0))


if __name__ == "__main__":
    main()
