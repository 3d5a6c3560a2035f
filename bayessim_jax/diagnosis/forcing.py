"""What an effect does along a recorded motion: the force it exerts, and how that changes with its parameters.

The effects' own equations are evaluated on the smoothed motion, remembering what they remember. Nothing is simulated,
and the programs know neither a model nor a prior: another machine finds them in the compilation cache. They take an
effect's numbers in their own units, and `rates`, how these grow with the variable x that derivatives are along.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.diagnosis.response import Numbers
from bayessim_jax.effects import Moment
from bayessim_jax.effects.contract import Past
from bayessim_jax.effects.forces import recorded_steps
from bayessim_jax.inference.shooting import COMPILER_OPTIONS
from bayessim_jax.programs import trace_once

__all__ = ["Joint", "Partners", "Passed", "commands_of", "force_of", "pass_on", "restore_readings"]


@struct.dataclass
class Joint:
    """A joint's motion at the beginning of every time step, `windows steps`."""

    position: Float[Array, "windows steps"]
    velocity: Float[Array, "windows steps"]
    acceleration: Float[Array, "windows steps"]
    """Of the simulator without the effect."""
    inertia: Float[Array, "windows steps"]
    drive: Float[Array, "windows steps"]

    def moment(self, time: Array, h: float) -> Moment:
        """As effects see it."""
        return Moment(time, h, self.position, self.velocity, self.acceleration, self.inertia, self.drive)


@struct.dataclass
class Partners:
    """How what an effect sees moves with every number of a candidate that has other effects beside it."""

    own: Float[Numbers, "m k"]
    """Of its own numbers."""
    acceleration: Float[Numbers, "m windows steps"]
    """Of the joint."""
    drive: Float[Numbers, "m windows steps"]
    before: Float[Numbers, "m windows before"] | None = None
    """What actuators exerted before the windows, where an effect remembers that."""


@struct.dataclass
class Passed:
    """Commands that have passed some effects, and how they move with every number of a candidate."""

    commands: Float[Numbers, "windows steps act"]
    """Of every time step; those before the window come first."""
    older: Float[Numbers, "windows early act"]
    """From before these."""
    along: Float[Numbers, "m windows steps act"]
    older_along: Float[Numbers, "m windows early act"]


def _named(names: tuple[str, ...], numbers: Array) -> dict[str, Array]:
    return {name: numbers[k] for k, name in enumerate(names)}


