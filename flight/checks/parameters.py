"""PX4's parameters against what the mission needs: each rule says what is wrong, why it matters, and what would be right.

Sources: PX4 v1.17 parameter reference and the project's own recordings (px4_reference: override, offboard_loss, geofence).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from flight.checks.facts import Value
from flight.mission import Mission
from flight.preflight import Check, Level
from flight.px4 import GRAVITY_M_S2

OVERRIDE_OFFBOARD = 2  # bit of COM_RC_OVERRIDE
EXCEPT_OFFBOARD = 4  # bit of COM_RCL_EXCEPT
STICKS_DISABLED = 4  # COM_RC_IN_MODE
RCL_DISABLED, RCL_HOLD, RCL_RTL, RCL_LAND = 0, 1, 2, 3
FENCE_HOLD, FENCE_RTL, FENCE_LAND = 2, 3, 5
BATTERY_WARNING = 0
MAX_TILT_DEG = 45.0
FAST = 5.0  # times the mission's speed: no second line any more
LIMIT_SLACK = 1e-6


@dataclass(frozen=True, slots=True)
class Needs:
    """What the rules compare with. `max_hor_m`, `max_ver_m`: PX4's outer fence for this mission, from home; 0 if unknown."""

    mission: Mission
    values: dict[str, Value]
    gps: bool = True
    max_hor_m: float = 0.0
    max_ver_m: float = 0.0

    @property
    def ceiling_m(self) -> float:
        """Top of the mission's fence above the ground."""
        return self.mission.safety.fence.high_m[2]

    @property
    def outer_hor_m(self) -> float:
        """GF_MAX_HOR_DIST for `--apply`: rounded up to 0.1 m."""
        return math.ceil(10.0 * self.max_hor_m) / 10.0

    @property
    def outer_ver_m(self) -> float:
        """GF_MAX_VER_DIST for `--apply`: rounded up to 0.1 m."""
        return math.ceil(10.0 * self.max_ver_m) / 10.0


@dataclass(frozen=True, slots=True)
class Problem:
    """Why a value does not do."""

    level: Level
    why: str


@dataclass(frozen=True, slots=True)
class Rule:
    """One parameter. `judge` finds the problem or None; `right` is what `--apply` writes, None: only by hand.

    `for_pilot`: matters only where a person holds the sticks, so in a simulation it is only a warning.
    """

    name: str
    kind: type[int] | type[float]
    judge: Callable[[float, Needs], Problem | None]
    right: Callable[[Needs], Value] | None = None
    for_pilot: bool = False


def fail(why: str) -> Problem:
    """A problem that forbids to fly."""
    return Problem(Level.FAIL, why)


def warn(why: str) -> Problem:
    """A problem to know of."""
    return Problem(Level.WARN, why)


def judge_parameters(needs: Needs) -> list[Check]:
    """One line per parameter."""
    return [_line(rule, needs) for rule in RULES]


def corrections(needs: Needs) -> dict[str, Value]:
    """What `--apply` writes: right values of the parameters that are judged wrong now."""
    wrong: dict[str, Value] = {}
    for rule in RULES:
        held = needs.values.get(rule.name)
        if rule.right is not None and held is not None and rule.judge(held, needs) is not None:
            value = rule.right(needs)
            wrong[rule.name] = rule.kind(value)
    return wrong


def _line(rule: Rule, needs: Needs) -> Check:
    held = needs.values.get(rule.name)
    if held is None:
        return Check(rule.name, Level.WARN, "not in this firmware", "check by hand what PX4 does instead")
    problem = rule.judge(held, needs)
    if problem is None:
        return Check(rule.name, Level.PASS, f"{held:g}")
    level = Level.WARN if rule.for_pilot and needs.mission.simulated else problem.level
    advice = problem.why
    if rule.right is not None:
        advice += f"; set it to {rule.right(needs):g} (--apply does)"
    return Check(rule.name, level, f"{held:g}", advice)


# -- loss of the setpoint stream ---------------------------------------------------------------------------------


def _loss_timeout(value: float, needs: Needs) -> Problem | None:
    wanted = needs.mission.failsafe.setpoint_loss_timeout_s
    if math.isclose(value, wanted, rel_tol=1e-6):
        return None
    return warn(f"the mission wants {wanted:g} s; fly writes it before OFFBOARD")


def _loss_action(value: float, needs: Needs) -> Problem | None:
    failsafe = needs.mission.failsafe
    if value == failsafe.loss_action:
        return None
    return warn(f"the mission wants {failsafe.setpoint_loss_action} ({int(failsafe.loss_action)}); fly writes it before OFFBOARD")


# -- the pilot ---------------------------------------------------------------------------------------------------


