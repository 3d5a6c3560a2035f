"""Any system with effects of its actuators and sensors, which act once in a control period."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.contracts import Box, Scalar, System
from bayessim_jax.effects.commands import begin_one, pass_one
from bayessim_jax.effects.contract import Moment
from bayessim_jax.effects.places import Site, at
from bayessim_jax.effects.rig import AugmentedState
from bayessim_jax.effects.wiring import Wired

__all__ = ["EVERY", "AugmentedSystem", "find_commands"]

EVERY = "actuator/*"
"""The place of an effect on all actuators alike."""


@struct.dataclass
class AugmentedSystem:
    """A `System` with effects; made by `with_effects`. θ' = [θ, the effects' parameters in their order]."""

    parameters: Box
    base: System[Any]
    effects: tuple[Wired, ...] = struct.field(pytree_node=False)

    @property
    def actions(self) -> Box:
        """Commands, before the actuators' effects."""
        actions = self.base.actions
        assert isinstance(actions, Box)
        return actions

    @property
    def observations(self) -> Box:
        """Those of the system without effects."""
        return self.base.observations

    @property
    def noise(self) -> Float[Array, " obs"]:
        """That of the system without effects."""
        return self.base.noise

    @property
    def dt(self) -> float:
        """One control period, s."""
        return self.base.dt

    def reset(self, key: PRNGKeyArray, theta: Float[Array, " d"]) -> AugmentedState:
        """An initial state of the system without effects, at time 0."""
        return self.resume(theta, self.base.reset(key, theta[: self.base.parameters.size]))

    def begin(
        self,
        theta: Float[Array, " d"],
        observation: Float[Array, " obs"],
        past: Float[Array, "periods act"],
        time: Scalar | float = 0.0,
    ) -> AugmentedState:
        """The state that shows this observation, `time` seconds into a recording, after these commands.

        One row for each control period before, the most recent last; the first had been held for long.
        """
        for w in reversed([w for w in self.effects if w.effect.port == "sense"]):
            c = self.observations.names.index(at(w.place))
            moment = Moment(jnp.asarray(time), self.dt, position=observation[c])
            observation = observation.at[c].set(w.effect.restore(w.values(theta), moment)[0])
        base: Any = self.base
        begun = self.resume(
            theta,
            base.restart(theta[: self.base.parameters.size], observation),
            past[0],
            time - len(past) * self.dt,
        )

        def once(state: AugmentedState, action: Float[Array, " act"]) -> tuple[AugmentedState, None]:
            return replace(self._command(theta, state, action)[1], time=state.time + self.dt), None

        return jax.lax.scan(once, begun, past)[0]

    def resume(
        self,
        theta: Float[Array, " d"],
        base: Any,
        action: Float[Array, " act"] | None = None,
        time: Scalar | float = 0.0,
    ) -> AugmentedState:
        """A state of the system without effects as one with, as if the action had always been held."""
        kind = jnp.result_type(theta)
        time = jnp.asarray(time, kind)
        commands = list(jnp.zeros(self.actions.size, kind) if action is None else jnp.asarray(action, kind))
        moment = Moment(time, self.dt)
        memories: list[Any] = []
        for w in self.effects:
            if w.effect.port == "sense":
                memories.append(w.effect.begin(w.values(theta), moment))
                continue
            commands, memory = begin_one(w, theta, commands, moment)
            memories.append(memory)
        return AugmentedState(base, tuple(memories), (), time)

    def step(self, theta: Float[Array, " d"], state: AugmentedState, action: Float[Array, " act"]) -> AugmentedState:
        """Advance by one control period."""
        arrived, state = self._command(theta, state, action)
        base = self.base.step(theta[: self.base.parameters.size], state.base, arrived)
        return replace(state, base=base, time=state.time + self.dt)

    def _command(
        self, theta: Float[Array, " d"], state: AugmentedState, action: Float[Array, " act"]
    ) -> tuple[Float[Array, " act"], AugmentedState]:
        """What arrives of an action, and the state whose effects have seen it."""
        commands: list[Any] = [action[k] for k in range(self.actions.size)]
        memories, moment = {}, Moment(state.time, self.dt)
        for k, w in enumerate(self.effects):
            if w.effect.port == "act":
                commands, memories[k] = pass_one(w, theta, state.memories[k], commands, moment)
        return jnp.stack(commands), state.with_memories(memories)

    def replay(
        self, theta: Float[Array, " d"], state: AugmentedState, actions: Float[Array, "periods act"]
    ) -> AugmentedState:
        """The states after each control period under recorded actions; a leading axis on every leaf."""

        def once(state: AugmentedState, action: Float[Array, " act"]) -> tuple[AugmentedState, AugmentedState]:
            after = self.step(theta, state, action)
            return after, after

        return jax.lax.scan(once, state, actions)[1]

    def observe(self, theta: Float[Array, " d"], state: AugmentedState) -> Float[Array, " obs"]:
        """What the sensors show of a state, with their effects, before noise."""
        seen = self.base.observe(theta[: self.base.parameters.size], state.base)
        for k, w in enumerate(self.effects):
            if w.effect.port == "sense":
                c = self.observations.names.index(at(w.place))
                seen = seen.at[c].set(
                    w.effect.sense(w.values(theta), state.memories[k], seen[c], Moment(state.time, self.dt))
                )
        return seen


def find_commands(system: System[Any], place: str) -> Site:
    """The actions that a place names, or `ValueError`."""
    if not isinstance(system.actions, Box):
        raise ValueError(f"place {place!r}: this system's actions are a choice among few; effects need numbers.")
    if place == EVERY and system.actions.size > 1:
        return Site(actuators=tuple(range(system.actions.size)))
    names = [name.removeprefix("actuator/") for name in place.split("#")]
    for name in names:
        if name not in system.actions.names:
            raise ValueError(
                f"place {place!r}: the system has no action {name!r}; take one of {', '.join(system.actions.names)}."
            )
    return Site(actuators=tuple(system.actions.names.index(name) for name in names))
