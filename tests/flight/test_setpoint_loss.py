"""PX4's reaction to a stream that stops: what fly writes, and the distances that it promises for it."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from stand import ROOT

from flight.errors import VehicleCommandError
from flight.mission import Mission, load_mission
from flight.preflight import Level
from flight.px4 import LossAction
from flight.setpoint_loss import set_loss_action, stopping_ways_m


@pytest.fixture(scope="module")
def mission() -> Mission:
    return load_mission(ROOT / "configs" / "corridor.yaml")


@dataclass
class Parameters:
    """A vehicle that takes parameters, or refuses one."""

    refused: str = ""
    held: dict[str, float] = field(default_factory=dict)

    def set_parameter(self, name: str, value: float) -> None:
        if name == self.refused:
            raise VehicleCommandError(f"parameter {name} reads back 1 after setting {value:g}")
        self.held[name] = value


def test_both_parameters_are_written_and_the_distances_said(mission: Mission) -> None:
    vehicle = Parameters()
    check = set_loss_action(vehicle, mission)  # type: ignore[arg-type]
    assert vehicle.held == {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": int(LossAction.HOLD)}
    assert check.level is Level.PASS
    assert all(f"{way_m:.2f} m" in check.seen for way_m in stopping_ways_m(mission))


@pytest.mark.parametrize("name", ["COM_OF_LOSS_T", "COM_OBL_RC_ACT"])
def test_a_parameter_that_does_not_stick_refuses_the_flight(mission: Mission, name: str) -> None:
    check = set_loss_action(Parameters(name), mission)  # type: ignore[arg-type]
    assert check.level is Level.FAIL
    assert name in check.seen


def test_the_ways_by_hand(mission: Mission) -> None:
    """1.2 m/s: 0.12 m until the guard's zero or 0.6 m until PX4's, 0.3 m of dead time and tick, 0.72 m of a 0.6 s lag."""
    assert stopping_ways_m(mission) == pytest.approx((1.14, 1.62))
