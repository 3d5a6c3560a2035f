"""The error of the simulation's time step: measured, taken out of predictions, and inferred as far as it is uncertain.

Simulators predict y(h) = y(0) + c h + O(h²) with a time step h. A machine takes no steps, but recordings may be another
simulator's, with a step s times the model's own: what they hold is y(s h), s between 0 and 1. Simulations with h and
h/4, and with h/16 where the error is large, give y as a function of s by interpolation.

An average over thousands of rows shows errors far below the noise of one. So s is inferred with θ, s ~ N(1/3, (1/3)²):
posteriors are neither moved by an error that is known, nor too narrow where the recordings do not tell θ and s apart.
What the steps do is computed once, at a first fit. Where it is not small against the noise, h/4 is simulated with.

Source: Richardson 1911 (extrapolation to the limit); Kennedy and O'Hagan 2001 (a simulator's own error as an unknown)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.beliefs.margins import Margins, normal
from bayessim_jax.diagnosis.whiteness import difference_noise
from bayessim_jax.inference.direct import fit_direct, noise_floor
from bayessim_jax.inference.replay import Inputs, Restarted
from bayessim_jax.inference.shooting import Fit, Predict, Shots
from bayessim_jax.recordings.shots import (
    REFINED,
    CaseModel,
    StepError,
    case_model,
    interpolate,
    lagrange,
    predictor,
    tame,
)
from bayessim_jax.recordings.windows import Windows

__all__ = ["Settled", "settle_step"]

TOLERABLE = 1.0
"""Of the noise: with a larger error of the time step the finer simulation is the one that is used."""
INVISIBLE = 0.2
"""Of the noise of an average over all rows: a smaller error changes no posterior."""
SURE = 0.25
"""Of s that is uncertain at least, for what interpolation does not hold."""
RATIO = normal(1 / 3, 1 / 3)
"""What is believed of s."""


@struct.dataclass
class Seen:
    """A window, and predictions with several time steps less the one that is simulated."""

    window: Inputs
    runs: Float[Array, "nodes rows obs"]


@dataclass(frozen=True)
class Stepped:
    """Predictions with the time step of what was recorded, the last of z."""

    predict: Predict
    """With the simulation's own."""
    nodes: tuple[float, ...]
    """What the time steps of the runs are, of the model's own."""

    def __call__(self, z: Float[Array, " d"], delta: Float[Array, " n"], seen: Seen) -> Float[Array, "rows obs"]:
        """What the sensors show in every row."""
        beside = jnp.tensordot(lagrange(self.nodes, RATIO.value(z[-1])), seen.runs, 1)
        return self.predict(z[:-1], delta, seen.window) + beside


@dataclass(frozen=True)
class Settled:
    """A case on a time step that its recordings can bear, and its fit. The last of z is that of s."""

    model: CaseModel
    """Its shots are less what the time step does at the fitted s."""
    fit: Fit
    predict: Predict
    """Of windows with what the time step does to them, `shots`."""
    shots: Shots
    margins: Margins
    """The case's, and that of s."""
    error: Float[np.ndarray, "windows rows obs"]
    """What is uncertain of the time step's effect on predictions, a standard deviation in the channels' units."""


def settle_step(
    key: Array, model: CaseModel, windows: Windows, *, say: Callable[[str], None] = lambda text: None
) -> Settled:
    """Fit a case and the time step of what was recorded, with a finer simulation where the model's is too coarse.

    The finer simulation is used where the error is not small against the sensors' noise, unless the recordings are
    explained less well by it, or derivatives are differences: these cost too much of it.
    """
    margins = model.margins + Margins.create(["time step"], [RATIO])
    shots = model.shots(windows)
    nodes = (1.0, 1 / REFINED)
    predict = Stepped(predictor(model), nodes)
    first = _with_runs(shots, np.zeros((len(shots.y), len(nodes), *shots.y.shape[1:])))
    fit = fit_direct(key, predict, first, margins.size, step=model.step, say=say)
    if isinstance(model.system, Restarted):
        return Settled(model, fit, predict, first, margins, np.zeros(shots.y.shape))
    finer = case_model(model.case, engine=model.engine_name, before=model.before, refined=REFINED)
    error = StepError((model, finer), fit.z[:-1])
    runs = error.runs(shots, 1, fit.delta)
    limit = interpolate(nodes, 0.0, runs)
    size, counts = _size(shots, fit, limit)
    if size * np.sqrt(counts) < INVISIBLE:
        return Settled(model, fit, predict, first, margins, SURE * limit)

    def refit(base: CaseModel, predict: Predict, error: StepError, runs: np.ndarray) -> Settled:
        calm = tame(runs, shots)
        seen = _with_runs(shots, calm)
        found = fit_direct(key, predict, seen, margins.size, start=fit, step=base.step, say=say)
        ratio = float(np.clip(RATIO.value(found.z[-1]), 0.0, 1.0))
        sd = RATIO.b * float(np.sqrt(np.linalg.inv(np.asarray(found.precision))[-1, -1]))
        ahead, behind = (interpolate(error.nodes, ratio + step, calm) for step in (1e-3, -1e-3))
        wild = (calm == 0.0).all(1) * np.abs(runs).max(1)
        base = dataclasses.replace(base, step_error=dataclasses.replace(error, z=found.z[:-1], ratio=ratio))
        return Settled(base, found, predict, seen, margins, max(sd, SURE) * (ahead - behind) / 2e-3 + wild)

    if size > TOLERABLE and not model.step:
        finest = case_model(model.case, engine=model.engine_name, before=model.before, refined=REFINED**2)
        wide = StepError((model, finer, finest), fit.z[:-1])
        again = refit(finer, Stepped(predictor(finer), wide.nodes), wide, wide.runs(shots, REFINED, fit.delta))
        if float((np.log(np.asarray(fit.sigma) / np.asarray(again.fit.sigma))).mean()) > -0.01:
            h = model.system.dt / model.system.substeps
            times = f"the integration error is {size:.1f} times the noise"
            remark = f"time step {h / REFINED:g} s instead of {h:g} s: {times}"
            say(remark)
            told = dataclasses.replace(again.model, remarks=(*again.model.remarks, remark))
            return dataclasses.replace(again, model=told)
    return refit(model, predict, error, runs)


def _with_runs(shots: Shots, runs: Float[np.ndarray, "windows nodes rows obs"]) -> Shots:
    return dataclasses.replace(shots, inputs=Seen(shots.inputs, jnp.asarray(runs)))


def _size(shots: Shots, fit: Fit, error: Float[np.ndarray, "windows rows obs"]) -> tuple[float, int]:
    """An error against the noise, in the channel where it is largest, and the numbers measured."""
    measured = np.asarray(shots.measured)
    noise = difference_noise(np.nan_to_num(fit.misses), measured)
    usual = np.sqrt((error**2).sum((0, 1)) / np.maximum(measured.sum((0, 1)), 1))
    return float((usual / np.maximum(noise, np.asarray(noise_floor(shots)))).max()), int(measured.sum())
