"""From words on the command line to a dataclass, or one line that says what is wrong."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import re
import textwrap
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import tyro
from typing_extensions import Doc

from bayessim_jax.spelling import near_miss

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["UsageError", "parse"]

C = TypeVar("C")
BOX = str.maketrans("│╭╮╰╯─", "      ")


class UsageError(Exception):
    """The user has to change the command or a file; ends the program with one line and exit code 2."""


def parse(schema: type[C], words: Sequence[str], prog: str, default: C | None = None) -> C:
    """Fill a dataclass from the command line; raises `UsageError`, and `SystemExit(0)` after printing help."""
    _describe(schema)
    flags, hidden = _flags(schema)
    flags += ["--help"]
    for word in words:
        flag = word.split("=")[0].replace("_", "-")
        if flag in hidden:
            raise UsageError(f"{flag} has no flag; set it in a table [{flag[2:]}] of a file for --config.")
        if flag.startswith("--") and flag not in flags:
            raise UsageError(f"unknown flag {word.split('=')[0]!r}: {near_miss(flag, flags)}")
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            parsed: Any = tyro.cli(
                schema, prog=prog, args=list(words), default=default, config=(tyro.conf.FlagCreatePairsOff,)
            )
            return parsed
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
    raise UsageError(_one_line(told.getvalue(), prog))


@functools.cache
def _describe(schema: Any) -> None:
    """Hand the parser the fields' docstrings without the line breaks, which it keeps, and no default that is empty."""
    hints = get_type_hints(schema, include_extras=True)
    for kind in get_type_hints(schema).values():
        if dataclasses.is_dataclass(kind):
            _describe(kind)
    (source,) = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    assert isinstance(source, ast.ClassDef)
    for statement, after in pairwise(source.body):
        match statement, after:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                field = schema.__dataclass_fields__[name]
                empty = field.default in ("", None) or field.default_factory is dict
                hint = tyro.conf.arg(help_behavior_hint="") if empty else tyro.conf.arg()
                schema.__annotations__[name] = Annotated[hints[name], Doc(" ".join(text.split())), hint]


def _flags(schema: Any) -> tuple[list[str], list[str]]:
    """Every flag of a dataclass and of the dataclasses in it, and the fields that have none."""
    hints, marked = get_type_hints(schema), get_type_hints(schema, include_extras=True)
    flags, hidden = [], []
    for field in dataclasses.fields(schema):
        if dataclasses.is_dataclass(hints[field.name]):
            inner_flags, inner_hidden = _flags(hints[field.name])
            flags, hidden = flags + inner_flags, hidden + inner_hidden
        else:
            marks = getattr(marked[field.name], "__metadata__", ())
            name = next((name for mark in marks if (name := getattr(mark, "name", None))), field.name)
            (hidden if tyro.conf.Suppress in marks else flags).append("--" + name.replace("_", "-"))
    return flags, hidden


def _one_line(text: str, prog: str) -> str:
    """The message inside the box that the parser draws, reworded where that helps."""
    lines = [line.translate(BOX).strip() for line in text.splitlines()[1:]]
    message = " ".join(lines[: lines.index("")] if "" in lines else lines)
    if match := re.search(r"invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*)\)", message):
        value, name, choices = match.groups()
        hint = near_miss(value, re.findall(r"'(.*?)'", choices))
        return f"unknown {name.lstrip('-').split('.')[-1]} {value!r}: {hint}"
    if match := re.search(r"Error parsing (\S+): (.*)", message):
        name, reason = match.groups()
        if number := re.search(r"invalid literal for int\(\) with base 10: (.*)", reason):
            reason = f"needs a whole number, not {number[1]}."
        elif number := re.search(r"could not convert string to float: (.*)", reason):
            reason = f"needs a number, not {number[1]}."
        return f"{name} {reason}" if name.startswith("--") else reason
    if match := re.match(r"Missing from .*?: *\{(.*?)\}", message):
        return f"{prog} needs one of {match[1].replace(',', ', ')} after it; see {prog} --help."
    if match := re.search(r"Missing from [^:]*:\s+(--\S+ \S+|\S+)", message):
        return f"{prog} needs {match[1]}; see {prog} --help."
    return f"{message} (see {prog} --help)"
