"""`bayessim report RUN`: the report of a run folder, from what lies in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.cli.parsing import UsageError
from bayessim_jax.recordings.files import write_text
from bayessim_jax.recordings.posterior import read_draws, read_history
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.report.beside import Beside
from bayessim_jax.report.drives import Drives, Scene
from bayessim_jax.report.evidence import OnlineRun
from bayessim_jax.report.online import render

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bayessim_jax.cli.plan import Plan

__all__ = ["read_run", "report", "write_report"]

SHOWN = ("hopper", "fetch_push", "fetch_slide")
"""Systems that are shown beside their target."""


def report(words: Sequence[str]) -> int:
    """Write `report.html` of a run again."""
    if words in (["--help"], ["-h"]):
        print("usage: bayessim report RUN\n\nWrites report.html again from what lies in the run folder RUN.")
        return 0
    if len(words) != 1 or words[0].startswith("-"):
        raise UsageError("usage: bayessim report RUN")
    try:
        print(write_report(RunFolder.open(Path(words[0]))))
    except ValueError as error:
        raise UsageError(str(error)) from error
    return 0


def read_run(folder: RunFolder) -> OnlineRun:
    """What a run folder says, as the report wants it; raises `ValueError` where a file is damaged."""
    read, settings = read_draws(folder.path / "posterior.nc"), folder.read_config()
    drives, scene, apparent = _control(folder, settings, read.draws)
    shown = settings.get("system") in SHOWN
    return OnlineRun(
        settings=settings,
        facts=folder.read_run(),
        lines=folder.read_metrics(len(read.draws)),
        draws=read.draws,
        names=read.names,
        units=read.units,
        low=read.low,
        high=read.high,
        truths=read.truths,
        drives=drives,
        scene=scene,
        beside=_beside(folder, settings, read.draws) if shown else None,
        apparent=apparent,
    )


def _beside(folder: RunFolder, settings: dict[str, Any], draws: np.ndarray) -> Beside | None:
    """The newest recording of the first seed, and the simulator at the mean of the belief under its actions."""
    from bayessim_jax.cli.beside import replay

    setup = _plan(folder, settings).setup
    seen = read_history(folder.path / "posterior.nc", setup.system.observations, setup.system.actions)
    return replay(str(settings["system"]), setup.system, seen, draws[:, 0])


def _control(
    folder: RunFolder, settings: dict[str, Any], draws: np.ndarray
) -> tuple[Drives | None, Scene | None, np.ndarray | None]:
    """What a planner did on the target, the scene of its last recording, and θ that a vehicle seems to have."""
    if settings.get("controller") not in ("mppi", "disco"):
        return None, None, None
    from bayessim_jax.cli.scene import replan

    plan = _plan(folder, settings)
    system, path = plan.setup.system, folder.path / "posterior.nc"
    seen = read_history(path, system.observations, system.actions)
    first = {name: getattr(seen, name)[:, 0, 0] for name in ("times", "observations", "rewards", "valid")}
    drives = Drives(channels=tuple(system.observations.names), **first)
    before = draws[-2, 0] if len(draws) > 1 else None
    planner: Any = plan.setup.learner
    return drives, replan(planner, drives, len(draws), before), plan.apparent(len(draws))


def _plan(folder: RunFolder, settings: dict[str, Any]) -> Plan:
    """What the settings of a run say."""
    from bayessim_jax.cli.config_file import settings_from
    from bayessim_jax.cli.options import Settings
    from bayessim_jax.cli.plan import make_plan

    return make_plan(Settings(**settings_from(settings, str(folder.path / "config.toml"))))


def write_report(folder: RunFolder) -> Path:
    """Write `report.html` into a run folder and return its path."""
    path = folder.path / "report.html"
    write_text(path, render(read_run(folder)))
    return path
