"""The YAML loader: what it reads, and that it names file, line and field of each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict

from strict_yaml import MAX_FILE_BYTES, ConfigError, load_config, load_yaml


class Inner(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    speed_m_s: float = 1.0


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    name: str
    inner: Inner = Inner()
    points: tuple[float, ...] = ()


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    return path


def test_reads_numbers_the_yaml_1_2_way(tmp_path: Path) -> None:
    data, _ = load_yaml(write(tmp_path, "a: 1e3\nb: on\nc: 12:30\nd: 010\ne: true\nf: '1'\ng: -0.5\nh:\n"))
    assert data == {"a": 1000.0, "b": "on", "c": "12:30", "d": 10, "e": True, "f": "1", "g": -0.5, "h": None}


@pytest.mark.parametrize(
    ("text", "line", "needle"),
    [
        ("name: x\nname: y\n", 2, "given twice"),
        ("name: x\nunknown: 1\n", 2, "unknown key"),
        ("name: x\ninner:\n  speed_m_s: .nan\n", 3, "inner.speed_m_s"),
        ("name: x\ninner:\n  speed_m_s: nan\n", 3, "finite"),
        ("name: x\ninner:\n  speed_m_s: 1e999\n", 3, "overflows"),
        ("name: x\npoints: [1, .inf]\n", 2, "points.1"),
        ("name: x\ninner:\n  speed_m_s: fast\n", 3, "'fast'"),
        ("inner: {}\n", 1, "required key is missing"),
        ("name: x\na: &a [1]\nb: *a\n", 2, "alias"),
        ("name: !!python/object:os.system x\n", 1, "tags"),
        ("name: [\n", 2, "not valid YAML"),
        ("- 1\n", 1, "mapping"),
    ],
)
def test_names_line_and_field(tmp_path: Path, text: str, line: int, needle: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        load_config(path, Outer)
    assert f"{path}:{line}" in str(error.value)
    assert needle in str(error.value)


def test_lists_every_mistake_at_once(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        load_config(write(tmp_path, "nam: x\ninner:\n  speed: 1\n  speed_m_s: a\n"), Outer)
    assert len(str(error.value).splitlines()) == 4


def test_refuses_missing_large_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "none.yaml", Outer)
    with pytest.raises(ConfigError, match="larger"):
        load_config(write(tmp_path, "name: " + "x" * MAX_FILE_BYTES), Outer)
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_config(tmp_path / "b.yaml", Outer)


@given(st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_any_bytes_load_or_are_refused(tmp_path_factory: pytest.TempPathFactory, raw: bytes) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "f.yaml"
    path.write_bytes(raw)
    outcome: object
    try:
        outcome = load_yaml(path)[0]
    except ConfigError as error:
        outcome = str(error)
    assert isinstance(outcome, dict) or str(path) in str(outcome)
