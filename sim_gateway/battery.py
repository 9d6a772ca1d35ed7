"""The simulated battery as PX4's own simulator has it (failures.json): it drains while armed, charges when disarmed, shows late.

SIM_BAT_DRAIN: seconds from full to empty; SIM_BAT_MIN_PCT: where draining ends. What is shown follows the charge with a time
constant of about a second; the voltage shows at once. What is done about it is in `failsafes`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from sim_gateway.parameters import ParameterStore

FULL_V, EMPTY_V = 16.2, 14.4  # four cells
SHOWN_LAG_S = 0.95  # recorded: 70 % shown falls to 26 % within a second of an injected failure


class Charge(IntEnum):
    """MAV_BATTERY_CHARGE_STATE."""

    OK = 1
    LOW = 2
    CRITICAL = 3
    EMERGENCY = 4


@dataclass(slots=True)
class Battery:
    """`fraction`: charge that is shown; `charge_state`: as PX4 has announced it. A failed battery neither drains nor charges."""

    fraction: float = 1.0
    charge_state: Charge = Charge.OK
    _charge: float = 1.0
    _failed: bool = False

    @property
    def percent(self) -> int:
        """SYS_STATUS.battery_remaining."""
        return round(100.0 * min(max(self.fraction, 0.0), 1.0))

    @property
    def volts(self) -> float:
        """Terminal voltage."""
        return EMPTY_V + (FULL_V - EMPTY_V) * min(max(self._charge, 0.0), 1.0)

    def fail(self, fraction: float, *, shown_at_once: bool) -> None:
        """From now on this charge is left."""
        self._charge, self._failed = fraction, True
        if shown_at_once:
            self.fraction = fraction

    def recover(self) -> None:
        """The failure is over."""
        self._failed = False

    def step(self, armed: bool, dt_s: float, parameters: ParameterStore) -> None:
        """Let `dt_s` pass."""
        if not self._failed:
            self._charge = self._drained(dt_s, parameters) if armed else 1.0
        self.fraction += (self._charge - self.fraction) * (1.0 - math.exp(-dt_s / SHOWN_LAG_S))

    def _drained(self, dt_s: float, parameters: ParameterStore) -> float:
        lowest = parameters.get("SIM_BAT_MIN_PCT") / 100.0
        return max(self._charge - dt_s / max(parameters.get("SIM_BAT_DRAIN"), 1.0), min(lowest, self._charge))

    def judge(self, parameters: ParameterStore) -> Charge:
        """The state by BAT_LOW_THR, BAT_CRIT_THR and BAT_EMERGEN_THR."""
        names = (("BAT_EMERGEN_THR", Charge.EMERGENCY), ("BAT_CRIT_THR", Charge.CRITICAL), ("BAT_LOW_THR", Charge.LOW))
        return next((state for name, state in names if self.fraction < parameters.get(name)), Charge.OK)
