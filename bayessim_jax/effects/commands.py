"""What becomes of commands on their way to the actuators: the effects of the port `act`, one after the other.

Most of them look at nothing but the commands. These are worked out for a whole recording before it is simulated
(`early_effects`, `pass_early`), which leaves the engine to itself between control periods.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.effects.contract import Moment, Number, Numbers
from bayessim_jax.effects.history import split_history
from bayessim_jax.effects.places import Site
from bayessim_jax.effects.rig import AugmentedState, Rig, as_arrays
from bayessim_jax.effects.wiring import Wired

__all__ = [
    "NONE",
    "Actions",
    "begin_commands",
    "begin_one",
    "early_effects",
    "is_free",
    "pass_commands",
    "pass_early",
    "pass_one",
    "pass_past",
    "warm_up",
]

Actions = Float[Array, "periods act"]
NONE: frozenset[int] = frozenset()


def pass_commands(
    rig: Rig,
    theta: Float[Array, " d"],
    numbers: Numbers,
    state: AugmentedState,
    action: Float[Array, " act"],
    early: frozenset[int] = NONE,
) -> tuple[list[Number], list[Any]]:
    """What arrives at the actuators during the next time step, and all memories after it.

    An action that has passed the `early` effects has been limited, too.
    """
    commands: list[Number] = [action[k] for k in range(action.size)]
    if not early:
        commands = _limit(rig, numbers, action)
    memories = list(state.memories)
    for k, w in rig.at("act"):
        if k not in early:
            moment = rig.see_actuator(numbers, state, w.site)
            commands, memories[k] = pass_one(w, theta, memories[k], commands, moment)
    return commands, memories


def pass_one(
    wired: Wired, theta: Float[Array, " d"], memory: Any, commands: list[Number], moment: Moment
) -> tuple[list[Number], Any]:
    """The commands after one effect, and what it remembers."""
    new, memory = wired.effect.command(wired.values(theta), memory, _pick(commands, wired.site), moment)
    return _put(commands, wired.site, new), memory


def begin_one(
    wired: Wired, theta: Float[Array, " d"], commands: list[Number], moment: Moment
) -> tuple[list[Number], Any]:
    """The same where the commands have been held for long, and what an effect then remembers."""
    begun = wired.effect.begin(wired.values(theta), _pick(commands, wired.site), moment)
    memory = as_arrays(begun, jnp.asarray(moment.time))
    return pass_one(wired, theta, memory, commands, moment)[0], memory


def begin_commands(
    rig: Rig, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, held: Float[Array, " act"]
) -> AugmentedState:
    """Memories as after a command that has been held for long; those of other ports are empty."""
    memories: list[Any] = [()] * len(rig.effects)
    commands = _limit(rig, numbers, held)
    for k, w in rig.at("act"):
        commands, memories[k] = begin_one(w, theta, commands, rig.see_actuator(numbers, state, w.site))
    return replace(state, memories=tuple(memories))


def warm_up(
    rig: Rig, theta: Float[Array, " d"], numbers: Numbers, state: AugmentedState, past: Actions
) -> AugmentedState:
    """Memories after past commands; effects that look at the joint are left alone.

    What lies long back goes in longer steps, past effects that have not forgotten it.
    """
    blind = frozenset(k for k, w in rig.at("act") if not w.effect.looks)
    long = frozenset(k for k in blind if not rig.effects[k].effect.brief)
    older, h, past = split_history(past, rig.dt)
    if len(older) and long:
        begun = replace(state, time=state.time - len(past) * rig.dt - len(older) * h)
        afresh = begin_commands(rig, theta, numbers, state, past[0])
        long_ago = _last(pass_early(rig, theta, numbers, begun, older, long, h)[1])
        state = afresh.with_memories(long_ago)
    begun = replace(state, time=state.time - len(past) * rig.dt)
    return state.with_memories(_last(pass_early(rig, theta, numbers, begun, past, blind)[1]))


def pass_past(
    rig: Rig,
    theta: Float[Array, " d"],
    numbers: Numbers,
    state: AugmentedState,
    past: Actions,
    qpos: Float[Array, "periods nq"],
    qvel: Float[Array, "periods nv"],
) -> Actions:
    """What arrived of past commands in every control period, which is one step of effects that remember.

    The first of them had been held for long; positions and velocities are those at the beginning of each period.
    """
    columns: list[Any] = _limit(rig, numbers, past)
    first = state.time - len(past) * rig.dt
    for _, w in rig.at("act"):
        values, picked = w.values(theta), _pick(columns, w.site)
        moment = rig.see_actuator(numbers, state, w.site)._replace(time=first, h=rig.dt)
        memory = begin_one(w, theta, [column[0] for column in columns], moment)[1]
        if not w.effect.looks:
            new = w.effect.ahead(values, memory, picked, moment)[0]
        else:
            q, v = rig.address(w.site.joint)
            # without a memory the length of a step is that of the simulation
            h = rig.dt if jax.tree.leaves(memory) else rig.h

            def once(memory: Any, now: Any, w: Wired = w, values: Any = values, moment: Moment = moment) -> Any:
                command, time, position, velocity = now
                seen = moment._replace(time=time, h=h, position=position, velocity=velocity)  # noqa: B023
                new, memory = w.effect.command(values, memory, command, seen)
                return memory, new

            times = first + rig.dt * jnp.arange(len(past))
            new = jax.lax.scan(once, memory, (picked, times, qpos[:, q], qvel[:, v]))[1]
        columns = _put(columns, w.site, new)
    return jnp.stack(columns, -1)


def early_effects(rig: Rig) -> frozenset[int]:
    """Effects that are worked out before the simulation: for one that hurries also those before it."""
    blind: list[int] = []
    for k, w in rig.at("act"):
        if w.effect.looks:
            break
        blind.append(k)
    if rig.engine.name == "mujoco" and is_free(rig, frozenset(blind)):
        return frozenset(blind)
    while blind and not rig.effects[blind[-1]].effect.hurries:
        blind.pop()
    return frozenset(blind)


def is_free(rig: Rig, early: frozenset[int]) -> bool:
    """Whether but for these effects nothing is left to do between time steps."""
    others = [w.effect for k, w in enumerate(rig.effects) if k not in early]
    return all(e.port == "model" or (e.port == "sense" and not e.remembers) for e in others)


def pass_early(
    rig: Rig,
    theta: Float[Array, " d"],
    numbers: Numbers,
    state: AugmentedState,
    actions: Actions,
    early: frozenset[int],
    h: float = 0.0,
) -> tuple[Float[Array, "periods steps act"], dict[int, Any]]:
    """What has become of the commands at each time step, and the memories after each period.

    With `h` a period is one step of that length.
    """
    substeps = 1 if h else rig.substeps
    columns = _limit(rig, numbers, jnp.repeat(actions, substeps, axis=0) if substeps > 1 else actions)
    later = {}
    for k in sorted(early):
        w, moment = rig.effects[k], Moment(state.time, h or rig.h)
        new, memory = w.effect.ahead(w.values(theta), state.memories[k], _pick(columns, w.site), moment)
        columns = _put(columns, w.site, new)
        later[k] = jax.tree.map(lambda x: x[substeps - 1 :: substeps], memory)
    return jnp.stack(columns, -1).reshape(-1, substeps, actions.shape[-1]), later


def _limit(rig: Rig, numbers: Numbers, action: Float[Array, "*rows act"]) -> list[Number]:
    """The commands within the limits that the model has on them; what becomes of them then has none."""
    commands: list[Number] = [action[..., k] for k in range(action.shape[-1])]
    for k in np.flatnonzero(rig.plain.actuator_ctrllimited != rig.model.actuator_ctrllimited):
        low, high = (numbers("actuator_ctrlrange", int(k), side) for side in (0, 1))
        commands[k] = jnp.clip(commands[k], low, high)
    return commands


def _pick(commands: list[Number], site: Site) -> Any:
    picked = tuple(commands[i] for i in site.actuators)
    return picked[0] if len(picked) == 1 else picked


def _put(commands: list[Number], site: Site, new: Any) -> list[Number]:
    put = dict(zip(site.actuators, new if isinstance(new, tuple) else (new,), strict=True))
    return [put.get(k, command) for k, command in enumerate(commands)]


def _last(later: Mapping[int, Any]) -> dict[int, Any]:
    return jax.tree.map(lambda x: x[-1], dict(later))
