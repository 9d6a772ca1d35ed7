"""What is flown: each case is a name from which everything follows, so that any single one can be flown again."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from campaigns.adversaries.disturbance import Conditions, draw_conditions
from campaigns.adversaries.flight import Duel, Outcome, Watcher
from campaigns.adversaries.policies import POLICIES, Generator, Policy
from campaigns.adversaries.replayed import flipped
from campaigns.adversaries.scenes import SCENES, Scene, make_scene
from campaigns.adversaries.search import GENERATIONS, POPULATION, SEQUENCE_TICKS, Attack, attacks
from safety.config import SafetyConfig
from safety.filter import SafetyFilter

TICKS = 400
SEARCH = "search"
SEARCH_TICKS = GENERATIONS * POPULATION * SEQUENCE_TICKS
ALL_POLICIES = {**POLICIES, "flipped": flipped}
MAIN, OPTIMISTIC, MOVERS = "main", "optimistic", "movers"
MOVER_SPEEDS_M_S = (0.5, 1.0)
MEASURED = {"dead_time_s": 0.172, "lag_s": 0.47, "braking_m_s2": 2.0}  # docs/safety.md: fitted, plus the campaign's least delay
TOO_GOOD = 0.8
OPTIMISTIC_SAFETY = {
    "dead_time_s": TOO_GOOD * MEASURED["dead_time_s"],
    "lag_s": TOO_GOOD * MEASURED["lag_s"],
    "braking_m_s2": MEASURED["braking_m_s2"] / TOO_GOOD,
}
SEARCH_SHARE, OPTIMISTIC_SHARE, MOVERS_SHARE = 0.3, 0.06, 0.03


@dataclass(frozen=True)
class Case:
    """One flight, or one search of many short ones. `block`: which assumptions hold."""

    block: str
    scene: str
    policy: str
    seed: int

    def __str__(self) -> str:
        return f"{self.block}/{self.scene}/{self.policy}/{self.seed}"

    @staticmethod
    def parse(text: str) -> Case:
        """The case that prints as `text`. Raises `ValueError` that says what a case looks like."""
        parts = text.split("/")
        known = len(parts) == 4 and parts[2] in {*ALL_POLICIES, SEARCH} and parts[3].isdigit()
        if not known:
            raise ValueError(f"{text!r} is no case: give block/scene/policy/seed as in the result file, main/pillars/bang/17 say")
        return Case(parts[0], parts[1], parts[2], int(parts[3]))

    @property
    def ticks(self) -> int:
        """How many ticks this case flies."""
        return SEARCH_TICKS if self.policy == SEARCH else TICKS

    def generator(self) -> Generator:
        """The one source of everything random in this case."""
        return np.random.default_rng((self.seed, zlib.crc32(f"{self.scene}/{self.policy}".encode())))


@dataclass(frozen=True)
class Result:
    """What a case came to; `outcome` is the worst over all its flights, events and ticks are summed."""

    case: Case
    mode: str
    outcome: Outcome

    def row(self) -> dict[str, Any]:
        """For the list of violations."""
        kept = {key: value for key, value in asdict(self.outcome).items() if key not in {"changed", "braking"}}
        return {"case": str(self.case), "errors": self.mode, **kept}


class Setting:
    """A case made ready to fly."""

    def __init__(self, case: Case) -> None:
        self.case, self.random = case, case.generator()
        changes = dict(OPTIMISTIC_SAFETY) if case.block == OPTIMISTIC else {}
        if case.block.startswith(MOVERS):
            changes["obstacle_speed_m_s"] = float(case.block.removeprefix(MOVERS))
        self.scene: Scene = make_scene(case.scene, self.random, **changes)
        # drawn for the filter's default assumptions, also where the filter believes in better ones
        self.conditions: Conditions = draw_conditions(self.random, SafetyConfig(fence=self.scene.safety.fence))
        self.noise_seed = int(self.random.integers(1 << 31))

    def duel(self, safety: type[SafetyFilter] = SafetyFilter) -> Duel:
        """The vehicle at the start, a fresh filter."""
        return Duel(self.scene, self.conditions, self.noise_seed, safety=safety(self.scene.safety))

    def policy(self) -> Policy:
        """The adversary, its own randomness drawn."""
        return ALL_POLICIES[self.case.policy](self.scene, self.random)

    def attacks(self, safety: type[SafetyFilter] = SafetyFilter) -> Iterator[tuple[Attack, Outcome]]:
        """All attacks of a search."""
        return attacks(lambda policy, errors: self.duel(safety).fly(policy, SEQUENCE_TICKS, errors), self.random)


def run_case(case: Case, safety: type[SafetyFilter] = SafetyFilter) -> Result:
    """Fly a case."""
    setting = Setting(case)
    if case.policy == SEARCH:
        outcome = _together([outcome for _, outcome in setting.attacks(safety)])
    else:
        outcome = setting.duel(safety).fly(setting.policy(), TICKS)
    return Result(case, setting.conditions.mode, outcome)


def replay(case: Case, watch: Watcher) -> Result:
    """Fly a case again and show every tick to `watch`; of a search, its worst attack."""
    setting = Setting(case)
    if case.policy == SEARCH:
        worst, _ = min(setting.attacks(), key=lambda pair: pair[1].worst_m)
        outcome = setting.duel().fly(worst.policy, SEQUENCE_TICKS, worst.error_sign, watch)
    else:
        outcome = setting.duel().fly(setting.policy(), TICKS, watch=watch)
    return Result(case, setting.conditions.mode, outcome)


def _together(outcomes: list[Outcome]) -> Outcome:
    total = Outcome()
    for one in outcomes:
        total.ticks += one.ticks
        total.clearance_m, total.fence_m = min(total.clearance_m, one.clearance_m), min(total.fence_m, one.fence_m)
        total.changed, total.braking = total.changed + one.changed, total.braking + one.braking
        for mine, its in ((total.events, one.events), (total.faults, one.faults)):
            for kind, count in its.items():
                mine[kind] = mine.get(kind, 0) + count
        total.first_s = one.first_s if total.first_s is None else total.first_s
    return total


def plan(ticks: int, seed: int) -> list[Case]:
    """Cases of all blocks: `ticks` or a little more in the main block, shares of that in the others."""
    searched = _fill(MAIN, SCENES, (SEARCH,), SEARCH_SHARE * ticks, seed)
    flown = _fill(MAIN, SCENES, tuple(ALL_POLICIES), ticks - sum(case.ticks for case in searched), seed)
    optimistic = _fill(OPTIMISTIC, SCENES, tuple(ALL_POLICIES), OPTIMISTIC_SHARE * ticks, seed)
    moved = [
        _fill(f"{MOVERS} {speed:g}", ("movers",), tuple(ALL_POLICIES), MOVERS_SHARE * ticks, seed) for speed in MOVER_SPEEDS_M_S
    ]
    return _interleaved([searched, flown, optimistic, *moved])


def _fill(block: str, scenes: tuple[str, ...], policies: tuple[str, ...], ticks: float, seed: int) -> list[Case]:
    """Every scene with every policy, with seed after seed, until there are enough ticks."""
    cases: list[Case] = []
    left = ticks
    while left > 0.0:
        for scene in scenes:
            for policy in policies:
                if left > 0.0:
                    cases.append(Case(block, scene, policy, seed))
                    left -= cases[-1].ticks
        seed += 1
    return cases


def _interleaved(groups: list[list[Case]]) -> list[Case]:
    """All groups mixed evenly, so that a campaign cut short has flown some of each."""
    marked = [((i + 0.5) / len(group), case) for group in groups for i, case in enumerate(group)]
    return [case for _, case in sorted(marked, key=lambda pair: pair[0])]
