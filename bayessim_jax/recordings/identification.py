"""From a case to what was learned of its parameters: fit, posterior, predictions before and after, identifiability."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.beliefs.margins import Margins
from bayessim_jax.diagnosis.whiteness import difference_noise
from bayessim_jax.inference.amortised import sample_amortised
from bayessim_jax.inference.direct import noise_floor, sample_direct
from bayessim_jax.inference.draws import PosteriorDraws
from bayessim_jax.inference.identifiability import Identifiability, find_unidentified
from bayessim_jax.inference.replay import Restarted
from bayessim_jax.inference.scores import (
    Score,
    compare,
    error_spread,
    predict_windows,
    prediction_errors,
    score,
    smallest_error,
)
from bayessim_jax.inference.shooting import Fit, Shots, ridge
from bayessim_jax.recordings.shots import CaseModel, predictor, split_windows
from bayessim_jax.recordings.stepping import settle_step
from bayessim_jax.recordings.windows import Windows
from bayessim_jax.spelling import near_miss

__all__ = ["METHODS", "CaseInference", "channel_scale", "infer_case", "start_spread"]

METHODS = ("direct", "amortised", "laplace")
"""By the likelihood, written down; by networks that learn from simulations; by Laplace's approximation alone."""
DRAWS = 2000
BAND = 24
"""Posterior draws whose predictions make the band around the recording."""


@dataclass(frozen=True)
class CaseInference:
    """A posterior over a case's parameters, and how the simulator predicts with it and without it."""

    model: CaseModel
    method: str
    """One of `METHODS`."""
    posterior: PosteriorDraws
    fitted: Windows
    """Windows that the posterior is of."""
    held_out: Windows
    """Windows that were not used; scores and figures are of these."""
    predictions: dict[str, Float[np.ndarray, "windows rows obs"]]
    """Of the held-out windows: `baseline` at the prior's mean, `posterior` at the posterior's."""
    band: Float[np.ndarray, "draws windows rows obs"]
    """Predictions of the held-out windows at draws of the posterior."""
    scores: dict[str, Score]
    noise_floor: float
    identifiability: Identifiability

    @property
    def held_out_names(self) -> list[str]:
        """Recordings none of whose windows were used; windows of a recording that was split are named by its file."""
        return sorted({self.model.recordings[i].name for i in self.held_out.recording})

    def table(self) -> dict[str, Any]:
        """What `inference.json` holds."""
        draws, margins = np.asarray(self.posterior.draws), self.model.margins
        quantiles = np.quantile(draws, [0.05, 0.5, 0.95], axis=0)
        priors = [str(p.prior) for p in self.model.case.parameters]
        parameters = {
            name: {
                "mean": float(draws[:, k].mean()),
                "sd": float(draws[:, k].std()),
                "q05": float(quantiles[0, k]),
                "median": float(quantiles[1, k]),
                "q95": float(quantiles[2, k]),
                "unit": margins.units[k],
                "prior": priors[k],
            }
            for k, name in enumerate(margins.names)
        }
        noise = dict(zip(self.model.channels, np.asarray(self.posterior.fit.sigma).tolist(), strict=True))
        return {
            "schema": 1,
            "case": self.model.case.case.name,
            "parameters": parameters,
            "noise": noise,
            "fit": {
                "horizon": self.model.case.case.horizon,
                "held_out": self.held_out_names,
                **{name: s.as_table() for name, s in self.scores.items()},
                "noise_floor": self.noise_floor,
                "windows": {"fitted": len(self.fitted), "held_out": len(self.held_out)},
                "diverged": max(s.diverged for s in self.scores.values()),
            },
            "identifiability": self.identifiability.as_table(),
            "engine": {"name": self.model.engine_name, "reason": self.model.system.reason},
            "method": self.method,
            "sampler": self.posterior.sampler,
            "calibration": None if self.posterior.coverage is None else self.posterior.coverage.as_table(),
        }


def start_spread(model: CaseModel, fit: Fit) -> Float[np.ndarray, " n"]:
    """How far recorded initial states are off: their own noise where they were measured, else what the fit found.

    Nothing of what effects remember beside them: not to know that is no excuse for what they predict.
    """
    found = fit.usual_move
    if isinstance(model.system, Restarted):
        size = model.system.observations.size
        unrecorded = np.zeros(len(found) - size)  # commands that nobody recorded are no noise
        return np.concatenate([fit.sigma, unrecorded]) if size == len(model.channels) else found
    joints, nv = model.case.layout.single, model.system.engine.model.nv
    sigma = dict(zip(model.channels, np.asarray(fit.sigma), strict=True))
    names = {v: (f"joint/{name}/qpos", f"joint/{name}/qvel") for name, _, v in joints}
    found[2 * nv :] = 0.0
    for v, (place, rate) in names.items():
        if place in sigma:
            found[v] = sigma[place]
        if rate in sigma:
            found[nv + v] = sigma[rate]
    return found


