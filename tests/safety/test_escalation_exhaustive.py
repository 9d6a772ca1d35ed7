"""The whole state machine: every state that can be reached from FLY, by every kind of input, in every bucket of time.

A state is reduced to what the rules look at: the level and, for each clock in it, on which side of its limits it stands.
Time moves in steps that hit every side of every limit. The search ends when no new reduced state appears: what holds then,
holds always.
"""

from __future__ import annotations

import itertools

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from safety.escalation import ESTIMATE_FAULTS, EscalationConfig, EscalationState, Level, escalate, re_engage
from safety.messages import Verdict
from safety.reactions import NOTICES, REACTIONS, level_of

CONFIG = EscalationConfig()
GOOD, BLOCKED = Verdict(braking=False), Verdict(braking=True)
# one rule of each kind: its level at once, and whether the estimate is what failed
KINDS = {
    (level, estimate): next(
        name for name, reaction in REACTIONS.items() if reaction.level == level and (name in ESTIMATE_FAULTS) == estimate
    )
    for level, estimate in {(reaction.level, name in ESTIMATE_FAULTS) for name, reaction in REACTIONS.items()}
}
INPUTS = [GOOD, BLOCKED, *(Verdict(braking=True, fault=name) for name in sorted(KINDS.values()))]
STEPS_S = (0.05, 0.95, 1.0, 1.95, 2.0, 9.95, 10.0, 15.0)


def reduced(state: EscalationState, now_s: float) -> tuple[object, ...]:
    """What the next step can depend on."""

    def age(since: float | None, *limits: float) -> int:
        return -1 if since is None else sum(now_s - since >= limit for limit in (0.01, *limits))

    return (
        state.level,
        age(state.level_since_s, 0.06, 9.9, 10.0),
        age(state.fault_since_s, 0.06, 1.0, 1.9, 2.0),
        age(state.fault_last_s, 0.06, 0.9, 1.0),
        age(state.blocked_since_s, 0.06, 10.0, 14.9, 15.0),
        state.cause is None,
    )


def reachable() -> list[tuple[EscalationState, float]]:
    """One representative of every reduced state."""
    start = EscalationState()
    seen = {reduced(start, 0.0): (start, 0.0)}
    todo = list(seen.values())
    while todo:
        state, now = todo.pop()
        for verdict, step in itertools.product(INPUTS, STEPS_S):
            after = escalate(state, verdict, now + step, CONFIG)
            if (key := reduced(after, now + step)) not in seen:
                seen[key] = (after, now + step)
                todo.append(seen[key])
    return list(seen.values())


STATES = reachable()


def transitions():
    for (state, now), verdict, step in itertools.product(STATES, INPUTS, STEPS_S):
        yield state, now, verdict, now + step, escalate(state, verdict, now + step, CONFIG)


def test_every_level_is_reachable_and_the_machine_is_small():
    assert {state.level for state, _ in STATES} == set(Level)
    assert len(STATES) < 1000
    assert {level for level, _ in KINDS} == set(Level) - {Level.FLY}


def test_severity_never_drops_but_for_a_pause_that_is_over():
    for state, _, verdict, now, after in transitions():
        if after.level < state.level:
            assert (state.level, after.level) == (Level.BRAKE, Level.FLY)
            assert verdict.fault is None
            assert state.fault_last_s is None or now - state.fault_last_s >= CONFIG.healthy_s


def test_every_fault_gets_at_least_its_level_in_the_same_step():
    for _, _, verdict, _, after in transitions():
        if verdict.fault is not None:
            assert after.level >= level_of(verdict.fault) >= Level.BRAKE


def test_yield_is_final_and_not_even_an_operator_leaves_it():
    for state, _, _, now, after in transitions():
        if state.level == Level.YIELD:
            assert after.level == Level.YIELD
            assert re_engage(after, now + 100.0, CONFIG) is after


def test_there_is_no_dead_end():
    """From everywhere below YIELD: two healthy seconds end a pause, an operator ends the rest, a lasting fault gets to LAND."""
    for state, now in STATES:
        if state.level == Level.YIELD:
            continue
        healed, t = state, now
        for _ in range(40):
            t += 0.05
            healed = escalate(healed, GOOD, t, CONFIG)
        assert healed.level == (Level.FLY if state.level == Level.BRAKE else state.level)
        assert re_engage(healed, t, CONFIG).level == Level.FLY
        worse, t = state, now
        for _ in range(260):
            t += 0.05
            worse = escalate(worse, Verdict(braking=True, fault="scan_stale"), t, CONFIG)
        assert worse.level == Level.LAND


def test_a_cause_is_named_exactly_while_there_is_one():
    for _, _, _, _, after in transitions():
        assert (after.cause is None) == (after.level == Level.FLY)


def test_nothing_below_hold_comes_from_an_obstacle_alone():
    for state, _, verdict, now, after in transitions():
        if verdict == BLOCKED and after.level > state.level:
            assert after.level == Level.HOLD
            assert after.blocked_since_s is not None
            assert now - after.blocked_since_s >= CONFIG.blocked_hold_s


def test_table_of_reactions_is_sound():
    for name, reaction in REACTIONS.items():
        assert name == reaction.rule
        assert reaction.faults
        assert reaction.level > Level.FLY
        assert 0.0 < reaction.bound_s <= 3.0
    assert not NOTICES.keys() & REACTIONS.keys()
    assert level_of("a rule that the table does not know") == Level.BRAKE


class Escalation(RuleBasedStateMachine):
    """Any order of faults, pauses, obstacles, take-overs and operators."""

    @initialize()
    def begin(self) -> None:
        self.state, self.now, self.worst, self.taken = EscalationState(), 0.0, Level.FLY, False

    def _step(self, verdict: Verdict, duration_s: float) -> None:
        self.now += duration_s
        before, self.state = self.state, escalate(self.state, verdict, self.now, CONFIG)
        self.worst = Level.FLY if self.state.level == Level.FLY else max(self.worst, self.state.level)
        assert self.state.level >= before.level or (before.level, self.state.level) == (Level.BRAKE, Level.FLY)

    @rule(name=st.sampled_from(sorted(REACTIONS)), duration_s=st.floats(0.01, 3.0))
    def fault(self, name: str, duration_s: float) -> None:
        self._step(Verdict(braking=True, fault=name), duration_s)
        self.taken = self.taken or level_of(name) == Level.YIELD
        assert self.state.level >= level_of(name)

    @rule(duration_s=st.floats(0.01, 20.0), braking=st.booleans())
    def no_fault(self, duration_s: float, braking: bool) -> None:
        self._step(Verdict(braking=braking), duration_s)

    @rule()
    def operator(self) -> None:
        before, self.state = self.state, re_engage(self.state, self.now, CONFIG)
        if self.state is not before:
            self.worst = Level.FLY
            assert before.fault_last_s is None or self.now - before.fault_last_s >= CONFIG.healthy_s

    @invariant()
    def pilot_always_wins(self) -> None:
        assert not self.taken or self.state.level == Level.YIELD

    @invariant()
    def severity_is_the_worst_since_flying(self) -> None:
        assert self.state.level == self.worst


Escalation.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestEscalation = Escalation.TestCase
