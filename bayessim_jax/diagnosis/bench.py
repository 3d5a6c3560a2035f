"""The bench on which candidates are tried: one simulator that holds every effect at every place, most of them neutral.

An effect at its neutral parameters changes nothing, bit for bit. So the simulator with all candidates in it is each of
them in turn, and the one without any: it is traced and compiled once, and a candidate is a choice of which parameters
are free. θ and the initial states of all windows are refitted with every candidate.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Scalar

from bayessim_jax.beliefs.margins import Margin, Margins, log_uniform, uniform
from bayessim_jax.effects import EffectParameter, Scales, at, with_effects
from bayessim_jax.effects.wiring import Wired
from bayessim_jax.inference.replay import Inputs, Restarted, replay_window
from bayessim_jax.inference.shooting import COMPILER_OPTIONS, DAMPING, Fit, Shots, predict_all, solve
from bayessim_jax.systems.mjcf import MjcfSystem

__all__ = ["NEAR", "SLOTS", "Bench", "Candidate", "CandidatesOf", "begin_point", "begin_value", "margin_of_effect"]

NEAR = 0.1
"""Of the way from an effect's neutral value to where a fit usually begins: weak effects are found from there."""
SLOTS = 6
"""Parameters that a candidate may have beside θ."""


@dataclass(frozen=True)
class Candidate:
    """Effects, by their numbers on the bench; none is the simulator as it is."""

    effects: tuple[int, ...] = ()

    def __add__(self, other: Candidate) -> Candidate:
        return Candidate(tuple(sorted({*self.effects, *other.effects})))


class CandidatesOf:
    """Effects at places, numbered, and where a candidate's parameters stand among the numbers of a fit."""

    pairs: Sequence[tuple[Any, str]]
    parameters: Sequence[Sequence[EffectParameter]]
    """Of every pair."""
    d: int
    """Parameters of the system."""
    slots: int

    def count(self, candidate: Candidate) -> int:
        """Parameters of a candidate."""
        return sum(len(self.parameters[k]) for k in candidate.effects)

    def name(self, candidate: Candidate) -> str:
        """`coulomb_friction@joint/hinge + …`."""
        return " + ".join(f"{self.pairs[k][0].name}@{at(self.pairs[k][1])}" for k in candidate.effects) or "nothing"

    def offsets(self, candidate: Candidate) -> list[tuple[int, slice]]:
        """Every effect of a candidate and the places of its parameters in p = [θ's z, x, zeros]."""
        found, first = [], self.d
        for k in candidate.effects:
            found.append((k, slice(first, first + len(self.parameters[k]))))
            first += len(self.parameters[k])
        return found


@struct.dataclass
class Tried:
    """A window, and which parameters are free in it."""

    window: Inputs
    index: Int[Array, " k"]
    """Where the free parameters stand in [θ, effects' parameters, a place for those that are not used]."""
    on: Bool[Array, " e"]
    """Which of the effects' parameters are not neutral."""
    low: Float[Array, " e"]
    """Ranges of the effects' parameters. They are arguments and not constants of the program, because recordings decide
    them: another case of the same model then finds the program in the compilation cache."""
    high: Float[Array, " e"]
    neutral: Float[Array, " e"]


