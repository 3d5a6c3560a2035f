"""Every effect at every place held against what was measured, along the recorded motion and without simulating it.

A candidate is fitted with θ and the initial states of all windows by `diagnosis.response`, with the force that it
exerts along the motion by `diagnosis.forcing`, and scored on recordings that its fit has not seen. One fit takes
hundredths of a second, so that pairs are tried as well. What comes out on top is then simulated (`diagnosis.bench`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from bayessim_jax.diagnosis.bench import NEAR, Candidate, begin_value
from bayessim_jax.diagnosis.response import cross_validate, propose
from bayessim_jax.diagnosis.scene import Scene
from bayessim_jax.diagnosis.whiteness import Misfit, judge_misfit
from bayessim_jax.inference.direct import noise_floor, noise_level

__all__ = ["Begun", "Screen", "Screened"]

ITERATIONS = 6
BEGINNING, KEPT, LASTING = 8, 2, 8
"""Steps of the solver from every point that a candidate is begun from, how many go on, and their further steps."""
LEAST_SHARE = 0.2
"""Of the numbers measured, that noise is taken to have in the residuals however many are fitted."""
GLANCING = 6
"""Steps of the solver from each of two points, by which partners of a known effect are ranked."""
MOMENTS, CLOCK = 8, 2.0
"""Times that are tried for what happens at some time; a parameter in s that may be so many windows long is a time."""
DRAWS = 3
"""Points of its prior from which a candidate of several parameters is begun, beside the usual ones."""


@dataclass
class Begun:
    """A candidate fitted from several points, at the noise of a fit without it."""

    candidate: Candidate
    ends: list[tuple[Any, ...]]
    """(p, δ, curvature, residuals, slopes), the best first."""
    likelihood: float
    """Log likelihood of the best at its own noise, up to a constant."""


@dataclass
class Screened:
    """A candidate fitted along the motion."""

    candidate: Candidate
    p: Float[Array, " k"]
    """[θ's z, the candidate's x, zeros in the places that are not used]."""
    delta: Float[Array, "windows n"]
    sigma: Float[Array, " obs"]
    scores: Float[np.ndarray, " windows"]
    """Log predictive density of every window."""

    @property
    def score(self) -> float:
        """Sum over windows."""
        return float(self.scores.sum())


class Screen:
    """Fits of candidates along the motion of a scene; `folds` are windows that are scored by fits to the others."""

    def __init__(self, scene: Scene, folds: Bool[Array, "folds windows"]) -> None:
        self.scene, self.folds = scene, folds
        self.shots, self.d, self.slots = scene.shots, scene.d, scene.slots
        self.pairs, self.name, self.takes, self.offsets = scene.pairs, scene.name, scene.takes, scene.offsets
        self.floor = noise_floor(scene.shots)

    def starts(self, candidate: Candidate, random: np.random.Generator) -> list[np.ndarray]:
        """Points of a candidate's x to begin from: its start values, mirrored where a sign is open, and draws."""
        parameters, margin = self.scene.parameters, self.scene.margin
        each = [(p, m) for k in candidate.effects for p, m in zip(parameters[k], margin[k], strict=True)]
        begin = np.array([float(m.standard(jnp.asarray(p.start, float))) for p, m in each])
        points = [begin]
        if any(p.low < 0.0 for p, _ in each):
            points.append(-begin)
        clocks = [k for k, (p, _) in enumerate(each) if p.unit == "s" and p.high > CLOCK * self.scene.length]
        for centre in np.linspace(0.0, 1.0, MOMENTS + 2)[1:-1] if clocks else ():
            point = begin.copy()
            for i, k in enumerate(clocks):
                p, m = each[k]
                when = centre + (2 * i - len(clocks) + 1) / (2 * MOMENTS)
                point[k] = float(m.standard(jnp.asarray(p.low + when * (p.high - p.low), float)))
            points.append(point)
        if len(each) > 1 and not clocks:
            points += [0.7 * random.standard_normal(len(each)) for _ in range(DRAWS)]
        return points

    def fit(
        self, candidate: Candidate, p: Float[Array, " k"], delta: Array, sigma: Array, iterations: int = ITERATIONS
    ) -> tuple[Any, ...]:
        """Levenberg-Marquardt from a point; returns (p, δ, curvature, residuals, slopes)."""
        free = jnp.arange(self.d + self.slots) < self.d + self.scene.count(candidate)
        damping = 1e-3
        here: Any = None
        tried = (p, delta)
        for _ in range(iterations):
            there = self.scene.assess(candidate, *tried, sigma)
            cost = float(there[0].cost)
            if np.isfinite(cost) and (here is None or cost <= float(here[2].cost)):
                gain = np.inf if here is None else (float(here[2].cost) - cost) / max(abs(cost), 1e-12)
                here, damping = (*tried, *there), max(damping / 5, 1e-9)
                if gain < 1e-4:
                    break
            elif here is None:
                break
            else:
                damping *= 10
            move, moves = propose(here[2], damping, free, self.shots.spread)
            tried = (here[0] + move, here[1] + moves)
        return here if here is not None else (p, delta, None, None, None)

    def settle(
        self, candidate: Candidate, p: Array, delta: Array, sigma: Array, rounds: int = 2, iterations: int = ITERATIONS
    ) -> Screened | None:
        """Fit a candidate and its noise in turn, and score it."""
        measured = np.asarray(self.shots.measured)
        counts = np.maximum(measured.sum((0, 1)), 1)
        fitted = self.d + self.scene.count(candidate) + delta.size
        r = slopes = None
        for k in range(rounds):
            p, delta, curvature, r, slopes = self.fit(candidate, p, delta, sigma, iterations if k == 0 else 3)
            if curvature is None:
                return None
            squares = (np.asarray(r) ** 2).sum((0, 1)) * np.asarray(sigma) ** 2
            new = noise_level(squares, counts, fitted, self.floor, LEAST_SHARE)
            r, slopes = r * (sigma / new), slopes * jnp.broadcast_to(sigma / new, self.shots.y.shape[1:]).reshape(-1)
            sigma = new
        free = jnp.arange(self.d + self.slots) < self.d + self.scene.count(candidate)
        scaled = delta / self.shots.spread
        scores = cross_validate(r, slopes, self.shots.measured, p, free, sigma, self.floor, self.folds, scaled)
        return Screened(candidate, p, delta, sigma, np.asarray(scores))

    def begin(self, z: Float[Array, " d"], sigma: Array) -> Screened:
        """The simulator without effects."""
        p = jnp.zeros(self.d + self.slots).at[: self.d].set(z)
        delta = jnp.zeros((len(self.scene.motion.start), 2 * self.scene.model.nv))
        found = self.settle(Candidate(), p, delta, sigma)
        if found is None:
            raise ValueError("the simulator diverges along the recorded motion.")
        return found

    def begin_candidate(self, candidate: Candidate, known: Screened, random: np.random.Generator) -> Begun | None:
        """Fit a candidate from several points beside a fit without it; `known` may hold some of its effects already."""
        held = dict(self.offsets(known.candidate))
        added = Candidate(tuple(k for k in candidate.effects if k not in held))
        own, ends = dict(self.offsets(added)), []
        for start in self.starts(added, random):
            p = self._put(candidate, known, held, own, start)
            ends.append(self.fit(candidate, p, known.delta, known.sigma, BEGINNING))
        ends = sorted((end for end in ends if end[2] is not None), key=lambda end: float(end[2].cost))[:KEPT]
        if not ends:
            return None
        return Begun(candidate, ends, self._profile(ends[0][3], known.sigma))

    def likelihood(self, found: Screened) -> float:
        """Log likelihood of a fit at its own noise, up to a constant."""
        return self._profile(self.scene.assess(found.candidate, found.p, found.delta, found.sigma)[1], found.sigma)

    def _profile(self, r: Array, sigma: Array) -> float:
        counts = np.maximum(np.asarray(self.shots.measured).sum((0, 1)), 1)
        rms = np.sqrt((np.asarray(r) ** 2).sum((0, 1)) / counts) * np.asarray(sigma)
        return -float((counts * np.log(np.maximum(rms, np.asarray(self.floor)))).sum())

    def finish_candidate(self, begun: Begun, known: Screened) -> Screened | None:
        """Fit what was begun to the end, with its own noise, and score it."""
        ends = [self.fit(begun.candidate, end[0], end[1], known.sigma, LASTING) for end in begun.ends]
        ends = [end for end in ends if end[2] is not None]
        if not ends:
            return None
        best = min(ends, key=lambda end: float(end[2].cost))
        return self.settle(begun.candidate, best[0], best[1], known.sigma)

    def misfit(self, key: PRNGKeyArray, found: Screened) -> Misfit:
        """What a candidate leaves of the misfit."""
        _, r, slopes = self.scene.assess(found.candidate, found.p, found.delta, found.sigma)
        n = found.delta.shape[-1]
        unscaled = slopes[:, -n:].reshape(len(slopes), n, *r.shape[1:]) * found.sigma
        residual = np.asarray(r * found.sigma)
        return judge_misfit(key, residual, unscaled.reshape(len(slopes), n, -1), np.asarray(self.shots.measured))

    def glance(self, candidate: Candidate, known: Screened) -> float:
        """The cost of a candidate after a few steps from a fit of a part of it, what is added nearly neutral or not."""
        held = dict(self.offsets(known.candidate))
        added = Candidate(tuple(k for k in candidate.effects if k not in held))
        own = dict(self.offsets(added))
        each = [q for k in added.effects for q in zip(self.scene.parameters[k], self.scene.margin[k], strict=True)]
        costs = []
        for share in (NEAR, 1.0):
            start = [float(m.standard(jnp.asarray(begin_value(p, share), float))) for p, m in each]
            p = self._put(candidate, known, held, own, np.array(start))
            found = self.fit(candidate, p, known.delta, known.sigma, GLANCING)
            costs.append(np.inf if found[2] is None else float(found[2].cost))
        return min(costs)

    def _put(
        self,
        candidate: Candidate,
        known: Screened,
        held: Mapping[int, slice],
        own: Mapping[int, slice],
        start: np.ndarray,
    ) -> Array:
        """A candidate's p, with what is known of some of its effects and a start for the others."""
        p = jnp.zeros(self.d + self.slots).at[: self.d].set(known.p[: self.d])
        for k, place in self.offsets(candidate):
            x = known.p[held[k]] if k in held else jnp.asarray(start[own[k].start - self.d : own[k].stop - self.d])
            p = p.at[place].set(x)
        return p
