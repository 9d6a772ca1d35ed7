"""What LiDAR faults make of a scan: the scans that leave the device instead of the one it measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_gateway.faults import SCAN, Active, FaultSchedule
from sim_gateway.readings import Scan

Ranges = NDArray[np.float32]


class ScanFaults:
    """Stands behind the scanner. Give it every scan, in order; it gives what comes out of the device then."""

    def __init__(self, schedule: FaultSchedule, seed: int) -> None:
        self._schedule = schedule
        self._seed = seed
        self._taken = 0
        self._frozen: Scan | None = None
        self._late: list[tuple[float, Scan]] = []

    def pass_on(self, scan: Scan) -> list[Scan]:
        """The scans that leave the device at the time of this one, oldest first."""
        if not self._schedule.has(SCAN):
            return [scan]
        now_s = scan.time_s
        self._taken += 1
        active = self._schedule.group(SCAN, now_s)
        leaving = scan if any(item.kind.startswith("lidar_freeze") for item in active) else self._remember(scan)
        for item in active:
            changed = self._apply(item, leaving)
            if changed is None:
                return self._due(now_s)
            leaving = changed
        delay_s = max((item["delay_s"] for item in active if item.kind == "lidar_delay"), default=0.0)
        self._late.append((now_s + delay_s, leaving))
        return self._due(now_s)

    def _remember(self, scan: Scan) -> Scan:
        self._frozen = scan
        return scan

    def _due(self, now_s: float) -> list[Scan]:
        due = [scan for due_s, scan in self._late if due_s <= now_s + 1e-9]
        self._late = [item for item in self._late if item[0] > now_s + 1e-9]
        return due

    def _apply(self, item: Active, scan: Scan) -> Scan | None:
        """The scan after one fault; None when nothing is sent."""
        if item.kind == "lidar_silent" or (item.kind == "lidar_slow" and self._taken % max(1, round(item["every"]))):
            return None
        if item.kind in ("lidar_freeze", "lidar_freeze_old") and self._frozen is not None:
            stamp = scan.time_s if item.kind == "lidar_freeze" else self._frozen.time_s
            return replace(self._frozen, time_s=stamp)
        if item.kind == "lidar_clock":
            return replace(scan, time_s=scan.time_s + item["offset_s"] + item["rate_s_s"] * (scan.time_s - item.begin_s))
        change = _CHANGES.get(item.kind)
        if change is None:
            return scan
        generator = np.random.Generator(np.random.Philox(key=[self._seed, item.number], counter=[0, 0, 0, self._taken]))
        return replace(scan, ranges_m=change(scan, item, generator).astype(np.float32))


def _bearings(scan: Scan) -> NDArray[np.float64]:
    bearings: NDArray[np.float64] = scan.angle_min_rad + scan.angle_increment_rad * np.arange(
        scan.ranges_m.size, dtype=np.float64
    )
    return bearings


def _sector(scan: Scan, item: Active) -> NDArray[np.bool_]:
    apart = _bearings(scan) - math.radians(item["bearing_deg"])
    inside: NDArray[np.bool_] = np.abs(apart) <= math.radians(0.5 * item["width_deg"]) + 1e-9
    return inside


def _share(scan: Scan, item: Active, generator: np.random.Generator) -> NDArray[np.bool_]:
    hit: NDArray[np.bool_] = generator.random(scan.ranges_m.size) < item["share"]
    return hit


def _noise(scan: Scan, item: Active, generator: np.random.Generator) -> NDArray[np.floating]:
    noisy: NDArray[np.floating] = scan.ranges_m + item["sigma_m"] * generator.standard_normal(scan.ranges_m.size)
    too_near = np.isfinite(noisy) & (noisy < scan.range_min_m)
    return np.where(too_near, 0.0, np.where(noisy > scan.range_max_m, np.inf, noisy))


def _speckle(scan: Scan, item: Active, generator: np.random.Generator) -> NDArray[np.floating]:
    hit = _share(scan, item, generator)
    near = generator.uniform(item["near_m"], item["far_m"], scan.ranges_m.size)
    return np.where(hit, np.minimum(near, scan.ranges_m), scan.ranges_m)


def _phantom(scan: Scan, item: Active, _: np.random.Generator) -> NDArray[np.floating]:
    return np.where(_sector(scan, item), np.minimum(scan.ranges_m, item["distance_m"]), scan.ranges_m)


def _turned(scan: Scan, item: Active, _: np.random.Generator) -> NDArray[np.floating]:
    return np.roll(scan.ranges_m, round(math.radians(item["angle_deg"]) / scan.angle_increment_rad))


def _put(value: float) -> Callable[[Scan, Active, np.random.Generator], NDArray[np.floating]]:
    return lambda scan, _item, _generator: np.full(scan.ranges_m.size, value)


_CHANGES: dict[str, Callable[[Scan, Active, np.random.Generator], NDArray[np.floating]]] = {
    "lidar_noise": _noise,
    "lidar_speckle": _speckle,
    "lidar_lost_beams": lambda scan, item, generator: np.where(_share(scan, item, generator), np.inf, scan.ranges_m),
    "lidar_phantom": _phantom,
    "lidar_blocked": _phantom,
    "lidar_vanish": lambda scan, item, _: np.where(_sector(scan, item), np.inf, scan.ranges_m),
    "lidar_sector": lambda scan, item, _: np.where(_sector(scan, item), np.nan, scan.ranges_m),
    "lidar_mirror": lambda scan, _item, _generator: scan.ranges_m[::-1].copy(),
    "lidar_turned": _turned,
    "lidar_max": _put(math.inf),
    "lidar_min": _put(0.0),
    "lidar_nan": lambda scan, item, generator: np.where(_share(scan, item, generator), np.nan, scan.ranges_m),
    "lidar_value": lambda scan, item, generator: np.where(_share(scan, item, generator), item["value_m"], scan.ranges_m),
    "lidar_beams": lambda scan, item, _: scan.ranges_m[: max(1, round(item["beams"]))].copy(),
}
