"""One run on a case: the folder, what is written at its start and its end, and how it fails."""

from __future__ import annotations

import os
import shlex
import sys
import time
import traceback
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_jax import __version__
from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.recordings.run_folder import RunFolder

if TYPE_CHECKING:
    from types import TracebackType

    from bayessim_jax.recordings.loading import LoadedCase
    from bayessim_jax.recordings.shots import CaseModel

__all__ = ["CaseRun"]

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "mujoco", "blackjax", "xarray")


@dataclass
class CaseRun:
    """A command at work on a case; as a context it keeps `run.json` true and tells a failure in one line.

    Computations are in float64 for as long as it is entered: a likelihood of thousands of numbers is a sum that
    float32 cannot difference.
    """

    name: str
    case: LoadedCase
    folder: RunFolder
    facts: dict[str, Any]
    quiet: bool
    started: float = field(default_factory=time.perf_counter)
    code: int = 0
    double: bool = False

    @classmethod
    def open(
        cls, name: str, case: Path, out: Path | None, settings: dict[str, Any], words: list[str], quiet: bool
    ) -> CaseRun:
        """Read and check the case, make the run folder; raises `UsageError`, and nothing is written then."""
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
        from bayessim_jax.recordings.loading import load_case

        try:
            loaded = load_case(case, mask=bool(settings["mask"])).check()
            if not loaded.parameters and name == "infer":
                raise ValueError(f"{case}: case.toml names no parameters to infer; add [[parameters]].")
            folder = RunFolder(out or Path("runs") / f"{loaded.case.folder.resolve().name}-{name}").create()
        except ValueError as error:
            raise UsageError(str(error)) from error
        facts = {
            "command": shlex.join(["bayessim", name, *words]),
            "folder": str(folder.path),
            "started": _now(),
            "ended": None,
            "seed": settings.get("seed"),
            "versions": {
                "bayessim_jax": __version__,
                "python": sys.version.split()[0],
                **{package: version(package) for package in PACKAGES},
            },
            "findings": [f"{f.severity}: {f}" for f in loaded.findings],
        }
        folder.write_config({"command": name, "case": str(loaded.case.folder.resolve()), **settings})
        run = cls(name, loaded, folder, facts, quiet)
        for finding in loaded.findings:
            run.say(f"{finding.severity}: {finding}")
        return run

    def __enter__(self) -> CaseRun:
        import jax

        from bayessim_jax.cli.cache import use_compilation_cache

        use_compilation_cache()
        device = jax.devices()[0]
        self.facts["device"] = {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()}
        self.folder.write_run(self.facts | {"status": "running"})
        self.double = bool(jax.config.read("jax_enable_x64"))
        jax.config.update("jax_enable_x64", True)  # for the whole process: engines are called on threads of their own
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        import jax

        jax.config.update("jax_enable_x64", self.double)
        self.facts |= {"ended": _now(), "seconds": round(time.perf_counter() - self.started, 2)}
        if error is None:
            self.folder.write_run(self.facts | {"status": "finished"})
            return False
        if isinstance(error, KeyboardInterrupt):
            self.folder.write_run(self.facts | {"status": "interrupted"})
            return False
        if not isinstance(error, Exception):
            return False
        usage = isinstance(error, UsageError)
        reason = str(error) if usage else f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
        self.folder.write_run(self.facts | {"status": "failed", "error": "".join(traceback.format_exception(error))})
        if usage:
            return False
        where = self.folder.path / "run.json"
        print(f"bayessim: the run failed: {reason[:300]} (more in {where})", file=sys.stderr)
        self.code = 1
        return True

    def model(self, **options: Any) -> CaseModel:
        """The case's system and windows; raises `UsageError` for what the engine does not take."""
        from bayessim_jax.recordings.shots import case_model

        try:
            model = case_model(self.case, **options)
        except ValueError as error:
            raise UsageError(str(error)) from error
        self.facts["engine"] = model.system.reason
        for remark in (f"engine: {model.system.reason}", *model.remarks):
            self.say(remark)
        return model

    def say(self, text: str) -> None:
        """A line on standard error, with the seconds since the start."""
        if not self.quiet:
            print(f"{time.perf_counter() - self.started:6.1f} s  {text}", file=sys.stderr, flush=True)

    def conclude(self, page: str, sentences: list[str]) -> None:
        """Write the report and say what was learned."""
        from bayessim_jax.recordings.files import write_text

        path = self.folder.path / "report.html"
        write_text(path, page)
        for sentence in sentences:
            self.say(sentence)
        if not self.quiet:
            print(f"report: {path}", file=sys.stderr)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