@trace_once(
    static_argnames=("effect", "names", "detail", "h", "steps", "period"),
    compiler_options=COMPILER_OPTIONS,
    to_numpy=True,
)
def force_of(
    effect: Any,
    names: tuple[str, ...],
    detail: str,
    h: float,
    steps: int,
    numbers: Float[Array, " k"],
    rates: Float[Array, " k"],
    time: Float[Array, "windows steps"],
    joint: Joint,
    other: Joint | None,
    earlier: tuple[Float[Array, "windows before"], ...] | None = None,
    period: float = 0.0,
    partners: Partners | None = None,
) -> tuple[Float[Array, "windows rows"], Float[Array, "windows rows k"]]:
    """Mean force of a `ForceEffect` in every row of so many time steps, and its derivatives along x.

    `earlier` are positions, velocities and what actuators exerted before the windows, every `period` s, for one that
    remembers them. Beside `partners`, derivatives are along all numbers of the candidate.
    """

    def moment(time: Array, joint: Joint, other: Joint | None) -> Moment:
        beside = None if other is None else other.moment(time, h)
        return joint.moment(time, h)._replace(detail=detail, other=beside)

    def force(x: Array, joint: Joint = joint, earlier: Any = earlier) -> Array:
        values = _named(names, x)

        def window(time: Array, joint: Joint, other: Joint | None, earlier: Any) -> Array:
            def once(memory: Any, now: Any) -> tuple[Any, Array]:
                f, memory = effect.force(values, memory, moment(*now))
                return memory, f * jnp.ones(())

            rows = (time, joint, other)
            first = jax.tree.map(lambda a: a[0], rows)
            begun = jax.tree.map(lambda m: jnp.asarray(m, time.dtype), effect.begin(values, moment(*first)))
            if earlier is not None:
                positions, velocities, drives = earlier
                start = moment(*first)
                motion = jnp.append(positions, start.position), jnp.append(velocities, start.velocity)
                recorded = recorded_steps(start.time, len(drives), period)
                begun = effect.recall(values, begun, Past(*motion, drives, recorded, period, h))
            if not jax.tree.leaves(begun):
                return jax.vmap(lambda now: once(begun, now)[1])(rows).reshape(-1, steps).mean(-1)
            return jax.lax.scan(once, begun, rows)[1].reshape(-1, steps).mean(-1)

        return jax.vmap(window)(time, joint, other, earlier)

    if partners is not None:

        def among(x: Array, acceleration: Array, drive: Array, before: Array | None) -> Array:
            there = dataclasses.replace(joint, acceleration=acceleration, drive=drive)
            return force(x, there, earlier if earlier is None or before is None else (*earlier[:2], before))

        drives = None if earlier is None or partners.before is None else earlier[2]
        here = numbers, joint.acceleration, joint.drive, drives
        moves = partners.own, partners.acceleration, partners.drive, None if drives is None else partners.before
        return jax.vmap(lambda *move: jax.jvp(among, here, move), out_axes=(None, -1))(*moves)
    values = _named(names, numbers)
    if effect.slopes(values, moment(*jax.tree.map(lambda a: a[0, 0], (time, joint, other)))) is None:
        return _with_slopes(force, numbers, rates)

    def both(*now: Any) -> tuple[Array, Array]:
        return effect.force(values, (), moment(*now))[0], effect.slopes(values, moment(*now))

    f, along = jax.vmap(jax.vmap(both))(time, joint, other)
    return f.reshape(len(f), -1, steps).mean(-1), rates * along.reshape(len(f), -1, steps, along.shape[-1]).mean(2)


@trace_once(
    static_argnames=("effect", "names", "h", "steps", "before", "coarse"),
    compiler_options=COMPILER_OPTIONS,
    to_numpy=True,
)
def commands_of(
    effect: Any,
    names: tuple[str, ...],
    h: float,
    steps: int,
    before: int,
    coarse: float,
    numbers: Float[Array, " k"],
    rates: Float[Array, " k"],
    time: Float[Array, "windows steps"],
    joint: Joint,
    commands: Float[Array, "windows steps act"],
    older: Float[Array, "windows early act"],
    gains: Float[Array, " act"],
) -> tuple[Float[Array, "windows rows act"], Float[Array, "windows rows act k"]]:
    """What an `ActEffect` changes in forces, `gains` times commands, on average over every row; derivatives along x.

    The first `before` of the commands come before the window and only fill what the effect remembers; so do `older`
    ones from before these, in steps of `coarse` s.
    """

    def change(x: Array) -> Array:
        new, _ = _arrive(effect, _named(names, x), h, before, coarse, time, joint, commands, older, gains[0])
        changes = (new - commands)[:, before:]
        return gains * changes.reshape(len(time), -1, steps, changes.shape[-1]).mean(2)

    return _with_slopes(change, numbers, rates)


@trace_once(
    static_argnames=("effect", "names", "h", "before", "coarse"), compiler_options=COMPILER_OPTIONS, to_numpy=True
)
def pass_on(
    effect: Any,
    names: tuple[str, ...],
    h: float,
    before: int,
    coarse: float,
    numbers: Float[Array, " k"],
    own: Float[Array, "m k"],
    time: Float[Array, "windows steps"],
    joint: Joint,
    passed: Passed,
    gains: Float[Array, " act"],
) -> Passed:
    """What arrives where an `ActEffect` takes commands that have passed others; as in `commands_of`.

    `own` are the ways of its own numbers as a candidate's numbers move.
    """

    def arrive(x: Array, commands: Array, older: Array) -> tuple[Array, Array]:
        return _arrive(effect, _named(names, x), h, before, coarse, time, joint, commands, older, gains[0])

    here, moves = (numbers, passed.commands, passed.older), (own, passed.along, passed.older_along)
    (new, long_ago), slopes = jax.vmap(lambda *move: jax.jvp(arrive, here, move), out_axes=(None, 0))(*moves)
    return Passed(new, long_ago, *slopes)