class Bench:
    """Every effect at every place of a system, windows of recordings, and the solver that fits them."""

    def __init__(
        self,
        system: MjcfSystem | Restarted,
        margins: Margins,
        pairs: Sequence[tuple[Any, str]],
        scales: Mapping[str, Scales],
        shots: Shots,
        step: float = 0.0,
        slots: int = SLOTS,
    ) -> None:
        self.margins, self.pairs, self.step, self.slots = margins, tuple(pairs), step, slots
        self.scales = scales
        plain: Any = system
        self.union = with_effects(plain, self.pairs, scales) if self.pairs else plain
        self.channels = system.observations.names
        self.shots = shots
        self.wired: tuple[Wired, ...] = self.union.effects if self.pairs else ()
        self.parameters = [p for w in self.wired for p in w.parameters]
        self.first = np.cumsum([0, *(len(w.parameters) for w in self.wired)])
        self.each: list[Margin] = [margin_of_effect(p) for p in self.parameters]
        self.neutral = np.array([p.neutral for p in self.parameters])

    @property
    def d(self) -> int:
        """Parameters of the system."""
        return self.margins.size

    @property
    def size(self) -> int:
        """Numbers that a fit finds: θ, and as many more as a candidate may have."""
        return self.d + self.slots

    def name(self, effect: int) -> str:
        """`coulomb_friction@joint/hinge`."""
        found, place = self.pairs[effect]
        return f"{found.name}@{at(place)}"

    def label(self, effect: int) -> str:
        """The same with what follows a `#`, which tells effects of one name at one place apart."""
        found, place = self.pairs[effect]
        return f"{found.name}@{place}"

    def names(self, candidate: Candidate) -> list[str]:
        """Of every effect of a candidate."""
        return [self.name(k) for k in candidate.effects]

    def seats(self, candidate: Candidate) -> dict[str, str]:
        """Names of a candidate's effects on actuators, and the same at the joint that is driven."""
        found = {}
        for k in candidate.effects:
            effect, place = self.pairs[k]
            joint = self.wired[k].site.joint
            if place.startswith("actuator/") and joint >= 0:
                found[self.name(k)] = f"{effect.name}@joint/{self.union.engine.model.joint(joint).name}"
        return found

    def columns(self, candidate: Candidate) -> list[int]:
        """Numbers of a candidate's parameters among those of all effects."""
        return [i for k in candidate.effects for i in range(self.first[k], self.first[k + 1])]

    def setup(self, candidate: Candidate, shots: Shots | None = None) -> Shots:
        """The windows (or others) with a candidate's parameters free."""
        every = self.shots if shots is None else shots
        columns = self.columns(candidate)
        unused = self.d + len(self.parameters)
        index = np.concatenate([np.arange(self.d), self.d + np.array(columns, int)])
        index = np.concatenate([index, np.full(self.size - len(index), unused)]).astype(int)
        on = np.isin(np.arange(len(self.parameters)), columns)
        ranges = ([m.a for m in self.each], [m.b for m in self.each], self.neutral)
        inputs = Tried(every.inputs, *map(jax.device_put, (index, on, *(np.asarray(x, float) for x in ranges))))
        axes: Any = (0, None, None, None, None, None)
        return dataclasses.replace(every, inputs=inputs, axes=Tried(*axes))

    def starts(self, candidate: Candidate, z: Float[Array, " d"]) -> list[Float[Array, " k"]]:
        """Points to begin from: θ as given, the effects a little off neutral, at their start values, and mirrored."""
        columns = self.columns(candidate)
        own = [self.parameters[i] for i in columns]
        begin, near = (begin_point(own, [self.each[i] for i in columns], share) for share in (1.0, NEAR))
        points = [near, begin] if len(own) and np.abs(near - begin).max() > 1e-9 else [begin]
        points += [-begin] if any(p.low < 0.0 for p in own) else []
        rest = np.zeros(self.slots - len(columns))
        return [jax.device_put(np.concatenate([np.asarray(z), x, rest])) for x in points]

    def free(self, candidate: Candidate) -> Bool[Array, " k"]:
        """Which of the numbers that a fit finds are free."""
        return jax.device_put(np.arange(self.size) < self.d + len(self.columns(candidate)))

    @cached_property
    def predict(self) -> Any:
        """`predict(x, δ, tried)`; the same function for every candidate."""
        d, margins, union, each = self.d, self.margins, self.union, self.each

        def predict(x: Array, delta: Array, tried: Tried) -> Array:
            z = jnp.zeros(d + len(each) + 1, x.dtype).at[tried.index].set(x)
            theta = margins.theta(z[:d])
            if each:
                own = [m.between(tried.low[k], tried.high[k]).value(z[d + k]) for k, m in enumerate(each)]
                theta = jnp.concatenate([theta, jnp.where(tried.on, jnp.stack(own), tried.neutral)])
            return replay_window(union, theta, delta, tried.window)

        return predict

    def values(self, candidate: Candidate, x: Float[Array, " k"]) -> dict[str, float]:
        """The effects' parameters in physical units, `coulomb_friction@joint/hinge/coulomb`."""
        named = {}
        for k in candidate.effects:
            for i in range(self.first[k], self.first[k + 1]):
                place = self.columns(candidate).index(i)
                value = float(self.each[i].value(float(x[self.d + place])))
                named[f"{self.label(k)}/{self.parameters[i].name}"] = value
        return named

    def fit(
        self,
        candidate: Candidate,
        x: Float[Array, " k"],
        delta: Float[Array, "windows n"],
        sigma: Float[Array, " obs"],
        *,
        steps: int = 20,
        damping: float | Scalar = DAMPING,
    ) -> Fit:
        """Fit a candidate from a point."""
        free, shots = self.free(candidate), self.setup(candidate)
        how = {"steps": jnp.asarray(steps), "step": self.step, "damping": jnp.asarray(damping)}
        return solve(self.predict, shots, x, delta, sigma, free, **how)

    def replay(
        self, candidate: Candidate, x: Float[Array, " k"], shots: Shots, delta: Float[Array, " n"] | float = 0.0
    ) -> Float[np.ndarray, "windows rows obs"]:
        """Predictions of windows from their recorded initial states, or from beside them."""
        still = jnp.broadcast_to(delta, (shots.y.shape[0], shots.spread.size))
        return np.asarray(_replay(self.predict, self.setup(candidate, shots), x, still))

    def scatter(
        self,
        candidate: Candidate,
        x: Float[Array, " k"],
        shots: Shots,
        start: Float[np.ndarray, " n"],
        here: Float[np.ndarray, "windows rows obs"],
    ) -> Float[np.ndarray, "windows rows obs"]:
        """Variance of predictions `here` where every part of the initial states is off by so much."""
        moved = (self.replay(candidate, x, shots, jnp.asarray(move)) for move in np.diag(start))
        return sum(((y - here) ** 2 for y in moved), np.zeros_like(here))


def margin_of_effect(p: EffectParameter) -> Margin:
    """The prior of an effect's parameter."""
    return log_uniform(p.low, p.high) if p.log else uniform(p.low, p.high)


def begin_point(
    parameters: Sequence[EffectParameter], margins: Sequence[Margin], share: float = 1.0
) -> Float[np.ndarray, " e"]:
    """The z of `begin_value` of every parameter."""
    pairs = zip(parameters, margins, strict=True)
    return np.array([m.standard(begin_value(p, share)) for p, m in pairs])


def begin_value(p: EffectParameter, share: float = 1.0) -> float:
    """Where a fit begins: so much of the way from neutral to the usual value, if the effect grows along it."""
    grows = np.isfinite(p.neutral) and p.low <= p.neutral <= p.high and not p.log
    return p.neutral + share * (p.start - p.neutral) if grows and share < 1.0 else p.start


_replay = jax.jit(predict_all, static_argnames="predict", compiler_options=COMPILER_OPTIONS)
