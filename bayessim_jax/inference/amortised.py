"""The posterior of θ by simulation: networks that read whole sets of windows, trained where the posterior lies.

θ is drawn from the prior cut to an ellipsoid around what is believed, and all windows of the recordings are simulated
with it at once: from their own initial states, corrected by δ ~ N(0, S²), under their own commands, with noise of a
level near the estimate, σ exp(ε/√(2n)) for n numbers. The networks learn q(θ | all windows), so that nothing has to be
multiplied.
Their posterior, recalibrated on sets that they were not trained on, is where the next round simulates; rounds end when
posteriors no longer shrink.

What a network reads of every window is what was measured, what the simulation at the ellipsoid's centre θ₀ missed in
units of σ, the commands, and the score Sᵀr of every row: the derivatives of the predictions, less what initial states
can absorb, times what was missed. Beside them stands the step from θ₀ that all scores together ask for. As it shrinks
towards a linear simulator these are sufficient; what is not linear, the networks learn.

Source: Deistler et al. 2022 (truncated rounds); Alsing and Wandelt 2018 (scores as summaries)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.special import ndtri
from jaxtyping import Array, Float, PRNGKeyArray

from bayessim_jax.beliefs import Ellipsoid, Truncated
from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.contracts import Box, Recording
from bayessim_jax.inference.draws import Coverage, PosteriorDraws
from bayessim_jax.inference.encoders import Lstm, Windowed, pool
from bayessim_jax.inference.estimators import MixtureDensity
from bayessim_jax.inference.fit import Schedule
from bayessim_jax.inference.heads import MixtureHead
from bayessim_jax.inference.proposals import TruncatedPrior
from bayessim_jax.inference.recalibration import CalibrationInfo
from bayessim_jax.inference.shooting import COMPILER_OPTIONS, Fit, Predict, Shots, absorb, expand

__all__ = ["sample_amortised"]

ROUNDS = 6
"""At most."""
SIMULATIONS, CALIBRATIONS = 2000, 256
"""Draws of θ in a round that networks are trained on, and that their posteriors are judged and corrected by."""
FRAMES = 5
"""Stretches of a window over which what is read is averaged."""
COMPONENTS = 3
_PARTS = (slice(None, SIMULATIONS), slice(SIMULATIONS, None))
SCHEDULE = Schedule(epochs=40, draws=1000, batch=50, patience=15, validation_draws=200)
SETTLED = 0.8
"""Of a standard deviation, the geometric mean over parameters: rounds that shrink the posterior less are the last."""
EDGE = 1e-7
"""Of probability, from where the normal variable of a float32 is no longer told apart."""
LOST = 0.5
"""Share of simulations that may diverge."""
FAR, STRANGE = 5.0, 0.01
"""Standard deviations of simulations by which what was recorded lies off them, and the share that may."""


@struct.dataclass
class View:
    """Windows against the simulation at one θ₀: what the reading of any measurement of them needs."""

    shots: Shots
    commands: Float[Array, "windows rows nu"]
    sigma: Float[Array, " obs"]
    reference: Float[Array, "windows rows obs"]
    score: Float[Array, "windows d rows obs"]
    """Derivatives of predictions / σ along z, less what initial states can absorb."""
    inverse: Float[Array, "d d"]
    """Of the curvature that they have together."""

    def read(self, y: Float[Array, "windows rows obs"]) -> Recording:
        """One recording of all windows, laid end to end; its rows are frames, its actions the mean commands."""
        measured, windows = self.shots.measured, y.shape[0]
        missed = jnp.where(measured, (y - self.reference) / self.sigma, 0.0)
        scores = jnp.einsum("wdro,wro->wrd", self.score, missed)
        onward = self.inverse @ scores.sum((0, 1))
        together = jnp.broadcast_to(onward, (*scores.shape[:2], onward.size))
        values = jnp.concatenate([jnp.where(measured, y, 0.0), missed, scores, together, self.commands], axis=-1)
        frames, valid = pool(values, measured.any(-1), -(-y.shape[1] // FRAMES))
        sound = jnp.isfinite(frames).all()
        flat = jnp.where(valid[..., None] & sound, frames, 0.0).reshape(-1, frames.shape[-1]).astype(jnp.float32)
        seen, actions = jnp.split(flat, [flat.shape[-1] - self.commands.shape[-1]], axis=-1)
        count = windows * frames.shape[1]
        return Recording(
            times=jnp.arange(count + 1, dtype=jnp.float32),
            observations=jnp.pad(seen, ((1, 0), (0, 0))),
            actions=actions,
            rewards=jnp.zeros(count, jnp.float32),
            valid=valid.reshape(-1) & sound,
            diverged=~sound,
        )


def _frames(recording: Recording) -> Float[Array, "steps features"]:
    return jnp.concatenate([recording.observations[1:], recording.actions], axis=-1)


def sample_amortised(
    key: PRNGKeyArray,
    predict: Predict,
    shots: Shots,
    margins: Margins,
    fit: Fit,
    commands: Float[Array, "windows steps nu"],
    *,
    draws: int = 2000,
    step: float = 0.0,
    say: Callable[[str], None] = lambda text: None,
) -> PosteriorDraws:
    """Draw θ from what networks say of all windows together; of the fit only the noise is used.

    δ ~ N(0, S²) with S the shots' `spread`, which has to be as small as initial states are known. Compute in float64:
    simulations are differenced at the accuracy of an average over all rows.
    """
    d = margins.size
    belief = _prior(d)
    held = jnp.pad(commands, ((0, 0), (0, 1), (0, 0)), mode="edge")
    estimator = MixtureDensity(
        Windowed(Lstm(size=24), shots.y.shape[0]), MixtureHead(COMPONENTS, hidden=32), SCHEDULE, 2, features=_frames
    )
    counts = jnp.maximum(shots.measured.sum((0, 1)), 1)
    settled = False
    for done in range(ROUNDS):
        keys = jax.random.split(jax.random.fold_in(key, done), 3)
        proposal, points = _propose(keys[0], belief)
        view = _look(predict, shots, held, fit.sigma, _normal(proposal.mean()), step)
        simulated, recorded = _simulate(predict, keys[1], view, _normal(points), counts), view.read(shots.y)
        if simulated.diverged.mean() > LOST:
            raise ValueError("most simulations of parameters that the prior allows are not finite; narrow the priors.")
        with jax.enable_x64(False):
            found, info = _learn(estimator, keys[2], points, simulated, recorded, proposal, belief)
            growth, gap = found.against(belief)
        belief, shrunk = found, float(jnp.exp(growth / d))
        say(f"round {done + 1}: posterior standard deviations {shrunk:.2g} times what they were")
        settled = done > 0 and shrunk > SETTLED and bool(gap < 2.0 * d)
        if settled:
            break
    z = _normal(_draw(jax.random.fold_in(key, ROUNDS), belief, draws))
    return PosteriorDraws(
        jax.vmap(margins.theta)(z),
        z,
        fit,
        f"networks, {done + 1} rounds of {SIMULATIONS + CALIBRATIONS} simulations",
        coverage=Coverage(float(info.coverage50), float(info.coverage90), CALIBRATIONS),
        doubts=_doubts(settled, info, simulated, recorded),
    )


def _doubts(settled: bool, info: CalibrationInfo, simulated: Recording, recorded: Recording) -> tuple[str, ...]:
    found = []
    if not settled:
        found.append(f"The posterior still changed in the last of {ROUNDS} rounds of simulations.")
    if bool(info.overconfident) or bool(info.collapsed):
        found.append("Posteriors of simulated recordings hold the truth less often than they say.")
    values, there = np.asarray(simulated.observations), np.asarray(recorded.valid)
    values = values[~np.asarray(simulated.diverged), 1:][:, there]
    off, sd = np.abs(np.asarray(recorded.observations)[1:][there] - values.mean(0)), values.std(0)
    share = float((off > FAR * sd)[sd > 0].mean()) if (sd > 0).any() else 0.0
    if share > STRANGE:
        found.append(
            f"{100 * share:.1f} % of what was recorded lies where no simulation does: something is missing in the "
            "simulator, and networks answer for what they were never shown."
        )
    return tuple(found)


def _normal(share: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
    """The z of probabilities, in the precision of everything that is simulated."""
    return ndtri(jnp.clip(jnp.asarray(np.asarray(share, float)), EDGE, 1 - EDGE))


def _prior(d: int) -> Truncated:
    """Uniform on the unit box of Φ(z); beliefs and networks are in float32."""
    with jax.enable_x64(False):
        names = tuple(str(k) for k in range(d))
        return Truncated.uniform(Box(jnp.zeros(d), jnp.ones(d), names, ("",) * d), COMPONENTS)


def _propose(key: PRNGKeyArray, belief: Truncated) -> tuple[Ellipsoid, Float[Array, "n d"]]:
    with jax.enable_x64(False):
        proposal = TruncatedPrior().propose(belief)
        keys = jax.random.split(key, SIMULATIONS + CALIBRATIONS)
        return proposal, jax.vmap(proposal.sample)(keys)


def _draw(key: PRNGKeyArray, belief: Truncated, draws: int) -> Float[Array, "draws d"]:
    with jax.enable_x64(False):
        return jax.vmap(belief.sample)(jax.random.split(key, draws))


@partial(jax.jit, static_argnames=("predict", "step"), compiler_options=COMPILER_OPTIONS)
def _look(predict: Predict, shots: Shots, commands: Array, sigma: Array, z: Array, step: float) -> View:
    """The simulation at z, and how it depends on z."""
    windows, d, n = shots.y.shape[0], z.size, shots.spread.size
    delta = jnp.zeros((windows, n))
    r, slopes = expand(predict, shots, z, delta, sigma, step)
    along, (toward, own, _) = slopes[:, :d], absorb(slopes, d)
    score = along - jnp.einsum("wnd,wnk->wdk", toward, own)
    curvature = jnp.einsum("wik,wjk->ij", score, along) + jnp.eye(d)
    reference = shots.y - r.reshape(shots.y.shape) * sigma
    return View(
        shots, commands, sigma, reference, score.reshape(windows, d, *shots.y.shape[1:]), jnp.linalg.inv(curvature)
    )


@partial(jax.jit, static_argnames="predict", compiler_options=COMPILER_OPTIONS)
def _simulate(predict: Predict, key: PRNGKeyArray, view: View, points: Float[Array, "n d"], counts: Array) -> Recording:
    """All windows at every point, with initial states and noise drawn."""
    shots = view.shots

    def one(args: Any) -> Recording:
        key, z = args
        state_key, noise_key, level_key = jax.random.split(key, 3)
        delta = shots.spread * jax.random.normal(state_key, (shots.y.shape[0], shots.spread.size))
        level = jnp.exp(jax.random.normal(level_key, counts.shape) / jnp.sqrt(2.0 * counts))
        y = jax.vmap(predict, in_axes=(None, 0, 0))(z, delta, shots.inputs)
        return view.read(y + view.sigma * level * jax.random.normal(noise_key, y.shape))

    return jax.lax.map(one, (jax.random.split(key, len(points)), points), batch_size=16)


@partial(jax.jit, compiler_options=COMPILER_OPTIONS)
def _learn(
    estimator: MixtureDensity,
    key: PRNGKeyArray,
    points: Float[Array, "n d"],
    simulated: Recording,
    recorded: Recording,
    proposal: Ellipsoid,
    belief: Truncated,
) -> tuple[Truncated, CalibrationInfo]:
    """The posterior of what was recorded, by networks fitted to the first simulations and corrected by the others."""
    init_key, fit_key, calibrate_key = jax.random.split(key, 3)
    one, use = jax.tree.map(lambda leaf: leaf[None], recorded), jnp.ones(1, bool)
    sets = jax.tree.map(lambda leaf: leaf[:, None], simulated)
    trained, judged = (jax.tree.map(lambda leaf, part=part: leaf[part], sets) for part in _PARTS)
    state = estimator.init(init_key, one, points.shape[1])
    state, _ = estimator.fit(fit_key, state, points[_PARTS[0]], trained, jnp.ones(SIMULATIONS))
    _, info, q = estimator.calibrate(calibrate_key, state, points[_PARTS[1]], judged, one, use, belief.box)
    return TruncatedPrior().combine(belief, proposal, q), info
