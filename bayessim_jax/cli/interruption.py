"""Ctrl-C: finish the round in hand, or the compilation, write it, stop; a second one stops at once."""

from __future__ import annotations

import os
import signal
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Interruption"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """While it is entered, the first SIGINT or SIGTERM is noted in `code` and told by `tell`; the second ends here.

    Whatever is on disk stays whole in both cases, because files are replaced in one step and a round counts from its
    checkpoint on.
    """

    def __init__(self, tell: Callable[[str], None], farewell: str) -> None:
        self.tell, self.farewell = tell, farewell
        self.code: int | None = None
        self.before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interruption:
        self.before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: object) -> None:
        if self.code is not None:
            print(f"\n{self.farewell}", file=sys.stderr, flush=True)
            os._exit(128 + number)
        self.code = 128 + number
        self.tell("stopping when what is under way is done; press Ctrl-C again to stop at once")