def _override(value: float, _: Needs) -> Problem | None:
    if int(value) & OVERRIDE_OFFBOARD:
        return None
    return fail("moving the sticks would not take over in OFFBOARD (bit 1 is off, as by default)")


def _stick_threshold(value: float, _: Needs) -> Problem | None:
    return None if 5.0 <= value <= 50.0 else fail("the sticks take over far too late or by noise: 5 to 50 % is sane")


def _input_mode(value: float, _: Needs) -> Problem | None:
    return fail("stick input is disabled: nobody could take over") if value == STICKS_DISABLED else None


def _rc_loss_action(value: float, needs: Needs) -> Problem | None:
    if value in (RCL_HOLD, RCL_LAND):
        return None
    if value == RCL_DISABLED:
        return fail("nothing happens when the pilot's link is lost")
    if value == RCL_RTL:
        return (
            None
            if _returns_below_ceiling(needs)
            else fail(f"return climbs to RTL_RETURN_ALT, above the fence's {needs.ceiling_m:g} m")
        )
    return fail("it ends the flight in the air (terminate or disarm)")


def _rc_loss_exception(value: float, _: Needs) -> Problem | None:
    if int(value) & EXCEPT_OFFBOARD:
        return warn("losing the pilot's link is ignored in OFFBOARD (bit 2)")
    return None


def _rc_loss_timeout(value: float, _: Needs) -> Problem | None:
    return None if 0.0 < value <= 2.0 else fail("a lost pilot's link is noticed too late")


# -- the fence in PX4 --------------------------------------------------------------------------------------------


def _fence_action(value: float, needs: Needs) -> Problem | None:
    if value in (FENCE_HOLD, FENCE_LAND):
        return None
    if value == FENCE_RTL:
        return None if _returns_below_ceiling(needs) else fail("return climbs above the mission's fence")
    if value < FENCE_HOLD:
        return fail("PX4 would only warn: recorded vehicles flew on 11 m past their fence")
    return fail("terminate drops the vehicle")


def _fence_distance(value: float, needed_m: float, what: str) -> Problem | None:
    if value <= 0.0:
        return warn(f"PX4 has no second fence in {what}")
    if value < needed_m - 0.5:
        return fail(f"PX4's fence cuts into the mission's, which needs {needed_m:.1f} m in {what}")
    return warn(f"wider than needed ({needed_m:.1f} m)") if value > 3.0 * needed_m else None


def _fence_horizontal(value: float, needs: Needs) -> Problem | None:
    return _fence_distance(value, needs.max_hor_m, "distance")


def _fence_vertical(value: float, needs: Needs) -> Problem | None:
    return _fence_distance(value, needs.max_ver_m, "height")


def _fence_predict(value: float, _: Needs) -> Problem | None:
    return fail("PX4's predictive fence is experimental and may cause flyaways") if value else None


# -- limits ------------------------------------------------------------------------------------------------------


def _speed(value: float, needs: Needs) -> Problem | None:
    wanted = needs.mission.safety.max_horizontal_speed_m_s
    if value < wanted - LIMIT_SLACK:
        return fail(f"the mission flies {wanted:g} m/s: PX4 would hold it back")
    if value > FAST * wanted:
        return warn(f"no second line: lower it to about {2 * wanted:g} for first flights (it limits the pilot too)")
    return None


def _vertical_speed(value: float, needs: Needs) -> Problem | None:
    wanted = needs.mission.safety.max_vertical_speed_m_s
    return fail(f"the mission climbs and sinks at up to {wanted:g} m/s") if value < wanted - LIMIT_SLACK else None


def _wanted_vertical(needs: Needs) -> Value:
    return max(1.0, needs.mission.safety.max_vertical_speed_m_s)


def _tilt(value: float, needs: Needs) -> Problem | None:
    braking = needs.mission.safety.braking_m_s2
    if GRAVITY_M_S2 * math.tan(math.radians(min(value, 89.0))) < 1.25 * braking:
        return fail(f"too little tilt to brake with the assumed {braking:g} m/s^2")
    if value > MAX_TILT_DEG:
        return warn(f"over {MAX_TILT_DEG:g} deg the LiDAR looks at the ground")
    return None


def _acceleration(value: float, needs: Needs) -> Problem | None:
    braking = needs.mission.safety.braking_m_s2
    return fail(f"PX4's Hold would brake weaker than the assumed {braking:g} m/s^2") if value < braking else None


def _jerk(value: float, needs: Needs) -> Problem | None:
    least = 2.0 * needs.mission.safety.braking_m_s2
    return fail(f"braking would build up too slowly: at least {least:g} m/s^3") if value < least else None


