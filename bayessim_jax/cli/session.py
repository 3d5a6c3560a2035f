"""One sitting of a run: what is written at its start, between its rounds and at its end, however it ends."""

from __future__ import annotations

import shlex
import sys
import time
import traceback
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from bayessim_jax import __version__
from bayessim_jax.cli.bibliography import read_bibliography, resolve
from bayessim_jax.cli.config_file import settings_from
from bayessim_jax.cli.interruption import Interruption
from bayessim_jax.cli.loop import run_rounds
from bayessim_jax.cli.options import Settings
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.cli.plan import Plan
from bayessim_jax.cli.progress import Reporter
from bayessim_jax.cli.report import read_run, write_report
from bayessim_jax.cli.resolution import refuse_differences
from bayessim_jax.recordings.journal import Journal
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.report.words import headline, invocation, title, worries

__all__ = ["Session"]

PACKAGES = ("jax", "jaxlib", "numpy", "flax", "optax", "distrax", "gymnasium", "orbax-checkpoint")


@dataclass
class Session:
    """Runs the rounds of a plan that its folder does not hold yet."""

    plan: Plan
    folder: RunFolder
    words: list[str]
    resume: bool
    quiet: bool

    @property
    def continuation(self) -> str:
        """The command that continues this run."""
        return f"{invocation(self.plan.settings.tables())} --out {shlex.quote(str(self.folder.path))} --resume"

    def run(self) -> int:
        """Run to the end, an interruption or a failure; returns the exit code."""
        facts: dict[str, Any] = {}
        try:
            if not self.resume:  # before anything takes long: what is killed from here on can be taken up
                self._open(facts, {})
            with (
                Reporter(self.plan.settings.rounds, quiet=self.quiet) as reporter,
                Interruption(reporter.say, f"interrupted; continue with: {self.continuation}") as interruption,
                self._journal() as journal,
            ):
                return self._rounds(facts, reporter, interruption, journal)
        except UsageError:
            raise
        except Exception as error:  # whatever goes wrong in a run is told in one line and kept in run.json
            reason = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
            if facts:
                self._close(facts, "failed", error=traceback.format_exc())
            more = f" (more in {self.folder.path / 'run.json'})" if facts else ""
            print(f"bayessim: the run failed: {reason[:300]}{more}", file=sys.stderr)
            return 1

    def _journal(self) -> Journal:
        plan = self.plan
        attributes = {
            "title": title(plan.settings.tables()),
            "inference_library": "bayessim_jax",
            "inference_library_version": __version__,
        }
        simulations = plan.settings.simulations + plan.settings.calibrations * plan.setup.remembered
        system, settings = plan.setup.system, plan.settings.tables()
        return Journal(self.folder, system, plan.seeds, plan.truths, settings, attributes, simulations)

    def _rounds(self, facts: dict[str, Any], reporter: Reporter, interruption: Interruption, journal: Journal) -> int:
        rounds, started = self.plan.settings.rounds, time.perf_counter()
        begun = journal.checkpoints.latest is not None or (self.folder.path / "metrics.jsonl").exists()
        if begun:
            self._refuse_another(journal)
        for remark in self.plan.remarks:
            reporter.say(remark)
        reporter.stage("compiling; this is quick the next time")
        state, done = self.plan.start(), 0
        if begun:
            done, state = self._take_up(journal, state)
        if self.resume:
            self._open(facts, self.folder.read_run())
        if not begun:
            journal.begin(state)
        if done < rounds:
            advance = self.plan.compile(state)
            facts["compile_seconds"] = round(time.perf_counter() - started, 2)
            reporter.compiled(facts["compile_seconds"], done)
            done = run_rounds(advance, state, journal, done, rounds, reporter, interruption)
        else:
            reporter.say(f"all {rounds} rounds are done already; go on with --rounds {2 * rounds}")
        self._close(facts, "finished" if done == rounds else "interrupted", rounds_done=done)
        if done:
            reporter.stage("writing the report")
            self._conclude(reporter, write_report(self.folder))
        if done < rounds:
            reporter.say(f"interrupted after round {done} of {rounds}; continue with: {self.continuation}")
            return interruption.code or 1
        return 0

    def _refuse_another(self, journal: Journal) -> None:
        """Raise `UsageError` unless the checkpoint is there, belongs to this configuration and lacks rounds."""
        where = f"the checkpoint in {journal.checkpoints.path}"
        try:
            saved = Settings(**settings_from(journal.checkpoints.settings(), where))
        except (ValueError, TypeError) as error:
            raise UsageError(str(error)) from error
        refuse_differences(saved, self.plan.settings, where, "config.toml")
        done, rounds = journal.checkpoints.latest or 0, self.plan.settings.rounds
        if done > rounds:
            raise UsageError(f"rounds is {rounds}, but {done} are done; give {done} or more.")

    def _take_up(self, journal: Journal, state: Any) -> tuple[int, Any]:
        """Rounds done and the state after them."""
        try:
            return journal.resume(state)
        except ValueError as error:
            raise UsageError(str(error)) from error

    def _open(self, facts: dict[str, Any], before: dict[str, Any]) -> None:
        """Put on disk what is run, before it is run; `before` are the facts of the sittings before this one."""
        facts.update(self._opening(before))
        self.folder.write_config(self.plan.settings.tables())
        self.folder.write_run(facts)

    def _opening(self, before: dict[str, Any]) -> dict[str, Any]:
        device, plan, now = jax.devices()[0], self.plan, _now()
        hidden = plan.hidden.first
        columns = [hidden[:, i].astype(float).tolist() for i in range(hidden.shape[1])]
        truth = {
            name: column if len(plan.seeds) > 1 else column[0]
            for name, column in zip(plan.hidden_names, columns, strict=True)
        }
        sources, entries = plan.sources(), read_bibliography()
        return {
            "status": "running",
            "command": shlex.join(["bayessim", "online", *self.words]),
            "folder": str(self.folder.path),
            "started": before.get("started", now),
            **({"resumed": [*before.get("resumed", []), now]} if self.resume else {}),
            "ended": None,
            "seeds": plan.seeds,
            **({"remarks": list(plan.remarks)} if plan.remarks else {}),
            "truth": truth,
            "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
            "versions": {
                "bayessim_jax": __version__,
                "python": sys.version.split()[0],
                **{name: version(name) for name in PACKAGES},
            },
            "sources": sources,
            "citations": sorted({resolve(source, entries).key for source in sources}),
        }

    def _close(self, facts: dict[str, Any], status: str, **more: Any) -> None:
        facts.update(status=status, ended=_now(), **more)
        self.folder.write_run(facts)

    def _conclude(self, reporter: Reporter, report: Path) -> None:
        run = read_run(self.folder)
        for sentence in [headline(run), *worries(run)]:
            reporter.say(sentence)
        reporter.say(f"report: {report}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
