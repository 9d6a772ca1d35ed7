"""Load a YAML file into a pydantic model, strictly: what a user's slip could change silently is an error with its line.

Refused: duplicate keys, unknown keys (by the models' `extra="forbid"`), NaN and infinities, tags, anchors used as
bombs (aliases), files over 256 KiB, and the YAML 1.1 readings that surprise (`on` as true, `12:30` as 750, `010` as 8).
Numbers are read the YAML 1.2 way, so `1e3` is 1000.0.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

MAX_FILE_BYTES = 256 * 1024
Path_ = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)

_INT = re.compile(r"[-+]?[0-9]+$")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$")
_NOT_FINITE = re.compile(r"([-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)|[-+]?(nan|inf|infinity))$", re.IGNORECASE)
_WORDS: dict[str, Any] = {"true": True, "false": False, "null": None, "~": None, "": None}


class ConfigError(Exception):
    """A configuration file that cannot be used. The message is one line per mistake: file, line, field, what to change."""


def load_config(path: str | Path, model: type[Model]) -> Model:
    """Read `path` and validate it as `model`. Raises `ConfigError` naming file, line and field of every mistake."""
    data, lines = load_yaml(path)
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(_describe(path, lines, item) for item in error.errors())) from None


def load_yaml(path: str | Path) -> tuple[dict[str, Any], dict[Path_, int]]:
    """The file as plain dicts, lists and scalars, and the line number of each field path."""
    text = _read_text(Path(path))
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ConfigError(f"{path}:{line}: not valid YAML: {error.problem}") from None
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"{path}:1: the file must be a mapping of `key: value` lines")
    lines: dict[Path_, int] = {}
    data = _convert(node, (), lines, str(path), set())
    return data, lines


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(raw) > MAX_FILE_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_FILE_BYTES // 1024} KiB; this is no configuration file")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not UTF-8 text") from None


def _convert(node: yaml.Node, path: Path_, lines: dict[Path_, int], file: str, seen: set[int]) -> Any:
    line = node.start_mark.line + 1
    lines.setdefault(path, line)
    if id(node) in seen:
        raise ConfigError(f"{file}:{line}: {_dotted(path)}: YAML aliases (*name) are not accepted; write the value out")
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        return _convert_mapping(node, path, lines, file, seen)
    if isinstance(node, yaml.SequenceNode):
        return [_convert(item, (*path, i), lines, file, seen) for i, item in enumerate(node.value)]
    return _scalar(node, path, file)


def _convert_mapping(node: yaml.MappingNode, path: Path_, lines: dict[Path_, int], file: str, seen: set[int]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode) or key_node.value == "<<":
            raise ConfigError(f"{file}:{line}: {_dotted(path)}: keys must be plain words")
        key = key_node.value
        if key in result:
            raise ConfigError(f"{file}:{line}: {_dotted((*path, key))}: key given twice; keep one")
        lines[(*path, key)] = line
        result[key] = _convert(value_node, (*path, key), lines, file, seen)
    return result


def _scalar(node: yaml.Node, path: Path_, file: str) -> Any:
    line, text = node.start_mark.line + 1, node.value
    if node.tag.startswith("!") or "python" in node.tag:
        raise ConfigError(f"{file}:{line}: {_dotted(path)}: tags such as {node.tag} are not accepted; write a plain value")
    if getattr(node, "style", None) in ("'", '"', "|", ">"):
        return text
    if _NOT_FINITE.match(text):
        raise ConfigError(f"{file}:{line}: {_dotted(path)}: {text} is not a finite number; give a finite value")
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _INT.match(text):
        return int(text) if len(text) <= 20 else text
    if _FLOAT.match(text):
        number = float(text)
        if not math.isfinite(number):
            raise ConfigError(f"{file}:{line}: {_dotted(path)}: {text} overflows; give a finite value")
        return number
    return text


def _describe(path: str | Path, lines: dict[Path_, int], item: Any) -> str:
    location: Path_ = tuple(item["loc"])
    known = location
    while known and known not in lines:
        known = known[:-1]
    message = str(item["msg"]).removeprefix("Value error, ")
    if item["type"] == "extra_forbidden":
        message = "unknown key; remove it or correct its spelling"
    elif item["type"] == "missing":
        message = "required key is missing; add it"
    elif not isinstance(item.get("input"), dict | list):
        message = f"{message} (got {item.get('input')!r})"
    return f"{path}:{lines.get(known, 1)}: {_dotted(location)}: {message}"


def _dotted(path: Path_) -> str:
    return ".".join(str(part) for part in path) or "(top level)"
