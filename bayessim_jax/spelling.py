"""What a misspelt name is answered with."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

__all__ = ["did_you_mean", "find_named", "near_miss"]

T = TypeVar("T")


def did_you_mean(
    word: str, known: Iterable[str], count: int = 1, cutoff: float = 0.4, show: Callable[[str], str] = repr
) -> str:
    """`did you mean 'x' or 'y'?` with at most `count` near misses, or nothing where none is near."""
    near = difflib.get_close_matches(word, list(known), n=count, cutoff=cutoff)
    return f"did you mean {' or '.join(show(name) for name in near)}?" if near else ""


def near_miss(word: str, known: Iterable[str]) -> str:
    """`did you mean 'x'?`, or the choices where nothing is near."""
    known = list(known)
    return did_you_mean(word, known) or f"choose one of {', '.join(known)}."


def find_named(name: str, known: Mapping[str, T], unknown: str) -> T:
    """The entry of a registry, or `ValueError`: what is `unknown`, the name, the near miss."""
    if name not in known:
        raise ValueError(f"{unknown} {name!r}: {near_miss(name, known)}")
    return known[name]
