"""A bench in the place of a scene: systems without a model have no motion to linearize, and are simulated at once.

A registered system takes few effects and its simulation costs little, so that what `diagnosis.screen` does along the
recorded motion is done here by simulating. One simulator holds every effect at every place, most of them neutral: an
effect at its neutral parameters changes nothing, bit for bit, so that this simulator is each of the candidates in turn.
It is compiled once, where a simulator for every candidate would be compiled for each of very many.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from bayessim_jax.beliefs.margins import Margin, values_between
from bayessim_jax.diagnosis.bench import Bench, Candidate, CandidatesOf
from bayessim_jax.effects import with_effects
from bayessim_jax.effects.commanded import EVERY
from bayessim_jax.inference.arrow import Curvature, normal_equations
from bayessim_jax.inference.replay import Inputs, replay_window
from bayessim_jax.inference.shooting import COMPILER_OPTIONS, Shots, expand

__all__ = ["SimulatedScene"]


@struct.dataclass
class Chosen:
    """A window, and which parameters are free in it."""

    window: Inputs
    index: Int[Array, " k"]
    """Where the free parameters stand in [θ, effects' parameters, a place for those that are not used]."""
    on: Bool[Array, " e"]
    """Which of the effects' parameters are not neutral."""
    low: Float[Array, " e"]
    """Ranges of the effects' parameters."""
    high: Float[Array, " e"]
    neutral: Float[Array, " e"]


class SimulatedScene(CandidatesOf):
    """The pairs and windows of a bench, with normal equations at single points."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.system, self.margins, self.shots, self.pairs = bench.system, bench.margins, bench.shots, bench.pairs
        self.d, self.slots = bench.d, bench.slots
        own = [bench.columns(Candidate((k,))) for k in range(len(bench.pairs))]
        self.parameters = [[bench.parameters[i] for i in columns] for columns in own]
        self.margin: list[list[Margin]] = [[bench.each[i] for i in columns] for columns in own]
        self.sites = [w.site for w in bench.wired]
        self._shots: dict[Candidate, Shots] = {}
        self.predict = _predict_chosen(bench)

    def twin(self) -> SimulatedScene:
        """The same for another thread."""
        return self

    def takes(self, candidate: Candidate) -> bool:
        """Whether it can be tried: not an effect of all actuators and of one, nor with too many parameters."""
        alike = {self.pairs[k][0].name for k in candidate.effects if self.pairs[k][1] == EVERY}
        apart = {self.pairs[k][0].name for k in candidate.effects if self.pairs[k][1] != EVERY}
        return not alike & apart and self.count(candidate) <= self.slots

    def apart(self, candidate: Candidate) -> list[tuple[Candidate, tuple[int, ...]]]:
        """A candidate with an effect of all actuators on each of them instead, and which of its effects it keeps."""
        found = []
        for k in candidate.effects:
            effect, place = self.pairs[k]
            if place == EVERY:
                each = (i for i, (other, where) in enumerate(self.pairs) if other is effect and where != EVERY)
                kept = tuple(i for i in candidate.effects if i != k)
                found.append((Candidate(kept) + Candidate(tuple(each)), kept))
        return found

    def assess(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> tuple[Curvature, Float[np.ndarray, "windows rows obs"]]:
        """Normal equations at a point, and residuals over σ."""
        r, slopes = self.expand(candidate, p, delta, sigma)
        scaled = np.asarray(delta) / np.asarray(self.shots.spread)
        return normal_equations(r.reshape(len(r), -1), slopes, np.asarray(p), scaled), r

    def expand(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> tuple[Float[np.ndarray, "windows rows obs"], Float[np.ndarray, "windows kn rowsobs"]]:
        """Residuals over σ at a point, and derivatives of what is predicted over σ."""
        if candidate not in self._shots:
            self._shots[candidate] = self.setup(candidate)
        r, slopes = map(np.asarray, _expand(self.predict, self._shots[candidate], jnp.asarray(p), delta, sigma))
        return r.reshape(self.shots.y.shape), slopes

    def setup(self, candidate: Candidate) -> Shots:
        """The windows with a candidate's parameters free."""
        bench, columns = self.bench, self.bench.columns(candidate)
        index = np.full(bench.size, self.d + len(bench.parameters))
        index[: bench.used(candidate)] = [*range(self.d), *(self.d + i for i in columns)]
        on = np.isin(np.arange(len(bench.parameters)), columns)
        ranges = ([m.a for m in bench.each], [m.b for m in bench.each], [p.neutral for p in bench.parameters])
        given = (jax.device_put(x) for x in (index, on, *(np.asarray(x, float) for x in ranges)))
        axes: Any = (0, None, None, None, None, None)
        return dataclasses.replace(self.shots, inputs=Chosen(self.shots.inputs, *given), axes=Chosen(*axes))

    def reach(
        self, candidate: Candidate, p: Float[np.ndarray, " k"], delta: Float[Array, "windows n"], sigma: Array
    ) -> list[int]:
        """Pairs that may matter beside a candidate: all."""
        return list(range(len(self.pairs)))

    def states(self, delta: Float[Array, "windows n"]) -> list[Float[Array, "windows n"]]:
        """Initial states to begin from: those of a fit, and the recorded ones, which no misfit has moved."""
        return [delta, jnp.zeros_like(delta)]

    def begin_around(self, candidate: Candidate, p: Float[Array, " k"] | np.ndarray) -> None:
        """Nothing is linearized beforehand."""

    def approach(self, candidate: Candidate, p: Float[Array, " k"] | np.ndarray) -> None:
        """Neither here."""


def _predict_chosen(bench: Bench) -> Any:
    """`predict(x, δ, chosen)` of all effects at once; the same function for every candidate."""
    d, margins, each, system = bench.d, bench.margins, bench.each, bench.system
    plain: Any = system
    union = with_effects(plain, bench.pairs, bench.scales) if bench.pairs else plain

    def predict(x: Array, delta: Array, chosen: Chosen) -> Array:
        z = jnp.zeros(d + len(each) + 1, x.dtype).at[chosen.index].set(x)
        theta = margins.theta(z[:d])
        if each:
            own = values_between([m.kind for m in each], chosen.low, chosen.high, z[d : d + len(each)])
            theta = jnp.concatenate([theta, jnp.where(chosen.on, own, chosen.neutral)])
        return replay_window(union, theta, delta, chosen.window)

    return predict


_expand = jax.jit(expand, static_argnames="predict", compiler_options=COMPILER_OPTIONS)
