"""What README and docs/ say exists: links, files, tests, commands with their options, YAML that loads."""

from __future__ import annotations

import importlib.util
import re
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml

from campaigns.cli import app as evaluate_policy
from flight.cli import app as fly
from flight.lidar.config import LidarSource
from flight.lidar.view import app as lidar_view
from flight.mission import Mission, TetherSection, load_mission
from flight.recording_config import RecordingConfig
from policy_export.cli import app as export_policy
from policy_export.cli import with_command
from sim_gateway.cli import app as sim_gateway
from sim_gateway.parameters import ParameterStore
from training.cli import app as train_policy

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "policies").glob("*.md"))]
COMMANDS = {
    "fly": fly,
    "lidar-view": lidar_view,
    "sim-gateway": sim_gateway,
    "train-policy": train_policy,
    "evaluate-policy": evaluate_policy,
    "export-policy": export_policy,
}
MODULES = ("benchmarks", "campaigns.", "sim_gateway.", "training.")
# made by a command, or the reader's own
NOT_OURS = {"FILE.md", "layout.yaml", "my.yaml", "scenario.yaml", "mission.yaml", "results.json", "truth-2.json", "gateway.json"}
NOT_OURS |= {"summary.json", "scans.npz", "stats.npz", "policy.onnx", "other.onnx", "fly.py"}

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


@cache
def repository() -> frozenset[str]:
    skipped = {".venv", ".git", "runs", "__pycache__", ".mypy_cache", ".ruff_cache", ".pytest_cache", ".hypothesis"}
    return frozenset(
        path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*") if not skipped & set(path.relative_to(ROOT).parts)
    )


@cache
def names_of_tests() -> frozenset[str]:
    names = {name for path in (ROOT / "tests").rglob("*.py") for name in re.findall(r"def (test_\w+)", path.read_text())}
    return frozenset(names)


def quoted(page: Path) -> list[str]:
    """Every `text in backticks` outside code blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL))


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), flags=re.DOTALL)


def command_lines(page: Path) -> list[list[str]]:
    """Words of every command of ours that the page shows, in a code block or in backticks."""
    shown = [line for block in blocks(page, "") for line in block.splitlines()] + quoted(page)
    found = []
    for line in shown:
        words = shlex.split(line.replace("'", ""), comments=True)
        while words and (words[0].endswith("/python") or "=" in words[0]):
            words = ["python", *words[1:]] if words[0].endswith("/python") else words[1:]
        if words and (words[0].rpartition("/")[2] in COMMANDS or is_module(words)):
            found.append([words[0].rpartition("/")[2], *words[1:]])
    return found


def is_module(words: list[str]) -> bool:
    return words[:2] == ["python", "-m"] and len(words) > 2 and words[2].startswith(MODULES)


@pages
def test_links_lead_somewhere(page: Path) -> None:
    targets = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()) if "://" not in link]
    assert [target for target in targets if target and not (page.parent / target).exists()] == []


@pages
def test_tests_that_are_named_exist(page: Path) -> None:
    named = [text for text in quoted(page) if re.fullmatch(r"test_[\w*]+", text)]
    known = names_of_tests()
    missing = [name for name in named if not any(re.fullmatch(name.replace("*", r"\w*"), test) for test in known)]
    assert missing == []


@pages
def test_files_that_are_named_exist(page: Path) -> None:
    named = [text for text in quoted(page) if re.fullmatch(r"[\w./-]+\.(py|md|yaml|json|npz|xml|onnx|service)", text)]
    files = repository()
    missing = [
        name
        for name in named
        if not name.startswith("runs/") and name not in NOT_OURS and not any(f"/{path}".endswith(f"/{name}") for path in files)
    ]
    assert missing == []


@pages
def test_commands_and_their_options_exist(page: Path) -> None:
    assert [" ".join(words) for words in command_lines(page) if unknown_options(words)] == []


def unknown_options(words: list[str]) -> set[str]:
    """Options that the command does not have; the module's name where there is none."""
    used = {word.partition("=")[0] for word in words if re.match(r"--?[a-zA-Z]", word)} - {"--help", "-m"}
    if words[0] == "python":
        spec = importlib.util.find_spec(words[2])
        if spec is None or spec.origin is None:
            return {words[2]}
        origin = Path(spec.origin)
        sources = origin.parent.rglob("*.py") if origin.name == "__init__.py" else [origin]
        known = {option for path in sources for option in re.findall(r'"(--[\w-]+)"', path.read_text())}
        return used - known if known else set()
    arguments = with_command(words[1:]) if words[0] == "export-policy" else words[1:]
    command: Any = typer.main.get_command(COMMANDS[words[0]])
    if arguments and arguments[0] in getattr(command, "commands", {}):
        command = command.commands[arguments[0]]
    return used - {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}


def test_an_option_that_is_gone_would_be_told() -> None:
    assert unknown_options(["fly", "check", "--mission", "m.yaml", "--aply"]) == {"--aply"}
    assert unknown_options(["python", "-m", "campaigns.price", "--splitt", "x"]) == {"--splitt"}
    assert unknown_options(["python", "-m", "campaigns.nowhere"]) == {"campaigns.nowhere"}


def test_the_parameters_that_the_gateway_obeys_are_listed() -> None:
    names = re.compile(r"[A-Z]{2,4}_[A-Z0-9_]+")
    listed = (ROOT / "docs" / "gateway.md").read_text().partition("## Parameters that change")[2].partition("\n## ")[0]
    sources = [path.read_text() for path in (ROOT / "sim_gateway").glob("*.py")]
    read = {name for text in sources for name in re.findall(rf'"({names.pattern})"', text)}
    assert set(names.findall(listed)) == read & set(ParameterStore().names)


def test_the_mission_of_the_manual_loads_and_names_every_key(tmp_path: Path) -> None:
    (text,) = blocks(ROOT / "docs" / "mission.md", "yaml")
    (tmp_path / "mission.yaml").write_text(text)
    mission = load_mission(tmp_path / "mission.yaml")
    shown = yaml.safe_load(text) | {"policy": {"path": "", "sha256": ""}}  # the digest stands in a comment
    for section, model in mission:
        if section in ("lidar", "safety"):  # each has a page of its own
            continue
        fields = set(getattr(type(model), "model_fields", ()))
        missing = fields - set(shown[section]) if fields else set()
        assert missing == set(), section
    assert set(shown) == set(Mission.model_fields)


def test_the_sections_of_the_other_pages_load() -> None:
    shown = {
        next(iter(document)): document
        for name in ("lidar.md", "recording.md", "check.md")
        for document in map(yaml.safe_load, blocks(ROOT / "docs" / name, "yaml"))
    }
    LidarSource.model_validate(shown["lidar"]["lidar"])
    assert set(shown["recording"]["recording"]) == set(RecordingConfig.model_fields)
    assert TetherSection.model_validate(shown["tether"]["tether"]) == TetherSection()
