"""The companion computer: clock, wake-up precision, load, real-time rights, heat, disk."""

from __future__ import annotations

import os
import resource
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from flight.preflight import Check, Level

FIRST_PLAUSIBLE_S = 1_735_689_600.0  # 2025-01-01
LARGE_CLOCK_ERROR_S = 60.0
WAKE_UPS, WAKE_UP_PERIOD_S = 100, 0.01
LATE_WARN_MS, LATE_FAIL_MS = 5.0, 50.0
FEW_MB, TOO_FEW_MB = 1000.0, 200.0
HOT_C, TOO_HOT_C = 75.0, 85.0
REALTIME_ADVICE = "allow real time: LimitRTPRIO=90 and LimitMEMLOCK=infinity in the systemd unit"


def check_clock(now_s: float, vehicle_unix_s: float | None) -> list[Check]:
    """The wall clock, used for names and logs only; the loop lives on the monotonic clock."""
    stamp = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    resolution_s = time.get_clock_info("monotonic").resolution
    if resolution_s > 1e-3:
        return [
            Check(
                "clock",
                Level.FAIL,
                f"monotonic clock ticks in {1e3 * resolution_s:g} ms",
                "use a kernel with high-resolution timers",
            )
        ]
    if now_s < FIRST_PLAUSIBLE_S:
        return [Check("clock", Level.WARN, stamp, "the wall clock is wrong: set it (NTP, RTC), or logs will be hard to find")]
    if vehicle_unix_s is not None and abs(vehicle_unix_s - now_s) > LARGE_CLOCK_ERROR_S:
        seen = f"{stamp}, {abs(vehicle_unix_s - now_s):.0f} s apart from the vehicle's"
        return [Check("clock", Level.WARN, seen, "set it (NTP, RTC), or logs of the two will not match")]
    return [Check("clock", Level.PASS, stamp)]


def measure_lateness_ms(wake_ups: int = WAKE_UPS, period_s: float = WAKE_UP_PERIOD_S) -> tuple[float, float]:
    """(p99, maximum) of how much later than asked this process wakes up, ms."""
    late: list[float] = []
    due_s = time.monotonic()
    for _ in range(wake_ups):
        due_s += period_s
        time.sleep(max(0.0, due_s - time.monotonic()))
        late.append(time.monotonic() - due_s)
        due_s = max(due_s, time.monotonic() - period_s)
    return 1e3 * float(np.percentile(late, 99)), 1e3 * max(late)


def check_wake_up(p99_ms: float, max_ms: float) -> list[Check]:
    """Lateness of wake-ups against the 50 ms period of the loop."""
    seen = f"wakes up {p99_ms:.1f} ms late (p99), {max_ms:.1f} ms at most"
    if p99_ms > LATE_FAIL_MS:
        return [Check("wake-up", Level.FAIL, seen, "this computer is too busy to fly: stop other programs")]
    if p99_ms > LATE_WARN_MS:
        return [Check("wake-up", Level.WARN, seen, "stop other programs; " + REALTIME_ADVICE)]
    return [Check("wake-up", Level.PASS, seen)]


def check_load(load: float, cores: int) -> list[Check]:
    """One-minute load average against the cores."""
    seen = f"load {load:.1f} on {cores} cores"
    if load > cores:
        return [Check("CPU load", Level.WARN, seen, "stop other programs: each core should have room")]
    return [Check("CPU load", Level.PASS, seen)]


def check_real_time(rt_priority: int, memory_lock: int, governors: Iterable[str]) -> list[Check]:
    """What the process may ask for, and the frequency governors."""
    lacking = []
    if rt_priority == 0:
        lacking.append("no real-time priority")
    if memory_lock != resource.RLIM_INFINITY and memory_lock < 256 * 1024 * 1024:
        lacking.append("memory cannot be locked")
    slow = sorted({name for name in governors if name != "performance"})
    checks = [Check("real time", Level.PASS, "real-time priority and memory locking allowed")]
    if lacking:
        checks = [Check("real time", Level.WARN, ", ".join(lacking), REALTIME_ADVICE)]
    if slow:
        advice = "choose the `performance` governor for flights (cpupower frequency-set -g performance)"
        checks.append(Check("CPU governor", Level.WARN, ", ".join(slow), advice))
    return checks


def check_heat(hottest_c: float | None) -> list[Check]:
    """The hottest zone: above about 80 C small computers throttle."""
    if hottest_c is None:
        return []
    seen = f"{hottest_c:.0f} C"
    if hottest_c > TOO_HOT_C:
        return [Check("temperature", Level.FAIL, seen, "let it cool down; it throttles")]
    if hottest_c > HOT_C:
        return [Check("temperature", Level.WARN, seen, "near throttling: add cooling")]
    return [Check("temperature", Level.PASS, seen)]


def check_disk(free_mb: float, writable: bool, folder: Path) -> list[Check]:
    """Room for the flight's folder."""
    if not writable:
        return [Check("disk", Level.FAIL, f"{folder} cannot be written", "give another folder with --out, or mount it writable")]
    seen = f"{free_mb / 1000.0:.1f} GB free"
    if free_mb < TOO_FEW_MB:
        return [Check("disk", Level.FAIL, seen, "delete old runs: a flight needs some hundred MB")]
    if free_mb < FEW_MB:
        return [Check("disk", Level.WARN, seen, "delete old runs soon")]
    return [Check("disk", Level.PASS, seen)]


def check_computer(vehicle_unix_s: float | None, folder: Path) -> list[Check]:
    """All of it, measured here and now (takes about a second)."""
    checks = check_clock(time.time(), vehicle_unix_s)
    checks += check_wake_up(*measure_lateness_ms())
    checks += check_load(os.getloadavg()[0], len(os.sched_getaffinity(0)))
    checks += check_real_time(_rt_priority(), resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], _governors())
    checks += check_heat(_hottest_c())
    free_mb = shutil.disk_usage(folder).free / 1e6
    return checks + check_disk(free_mb, os.access(folder, os.W_OK), folder)


def _rt_priority() -> int:
    return 99 if os.geteuid() == 0 else resource.getrlimit(resource.RLIMIT_RTPRIO)[0]


def _governors() -> list[str]:
    return [text for path in Path("/sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor") if (text := _read(path))]


def _hottest_c() -> float | None:
    texts = [_read(path) for path in Path("/sys/class/thermal").glob("thermal_zone*/temp")]
    values = [int(text) / 1000.0 for text in texts if text.lstrip("-").isdigit()]
    return max(values, default=None)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return ""
