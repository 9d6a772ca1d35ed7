"""The fault campaign: the catalogue is whole, each sort of fault gets its reaction, and a filter that does nothing is seen."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from campaigns.faults import campaign
from campaigns.faults.campaign import ENTRIES, GROUND_ENTRIES, ON_GROUND, Result, cases, run_all, run_case, summarise
from campaigns.faults.catalogue import ELSEWHERE, IN_FLIGHT, Expected, Reaction
from campaigns.faults.ground import VARIANTS
from campaigns.faults.oracle import judge
from campaigns.faults.realtime import FLOWN, text_of, trace_of, write_mission
from campaigns.faults.report import draw, markdown
from campaigns.faults.run import Case, play
from campaigns.faults.scenes import FLIGHT_SCENES, SCENES
from campaigns.faults.stage import Stage, Trace, load
from campaigns.lockstep import Unfiltered
from flight.mission import load_mission
from sim_gateway.faults import Fault
from sim_gateway.flight_modes import FlightMode

ROOT = Path(__file__).resolve().parents[2]
MISSION = ROOT / "configs" / "corridor.yaml"
CATALOGUE = {
    *(f"L{i}" for i in range(1, 19)), *(f"E{i}" for i in range(1, 12)), *(f"K{i}" for i in range(1, 12)),
    *(f"P{i}" for i in range(1, 12)), *(f"C{i}" for i in range(1, 14)), *(f"V{i}" for i in range(1, 11)),
    *(f"G{i}" for i in range(1, 9)),
}  # fmt: skip


# -- what is injected


def test_every_row_of_the_catalogue_is_injected_or_says_where_it_is_shown() -> None:
    assert {*ENTRIES, *GROUND_ENTRIES, *ELSEWHERE} == CATALOGUE
    assert len(ENTRIES) + len(GROUND_ENTRIES) >= 75
    assert len(FLIGHT_SCENES) >= 5
    assert len(FLOWN) >= 25
    assert set(FLOWN) <= set(ENTRIES)
    assert all(set(entry.scenes) <= set(FLIGHT_SCENES) for entry in IN_FLIGHT)
    assert all(entry.faults or entry.inject for entry in IN_FLIGHT)


def test_cases_are_every_fault_in_every_scene_with_every_seed() -> None:
    assert len(cases(5)) == 5 * len(ENTRIES) * len(FLIGHT_SCENES) + VARIANTS * len(GROUND_ENTRIES)
    assert cases(2, ["L1"]) == [Case("L1", scene, seed) for seed in (1, 2) for scene in FLIGHT_SCENES]
    with pytest.raises(ValueError, match="no such fault: L99"):
        cases(1, ["L99"])


# -- reactions, each sort once


@pytest.mark.parametrize(
    ("fault", "scene"),
    [
        ("L1", "wall"), ("L5", "engage"), ("L8", "hover"), ("L13", "wall"), ("L18", "yawing"), ("E1", "corner"),
        ("E3", "braking"), ("E9", "hover"), ("K1", "wall"), ("K2", "corner"), ("K5", "yawing"), ("K8", "hover"),
        ("P1", "wall"), ("P3", "yawing"),
        ("P7", "wall"), ("C1", "wall"), ("C5", "hover"), ("C7", "yawing"), ("C11", "hover"), ("V1", "braking"), ("V3", "hover"),
        ("V5", "engage"), ("V6", "wall"),
    ],
)  # fmt: skip
def test_reaction(fault: str, scene: str) -> None:
    result = run_case(Case(fault, scene, 1), MISSION)
    assert result.problem is None, result


@pytest.mark.parametrize("fault", GROUND_ENTRIES)
def test_refused_on_the_ground(fault: str) -> None:
    problems = {variant: run_case(Case(fault, "ground", variant), MISSION).problem for variant in range(VARIANTS)}
    assert problems == dict.fromkeys(range(VARIANTS))


@pytest.mark.parametrize("scene", SCENES)
def test_without_a_fault_every_scene_moves_and_stays_inside(scene: str) -> None:
    mission, runner = load(MISSION)
    trace = Stage(SCENES[scene], mission, runner, 3, duration_s=3.5 if SCENES[scene].before_offboard else 2.0).play()
    moving = [time_s for time_s, velocity in trace.sent if any(velocity)]
    assert len(moving) > 30
    assert trace.contacts == 0
    assert trace.fence_margin_m > 0.0
    assert not [record.verdict.fault for _, record in trace.records if record.verdict.fault]


def test_the_same_case_gives_the_same_result() -> None:
    case = Case("K5", "corner", 2)
    assert run_case(case, MISSION) == run_case(case, MISSION)


# -- the campaign can fail


def test_what_is_done_is_kept_on_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "KEEP_EVERY_S", 0.0)
    wanted = [Case(next(iter(GROUND_ENTRIES)), ON_GROUND, variant) for variant in range(2)]
    kept: list[list[Result]] = []
    results = run_all(wanted, MISSION, 1, kept.append)
    assert kept == [results[:1], results]


@pytest.mark.parametrize(("fault", "scene"), [("L4", "wall"), ("E9", "hover"), ("P5", "corner"), ("L5", "yawing")])
def test_a_filter_that_passes_everything_is_found_out(fault: str, scene: str) -> None:
    mission, runner = load(MISSION)
    _, verdict = play(ENTRIES[fault], scene, 1, mission, runner, make_filter=Unfiltered)
    assert verdict.problem is not None


def test_the_oracle_sees_late_missing_and_wrong_reactions() -> None:
    still, ahead = (0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    brake = Expected(Reaction.BRAKE, 0.2)

    def trace(*moving_until_s: float, end_s: float = 14.0) -> Trace:
        times = [10.0 + 0.05 * k for k in range(round((end_s - 10.0) / 0.05))]
        sent = [(t, ahead if any(low <= t < high for low, high in spans(moving_until_s)) else still) for t in times]
        return Trace(11.0, felt_s=11.0, sent=sent, end_s=end_s)

    def spans(edges: tuple[float, ...]) -> list[tuple[float, float]]:
        return list(zip(edges[::2], edges[1::2], strict=True))

    assert judge(trace(0.0, 11.12), brake).problem is None
    assert "first zero after 300 ms" in str(judge(trace(0.0, 11.28), brake).problem)
    assert "moving setpoints after" in str(judge(trace(0.0, 11.12, 12.0, 12.5), brake).problem)
    assert "never zero" in str(judge(trace(0.0, 20.0), brake).problem)
    assert "named nothing" in str(judge(trace(0.0, 11.12), replace(brake, rules=("scan_stale",))).problem)
    assert "Hold was commanded never" in str(judge(trace(0.0, 11.12), Expected(Reaction.HOLD, 0.2)).problem)
    assert "3000 ms" in str(judge(trace(end_s=14.05), Expected(Reaction.YIELD, 0.2)).problem)
    touched = trace(0.0, 11.12)
    touched.contacts, touched.fence_margin_m = 1, -0.1
    assert judge(touched, brake).problem == "touched something"
    assert judge(touched, replace(brake, contacts=False)).problem == "left the fence by 0.10 m"
    assert judge(trace(), Expected(Reaction.STOP, 0.7)).problem is None
    lost = trace()
    lost.modes = [(10.0, FlightMode.OFFBOARD, False), (11.5, FlightMode.LOITER, True), (12.0, FlightMode.OFFBOARD, False)]
    assert judge(lost, Expected(Reaction.STOP, 0.7)).problem == "back to OFFBOARD"


# -- what is published


def test_table_and_plot(tmp_path: Path) -> None:
    results = [run_case(case, MISSION) for case in (Case("L5", "hover", 1), Case("G1", "ground", 0))]
    result = summarise([*results, replace(results[0], seed=2, problem="late", reaction_s=0.4)], "a command", 2)
    assert json.loads(json.dumps(result))["right"] == 2
    assert "| L5 | every beam too near | brake | 1 of 2 |" in markdown(result)
    draw(result, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 5000


# -- real time


def test_a_mission_in_real_time_carries_its_faults(tmp_path: Path) -> None:
    for name in FLOWN:
        mission = load_mission(write_mission(ENTRIES[name], ROOT / "policies" / "corridor_ppo_lstm.onnx", tmp_path))
        assert mission.sim is not None
        placed = [Fault.parse(text) for text in mission.sim.faults]
        assert [fault.kind for fault in placed] == [fault.kind for fault in ENTRIES[name].faults]
        assert all(fault.after == "offboard" and fault.start_s >= 3.0 for fault in placed)
    assert text_of(Fault(kind="battery", parameters={"fraction": 0.12})) == "battery@offboard:3.0:fraction=0.12"


def test_the_gateways_report_is_judged_like_a_run() -> None:
    rows = [[10.0 + 0.05 * k, 1.0 if k < 62 else 0.0, 0.0, 0.0, 0.0, 245, 192] for k in range(120)]
    report = {
        "faults": [{"kind": "lidar_silent", "begin_s": 13.0, "end_s": 16.0}],
        "setpoints": {"rows": [*rows, [13.5, 0.5, 0.0, 0.0, 0.0, 200, 191]]},
        "events": [{"t": 10.0, "mode": "OFFBOARD", "failsafe": False}, {"t": 15.5, "mode": "AUTO.LOITER", "failsafe": False}],
        "contacts": 0,
        "duration_s": 30.0,
    }
    verdict = judge(trace_of(report), ENTRIES["L1"].expected.__class__(Reaction.BRAKE, 0.3))
    assert verdict.problem is None
    assert verdict.reaction_s == pytest.approx(0.1, abs=0.06)
    assert math.isinf(verdict.fence_margin_m)
