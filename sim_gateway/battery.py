"""The simulated battery, and what PX4 does about it (failures.json: warnings, Hold for a while, then landing)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from sim_gateway.parameters import ParameterStore

FULL_V, EMPTY_V = 16.2, 14.4  # four cells


class Charge(IntEnum):
    """MAV_BATTERY_CHARGE_STATE."""

    OK = 1
    LOW = 2
    CRITICAL = 3
    EMERGENCY = 4


@dataclass(slots=True)
class Battery:
    """`fraction` of the charge that is left; `charge_state` as PX4 has announced it."""

    fraction: float = 1.0
    charge_state: Charge = Charge.OK

    @property
    def percent(self) -> int:
        """SYS_STATUS.battery_remaining."""
        return round(100.0 * min(max(self.fraction, 0.0), 1.0))

    @property
    def volts(self) -> float:
        """Terminal voltage."""
        return EMPTY_V + (FULL_V - EMPTY_V) * min(max(self.fraction, 0.0), 1.0)

    def judge(self, parameters: ParameterStore) -> Charge:
        """The state by BAT_LOW_THR, BAT_CRIT_THR and BAT_EMERGEN_THR."""
        names = (("BAT_EMERGEN_THR", Charge.EMERGENCY), ("BAT_CRIT_THR", Charge.CRITICAL), ("BAT_LOW_THR", Charge.LOW))
        return next((state for name, state in names if self.fraction < parameters.get(name)), Charge.OK)
