"""The hunt for mutants itself: it makes the mutants that cosmic-ray makes, and its children can fail in every way."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import textwrap
import time
import types
from pathlib import Path

import pytest
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

from campaigns.mutation.__main__ import command_of
from campaigns.mutation.forks import Job, run_forked
from campaigns.mutation.hotswap import module_name
from campaigns.mutation.hunt import judged
from campaigns.mutation.inplace import function_at, replace
from campaigns.mutation.ledger import KILLED, NO_CHANGE, SURVIVED, TIMEOUT, Ledger, Verdict
from campaigns.mutation.mutants import Mutant, SourceFile, changed_lines, definitions, mutants_of
from campaigns.mutation.report import MOST_EQUIVALENT, Equivalent, figures, load_equivalents
from campaigns.mutation.suite import properties

ROOT = Path(__file__).resolve().parents[2]
SOURCE = textwrap.dedent(
    '''
    from __future__ import annotations

    LIMIT = 2


    def limited(value: float | str | None, most: int = LIMIT) -> float:
        """A docstring."""
        if value > most and not value < 0:
            return most
        return value + 1
    '''
)


def test_mutants_are_those_of_cosmic_ray():
    """Same operators, same numbering: what our tree walk makes is what its own function makes."""
    mutants = mutants_of("x.py", SOURCE)
    assert len(mutants) > 30
    for mutant in mutants:
        assert SourceFile("x.py", SOURCE).changed(mutant) == mutate_code(
            SOURCE, get_operator(mutant.operator)(), mutant.occurrence
        )
    with pytest.raises(ValueError, match="99"):
        SourceFile("x.py", SOURCE).changed(Mutant("x.py", "core/NumberReplacer", 99, 1, ""))


def test_only_changes_of_annotations_are_the_same_program():
    same = []
    for mutant in mutants_of("x.py", SOURCE):
        changed = SourceFile("x.py", SOURCE).changed(mutant)
        if SourceFile("x.py", SOURCE).same_program(changed):
            same.append(changed_lines(SOURCE, changed))
    assert same
    assert all("value: float" in before and "value: float" in after for before, after in same)
    assert not SourceFile("x.py", SOURCE).same_program(SOURCE.replace("LIMIT = 2", "LIMIT = 3"))
    assert not SourceFile("x.py", SOURCE).same_program(SOURCE.replace("most: int = LIMIT", "most: int = 1"))
    evaluated = SOURCE.replace("from __future__ import annotations", "")
    assert not SourceFile("x.py", evaluated).same_program(evaluated)


def test_annotations_that_pydantic_reads_are_code():
    text = "from __future__ import annotations\nclass Config(Base):\n    a: int | None = 1\n"
    assert not SourceFile("x.py", text).same_program(text.replace("int |", "str |"))
    data = text.replace("class", "@dataclass\nclass")
    assert SourceFile("x.py", data).same_program(data.replace("int |", "str |"))


def test_changed_lines_tell_before_and_after():
    assert changed_lines("a\n  b\nc", "a\n  d\nc") == ("b", "d")
    assert changed_lines("a\nb\nc", "a\nc") == ("b", "")


def test_definitions_span_the_body():
    spans = definitions(SOURCE)
    body = [line for line, text in enumerate(SOURCE.splitlines(), 1) if "docstring" in text or "return value" in text]
    assert spans[body[0]] == (body[0], body[1])
    assert 4 not in spans


def test_children_answer_fail_and_are_stopped():
    def spin():
        while True:
            pass

    jobs = [
        Job("answer", lambda: {"pid": os.getpid()}, 5.0),
        Job("exit", lambda: os._exit(3), 5.0),
        Job("spin", spin, 0.1),
        Job("sleep", lambda: time.sleep(60) or {}, 0.1),
        Job("memory", lambda: {"size": len(bytearray(1 << 40))}, 5.0),
    ]
    begin = time.monotonic()
    answers = dict(run_forked(iter(jobs), 3))
    assert answers["answer"]["pid"] != os.getpid()
    assert answers["exit"] == {"ended": "exit 3"}
    assert answers["spin"] == answers["sleep"] == {"ended": "time"}
    assert answers["memory"]["ended"].startswith("exit")
    assert time.monotonic() - begin < 30.0


def test_an_error_of_the_hunt_itself_is_no_kill():
    with pytest.raises(ChildProcessError, match="KeyError"):
        list(run_forked(iter([Job("raise", lambda: {}["nothing"], 5.0)]), 1))


def test_running_out_of_time_is_no_kill():
    assert judged({"ended": "time"}, 1.0).outcome == TIMEOUT
    assert judged({"ended": "signal 11"}, 1.0).outcome == KILLED
    base = {"before": "a", "after": "b"}
    assert judged(base | {"failed": {"t": "why"}, "tests": 1}, 1.0).killer == "t"
    assert judged(base | {"failed": {}, "tests": 7}, 1.0).outcome == SURVIVED
    assert judged(base | {"failed": {}, "tests": 0}, 1.0).outcome == NO_CHANGE


def test_paths_are_named_as_python_names_them():
    assert module_name("p/__init__.py") == "p"
    assert module_name("p/a.py") == "p.a"


def test_only_the_changed_function_gets_new_code():
    """In place: the outermost function that holds the line, whatever wraps it."""
    source = "class A:\n    @property\n    def b(self):\n        return 1\n\n    def c(self):\n        return 2\n"
    assert [function_at(source, line) for line in range(1, 8)] == [None, None, None, "A.b", None, None, "A.c"]
    module = types.ModuleType("changed_in_place")
    exec(source, module.__dict__)
    sys.modules[module.__name__] = module
    assert replace(module.__name__, "A.b", source.replace("return 1", "return 3"), "x.py")
    assert (module.A().b, module.A().c()) == (3, 2)
    assert not replace(module.__name__, "A.d", source, "x.py")
    del sys.modules[module.__name__]


def test_ledger_forgets_survivors_when_the_tests_change(tmp_path):
    ledger, mutants = Ledger(tmp_path / "l.sqlite"), mutants_of("x.py", SOURCE)
    ledger.add(mutants[0], SOURCE, "suite 1", Verdict(KILLED, "t", 1, "a", "b", 0.1))
    ledger.add(mutants[1], SOURCE, "suite 1", Verdict(SURVIVED, "", 9, "a", "b", 0.1))
    assert len(ledger.known("x.py", SOURCE, "suite 1")) == 2
    assert [v.outcome for v in ledger.known("x.py", SOURCE, "suite 2").values()] == [KILLED]
    assert ledger.known("x.py", SOURCE + "\n", "suite 1") == {}
    ledger.close()


def test_figures_count_what_is_explained():
    mutants = mutants_of("x.py", SOURCE)[:4]
    verdicts = [
        Verdict(KILLED, "t", 1, "", "", 0.0),
        Verdict(SURVIVED, "", 2, "a", "b", 0.0),
        Verdict(SURVIVED, "", 2, "c", "d", 0.0),
        None,
    ]
    proof = Equivalent("x.py", mutants[1].definition, "a", "b", "because")
    result = figures(list(zip(mutants, verdicts, strict=True)), [proof])
    assert (result["killed"], result["survived"], result["proved_equivalent"], result["unexplained"]) == (1, 2, 1, 1)
    assert result["not_run"] == 1
    assert [s["proof"] for s in result["survivors"]] == ["because", None]


def test_the_command_names_what_decides_the_result():
    everything = types.SimpleNamespace(module=None, sample=None, budget_s=math.inf)
    assert command_of(everything) == "python -m campaigns.mutation --out results/mutation.json"
    sample = types.SimpleNamespace(module=["safety/caps.py"], sample=12, budget_s=20.0)
    assert "--module safety/caps.py --sample 12 --budget-s 20 --out" in command_of(sample)


def test_a_mutant_is_found_by_the_real_tests():
    """One real change of safety/limits.py, in a process of its own, looked for by one real test file."""
    code = textwrap.dedent(
        """
        import json, sys
        from pathlib import Path
        from campaigns.mutation.hotswap import swap
        from campaigns.mutation.probe import fixed_examples, run_tests
        root = Path.cwd()
        path = root / "safety" / "limits.py"
        fixed_examples()
        swap(root, {"safety/limits.py": path.read_text().replace("limit / step", "1.0")})
        probe = run_tests(root, ["tests/safety/test_limits.py"], None, 1)
        print("ANSWER" + json.dumps(sorted(probe.failed)))
        """
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    failed = json.loads(done.stdout.partition("ANSWER")[2])
    assert len(failed) == 1, done.stdout + done.stderr
    assert "test_growth" in failed[0]


def test_equivalent_list_is_short_current_and_each_has_its_proof():
    """The list may only shrink: it never holds more than the share that the issue allows, nor what is not a mutant any more."""
    listed = load_equivalents(ROOT / "tests" / "safety" / "equivalent_mutants.json")
    count = 0
    for path in {one.path for one in listed}:
        source = (ROOT / path).read_text()
        count += len(mutants_of(path, source))
        for one in (e for e in listed if e.path == path):
            assert all(line in source for line in one.before.split(" / ")), f"not there any more: {one.before}"
            assert len(one.proof) > 20
    keys = [one.key for one in listed]
    assert len(keys) == len(set(keys))
    assert len(listed) <= MOST_EQUIVALENT * max(count, 1)


def test_the_safety_layer_has_thirty_properties_and_more():
    found = properties(ROOT)
    assert len(set(found)) == len(found) >= 30
