"""The bench on which candidates are simulated: for each a simulator with its effects in it, and θ fitted with them.

The initial states of all windows are fitted as well. What a case decides (recordings, ranges of the effects'
parameters) is an argument of the programs: another case of the same model and effects finds them compiled, whatever
other candidates there are.
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
from jaxtyping import Array, Bool, Float

from bayessim_jax.beliefs.margins import Margin, Margins, log_uniform, uniform, values_between
from bayessim_jax.effects import EffectParameter, Scales, at, with_effects
from bayessim_jax.effects.attach import wire
from bayessim_jax.effects.places import turned_joint
from bayessim_jax.inference.replay import Inputs, Restarted, replay_window
from bayessim_jax.inference.shooting import DAMPING, FEW_CALLS, Fit, Shots, predict_all, solve
from bayessim_jax.programs import trace_once
from bayessim_jax.systems.mjcf import MjcfSystem, system_key

__all__ = [
    "NEAR",
    "SLOTS",
    "Bench",
    "Candidate",
    "CandidatesOf",
    "begin_point",
    "begin_value",
    "bounded_numbers",
    "margin_of_effect",
    "traded",
]

NEAR = 0.1
"""Of the way from an effect's neutral value to where a fit usually begins: weak effects are found from there."""
SLOTS = 10
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
    """A window, and the ranges of the effects' parameters."""

    window: Inputs
    low: Float[Array, " e"]
    high: Float[Array, " e"]


