"""From a `Source:` line of a docstring to its entry in the bibliography."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files

__all__ = ["Entry", "find_sources", "read_bibliography", "resolve"]

SOURCE = re.compile(r"^\s*Source: (.+?)\s*$", re.MULTILINE)
CITED = re.compile(r"(?P<authors>.+?) (?P<year>\d{4})\b")


@dataclass(frozen=True)
class Entry:
    """A BibTeX entry: its key, the authors' family names, the year, and its text."""

    key: str
    families: tuple[str, ...]
    year: str
    text: str


def read_bibliography() -> dict[str, Entry]:
    """Every entry of the package's bibliography, by key."""
    text = files("bayessim_jax.cli").joinpath("references.bib").read_text(encoding="utf-8")
    entries = [_entry(block.strip()) for block in re.split(r"\n(?=@)", text) if block.strip()]
    return {entry.key: entry for entry in entries}


def _entry(text: str) -> Entry:
    key = re.match(r"@\w+\{([^,]+),", text)
    authors = re.search(r"^\s*author\s*= \{(.*)\},$", text, re.MULTILINE)
    year = re.search(r"^\s*year\s*= \{(\d+)\},$", text, re.MULTILINE)
    if not (key and authors and year):
        raise ValueError(f"bibliography: entry {text.splitlines()[0]!r} lacks its key, author or year.")
    families = tuple(name.split(",")[0].strip("{} ") for name in authors[1].split(" and "))
    return Entry(key[1], families, year[1], text)


def find_sources(text: str) -> list[str]:
    """What the `Source:` lines of a docstring cite, in order."""
    return [cited for line in SOURCE.findall(text) for cited in line.split("; ")]


def resolve(source: str, entries: dict[str, Entry]) -> Entry:
    """The entry that `Author Year`, `A and B Year`, `A, B and C Year` or `A et al. Year` cites, or `ValueError`."""
    cited = CITED.match(source)
    if cited is None:
        raise ValueError(f"source {source!r} does not begin with authors and a year.")
    several = cited["authors"].endswith(" et al.")
    families = re.split(r", | and ", cited["authors"].removesuffix(" et al."))

    def fits(entry: Entry) -> bool:
        known = list(entry.families[: len(families)]) == families
        return known and entry.year == cited["year"] and (several or len(entry.families) == len(families))

    matches = [entry for entry in entries.values() if fits(entry)]
    if len(matches) != 1:
        raise ValueError(f"source {source!r} fits {len(matches)} entries of the bibliography; it must fit one.")
    return matches[0]
