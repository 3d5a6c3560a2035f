"""One set of settings out of flags, a config file, the run that is continued, and defaults: the first named wins."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import tyro

from bayessim_jax.cli.config_file import differing, read_settings, settings_from
from bayessim_jax.cli.options import DIAGNOSED, HABITS, Online, Settings
from bayessim_jax.cli.parsing import UsageError, parse
from bayessim_jax.recordings.run_folder import RunFolder

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["read_command", "refuse_differences"]

PROG = "bayessim online"


def read_command(words: Sequence[str]) -> Online:
    """The command with its settings complete but for what only the system knows; raises `UsageError`."""
    given = {word.split("=")[0] for word in words}
    elsewhere = "--config" in given or {"--resume", "--out"} <= given
    own = {"system": DIAGNOSED} if "--from" in given else {}
    command = _parse(words, own or ({"system": "cartpole"} if elsewhere else {}))
    told = {**own, **(read_settings(command.config) if command.config else {})}
    if told or (elsewhere and not command.resume):
        command = _parse(words, told)
    habits = HABITS.get(command.settings.system, {})
    if habits and not command.resume:
        command = _parse(words, {**habits, **told})
    if not command.resume:
        return command
    try:
        folder = RunFolder.open(command.folder)
        folder.read_run()
        stored = Settings(**settings_from(folder.read_config(), f"{folder.path / 'config.toml'}"))
    except (ValueError, TypeError) as error:
        raise UsageError(str(error)) from error
    again = _parse(words, _merge(stored, told))
    refuse_differences(stored, again.settings, str(folder.path), "the command")
    return dataclasses.replace(again, out=folder.path)


def refuse_differences(stored: Settings, wanted: Settings, where: str, other: str) -> None:
    """Raise `UsageError` naming the settings in which two runs differ; the number of rounds may."""
    found = [(name, a, b) for name, a, b in differing(stored, wanted) if name != "rounds"]
    if found:
        each = "; ".join(f"{name} is {_show(a)} there and {_show(b)} in {other}" for name, a, b in found[:3])
        raise UsageError(f"{where} holds a run of another configuration: {each}. Choose another --out.")


def _parse(words: Sequence[str], settings: Mapping[str, Any]) -> Online:
    if not settings:
        return parse(Online, words, PROG)
    try:
        default = Online(Settings(**{"system": tyro.MISSING, **settings}))
    except ValueError as error:
        raise UsageError(f"config: {error}") from error
    return parse(Online, words, PROG, default)


def _merge(stored: Settings, told: Mapping[str, Any]) -> dict[str, Any]:
    """The stored settings with those of a config file over them, tables key by key."""
    merged = {field.name: getattr(stored, field.name) for field in dataclasses.fields(stored)}
    for name, value in told.items():
        merged[name] = {**merged[name], **value} if isinstance(value, dict) else value
    return merged


def _show(value: Any) -> str:
    return "not set" if value is None else repr(value)