@dataclass(frozen=True, eq=False)
class Simulator:
    """`predict(x, δ, tried)` of a system with some effects, x = [θ's z, the effects' z].

    Two of the same system, priors and effects are equal, so that what was compiled for one serves the other: ranges
    and scales are no part of the program.
    """

    system: MjcfSystem | Restarted
    """Without the effects."""
    margins: Margins
    pairs: tuple[tuple[Any, str], ...]
    scales: Mapping[str, Scales]
    kinds: tuple[Margin, ...]
    """Of the effects' parameters; their numbers come with the windows."""

    @cached_property
    def augmented(self) -> Any:
        """The system with the effects."""
        plain: Any = self.system
        return with_effects(plain, self.pairs, self.scales) if self.pairs else plain

    def __call__(self, x: Float[Array, " k"], delta: Float[Array, " n"], tried: Tried) -> Float[Array, "rows obs"]:
        """What the sensors show in every row."""
        d = self.margins.size
        theta = self.margins.theta(x[:d])
        if self.kinds:
            kinds = [m.kind for m in self.kinds]
            own = values_between(kinds, tried.low, tried.high, x[d : d + len(kinds)])
            theta = jnp.concatenate([theta, own])
        return replay_window(self.augmented, theta, delta, tried.window)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Simulator) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @cached_property
    def _key(self) -> tuple[Any, ...]:
        return system_key(self.system), self.margins, self.pairs, tuple(m.kind for m in self.kinds)


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
        self.system, self.margins, self.pairs = system, margins, tuple(pairs)
        self.scales, self.shots, self.step, self.slots = scales, shots, step, slots
        self.channels = system.observations.names
        self.wired = wire(system, self.pairs, scales)
        self.parameters = [p for w in self.wired for p in w.parameters]
        self.first = np.cumsum([0, *(len(w.parameters) for w in self.wired)])
        self.each: list[Margin] = [margin_of_effect(p) for p in self.parameters]

    def on(self, shots: Shots) -> Bench:
        """The same with other windows, or what else was recorded in them."""
        return Bench(self.system, self.margins, self.pairs, self.scales, shots, self.step, self.slots)

    @property
    def d(self) -> int:
        """Parameters of the system."""
        return self.margins.size

    @property
    def size(self) -> int:
        """Numbers of a fit: θ's, as many more as a candidate may have, and zeros where it has fewer."""
        return self.d + self.slots

    def used(self, candidate: Candidate) -> int:
        """Numbers of a fit that a candidate has."""
        return self.d + len(self.columns(candidate))

    def name(self, effect: int) -> str:
        """`coulomb_friction@joint/hinge`."""
        found, place = self.pairs[effect]
        return f"{found.name}@{at(place)}"

    def label(self, effect: int) -> str:
        """The same with what follows a `#`, which tells effects of one name at one place apart."""
        found, place = self.pairs[effect]
        return f"{found.name}@{place}"

    @property
    def largest_shift(self) -> float:
        """Seconds below which a shift in time is the simulator's own."""
        return max((p.least for p in self.parameters if p.unit == "s"), default=0.0)

    def told(self, candidate: Candidate, x: Float[Array, " k"]) -> list[int]:
        """A candidate's effects without those that are no more than the time step of the simulator."""
        found, values = [], self.values(candidate, x)
        for k in candidate.effects:
            own = self.parameters[self.first[k] : self.first[k + 1]]
            if all(abs(values[f"{self.label(k)}/{p.name}"]) >= p.least for p in own):
                found.append(k)
        return found

    def seats(self, candidate: Candidate) -> dict[str, str]:
        """Names of effects, and the same at the joint that their actuator drives or whose zero they turn."""
        found: dict[str, str] = {}
        if isinstance(self.system, Restarted):
            return found
        model = self.system.engine.model
        for k in candidate.effects:
            effect, place = self.pairs[k]
            joint = self.wired[k].site.joint if place.startswith("actuator/") else turned_joint(model, place)
            if joint >= 0:
                found[self.name(k)] = f"{effect.name}@joint/{model.joint(joint).name}"
        return found

    def columns(self, candidate: Candidate) -> list[int]:
        """Numbers of a candidate's parameters among those of all effects."""
        return [i for k in candidate.effects for i in range(self.first[k], self.first[k + 1])]

    def simulator(self, candidate: Candidate) -> Simulator:
        """`predict` of a candidate."""
        pairs = tuple(self.pairs[k] for k in candidate.effects)
        kinds = tuple(self.each[i] for i in self.columns(candidate))
        return Simulator(self.system, self.margins, pairs, self.scales, kinds)

    def unsettled(self, candidate: Candidate) -> int:
        """Of a candidate's effects, how many remember what no state tells."""
        return sum(not getattr(self.pairs[k][0], "settles", True) for k in candidate.effects)

    def setup(self, candidate: Candidate, shots: Shots | None = None) -> Shots:
        """The windows (or others) as a candidate's simulator takes them.

        Where some of its effects remember what the state in which a window begins does not tell, its initial states
        have a number more for each.
        """
        every = self.shots if shots is None else shots
        unsettled = self.unsettled(candidate)
        if unsettled:
            every = dataclasses.replace(every, spread=jnp.concatenate([every.spread, jnp.ones(unsettled)]))
        own = [self.each[i] for i in self.columns(candidate)]
        low, high = (jax.device_put(np.array([getattr(m, side) for m in own], float)) for side in "ab")
        axes: Any = (0, None, None)
        bounded = jax.device_put(bounded_numbers(self.margins, self.slots))
        return dataclasses.replace(every, inputs=Tried(every.inputs, low, high), bounded=bounded, axes=Tried(*axes))

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
        return jax.device_put(np.arange(self.size) < self.used(candidate))

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
        damping: float = DAMPING,
        known: Fit | None = None,
    ) -> Fit:
        """Fit a candidate from a point; what δ does not say of initial states is as it is taken to be.

        `known` is its fit to the same windows that ended there.
        """
        own = self.setup(candidate)
        states = np.pad(np.asarray(delta), ((0, 0), (0, own.spread.size - delta.shape[-1])))
        start, how = (x, states, sigma, self.free(candidate)), {"steps": steps, "step": self.step, "damping": damping}
        return solve(self.simulator(candidate), own, *start, **how, live=self.used(candidate), known=known)

    def traded(self, candidate: Candidate, x: Float[Array, " k"]) -> list[Float[Array, " k"]]:
        """Points at which one of a candidate's effects has other numbers that do much the same."""
        points, first = [], self.d
        for k in candidate.effects:
            own = slice(self.first[k], self.first[k + 1])
            place = slice(first, first + own.stop - own.start)
            points += traded(self.pairs[k][0], self.parameters[own], self.each[own], np.asarray(x), place)
            first = place.stop
        return [jax.device_put(point) for point in points]

    def replay(
        self, candidate: Candidate, x: Float[Array, " k"], shots: Shots, delta: Float[Array, " n"] | float = 0.0
    ) -> Float[np.ndarray, "windows rows obs"]:
        """Predictions of windows from their recorded initial states, or from beside them."""
        own = self.setup(candidate, shots)
        still = jnp.broadcast_to(delta, (shots.y.shape[0], own.spread.size))
        return np.asarray(_replay(self.simulator(candidate), own, np.asarray(x)[: self.used(candidate)], still))

    def scatter(
        self,
        candidate: Candidate,
        x: Float[Array, " k"],
        shots: Shots,
        start: Float[np.ndarray, " n"],
        here: Float[np.ndarray, "windows rows obs"],
    ) -> Float[np.ndarray, "windows rows obs"]:
        """Variance of predictions `here` where every part of the initial states is off by so much."""
        moves = np.diag(start)[np.flatnonzero(start)]
        moved = (self.replay(candidate, x, shots, jnp.asarray(move)) for move in moves)
        return sum(((y - here) ** 2 for y in moved), np.zeros_like(here))


def bounded_numbers(margins: Margins, slots: int) -> Bool[np.ndarray, " k"]:
    """Which numbers of a fit are shares of an interval: some of θ's, and all of the effects'."""
    return np.append(margins.bounded, np.ones(slots, bool))


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


def traded(
    effect: Any,
    parameters: Sequence[EffectParameter],
    margins: Sequence[Margin],
    x: Float[np.ndarray, " k"],
    place: slice,
) -> list[Float[np.ndarray, " k"]]:
    """Points at which an effect, whose numbers stand at a place in x, has others that do much the same."""
    trade = getattr(effect, "trade", None)
    if trade is None:
        return []
    values = {p.name: float(m.value(float(z))) for p, m, z in zip(parameters, margins, x[place], strict=True)}
    points = []
    for other in trade(values):
        point = x.copy()
        point[place] = [m.standard(other[p.name]) for p, m in zip(parameters, margins, strict=True)]
        points.append(point)
    return points


_replay = trace_once(predict_all, static_argnames="predict", compiler_options=FEW_CALLS)
