"""`config.toml`: read against the dataclass that is its schema, with the near miss for a wrong key."""

from __future__ import annotations

import dataclasses
import tomllib
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.spelling import near_miss

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


__all__ = ["differing", "read_settings", "settings_from"]

WORDS = {int: "a whole number", float: "a number", str: "a string", dict: "a table"}


def read_settings(path: Path) -> dict[str, Any]:
    """The settings that a file gives, checked; raises `UsageError` naming file and key."""
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"cannot read config file {path}: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"config file {path} is not TOML: {error}.") from error
    return settings_from(tables, f"config file {path}")


def settings_from(tables: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Check plain tables against `Settings`; `where` names their origin in messages."""
    hints = get_type_hints(Settings)
    checked = {}
    for key, value in tables.items():
        if key not in hints:
            raise UsageError(f"{where}: unknown key {key!r}: {near_miss(key, hints)}")
        checked[key] = _check(value, hints[key], f"{where}: {key}")
    for name, (low, high) in checked.get("prior", {}).items():
        if not low < high:
            raise UsageError(f"{where}: prior.{name}: low {low} must be below high {high}; swap or widen the bounds.")
    return checked


def differing(left: Settings, right: Settings) -> list[tuple[str, Any, Any]]:
    """The settings in which two runs differ, by dotted name, with both values."""
    found = []

    def compare(name: str, a: Any, b: Any) -> None:
        if isinstance(a, dict) and isinstance(b, dict):
            for key in dict.fromkeys([*a, *b]):
                compare(f"{name}.{key}", a.get(key), b.get(key))
        elif a != b:
            found.append((name, a, b))

    for field in dataclasses.fields(Settings):
        compare(field.name, *(settings.tables()[field.name] for settings in (left, right)))
    return found


def _check(value: Any, hint: Any, name: str) -> Any:
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise UsageError(f"{name}: unknown value {value!r}: {near_miss(str(value), get_args(hint))}")
        return value
    if hint == float | str:
        return value if isinstance(value, str) else _check(value, float, name)
    if hint is float and type(value) is int:
        return float(value)
    kind = get_origin(hint) or hint
    if kind is tuple:
        if not (isinstance(value, list) and len(value) == 2):
            raise UsageError(f"{name} is {value!r}; it needs two numbers, [low, high].")
        return tuple(_check(v, float, name) for v in value)
    if type(value) is not kind:
        raise UsageError(f"{name} is {value!r}; it needs {WORDS[kind]}.")
    if kind is dict and get_args(hint)[1] is not Any:
        return {key: _check(v, get_args(hint)[1], f"{name}.{key}") for key, v in value.items()}
    return value