def _arrive(
    effect: Any,
    values: dict[str, Array],
    h: float,
    before: int,
    coarse: float,
    time: Float[Array, "windows steps"],
    joint: Joint,
    commands: Float[Array, "windows steps act"],
    older: Float[Array, "windows early act"],
    gain: Array,
) -> tuple[Float[Array, "windows steps act"], Float[Array, "windows early act"]]:
    """What arrives of commands, and of older ones; a brief memory has forgotten these and leaves them as they are."""
    single = commands.shape[-1] == 1

    def window(time: Array, joint: Joint, commands: Array, older: Array) -> tuple[Array, Array]:
        def moment(time: Array, joint: Joint) -> Moment:
            return joint.moment(time, h)._replace(gain=gain)

        def pick(row: Array) -> Any:
            return row[0] if single else tuple(row)

        def stack(new: Any) -> Array:
            return jnp.stack(new if isinstance(new, tuple) else (new,), -1)

        def once(memory: Any, now: tuple[Array, Joint, Array]) -> tuple[Any, Array]:
            time, joint, row = now
            new, memory = effect.command(values, memory, pick(row), moment(time, joint))
            return memory, stack(new)

        rows = (time, joint, commands)
        first = jax.tree.map(lambda a: a[0], rows)
        long = bool(len(older)) and not effect.brief
        begun = effect.begin(values, pick(older[0] if long else first[2]), moment(*first[:2]))
        begun = jax.tree.map(lambda m: jnp.asarray(m, time.dtype), begun)
        arrived = older
        if long:
            early = moment(*first[:2])._replace(h=coarse, time=time[0] - len(older) * coarse)
            new, memories = effect.ahead(values, begun, pick(older.T), early)
            begun, arrived = jax.tree.map(lambda m: m[-1], memories), stack(new)
        return jax.lax.scan(once, begun, rows)[1], arrived

    earlier = jnp.concatenate([time[:, :1] + h * jnp.arange(-before, 0), time], 1)
    held = jax.tree.map(lambda a: jnp.concatenate([jnp.repeat(a[:, :1], before, 1), a], 1), joint)
    return jax.vmap(window)(earlier, held, commands, older)


@trace_once(
    static_argnames=("effect", "names", "period", "prompt"),
    compiler_options=COMPILER_OPTIONS,
    to_numpy=True,
)
def restore_readings(
    effect: Any,
    names: tuple[str, ...],
    period: float,
    prompt: bool,
    numbers: Float[Array, " k"],
    rates: Float[Array, " k"],
    time: Float[Array, "windows rows"],
    position: Float[Array, "windows rows"],
    velocity: Float[Array, "windows rows"],
    acceleration: Float[Array, "windows rows"],
    jerk: Float[Array, "windows rows"],
) -> tuple[Array, Array, Array, Array, Array]:
    """True positions and velocities behind readings of a `SenseEffect`, ∂q/∂x, ∂v/∂x, and ∂q/∂reading.

    `prompt` where velocities are measured of themselves.
    """

    def restore(x: Array, position: Array) -> tuple[Array, Array]:
        moment = Moment(time, period, position, velocity, acceleration, jerk=jerk, prompt=prompt)
        q, v = effect.restore(_named(names, x), moment)
        return q * jnp.ones_like(time), v * jnp.ones_like(time)

    (q, v), slope = jax.jvp(lambda position: restore(numbers, position), (position,), (jnp.ones_like(position),))
    _, along = _with_slopes(lambda x: restore(x, position), numbers, rates)
    return q, v, *along, slope[0]


def _with_slopes(f: Any, numbers: Array, rates: Array) -> tuple[Any, Any]:
    along = jax.vmap(lambda d: jax.jvp(f, (numbers,), (d,)), out_axes=(None, 0))
    value, slopes = along(jnp.diag(rates))
    return value, jax.tree.map(lambda s: jnp.moveaxis(s, 0, -1), slopes)
