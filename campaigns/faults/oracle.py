"""Was the reaction right, and how long did it take? Judged from what left the computer, what the autopilot did and the truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from campaigns.faults.catalogue import Expected, Reaction
from campaigns.faults.stage import Trace
from flight.guard.core import Velocity
from flight.px4 import COMMAND_DO_SET_MODE
from sim_gateway.flight_modes import FlightMode

HOLD_COMMAND_S = 1.5  # brake of a second, then the command
ROUNDING_S = 1e-6
AHEAD_M_S = 0.05
MOVING_SHARE = 0.8
_HOLD, _LAND = (4.0, 3.0), (4.0, 6.0)


@dataclass(frozen=True, slots=True)
class Verdict:
    """`problem`: None when all was right. `reaction_s`: None where nothing has to happen. `rules`: named while it lasted."""

    problem: str | None
    reaction_s: float | None
    rules: tuple[str, ...]
    outcome: str
    fence_margin_m: float
    contacts: int


def judge(trace: Trace, expected: Expected) -> Verdict:
    """The verdict on one run."""
    rules = _rules(trace, expected)
    reaction_s, problem = _JUDGES[expected.reaction](trace, expected)
    if problem is None and reaction_s is not None and reaction_s > expected.bound_s + ROUNDING_S:
        problem = f"{1e3 * reaction_s:.0f} ms, bound {1e3 * expected.bound_s:.0f} ms"
    if problem is None and expected.rules and not trace.refused and not set(expected.rules) & set(rules):
        problem = f"named {', '.join(rules) or 'nothing'}, not {' or '.join(expected.rules)}"
    problem = problem or _unsafe(trace, expected)
    outcome = trace.ending.outcome if trace.ending is not None else "flying"
    return Verdict(problem, reaction_s, rules, outcome, trace.fence_margin_m, trace.contacts)


def moving(setpoint: Velocity) -> bool:
    """Whether it asks for any motion."""
    return any(setpoint)


def _until(trace: Trace, expected: Expected) -> float:
    return min(trace.felt_s + expected.window_s, max(trace.over_s, trace.felt_s))


def _rules(trace: Trace, expected: Expected) -> tuple[str, ...]:
    """What the safety layer named while the fault lasted, faults first."""
    records = [record for time_s, record in trace.records if trace.felt_s - ROUNDING_S <= time_s <= _until(trace, expected)]
    faults = dict.fromkeys(r.verdict.fault for r in records if r.verdict.fault is not None)
    told = dict.fromkeys(i.rule for r in records for i in r.verdict.interventions)
    return tuple(dict.fromkeys((*faults, *told)))


def _unsafe(trace: Trace, expected: Expected) -> str | None:
    if expected.contacts and trace.contacts:
        return "touched something"
    if expected.fence and trace.fence_margin_m < 0.0:
        return f"left the fence by {-trace.fence_margin_m:.2f} m"
    return None


def _commanded(trace: Trace, mode: tuple[float, float]) -> float:
    """When fly commanded a mode after the fault was felt; infinity when never."""
    times = (t for t, command, *numbers in trace.commands if command == COMMAND_DO_SET_MODE and tuple(numbers) == mode)
    return min((t for t in times if t >= trace.felt_s), default=math.inf)


def _brake(trace: Trace, expected: Expected) -> tuple[float | None, str | None]:
    """From the fault to the first setpoint of a zero series that lasts."""
    window = [(t, v) for t, v in trace.sent if trace.felt_s - ROUNDING_S <= t <= _until(trace, expected)]
    last = max((t for t, v in window if moving(v)), default=None)
    if last is None:
        return (window[0][0] - trace.felt_s if window else 0.0), None
    after = min((t for t, _ in window if t > last), default=None)
    if after is not None and after - trace.felt_s <= expected.bound_s + ROUNDING_S:
        return after - trace.felt_s, None
    if after is None and last - trace.felt_s <= expected.bound_s + ROUNDING_S:
        return last - trace.felt_s, None  # the stream ended there
    return (after if after is not None else last) - trace.felt_s, _when_moving(window, trace.felt_s, expected)


def _when_moving(window: list[tuple[float, Velocity]], felt_s: float, expected: Expected) -> str:
    first = min((t for t, v in window if not moving(v)), default=None)
    late = sum(moving(v) for t, v in window if t > felt_s + expected.bound_s)
    stopped = f"first zero after {1e3 * (first - felt_s):.0f} ms" if first is not None else "never zero"
    return f"{stopped}, then {late} moving setpoints after the bound of {1e3 * expected.bound_s:.0f} ms"


def _hold(trace: Trace, expected: Expected) -> tuple[float | None, str | None]:
    reaction_s, problem = _brake(trace, expected)
    if problem is not None:
        return reaction_s, problem
    hold_s, land_s = _commanded(trace, _HOLD) - trace.felt_s, _commanded(trace, _LAND) - trace.felt_s
    if min(hold_s, land_s) > expected.bound_s + HOLD_COMMAND_S:
        when = f"after {min(hold_s, land_s):.2f} s" if math.isfinite(min(hold_s, land_s)) else "never"
        return reaction_s, f"Hold was commanded {when}, bound {expected.bound_s + HOLD_COMMAND_S:.2f} s"
    return reaction_s, None if math.isfinite(land_s) or trace.end_s - hold_s - trace.felt_s < 1.0 else "never landed"


def _yield(trace: Trace, _expected: Expected) -> tuple[float | None, str | None]:
    """The last thing that fly sent."""
    times = [t for t, _ in trace.sent] + [t for t, command, *_ in trace.commands if command == COMMAND_DO_SET_MODE]
    return max((t - trace.felt_s for t in times if t >= trace.felt_s), default=0.0), None


def _stop(trace: Trace, _expected: Expected) -> tuple[float | None, str | None]:
    """PX4's loss action, and no way back to OFFBOARD."""
    modes = [(t, mode) for t, mode, _ in trace.modes if t >= trace.begin_s]
    taken_s = next((t for t, mode in modes if mode is FlightMode.LOITER), math.inf)
    if not any(t < trace.begin_s and mode is FlightMode.OFFBOARD for t, mode, _ in trace.modes):
        return 0.0, None if not any(mode is FlightMode.OFFBOARD for _, mode in modes) else "OFFBOARD was entered"
    if math.isinf(taken_s):
        return None, "the autopilot never took over"
    back = any(t > taken_s and mode is FlightMode.OFFBOARD for t, mode in modes)
    return taken_s - trace.felt_s, "back to OFFBOARD" if back else None


