"""What a person sees while a run goes on: a line for each round, and on a terminal a bar beneath them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

from bayessim_jax.inference.strangeness import STRANGE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["Reporter", "describe"]


def describe(lines: Sequence[Mapping[str, Any]], left: float) -> str:
    """One round in a line: log q(θ*) where θ* is known, return, speed, time left; means where there are seeds."""

    def mean(name: str) -> float | None:
        values = [line[name] for line in lines if line[name] is not None and line[name] == line[name]]
        return sum(values) / len(values) if values else None

    parts = []
    if (log_prob := mean("log_prob_true")) is not None:
        parts.append(f"log q(θ*) {log_prob:6.2f}")
    if (returned := mean("return_target")) is not None:
        parts.append(f"return {returned:7.1f}")
    if (success := mean("success_target")) is not None:
        parts.append(f"success {success:4.2f}")
    if (speed := lines[0]["simulations_per_second"]) > 0:
        parts.append(f"{speed:6.0f} simulations/s")
    parts.append(f"{_duration(left)} left")
    marks = ("overconfident", "over-confident"), ("overfit", "over-fitted"), ("diverged_target", "target diverged")
    parts += [word for name, word in marks if any(line.get(name) for line in lines)]
    if any((line.get("strangeness") or 0.0) > STRANGE for line in lines):
        parts.append("strange")
    if diverged := sum(line["diverged"] for line in lines):
        parts.append(f"{diverged} diverged")
    return "  ".join(parts)


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


class Reporter:
    """Progress on standard error; plain lines where that is no terminal, nothing where quiet."""

    def __init__(self, rounds: int, quiet: bool = False) -> None:
        self.console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)
        self.rounds, self.times = rounds, []
        self.bar: Progress | None = None
        if self.console.is_terminal and not quiet:
            columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
            self.bar = Progress(*columns, console=self.console, transient=True)
            self.task = self.bar.add_task("starting", total=rounds)

    def __enter__(self) -> Reporter:
        if self.bar is not None:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def say(self, text: str) -> None:
        """Print a line."""
        self.console.print(text, markup=False)

    def stage(self, text: str) -> None:
        """What goes on now: the words beside the bar, or a line."""
        if self.bar is not None:
            self.bar.update(self.task, description=text)
        else:
            self.say(text)

    def compiled(self, seconds: float, done: int) -> None:
        """Tell how long the compilation took; so many rounds are done already."""
        self.say(f"compiled in {seconds:.1f} s")
        if self.bar is not None:
            self.bar.update(self.task, description="running", completed=done)

    def round(self, index: int, lines: Sequence[Mapping[str, Any]], seconds: float) -> None:
        """Tell of a round that is on disk."""
        self.times = [*self.times[-9:], seconds]
        left = (self.rounds - index) * sum(self.times) / len(self.times)
        width = len(str(self.rounds))
        self.say(f"round {index:{width}d}/{self.rounds}  {describe(lines, left)}")
        if self.bar is not None:
            self.bar.update(self.task, completed=index)