def _yaw_rate(value: float, needs: Needs) -> Problem | None:
    wanted_deg = math.degrees(needs.mission.safety.max_yaw_rate_rad_s)
    return fail(f"the mission turns at up to {wanted_deg:.0f} deg/s") if value < wanted_deg else None


# -- other failsafes ---------------------------------------------------------------------------------------------


def _returns_below_ceiling(needs: Needs) -> bool:
    return needs.values.get("RTL_RETURN_ALT", math.inf) <= needs.ceiling_m


def _return_height(value: float, needs: Needs) -> Problem | None:
    if value <= needs.ceiling_m:
        return None
    return fail(f"a return to launch would climb to {value:g} m; the mission's fence ends at {needs.ceiling_m:g} m")


def _battery_action(value: float, _: Needs) -> Problem | None:
    return warn("PX4 only warns of an empty battery") if value == BATTERY_WARNING else None


def _collision_prevention(value: float, _: Needs) -> Problem | None:
    if value <= 0.0:
        return None
    return warn("Position mode does not move without OBSTACLE_DISTANCE: the pilot who takes over would be stuck")


def _auto_disarm(value: float, _: Needs) -> Problem | None:
    return fail("fly waits for PX4 to disarm after landing: it never would") if value <= 0.0 else None


def _arming_without_gps(value: float, needs: Needs) -> Problem | None:
    return fail("PX4 refuses to arm without GPS, and there is none") if value == 0 and not needs.gps else None


def _hardware_in_the_loop(value: float, needs: Needs) -> Problem | None:
    return fail("hardware-in-the-loop is on: the motors do not run") if value and not needs.mission.simulated else None


RULES: tuple[Rule, ...] = (
    Rule("COM_OF_LOSS_T", float, _loss_timeout, lambda n: n.mission.failsafe.setpoint_loss_timeout_s),
    Rule("COM_OBL_RC_ACT", int, _loss_action, lambda n: int(n.mission.failsafe.loss_action)),
    Rule("COM_RC_OVERRIDE", int, _override, lambda _: 3, for_pilot=True),
    Rule("COM_RC_STICK_OV", float, _stick_threshold, lambda _: 30.0, for_pilot=True),
    Rule("COM_RC_IN_MODE", int, _input_mode, None, for_pilot=True),
    Rule("NAV_RCL_ACT", int, _rc_loss_action, lambda _: RCL_LAND, for_pilot=True),
    Rule("COM_RCL_EXCEPT", int, _rc_loss_exception, lambda n: int(n.values["COM_RCL_EXCEPT"]) & ~EXCEPT_OFFBOARD, for_pilot=True),
    Rule("COM_RC_LOSS_T", float, _rc_loss_timeout, lambda _: 0.5, for_pilot=True),
    Rule("GF_ACTION", int, _fence_action, lambda _: FENCE_HOLD),
    Rule("GF_MAX_HOR_DIST", float, _fence_horizontal, lambda n: n.outer_hor_m),
    Rule("GF_MAX_VER_DIST", float, _fence_vertical, lambda n: n.outer_ver_m),
    Rule("GF_PREDICT", int, _fence_predict, lambda _: 0),
    Rule("MPC_XY_VEL_MAX", float, _speed, None),
    Rule("MPC_Z_VEL_MAX_UP", float, _vertical_speed, _wanted_vertical),
    Rule("MPC_Z_VEL_MAX_DN", float, _vertical_speed, _wanted_vertical),
    Rule("MPC_TILTMAX_AIR", float, _tilt, lambda _: MAX_TILT_DEG),
    Rule("MPC_ACC_HOR", float, _acceleration, lambda n: max(3.0, n.mission.safety.braking_m_s2)),
    Rule("MPC_JERK_MAX", float, _jerk, lambda n: max(8.0, 2.0 * n.mission.safety.braking_m_s2)),
    Rule("MC_YAWRATE_MAX", float, _yaw_rate, lambda _: 200.0),
    Rule("RTL_RETURN_ALT", float, _return_height, lambda n: n.mission.takeoff_height_m, for_pilot=True),
    Rule("COM_LOW_BAT_ACT", int, _battery_action, lambda _: 2),
    Rule("CP_DIST", float, _collision_prevention, lambda _: -1.0, for_pilot=True),
    Rule("COM_DISARM_LAND", float, _auto_disarm, lambda _: 2.0),
    Rule("COM_ARM_WO_GPS", int, _arming_without_gps, lambda _: 1),
    Rule("SYS_HITL", int, _hardware_in_the_loop, None),
)
READ_ALSO: tuple[tuple[str, type[int] | type[float]], ...] = (
    ("EKF2_GPS_CTRL", int),
    ("EKF2_EV_CTRL", int),
    ("EKF2_OF_CTRL", int),
)
