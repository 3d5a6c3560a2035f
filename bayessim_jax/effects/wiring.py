"""Effects at their places in a system: which of θ' is whose, and which numbers of the model they set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from bayessim_jax.contracts import Box
from bayessim_jax.effects.contract import Effect, EffectParameter, ModelEffect, Scales, Values
from bayessim_jax.effects.drive import read_numbers
from bayessim_jax.effects.places import Site
from bayessim_jax.engines.fields import Write

__all__ = ["Wired", "assign", "edit_model", "extend_box", "extend_writes", "parameter_name"]


@dataclass(frozen=True)
class Wired:
    """An effect at a place; its parameters are θ'[first], θ'[first + 1], …"""

    effect: Any
    place: str
    site: Site
    parameters: tuple[EffectParameter, ...]
    first: int

    def values(self, theta: Float[Array, " d"]) -> Values:
        """Its parameters by name."""
        return {p.name: theta[self.first + k] for k, p in enumerate(self.parameters)}


def parameter_name(effect: Effect, place: str, parameter: str) -> str:
    """Name of an effect's parameter in θ': `stribeck_friction@joint/hinge/coulomb`."""
    return f"{effect.name}@{place}/{parameter}"


def assign(
    effects: Sequence[tuple[Any, str]],
    sites: Sequence[Site],
    scales: Scales | Mapping[str, Scales],
    first: int,
) -> tuple[Wired, ...]:
    """Number the effects' parameters from `first` on; `scales` holds for all places or for each by name."""
    wired = []
    for (effect, place), site in zip(effects, sites, strict=True):
        parameters = effect.parameters(place, scales if isinstance(scales, Scales) else scales[place])
        wired.append(Wired(effect, place, site, tuple(parameters), first))
        first += len(parameters)
    return tuple(wired)


def extend_box(box: Box, wired: Sequence[Wired]) -> Box:
    """The box of θ' = [θ, parameters of the effects]."""
    added = [(w, p) for w in wired for p in w.parameters]
    low, high = ([getattr(p, side) for _, p in added] for side in ("low", "high"))
    return Box(
        low=jnp.concatenate([box.low, jnp.asarray(low, box.low.dtype)]),
        high=jnp.concatenate([box.high, jnp.asarray(high, box.high.dtype)]),
        names=box.names + tuple(parameter_name(w.effect, w.place, p.name) for w, p in added),
        units=box.units + tuple(p.unit for _, p in added),
    )


def extend_writes(
    model: mujoco.MjModel, writes: Sequence[Write], effects: Sequence[Wired], first: int
) -> tuple[Write, ...]:
    """The writes of an engine to which effects hand the numbers that they set as θ[first], θ[first + 1], …"""
    targets = _targets(model, effects)
    kept = [w for w in writes if (w.field, w.index) not in targets]
    return (*kept, *(Write(field, index, 1.0, first + k) for k, (field, index) in enumerate(targets)))


def edit_model(
    model: mujoco.MjModel, writes: Sequence[Write], effects: Sequence[Wired], theta: Float[Array, " d"], size: int
) -> Float[Array, " e"]:
    """The engine's θ: the first `size` of θ', and then what the effects make of the numbers that they set."""
    if not effects:
        return theta[:size]
    plain = read_numbers(model, writes, theta)
    edited: dict[tuple[str, tuple[int, ...]], Any] = {}

    def numbers(field: str, *index: int) -> Any:
        return edited[field, index] if (field, index) in edited else plain(field, *index)

    for w in effects:
        effect: ModelEffect = w.effect
        new = effect.edit(w.values(theta), numbers, model, w.place)
        edited |= dict(zip(effect.targets(model, w.place), new, strict=True))
    derived = [jnp.asarray(edited[target], theta.dtype) for target in _targets(model, effects)]
    return jnp.concatenate([theta[:size], jnp.stack(derived)])


def _targets(model: mujoco.MjModel, effects: Sequence[Wired]) -> list[tuple[str, tuple[int, ...]]]:
    return list(dict.fromkeys(target for w in effects for target in w.effect.targets(model, w.place)))
