"""The accidents are still accidents: their texts are there, and the tests that noticed them notice them again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from campaigns.accidents import LEAST_TESTS, Accident, handful, load_accidents, recorded
from campaigns.mutation.probe import function_of

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "tests" / "safety" / "accidents"
RESULT = ROOT / "results" / "accidents.json"
LEAST = 40
ACCIDENTS = load_accidents(FOLDER)


def test_there_are_enough_and_each_tells_its_story():
    assert len(ACCIDENTS) >= LEAST
    assert len({one.name for one in ACCIDENTS}) == len(ACCIDENTS)
    assert all(one.catalogue and len(one.story) > 20 for one in ACCIDENTS)
    assert len({one.file for one in ACCIDENTS}) >= 8


@pytest.mark.parametrize("accident", ACCIDENTS, ids=lambda one: one.name)
def test_its_text_stands_there_exactly_once_and_the_change_is_python(accident):
    changed = accident.applied((ROOT / accident.file).read_text())
    compile(changed, accident.file, "exec")
    assert changed != (ROOT / accident.file).read_text()


def test_a_text_that_is_gone_or_there_twice_is_told():
    one = Accident(name="n", catalogue="1", story="s", file="f", old="a", new="b")
    assert one.applied("cab") == "cbb"
    for text in ("none", "a a"):
        with pytest.raises(ValueError, match="times in f"):
            one.applied(text if text != "none" else "x")


def test_accidents_were_noticed_by_two_tests():
    noticed = recorded(RESULT)
    assert set(noticed) == {one.name for one in ACCIDENTS}
    twice = [name for name, tests in noticed.items() if len(set(map(function_of, tests))) >= LEAST_TESTS]
    assert len(twice) == len(ACCIDENTS) >= LEAST
    assert json.loads(RESULT.read_text())["accidents"] == len(ACCIDENTS)


def test_every_accident_gets_its_turn():
    turns = [one.name for day in range(len(ACCIDENTS)) for one in handful(ACCIDENTS, 5, day)]
    assert set(turns) == {one.name for one in ACCIDENTS}
    assert len(handful(ACCIDENTS, 5, 7)) == 5


def test_a_handful_happens_again_and_is_noticed():
    """Every day others; only the tests that noticed each before."""
    command = [sys.executable, "-m", "campaigns.accidents", "--again", "results/accidents.json", "--handful", "5", "--jobs", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "5 of 5 accidents" in done.stdout
