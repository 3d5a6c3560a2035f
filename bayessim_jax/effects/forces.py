"""The effects of the port `force`: what they exert on joints, and what they remember when a simulation begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.commands import pass_past
from bayessim_jax.effects.contract import Number, Numbers, Past
from bayessim_jax.effects.drive import CAUTION, actuators_of, drive_of
from bayessim_jax.effects.rig import AugmentedState, Grip, Rig, as_arrays

__all__ = ["add_forces", "begin_joints", "recall_motion", "recorded_steps"]


def add_forces(
    rig: Rig,
    theta: Float[Array, " d"],
    numbers: Numbers,
    state: AugmentedState,
    commands: Sequence[Number],
    memories: list[Any],
) -> tuple[Float[Array, " nv"] | None, tuple[Grip, ...], list[Any]]:
    """The generalized force of all effects together; holding effects do not see the forces of each other."""
    wired = rig.at("force")
    if not wired:
        return None, state.grips, memories
    accelerations = _accelerations(rig, state)
    kind = state.time.dtype
    total: list[Number] = [0.0] * rig.model.nv
    held: dict[int, Number] = {joint: 0.0 for joint, _ in rig.shares}
    for k, w in wired:
        moment = rig.see_joint(numbers, state, w.site, commands, accelerations)
        force, memories[k] = w.effect.force(w.values(theta), memories[k], moment)
        dof = rig.address(w.site.joint)[1]
        total[dof] = total[dof] + force
        if w.effect.holds:
            held[w.site.joint] = held[w.site.joint] + force
            accelerations[w.site.joint] = accelerations[w.site.joint] + force / moment.inertia
    velocity = rig.engine.qvel(state.base.physics)
    grips = tuple(
        Grip(velocity[rig.address(joint)[1]], jnp.asarray(held[joint], kind), grip.inertia)
        for (joint, _), grip in zip(rig.shares, state.grips, strict=True)
    )
    return jnp.stack([jnp.asarray(f, kind) for f in total]), grips, memories


def begin_joints(
    rig: Rig,
    theta: Float[Array, " d"],
    numbers: Numbers,
    inner: Float[Array, " e"],
    state: AugmentedState,
    commands: Sequence[Number],
) -> AugmentedState:
    """Memories of the effects at joints, from what these are about to do without anything that holds them."""
    wired = rig.at("force")
    if not wired:
        return state
    kind = state.time.dtype
    ctrl = jnp.stack([jnp.asarray(c, kind) for c in commands]) if commands else state.base.ctrl
    physics = state.base.physics
    after = rig.engine.step(inner, physics, ctrl, None, 1)
    acceleration = (rig.engine.qvel(after) - rig.engine.qvel(physics)) / rig.h
    before = [
        replace(grip, velocity=grip.velocity - rig.h / CAUTION * acceleration[rig.address(joint)[1]])
        for (joint, _), grip in zip(rig.shares, state.grips, strict=True)
    ]
    state = replace(state, grips=tuple(before))
    accelerations = _accelerations(rig, state)
    begun = {}
    for k, w in wired:
        moment = rig.see_joint(numbers, state, w.site, commands, accelerations)
        begun[k] = as_arrays(w.effect.begin(w.values(theta), moment), state.time)
    return state.with_memories(begun)


def recall_motion(
    rig: Rig,
    theta: Float[Array, " d"],
    numbers: Numbers,
    state: AugmentedState,
    qpos: Float[Array, "periods nq"],
    qvel: Float[Array, "periods nv"],
    ctrl: Float[Array, "periods act"],
    moves: Float[Array, " m"] | None = None,
) -> AugmentedState:
    """The memories of effects that remember how their joint has moved, and under what had become of which commands.

    `moves` are how far the effects that do not settle, one after the other, were from the best guess before that.
    """
    recalled, physics = {}, state.base.physics
    unsettled = [k for k, w in rig.at("force") if not w.effect.settles]
    recorded = recorded_steps(state.time, len(qpos), rig.dt)
    if rig.at("act") and rig.recalls:
        ctrl = pass_past(rig, theta, numbers, state, ctrl, qpos, qvel)
    for k, w in rig.at("force"):
        if w.effect.recalls:
            q, v = rig.address(w.site.joint)
            position, velocity = qpos[:, q], qvel[:, v]
            drive = drive_of(rig.model, numbers, actuators_of(rig.model, w.site.joint), ctrl.T, position, velocity)
            drives = drive + jnp.zeros_like(position)
            position = jnp.append(position, rig.engine.qpos(physics)[q])
            velocity = jnp.append(velocity, rig.engine.qvel(physics)[v])
            move = moves[unsettled.index(k)] if moves is not None and k in unsettled else 0.0
            past = Past(position, velocity, drives, recorded, rig.dt, rig.h)
            recalled[k] = w.effect.recall(w.values(theta), state.memories[k], past, move)
    return state.with_memories(recalled)


def recorded_steps(time: Scalar, count: int, period: float) -> Bool[Array, " count"]:
    """Which of so many steps before a time, s since the beginning of a recording, are in it."""
    return time - period * jnp.arange(count, 0, -1) > -0.5 * period


def _accelerations(rig: Rig, state: AugmentedState) -> dict[int, Number]:
    """What the joints did in the last time step, less what held them: a = (v − v⁻)/h − f⁻/m."""
    velocity = rig.engine.qvel(state.base.physics)
    return {
        joint: (velocity[rig.address(joint)[1]] - grip.velocity) / rig.h - grip.held / grip.inertia
        for (joint, _), grip in zip(rig.shares, state.grips, strict=True)
    }
