"""How problems are told: one line with the file, the row, what is there, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from bayessim_jax.spelling import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["CaseError", "Finding", "hint", "merge", "quote"]

LONGEST = 60


@dataclass(frozen=True)
class Finding:
    """Something to know about a file before it is used.

    An `error` stops; a `hole` in the data stops unless it is to be masked; a `warning` says what will not be used, or
    not as it stands; a `suspicion` says that numbers are possible but unlikely, such as angles in degrees. `row` counts
    from 1 below the header.
    """

    severity: str
    file: str
    what: str
    remedy: str
    row: int | None = None
    others: int = 0
    """In how many more files the same was found."""

    def __str__(self) -> str:
        more = f" and {self.others} more file{'s' * (self.others > 1)}" if self.others else ""
        line = f" (line {self.row + 1})" if self.row is not None and self.file.lower().endswith(".csv") else ""
        row = f", row {self.row}{line}" if self.row is not None and not more else ""
        end = "" if self.remedy.endswith("?") else "."
        return f"{self.file}{row}{more}: {self.what}; {self.remedy}{end}"


class CaseError(ValueError):
    """A case cannot be used; the message is one line that names the file, what is wrong and the remedy."""

    def __init__(self, file: str, what: str, remedy: str, row: int | None = None) -> None:
        self.finding = Finding("error", file, what, remedy, row)
        super().__init__(str(self.finding))


def merge(findings: Iterable[Finding]) -> list[Finding]:
    """One finding for several that differ in nothing but the file; for suspicions with one remedy, the first."""
    first: dict[tuple[object, ...], list[Finding]] = {}
    for finding in findings:
        same = finding.remedy if finding.severity == "suspicion" else (finding.what, finding.remedy, finding.row)
        first.setdefault((finding.severity, same), []).append(finding)
    return [replace(group[0], others=len({f.file for f in group}) - 1) for group in first.values()]


def quote(text: object) -> str:
    """Text from a file as it may be shown: quoted, control characters escaped, cut where it is long."""
    shown = str(text)
    return repr(shown if len(shown) <= LONGEST else shown[: LONGEST - 1] + "…")


def hint(word: str, known: Iterable[str], count: int = 3) -> str:
    """`did you mean 'x' or 'y'?` with the near misses, or the choices where nothing is near."""
    known = list(known)
    if near := did_you_mean(word, known, count, cutoff=0.5, show=quote):
        return near
    if not known:
        return "there is none to choose from"
    more = f", … ({len(known)} in all)" if len(known) > 8 else ""
    return f"choose one of {', '.join(quote(name) for name in known[:8])}{more}"
