"""Putting effects into a simulator."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from bayessim_jax.contracts import Box, System
from bayessim_jax.effects.alike import Alike
from bayessim_jax.effects.augmented import AugmentedMjcf
from bayessim_jax.effects.commanded import EVERY, AugmentedSystem, find_commands
from bayessim_jax.effects.contract import Scales
from bayessim_jax.effects.drive import least_share
from bayessim_jax.effects.places import Site, find_site
from bayessim_jax.effects.wiring import Wired, assign, extend_box, extend_writes
from bayessim_jax.engines.choice import choose_engine
from bayessim_jax.engines.contract import Engine
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.tree import TreeEngine
from bayessim_jax.systems.channels import observed_sensors
from bayessim_jax.systems.mjcf import MjcfSystem

__all__ = ["effect_places", "wire", "with_effects"]


def effect_places(effect: Any, system: System[Any]) -> list[str]:
    """Where an effect can act in a system."""
    if isinstance(system, (MjcfSystem, AugmentedMjcf)):
        places = effect.places(system.engine.model)
        seen = {c.name for c in system.channels}
        return places if effect.port != "sense" else [p for p in places if p in seen]
    if effect.port == "act" and isinstance(system.actions, Box):
        return [] if effect.looks else _actuators(effect, system.actions.names)
    return list(system.observations.names) if effect.port == "sense" and not effect.remembers else []


def with_effects(
    system: System[Any],
    effects: Sequence[tuple[Any, str]],
    scales: Scales | Mapping[str, Scales] | None = None,
) -> Any:
    """The system with effects at places, in their order: θ' = [θ, `stribeck_friction@joint/hinge/coulomb`, …].

    `scales` holds for all places or for each by name. Effects of forces and of the model need an `MjcfSystem`; any
    other system with continuous actions takes effects of its actuators and sensors. Raises `ValueError`.
    """
    scales = scales if scales is not None else Scales(period=system.dt, timestep=system.dt)
    if isinstance(system, MjcfSystem):
        return _augment(system, effects, scales)
    for effect, place in effects:
        if (
            effect.port not in ("act", "sense")
            or getattr(effect, "looks", False)
            or getattr(effect, "remembers", False)
        ):
            raise ValueError(f"{effect.name}@{place}: only a system made of a MuJoCo model takes this effect.")
    wired = wire(system, effects, scales)
    return AugmentedSystem(extend_box(system.parameters, wired), system, wired)


def wire(system: Any, effects: Sequence[tuple[Any, str]], scales: Scales | Mapping[str, Scales]) -> tuple[Wired, ...]:
    """Where effects act in a system, and their parameters in θ'."""
    if isinstance(system, MjcfSystem):
        sites = [find_site(system.engine.model, place) for _, place in effects]
        return assign(effects, sites, scales, system.parameters.size)
    sites = [find_commands(system, p) if e.port == "act" else _observed(system, p) for e, p in effects]
    spread = [(Alike(e) if p == EVERY else e, p) for e, p in effects]
    return assign(spread, sites, scales, system.parameters.size)


def _actuators(effect: Any, names: Sequence[str]) -> list[str]:
    """Where an effect on actuators can act; what acts on any one of several can act on all of them alike."""
    places = effect.choose(names)
    return [*places, EVERY] if len(places) == len(names) > 1 else places


def _augment(
    system: MjcfSystem, effects: Sequence[tuple[Any, str]], scales: Scales | Mapping[str, Scales]
) -> AugmentedMjcf:
    model, size = system.engine.model, system.parameters.size
    wired = wire(system, effects, scales)
    seen = {c.name for c in system.channels}
    for w in wired:
        if w.effect.port == "sense" and w.place not in seen:
            raise ValueError(f"{w.effect.name}@{w.place}: this channel is not observed; observe it.")
    edits = [w for w in wired if w.effect.port == "model"]
    engine = system.engine
    driven = sorted({i for w in wired if w.effect.port == "act" for i in w.site.actuators})
    limited = [i for i in driven if model.actuator_ctrllimited[i]]
    if edits or limited:
        engine = _rebuild(system, extend_writes(model, engine.writes, edits, size), limited)
    looking = [w for w in wired if w.effect.port == "force" or (w.effect.port == "act" and w.effect.looks)]
    joints = dict.fromkeys(w.site.joint for w in looking if w.site.joint >= 0)
    shares = tuple((j, least_share(model, np.asarray(system.qpos), int(model.jnt_dofadr[j]))) for j in joints)
    return AugmentedMjcf(extend_box(system.parameters, wired), system, engine, wired, shares)


def _rebuild(system: MjcfSystem, writes: Sequence[Write], free: Sequence[int]) -> Engine[Any]:
    """The same engine with other writes, and without limits on what arrives at some actuators."""
    engine = system.engine
    model = copy.copy(engine.model)
    model.actuator_ctrllimited[list(free)] = 0
    if isinstance(engine, TreeEngine):
        return TreeEngine(model, tuple(writes))
    spec = getattr(getattr(engine, "bank", None), "spec", None)
    if spec is not None:
        spec = spec.copy()
        for i in free:
            spec.actuators[i].ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    return choose_engine(model, writes, engine.name, spec, observed_sensors(engine.model, system.channels)).engine


def _observed(system: System[Any], place: str) -> Site:
    if place not in system.observations.names:
        raise ValueError(f"place {place!r}: the system observes {', '.join(system.observations.names)}.")
    return Site()
