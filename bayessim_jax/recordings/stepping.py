"""The error of the simulation's time step: measured, taken out of predictions, and inferred as far as it is uncertain.

Simulators of first order predict y(h) = y(0) + c h + O(h²) with a time step h. A machine takes no steps, but recordings
may be another simulator's, with a step s times the model's own: what they hold is y(s h), s between 0 and 1. From
simulations with h and with h/4,

    D = (4/3) (y(h/4) − y(h)) ≈ y(0) − y(h)    and    y(s h) ≈ y(h) + (1 − s) D ≈ y(h/4) + (1/4 − s) D.

An average over thousands of rows shows errors far below the noise of one. So D is computed once, at a first fit, and
s is inferred with θ, s ~ N(1/3, (1/3)²): posteriors are neither moved by an error that is known, nor too narrow where
the recordings do not tell θ and s apart. Where D is not small against the noise, the finer simulation is used.

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
from bayessim_jax.recordings.shots import REFINED, CaseModel, StepError, case_model, predictor
from bayessim_jax.recordings.windows import Windows

__all__ = ["Settled", "settle_step"]

TOLERABLE = 1.0
"""Of the noise: with a larger error of the time step the finer simulation is the one that is used."""
INVISIBLE = 0.2
"""Of the noise of an average over all rows: a smaller error changes no posterior."""
SURE = 0.1
"""Of D that is uncertain at least: what of it is not of first order."""
RATIO = normal(1 / 3, 1 / 3)
"""What is believed of s."""


@struct.dataclass
class Stepped:
    """A window, and what the time step does to its prediction."""

    window: Inputs
    own: Float[Array, ""]
    """The simulation's time step over the model's own."""
    drift: Float[Array, "rows obs"]
    """D."""


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

    The finer simulation is used where D is not small against the sensors' noise, unless the recordings are explained
    less well by it.
    """
    margins = model.margins + Margins.create(["time step"], [RATIO])
    shots = model.shots(windows)
    nothing = np.zeros(shots.y.shape)
    predict, first = _stepped(predictor(model)), _with_drift(shots, model, nothing)
    fit = fit_direct(key, predict, first, margins.size, step=model.step, say=say)
    if isinstance(model.system, Restarted):
        return Settled(model, fit, predict, first, margins, nothing)
    finer = case_model(model.case, engine=model.engine_name, before=model.before, refined=REFINED)
    error = StepError(model, finer, fit.z[:-1])
    drift = error.drift(shots, fit.delta)
    size, counts = _size(shots, fit, drift)
    if size * np.sqrt(counts) < INVISIBLE:
        return Settled(model, fit, predict, first, margins, SURE * drift)

    def refit(base: CaseModel) -> Settled:
        predict, seen = _stepped(predictor(base)), _with_drift(shots, base, drift)
        found = fit_direct(key, predict, seen, margins.size, start=fit, step=base.step, say=say)
        ratio = float(np.clip(RATIO.value(found.z[-1]), 0.0, 1.0))
        sd = RATIO.b * float(np.sqrt(np.linalg.inv(np.asarray(found.precision))[-1, -1]))
        base = dataclasses.replace(base, step_error=dataclasses.replace(error, z=found.z[:-1], ratio=ratio))
        return Settled(base, found, predict, seen, margins, max(sd, SURE) * drift)

    if size > TOLERABLE:
        again = refit(finer)
        if float((np.log(np.asarray(fit.sigma) / np.asarray(again.fit.sigma))).mean()) > -0.01:
            h = model.system.dt / model.system.substeps
            times = f"the integration error is {size:.1f} times the noise"
            remark = f"time step {h / REFINED:g} s instead of {h:g} s: {times}"
            say(remark)
            told = dataclasses.replace(again.model, remarks=(*again.model.remarks, remark))
            return dataclasses.replace(again, model=told)
    return refit(model)


def _stepped(predict: Predict) -> Predict:
    """Predictions with the time step of what was recorded."""

    def stepped(z: Array, delta: Array, seen: Stepped) -> Array:
        return predict(z[:-1], delta, seen.window) + (seen.own - RATIO.value(z[-1])) * seen.drift

    return stepped


def _with_drift(shots: Shots, model: CaseModel, drift: Float[np.ndarray, "windows rows obs"]) -> Shots:
    own = jnp.full(drift.shape[0], 1.0 / model.refined)
    return dataclasses.replace(shots, inputs=Stepped(shots.inputs, own, jnp.asarray(drift)))


def _size(shots: Shots, fit: Fit, drift: Float[np.ndarray, "windows rows obs"]) -> tuple[float, int]:
    """D of a usual window against the noise, in the channel where it is largest, and the numbers measured."""
    measured = np.asarray(shots.measured)
    noise = difference_noise(np.nan_to_num(np.asarray(fit.misses)), measured)
    usual = np.sqrt(np.median((drift**2).sum(1) / np.maximum(measured.sum(1), 1), axis=0))
    return float((usual / np.maximum(noise, np.asarray(noise_floor(shots)))).max()), int(measured.sum())
