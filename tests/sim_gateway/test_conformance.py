"""The gateway against the facts recorded from a real PX4: the table, its file, its place in the docs."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_gateway.conformance.__main__ import GROUPS, WANTED, compare, markdown, plain
from sim_gateway.conformance.facts import RecordingsError, read_facts
from sim_gateway.conformance.rows import Row, Table, numbers_hidden, same_share

FACTS = Path("tests/data/px4_conformance.json")
DOCS = Path("docs/gateway.md")
BEGIN, END = "<!-- conformance -->", "<!-- end of conformance -->"


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return compare(read_facts(FACTS))


def test_at_least_95_percent_of_what_was_recorded_is_the_same(rows: list[Row]) -> None:
    assert {row.group for row in rows} == set(GROUPS)
    assert same_share(rows) >= WANTED, plain([row for row in rows if not row.same])


@pytest.mark.parametrize("group", ["modes", "commands", "offboard_loss", "failures"])
def test_nothing_differs_by_accident_where_a_flight_depends_on_it(rows: list[Row], group: str) -> None:
    assert [row.case for row in rows if row.group == group and not row.same and not row.reason] == []


def test_the_table_in_the_docs_is_the_one_that_is_measured(rows: list[Row]) -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert text.split(BEGIN)[1].split(END)[0].strip() == markdown(rows)


def test_a_row_is_only_the_same_within_its_tolerance() -> None:
    table = Table("test", {"late": "on purpose"})
    table.within("early", [1.0, 2.0], 0.95, 0.1)
    table.within("late, s", [1.0, 2.0], 2.2, 0.1)
    table.within("never", [1.0], None, 0.1)
    table.equal("text", ["a"], ["b"])
    assert [row.same for row in table.rows] == [True, False, False, False]
    assert [row.reason for row in table.rows] == ["", "on purpose", "", ""]


def test_texts_are_compared_without_numbers_and_log_files() -> None:
    assert numbers_hidden(["RTL: start return at 495 m", "[logger] 12_30.ulg", "frame 12 "]) == [
        "RTL: start return at # m",
        "frame #",
    ]


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingsError, match="link_census"):
        read_facts(tmp_path)