def _away(trace: Trace, expected: Expected) -> tuple[float | None, str | None]:
    """The last setpoint with a part ahead, by the yaw of its tick."""
    yaw = [(t, r.yaw_rad) for t, r in trace.records if trace.felt_s - ROUNDING_S <= t <= _until(trace, expected)]
    last = trace.felt_s
    for time_s, velocity in trace.sent:
        near = min(yaw, key=lambda item: abs(item[0] - time_s), default=None)
        if near is None or not trace.felt_s <= time_s <= _until(trace, expected):
            continue
        ahead = velocity[0] * math.cos(near[1]) - velocity[1] * math.sin(near[1])  # NED north, east; yaw counter-clockwise
        last = time_s if ahead > AHEAD_M_S else last
    return last - trace.felt_s, None


def _fly(trace: Trace, expected: Expected) -> tuple[float | None, str | None]:
    window = [(t, v) for t, v in trace.sent if trace.felt_s <= t <= _until(trace, expected)]
    records = [r for t, r in trace.records if trace.felt_s <= t <= _until(trace, expected)]
    faults = sorted({r.verdict.fault for r in records if r.verdict.fault is not None})
    if faults:
        return None, f"named {', '.join(faults)}"
    if trace.ending is not None:
        return None, f"ended: {trace.ending.message}"
    wanted = [r for r in records if r.wanted is not None]
    if len(window) < MOVING_SHARE * len(records) or len(wanted) < len(records):
        return None, "the stream has gaps"
    return None, None


def _refuse(trace: Trace, _expected: Expected) -> tuple[float | None, str | None]:
    asked = sum(
        command == COMMAND_DO_SET_MODE and numbers[0] == FlightMode.OFFBOARD.main for _, command, *numbers in trace.commands
    )
    if any(mode is FlightMode.OFFBOARD for _, mode, _ in trace.modes):
        return None, "OFFBOARD was entered"
    if any(moving(v) for _, v in trace.sent):
        return None, "a moving setpoint was sent"
    return None, None if 1 <= asked <= 3 else f"OFFBOARD was asked for {asked} times"


_JUDGES: dict[Reaction, Callable[[Trace, Expected], tuple[float | None, str | None]]] = {
    Reaction.BRAKE: _brake,
    Reaction.HOLD: _hold,
    Reaction.YIELD: _yield,
    Reaction.STOP: _stop,
    Reaction.AWAY: _away,
    Reaction.FLY: _fly,
    Reaction.SAFE: lambda _trace, _expected: (None, None),
    Reaction.REFUSE: _refuse,
}
