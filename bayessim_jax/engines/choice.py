"""Which engine steps a model, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import mujoco

from bayessim_jax.engines.contract import Engine
from bayessim_jax.engines.fields import Write, infers_inertia
from bayessim_jax.engines.mjx import MjxEngine
from bayessim_jax.engines.mujoco import MujocoEngine
from bayessim_jax.engines.tree import TreeEngine, find_refusals

__all__ = ["ENGINES", "Choice", "choose_engine"]

ENGINES = ("auto", "tree", "mujoco", "mjx")


@dataclass(frozen=True)
class Choice:
    """An engine, and one sentence that says why it was taken."""

    engine: Engine[Any]
    reason: str


def choose_engine(
    model: mujoco.MjModel,
    writes: Sequence[Write] = (),
    engine: str = "auto",
    spec: mujoco.MjSpec | None = None,
    sensors: Sequence[str] = (),
) -> Choice:
    """Take the engine of that name; `auto` takes tree where it can, else mujoco on a CPU and mjx on an accelerator.

    `sensors` names those that are observed beyond the joints' positions and velocities. Raises `ValueError` where the
    engine asked for does not take the model, with everything that it refuses.
    """
    if engine not in ENGINES:
        raise ValueError(f"engine {engine!r}: choose one of {', '.join(ENGINES)}.")
    if engine == "mujoco":
        return Choice(MujocoEngine(model, writes, spec), "mujoco, as asked for")
    if engine == "mjx":
        return Choice(MjxEngine(model, writes), "mjx, as asked for")
    refusals = [*find_refusals(model, writes), *_refuse_sizes(model, writes, spec), *_refuse_sensors(sensors)]
    if not refusals:
        asked = "as asked for" if engine == "tree" else "which takes every element of this model"
        return Choice(TreeEngine(model, tuple(writes)), f"tree, {asked}")
    if engine == "tree":
        raise ValueError(f"the tree engine does not take this model: {'; '.join(refusals)}.")
    why = f"because the tree engine refuses it: {'; '.join(refusals)}"
    platform = jax.default_backend()
    if platform == "cpu":
        return Choice(MujocoEngine(model, writes, spec), f"mujoco, {why}")
    try:
        return Choice(MjxEngine(model, writes), f"mjx on this {platform}, {why}")
    except ValueError as error:
        return Choice(MujocoEngine(model, writes, spec), f"mujoco, {why}; and {error}")


def _refuse_sizes(model: mujoco.MjModel, writes: Sequence[Write], spec: mujoco.MjSpec | None) -> list[str]:
    names = {model.geom(w.index[0]).name for w in writes if w.field == "geom_size"}
    decisive = [name for name in sorted(names) if spec is None or infers_inertia(spec, name)]
    return [f"geom/{name}/size decides the inertia of its body" for name in decisive]


def _refuse_sensors(sensors: Sequence[str]) -> list[str]:
    return [f"sensor/{name} is observed" for name in sensors]