def restarted_shots(shots: Shots, spread: Float[np.ndarray, " n"]) -> Shots:
    """Windows given their first rows: initial states as recorded, off by as much as those are; the rest is compared."""
    return dataclasses.replace(shots, spread=jnp.asarray(spread), measured=shots.measured.at[:, 0].set(False))


def infer_case(
    key: Array,
    model: CaseModel,
    *,
    method: str = "direct",
    draws: int = DRAWS,
    say: Callable[[str], None] = lambda text: None,
) -> CaseInference:
    """Infer a case's parameters by one of `METHODS`; raises `ValueError` where nothing can be simulated.

    Windows of held-out recordings (of held-out stretches, where there is one recording) take no part in the fit. All
    methods share the estimate of the noise, of the time step and of how far recorded initial states are off.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}: {near_miss(method, METHODS)}")
    fit_key, draw_key = jax.random.split(key)
    fitted, held = split_windows(model)
    say(f"fitting {len(fitted)} windows of {model.case.case.horizon:g} s; {len(held)} are kept to judge by")
    settled = settle_step(fit_key, model, fitted, say=say)
    model = settled.model
    predict, shots, left = predictor(model), model.shots(fitted), model.shots(held)
    say("sampling the posterior")
    about, options = (settled.margins, settled.fit), {"draws": draws, "step": model.step}
    if method == "amortised":
        seen = restarted_shots(settled.shots, start_spread(model, settled.fit))
        commands = jnp.asarray(fitted.ctrl)
        wide = sample_amortised(draw_key, settled.predict, seen, *about, commands, **options, say=say)
    else:
        exact = method == "direct" and not model.step  # where bodies collide, chains take minutes
        wide = sample_direct(draw_key, settled.predict, settled.shots, *about, **options, exact=exact)
    posterior = wide.marginal(model.margins.size)
    say("predicting held-out windows")
    prior_mean = np.array([p.prior.mean for p in model.case.parameters])
    every = np.asarray(posterior.z)
    points = {"baseline": np.asarray(_standard(model.margins, prior_mean)), "posterior": every.mean(0)}
    scale, fit, noise = channel_scale(shots, left), posterior.fit, _white_noise(posterior.fit, shots)
    scores, predictions = {}, {}
    for name, z in points.items():
        predictions[name] = predict_windows(predict, left, z)
        spread = error_spread(prediction_errors(predict, shots, z), scale)
        judged = compare(predictions[name], np.asarray(left.y), np.asarray(left.measured))
        scores[name] = score(judged, spread, scale, model.channels)
    band = np.stack([predict_windows(predict, left, z) for z in every[:: max(draws // BAND, 1)][:BAND]])
    return CaseInference(
        model=model,
        method=method,
        posterior=posterior,
        fitted=fitted,
        held_out=held,
        predictions=predictions,
        band=band,
        scores=scores,
        noise_floor=smallest_error(
            ridge(fit), shots, noise, start_spread(model, dataclasses.replace(fit, sigma=jnp.asarray(noise))), scale
        ),
        identifiability=find_unidentified(np.asarray(posterior.z), model.margins.names),
    )


def _white_noise(fit: Fit, shots: Shots) -> Float[np.ndarray, " obs"]:
    """The sensors' part of what a fit leaves: what differs from row to row, where the fit counts all of it as noise."""
    rough = difference_noise(np.nan_to_num(fit.misses), np.asarray(shots.measured))
    return np.minimum(np.maximum(rough, np.asarray(noise_floor(shots))), np.asarray(fit.sigma))


_standard = jax.jit(Margins.standard)


def channel_scale(*shots: Shots) -> Float[np.ndarray, " obs"]:
    """Standard deviation of every channel over all rows that are compared."""
    columns = []
    for k in range(shots[0].y.shape[-1]):
        values = np.concatenate([np.asarray(s.y)[..., k][np.asarray(s.measured)[..., k]] for s in shots])
        columns.append(max(float(values.std()), 1e-12) if values.size else 1.0)
    return np.array(columns)
