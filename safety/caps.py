"""One factor on the speed limits for assumptions that weaken in flight: old data, a late loop, a slow link, weak braking.

All delays beyond their nominal value add to the total blind time T; speed is then limited to what makes v T no longer than
assumed. The factor is exactly 1 while everything is nominal, so that nothing changes, bit for bit.
"""

from __future__ import annotations

import math

from safety.config import SafetyConfig
from safety.frames import CorridorVector
from safety.messages import Health, Intervention, VelocityCommand


def extra_delay_s(state_age_s: float, scan_age_s: float, health: Health, config: SafetyConfig) -> float:
    """Delay beyond what the assumptions contain, s. NaN is unknown and adds nothing."""
    monitors = config.monitors
    beyond = (
        max(_beyond(state_age_s, monitors.nominal_state_age_s), _beyond(scan_age_s, monitors.nominal_scan_age_s)),
        _beyond(health.lateness_s, monitors.nominal_late_s),
        _beyond(health.link_delay_s, monitors.nominal_link_delay_s),
        _beyond(health.inference_s, monitors.inference_late_s),
    )
    return math.fsum(beyond)


def cap_factor(extra_s: float, braking: float, config: SafetyConfig) -> float:
    """Share of the speed limits that may be flown. `braking`: share that the braking seen supports, 0..1."""
    if extra_s == 0.0 and braking == 1.0:
        return 1.0
    return max(config.monitors.cap_least, braking * config.delay_s / (config.delay_s + extra_s))


def cap_speed(command: VelocityCommand, factor: float, config: SafetyConfig) -> tuple[VelocityCommand, tuple[Intervention, ...]]:
    """The command, shortened where it is faster than `factor` times the limits; the very same where it is not."""
    if factor == 1.0:
        return command, ()
    v, across, up = command.velocity, factor * config.max_horizontal_speed_m_s, factor * config.max_vertical_speed_m_s
    share = min(across / max(math.hypot(v.x, v.y), across), up / max(abs(v.z), up))
    if share == 1.0:
        return command, ()
    speed = math.sqrt(v.x * v.x + v.y * v.y + v.z * v.z)
    shorter = CorridorVector(share * v.x, share * v.y, share * v.z)
    return VelocityCommand(shorter, command.yaw_rate_rad_s), (Intervention("speed_cap", speed, share * speed),)


def _beyond(value_s: float, nominal_s: float) -> float:
    return value_s - nominal_s if value_s > nominal_s else 0.0
