"""The effects of the port `sense`: what sensors make of the motion, and the motion behind what they showed."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import Moment
from bayessim_jax.effects.places import has_rate
from bayessim_jax.effects.rig import AugmentedState, Rig, as_arrays
from bayessim_jax.effects.wiring import Wired

__all__ = ["begin_late", "distort", "restore", "restore_motion", "sensors", "track"]


def sensors(rig: Rig) -> list[tuple[int, Wired]]:
    """Effects on readings in the order in which they act: first those that show another moment of the motion."""
    return sorted(rig.at("sense"), key=lambda item: not item[1].effect.remembers)


def distort(
    rig: Rig,
    theta: Float[Array, " d"],
    state: AugmentedState,
    seen: Float[Array, " obs"],
    channels: Sequence[str],
) -> Float[Array, " obs"]:
    """The channels as the sensors' effects show them."""
    for k, w in sensors(rig):
        for c in [c for c, name in enumerate(channels) if name == w.place]:
            moment = Moment(state.time, rig.dt)
            seen = seen.at[c].set(w.effect.sense(w.values(theta), state.memories[k], seen[c], moment))
    return seen


def track(rig: Rig, theta: Float[Array, " d"], state: AugmentedState) -> AugmentedState:
    """What late sensors remember after a control period."""
    late = [(k, w) for k, w in rig.at("sense") if w.effect.remembers]
    return state.with_memories(
        {k: w.effect.track(w.values(theta), state.memories[k], rig.see_sensor(state, w.site)) for k, w in late}
    )


def begin_late(
    rig: Rig,
    theta: Float[Array, " d"],
    state: AugmentedState,
    acceleration: Float[Array, " nv"],
    jerk: Float[Array, " nv"],
) -> AugmentedState:
    """What late sensors remember of joints that came with this acceleration and jerk."""
    begun = {}
    for k, w in rig.at("sense"):
        if w.effect.remembers:
            v = rig.address(w.site.joint)[1]
            moment = rig.see_sensor(state, w.site)._replace(acceleration=acceleration[v], jerk=jerk[v])
            begun[k] = as_arrays(w.effect.begin(w.values(theta), moment), state.time)
    return state.with_memories(begun)


def restore(
    rig: Rig,
    wired: Sequence[Wired],
    theta: Float[Array, " d"],
    channels: Collection[str],
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    time: Scalar,
    acceleration: Float[Array, " nv"],
    jerk: Float[Array, " nv"],
) -> tuple[Float[Array, " nq"], Float[Array, " nv"]]:
    """The positions and velocities behind these, which some effects on readings show, the last one outermost."""
    for w in reversed(wired):
        if w.site.joint < 0:
            continue
        q, v = rig.address(w.site.joint)
        prompt = has_rate(w.place, channels)
        moment = Moment(time, rig.dt, qpos[q], qvel[v], acceleration[v], jerk=jerk[v], prompt=prompt)
        position, velocity = w.effect.restore(w.values(theta), moment)
        if not w.place.endswith("/qvel"):
            qpos = qpos.at[q].set(position)
        if w.place.endswith("/qvel") or not prompt:
            qvel = qvel.at[v].set(velocity)
    return qpos, qvel


def restore_motion(
    rig: Rig,
    theta: Float[Array, " d"],
    channels: Collection[str],
    qpos: Float[Array, "periods nq"],
    qvel: Float[Array, "periods nv"],
    time: Scalar,
) -> tuple[Float[Array, "periods nq"], Float[Array, "periods nv"]]:
    """The same of all control periods before a time."""
    times, every = time - rig.dt * jnp.arange(len(qpos), 0, -1), [w for _, w in sensors(rig)]
    late = any(w.effect.remembers for w in every)
    if not every or (late and len(qpos) < 2):
        return qpos, qvel
    rate = jnp.asarray(jnp.gradient(qvel, rig.dt, axis=0)) if late else jnp.zeros_like(qvel)
    seen = (qpos, qvel, times, rate, jnp.asarray(jnp.gradient(rate, rig.dt, axis=0)) if late else rate)
    return jax.vmap(lambda *row: restore(rig, every, theta, channels, *row))(*seen)
