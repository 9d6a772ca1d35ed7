"""Replays of link_census.json, modes.json and parameters_full.json: what is sent how often, what status says, what is stored."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

from pymavlink.dialects.v20 import development as mav

from sim_gateway.conformance.bench import Bench
from sim_gateway.conformance.facts import Json
from sim_gateway.conformance.rows import RATE_HZ, RATE_SHARE, Row, Table
from sim_gateway.flight_modes import FlightMode

WINDOW_S = 15.0
NO_EVENTS = "events say in numbers what STATUSTEXT says in words; the gateway sends the words"
# The recording says that it could not tell these from other senders' on the ground station link.
_INFLATED = ("EVENT", "CURRENT_EVENT_SEQUENCE", "LINK_NODE_STATUS", "TIME_ESTIMATE_TO_TARGET")
_LINKS = {"onboard_14540": "onboard", "gcs_14550": "ground"}


def census(facts: Json) -> list[Row]:
    """Which messages come how often on which link."""
    table = Table("census", {f"{situation}, ground: EVENT": NO_EVENTS for situation in facts})
    benches: dict[str, Callable[[], Bench]] = {
        "disarmed": lambda: Bench(everything=True).run(4.0),
        "flying_offboard": lambda: Bench(5.0, everything=True).run(4.0).offboard(),
        "flying_hold": lambda: Bench(5.0, everything=True).run(4.0),
    }
    for situation, make in benches.items():
        bench = make()
        since_s = bench.time_s
        bench.run(WINDOW_S)
        for link, client in _LINKS.items():
            counted = Counter(m.get_type() for at, m in getattr(bench, client).seen if at > since_s)
            for name in sorted(set(facts[situation][link]) | set(counted)):
                recorded = facts[situation][link].get(name)
                _rate_row(table, f"{situation}, {client}: {name}", name, recorded, counted[name] / WINDOW_S)
    return table.rows


def _rate_row(table: Table, case: str, name: str, recorded: float | None, hz: float) -> None:
    if recorded is None:
        table.add(case, "not seen", f"{hz:.2f} Hz", False)
        return
    low = high = recorded
    if name in _INFLATED and ", ground:" in case:
        low = recorded / 4.0
    same = low * (1 - RATE_SHARE) - RATE_HZ <= hz <= high * (1 + RATE_SHARE) + RATE_HZ
    table.add(case, f"{recorded:.2f} Hz", f"{hz:.2f} Hz", same)


def _failsafe(action: int) -> Bench:
    bench = Bench(5.0, parameters={"COM_OBL_RC_ACT": action}).offboard()
    bench.stream = None
    return bench.run(1.5)


def _with_sticks() -> Bench:
    bench = Bench(5.0)
    bench.sticks = (0, 0, 500, 0)
    bench.run(0.5).pilot.set_mode(FlightMode.POSCTL)
    return bench.run(0.2)


def _landed_from_offboard() -> Bench:
    bench = Bench(1.5).offboard()
    bench.stream = None
    bench.command(mav.MAV_CMD_NAV_LAND).run(20.0, until=lambda: not bench.pilot.armed)
    return bench.run(0.2)


def _armed(mode: FlightMode) -> Bench:
    bench = Bench().fly(0.0) if mode is FlightMode.OFFBOARD else Bench()
    bench.run(0.2).pilot.set_mode(mode)
    bench.pilot.arm()
    return bench.run(0.2)


def _taking_off() -> Bench:
    bench = _armed(FlightMode.LOITER)
    return bench.command(mav.MAV_CMD_NAV_TAKEOFF, *[math.nan] * 7).run(3.0)


def _flying(mode: FlightMode, seconds: float = 0.2) -> Bench:
    bench = Bench(5.0).run(0.5)
    bench.pilot.set_mode(mode)
    return bench.run(seconds)


def _disarmed_offboard() -> Bench:
    bench = Bench().fly(0.0).run(0.2)
    bench.pilot.set_mode(FlightMode.OFFBOARD)
    return bench.run(0.2)


def _without_gps() -> Bench:
    bench = Bench(5.0).offboard()
    bench.pilot.parameters.set("SIM_GPS_USED", 0)
    return bench.run(5.5)


_MODES: dict[str, Callable[[], Bench]] = {
    "disarmed_ready": lambda: Bench().run(0.2),
    "armed_on_ground_default_mode": lambda: _armed(FlightMode.LOITER),
    "disarmed_offboard": _disarmed_offboard,
    "armed_on_ground_offboard": lambda: _armed(FlightMode.OFFBOARD),
    "takeoff": _taking_off,
    "hold_loiter": lambda: _flying(FlightMode.LOITER),
    "offboard": lambda: Bench(5.0).offboard(),
    "rtl": lambda: _flying(FlightMode.RTL, 3.0),
    "land": lambda: _flying(FlightMode.LAND),
    "disarmed_after_land": _landed_from_offboard,
    "posctl_with_manual_input": _with_sticks,
    "failsafe_AUTO.RTL": lambda: _failsafe(3),
    "failsafe_AUTO.LAND": lambda: _failsafe(4),
    "failsafe_AUTO.LOITER": lambda: _failsafe(5),
    "failsafe_gps_loss": _without_gps,
}


def modes(facts: Json) -> list[Row]:
    """HEARTBEAT, EXTENDED_SYS_STATE and CURRENT_MODE in every mode that was recorded."""
    table = Table("modes")
    for name, recorded in facts.items():
        bench = _MODES[name]()
        beat = bench.heartbeat()
        for field in ("type", "autopilot", "base_mode", "custom_mode", "system_status"):
            if field in recorded:
                table.equal(f"{name}: {field}", recorded[field], getattr(beat, field))
        if "extended_sys_state_landed" in recorded:
            state = bench.named("EXTENDED_SYS_STATE")[-1][1]
            table.equal(f"{name}: landed_state", recorded["extended_sys_state_landed"], state.landed_state)
        if "CURRENT_MODE" in recorded:
            current = bench.named("CURRENT_MODE")[-1][1]
            for field in ("standard_mode", "custom_mode", "intended_custom_mode"):
                table.equal(f"{name}: CURRENT_MODE.{field}", recorded["CURRENT_MODE"][field], getattr(current, field))
    return table.rows


def parameters(facts: Json) -> list[Row]:
    """Names, types and defaults. One row each for the whole list: 875 rows would hide everything else."""
    table, store = Table("parameters"), Bench().pilot.parameters
    names = [name for name in facts if name in store]
    kinds = {"INT32": 6, "REAL32": 9}
    table.equal("names", len(set(facts)), len(set(facts) & set(store.names)))
    table.equal("no others", 0, len(set(store.names) - set(facts)))
    table.equal("types", 0, sum(kinds[facts[n][0]] != store.type_of(n) for n in names))
    table.equal("defaults", 0, sum(not math.isclose(facts[n][1], store.get(n), rel_tol=1e-6, abs_tol=1e-9) for n in names))
    return table.rows
