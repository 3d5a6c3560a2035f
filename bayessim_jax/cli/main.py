"""The `bayessim` command."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from bayessim_jax import __version__
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.spelling import near_miss

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

HELP = """\
usage: bayessim COMMAND [...]

Bayesian inference of simulator parameters, composed with the learning of a controller.

commands:
  online SYSTEM   learn a system's parameters and its controller together (bayessim online --help);
                  online --from RUN trains on the simulator that a diagnosis repaired
  new CASE        make a case folder from a MuJoCo model (bayessim new --help)
  check CASE      print what a case holds and what is wrong with it
  infer CASE      infer a model's parameters from recordings (bayessim infer --help)
  diagnose CASE   say whether physics is missing in a model, where and which (bayessim diagnose --help)
  conceal MODEL   make a case in which an effect is hidden (bayessim conceal --help)
  evaluate RUN    score a diagnosis on other recordings (bayessim evaluate --help)
  report RUN      write the report of a run folder again
  systems         what can be identified: parameters, units, priors

options:
  --help          show this message
  --version       show the version
  --citations     BibTeX of what this package builds on (bayessim --citations RUN: of what that run used)
"""
COMMANDS = ("online", "new", "check", "infer", "diagnose", "conceal", "evaluate", "report", "systems")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 done, 1 the run failed, 2 bad usage, 130 interrupted."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _dispatch(words)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # whoever reads the output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except UsageError as error:
        print("bayessim: " + " ".join(str(error).split()), file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bayessim: interrupted", file=sys.stderr)
        return 130
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("--help", "-h", "help"):
        print(HELP, end="", file=sys.stdout if words else sys.stderr)
        return 0 if words else 2
    first, rest = words[0], words[1:]
    if first == "--version":
        print(f"bayessim {__version__}")
        return 0
    if first == "--citations":
        from bayessim_jax.cli.citations import citations

        return citations(rest)
    if first == "online":
        from bayessim_jax.cli.online import online

        return online(rest)
    if first == "new":
        from bayessim_jax.cli.new import new

        return new(rest)
    if first == "check":
        from bayessim_jax.cli.check import check

        return check(rest)
    if first == "infer":
        from bayessim_jax.cli.infer import infer

        return infer(rest)
    if first == "diagnose":
        from bayessim_jax.cli.diagnose import diagnose

        return diagnose(rest)
    if first == "conceal":
        from bayessim_jax.cli.conceal import conceal

        return conceal(rest)
    if first == "evaluate":
        from bayessim_jax.cli.evaluate import evaluate

        return evaluate(rest)
    if first == "report":
        from bayessim_jax.cli.report import report

        return report(rest)
    if first == "systems":
        from bayessim_jax.cli.systems import systems

        return systems(rest)
    options = ("--help", "--version", "--citations")
    kind, known = ("flag", options) if first.startswith("-") else ("command", COMMANDS)
    raise UsageError(f"unknown {kind} {first!r}: {near_miss(first, known)}")
