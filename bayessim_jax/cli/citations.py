"""`bayessim --citations`: BibTeX of what the package, or one run, builds on."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from pathlib import Path
from types import CodeType, FunctionType
from typing import TYPE_CHECKING, Any

from bayessim_jax.cli.bibliography import find_sources, read_bibliography
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.recordings.run_folder import RunFolder

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

__all__ = ["citations", "used_sources"]

ALWAYS = ("bayessim_jax", "possas2020online")


def citations(words: Sequence[str]) -> int:
    """Print the entries that a run used, or all of them."""
    entries = read_bibliography()
    if len(words) > 1 or any(word.startswith("-") for word in words):
        raise UsageError("usage: bayessim --citations [RUN]")
    keys = list(entries)
    if words:
        try:
            keys = RunFolder.open(Path(words[0])).read_run().get("citations", [])
        except ValueError as error:
            raise UsageError(str(error)) from error
    print("\n\n".join(entries[key].text for key in dict.fromkeys([*ALWAYS, *keys]) if key in entries))
    return 0


def used_sources(roots: Iterable[Any]) -> list[str]:
    """What is cited by the functions and objects given and by everything of this package that they call.

    Functions are followed through the names in their code, objects through their fields and their class's methods.
    """
    cited: dict[str, None] = {}
    seen: set[int] = set()
    todo = list(roots)
    while todo:
        thing = todo.pop()
        if id(thing) in seen or not _ours(thing):
            continue
        seen.add(id(thing))
        cited |= dict.fromkeys(find_sources(inspect.getdoc(thing) or ""))
        if isinstance(thing, FunctionType):
            todo += [thing.__globals__.get(name) for name in _names(thing.__code__)]
        elif isinstance(thing, type):
            cited |= dict.fromkeys(find_sources(sys.modules[thing.__module__].__doc__ or ""))
            todo += [inspect.unwrap(getattr(member, "__func__", member)) for member in vars(thing).values()]
        else:
            todo += [type(thing), *(getattr(thing, field.name) for field in dataclasses.fields(thing))]
    return sorted(cited)


def _ours(thing: Any) -> bool:
    owner = thing if isinstance(thing, (type, FunctionType)) else type(thing)
    ours = getattr(owner, "__module__", None) or ""
    known = isinstance(thing, (type, FunctionType)) or dataclasses.is_dataclass(thing)
    return known and ours.startswith("bayessim_jax.")


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)
