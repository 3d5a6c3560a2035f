"""The folder of a run: its settings, its facts and a line of numbers for every round."""

from __future__ import annotations

import json
import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from bayessim_jax.recordings.files import to_json, write_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["RunFolder"]


@dataclass(frozen=True)
class RunFolder:
    """Where a run lives; every file in it is replaced in one step, so that a kill at any moment leaves it readable.

    | file | holds |
    |---|---|
    | `config.toml` | everything that is needed to run it again, defaults included |
    | `run.json` | versions, device, command, start, end, status, the hidden truth |
    | `metrics.jsonl` | a line for each round (and seed); a number that is not finite is `null` |
    | `posterior.nc` | prior, posterior of every round and what was observed, readable by xarray and ArviZ |
    | `checkpoints/` | the state after the last rounds, to continue from |
    | `tensorboard/` | the same numbers for TensorBoard |
    | `report.html` | what was learned, to open in a browser |
    """

    path: Path

    def check_free(self, resumable: bool = False) -> None:
        """Raise `ValueError` where something is there already."""
        path = self.path
        try:
            if path.exists() and not path.is_dir():
                raise ValueError(f"output folder {path} is a file; choose another --out.")
            used = path.is_dir() and any(path.iterdir())
        except OSError as error:
            raise _unwritable(path, error) from error
        if used:
            way = "continue with --resume or choose" if resumable else "choose"
            raise ValueError(f"output folder {path} is already used; {way} another --out.")

    def create(self) -> RunFolder:
        """Make the folder, or raise `ValueError` where something is there already or cannot be written."""
        self.check_free()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unwritable(self.path, error) from error
        self.check_writable()
        return self

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Find an existing run, or raise `ValueError` where there is none."""
        if not (path / "config.toml").is_file():
            raise ValueError(f"no run in {path} (no config.toml there); check the folder's name.")
        return cls(path)

    def check_writable(self) -> None:
        """Raise `ValueError` unless files can be written here."""
        try:
            probe = self.path / f".probe-{os.getpid()}"
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise _unwritable(self.path, error) from error

    def write_config(self, settings: Mapping[str, Any]) -> None:
        """Write `config.toml`."""
        write_text(self.path / "config.toml", tomli_w.dumps(settings))

    def read_config(self) -> dict[str, Any]:
        """The settings of the run, or `ValueError` where the file is damaged."""
        path = self.path / "config.toml"
        try:
            return tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise _damaged(path, error) from error

    def write_run(self, facts: Mapping[str, Any]) -> None:
        """Write `run.json`."""
        write_text(self.path / "run.json", to_json(facts, indent=2) + "\n")

    def read_run(self) -> dict[str, Any]:
        """The facts of the run, or `ValueError` where the file is damaged or absent."""
        path = self.path / "run.json"
        try:
            facts = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise _damaged(path, error) from error
        if not isinstance(facts, dict):
            raise _damaged(path, "not a table")
        return facts

    def write_metrics(self, lines: Sequence[Mapping[str, Any]]) -> None:
        """Write `metrics.jsonl`, a line for each mapping."""
        write_text(self.path / "metrics.jsonl", "".join(to_json(line) + "\n" for line in lines))

    def read_metrics(self, rounds: int | None = None) -> list[dict[str, Any]]:
        """The lines of the first `rounds` rounds (all of them by default), or `ValueError` where one is damaged."""
        path = self.path / "metrics.jsonl"
        try:
            lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
            return [line for line in lines if rounds is None or line["round"] <= rounds]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _damaged(path, error) from error


def _unwritable(path: Path, error: OSError) -> ValueError:
    return ValueError(f"cannot write to output folder {path}: {error.strerror or error}; choose another --out.")


def _damaged(path: Path, error: object) -> ValueError:
    reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
    return ValueError(f"{path} is missing or damaged ({reason}); restore it or start again with another --out.")
