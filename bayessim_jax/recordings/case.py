"""`case.toml`: what to simulate, what is unknown in it, and where the recordings are."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from bayessim_jax.recordings.priors import Prior, number, read_prior
from bayessim_jax.recordings.readers import SUFFIXES
from bayessim_jax.recordings.wording import CaseError, hint, quote

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

__all__ = ["Case", "ChannelSpec", "ParameterSpec", "read_case"]

FILE = "case.toml"
SCHEMA = 1
KEYS = ("schema", "name", "model", "system", "recordings", "horizon", "parameters", "channels")
PARAMETER_KEYS = ("name", "unit", "targets", "prior")
CHANNEL_KEYS = ("column", "scale", "offset")
HORIZON = 0.5
NAME = re.compile(r"[^\W\d][\w .-]*")


@dataclass(frozen=True)
class ParameterSpec:
    """An unknown: its one value is written to every target."""

    name: str
    targets: tuple[str, ...]
    prior: Prior
    unit: str = ""


@dataclass(frozen=True)
class ChannelSpec:
    """Where a channel is read from: value = scale · column + offset, in SI units."""

    column: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Case:
    """What `case.toml` says; whether the model has the targets and channels is checked where the model is."""

    folder: Path
    name: str
    recordings: str
    """Pattern of the recordings' files, relative to the folder."""
    parameters: tuple[ParameterSpec, ...]
    model: str = ""
    """MJCF file, relative to the folder; or else:"""
    system: str = ""
    """Name of a registered system."""
    horizon: float = HORIZON
    """Length of the windows that predictions are scored on, s."""
    channels: Mapping[str, ChannelSpec] = field(default_factory=dict)

    @property
    def files(self) -> list[Path]:
        """The recordings, sorted by name, without hidden files; raises `CaseError` where there is none."""
        try:
            found = sorted(p for p in self.folder.glob(self.recordings) if p.is_file() and not p.name.startswith("."))
        except (ValueError, NotImplementedError, OSError) as error:
            what = f"recordings = {quote(self.recordings)} is no pattern ({error})"
            raise CaseError(FILE, what, "correct it, such as recordings/*.csv") from error
        if not found:
            near = f"files end in {', '.join(SUFFIXES)}"
            raise CaseError(
                FILE, f"no file matches recordings = {quote(self.recordings)}", f"correct the pattern; {near}"
            )
        return found


def read_case(folder: Path) -> Case:
    """Read `case.toml` of a folder (or the file itself); raises `CaseError` that names the key and the remedy."""
    path = folder if folder.name == FILE else folder / FILE
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        what = f"cannot be read in {quote(str(path.parent))} ({error.strerror})"
        raise CaseError(FILE, what, "check the folder, or make a case with: bayessim new") from error
    except UnicodeDecodeError as error:
        raise CaseError(FILE, "is not UTF-8 text", "save it in UTF-8") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise CaseError(FILE, f"is not TOML ({error})", "correct it there") from error
    try:
        return _case(path.parent, tables)
    except CaseError:
        raise
    except ValueError as error:
        what, _, remedy = str(error).rpartition("; ")
        raise CaseError(FILE, what or str(error), remedy) from error


def _case(folder: Path, tables: dict[str, Any]) -> Case:
    if "schema" in tables and (tables["schema"] != SCHEMA or isinstance(tables["schema"], bool)):
        raise ValueError(f"schema is {quote(tables['schema'])}, this version reads {SCHEMA}; set schema = {SCHEMA}")
    _known(tables, KEYS, "")
    if "schema" not in tables:
        raise ValueError(f"key 'schema' is missing; set schema = {SCHEMA}")
    if ("model" in tables) == ("system" in tables):
        word = "both 'model' and 'system' are" if "model" in tables else "neither 'model' nor 'system' is"
        raise ValueError(f"{word} given; give one of them")
    horizon = number(tables.get("horizon", HORIZON), "horizon")
    if not horizon > 0:
        raise ValueError(f"horizon is {horizon:g}; it must be above 0 s")
    pattern = _text(tables, "recordings")
    if pattern.startswith(("/", "~")) or ".." in pattern.replace("\\", "/").split("/"):
        raise ValueError(f"recordings {quote(pattern)} lie outside of the case folder; copy or link them into it")
    model = _text(tables, "model") if "model" in tables else ""
    if model and not (folder / model).resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"model {quote(model)} lies outside of the case folder; copy it into it")
    return Case(
        folder=folder,
        name=_text(tables, "name") if "name" in tables else folder.resolve().name,
        recordings=pattern,
        parameters=_parameters(_table(tables.get("parameters", []), "parameters", list)),
        model=model,
        system=_text(tables, "system") if "system" in tables else "",
        horizon=horizon,
        channels={
            name: _channel(name, _table(table, f"channels.{quote(name)}"))
            for name, table in _table(tables.get("channels", {}), "channels").items()
        },
    )


def _parameters(tables: list[Any]) -> tuple[ParameterSpec, ...]:
    found: list[ParameterSpec] = []
    taken: dict[str, str] = {}
    for i, table in enumerate(tables):
        where = f"parameter {i + 1}"
        _known(_table(table, where), PARAMETER_KEYS, f"{where}: ")
        name = _text(table, "name", f"{where}: ")
        if not NAME.fullmatch(name):
            raise ValueError(f"{where}: name {quote(name)} has to be of letters, digits, _, - and .; rename it")
        where = f"parameter {name}"
        if name in (spec.name for spec in found):
            raise ValueError(f"{where} occurs twice; rename one, or give one both targets")
        targets = table.get("targets")
        if not (isinstance(targets, list) and targets and all(isinstance(t, str) for t in targets)):
            raise ValueError(f'{where}: targets is {quote(targets)}; it needs a list of paths, ["body/bob/mass"]')
        for target in targets:
            if target in taken:
                raise ValueError(f"{where}: target {quote(target)} is {taken[target]}'s already; remove one of them")
            taken[target] = name
        if "prior" not in table:
            raise ValueError(f"{where}: key 'prior' is missing; give a distribution")
        try:
            prior = read_prior(_table(table["prior"], "prior"))
        except ValueError as error:
            raise ValueError(f"{where}: prior: {error}") from error
        unit = _text(table, "unit", f"{where}: ") if table.get("unit") else ""
        found.append(ParameterSpec(name, tuple(targets), prior, unit))
    return tuple(found)


def _channel(name: str, table: Mapping[str, Any]) -> ChannelSpec:
    where = f"channels.{quote(name)}: "
    _known(table, CHANNEL_KEYS, where)
    scale, offset = number(table.get("scale", 1.0), f"{where}scale"), number(table.get("offset", 0.0), f"{where}offset")
    if scale == 0:
        raise ValueError(f"{where}scale is 0; it must be another number")
    return ChannelSpec(_text(table, "column", where) if "column" in table else name, scale, offset)


def _known(table: Mapping[str, Any], known: Collection[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{where}unknown key {quote(key)}; {hint(key, known, 1)}")


def _text(table: Mapping[str, Any], key: str, where: str = "") -> str:
    if key not in table:
        raise ValueError(f"{where}key {key!r} is missing; add it")
    if not isinstance(table[key], str) or not table[key].strip() or not table[key].isprintable():
        raise ValueError(f"{where}{key} is {quote(table[key])}; it needs a text of one line")
    return table[key]


def _table(value: Any, where: str, kind: type = dict) -> Any:
    if not isinstance(value, kind):
        wanted = "a table" if kind is dict else "a list"
        raise ValueError(f"{where} is {quote(value)}; it needs {wanted}")
    return value
