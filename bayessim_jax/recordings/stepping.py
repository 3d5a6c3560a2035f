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
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from bayessim_jax.beliefs.margins import Margins, normal
from bayessim_jax.diagnosis.bench import Bench, Candidate
from bayessim_jax.diagnosis.verdict import Entry
from bayessim_jax.diagnosis.whiteness import difference_noise
from bayessim_jax.inference.arrow import eliminate, normal_equations, own_pulls
from bayessim_jax.inference.direct import estimate_noise, fit_direct, noise_floor
from bayessim_jax.inference.replay import Inputs, Restarted
from bayessim_jax.inference.shooting import Fit, Predict, Shots
from bayessim_jax.recordings.late import BLUR, is_runge_kutta, measure_lag
from bayessim_jax.recordings.shots import (
    REFINED,
    CaseModel,
    StepError,
    case_model,
    interpolate,
    lagrange,
    predictor,
    tame,
    with_euler_steps,
)
from bayessim_jax.recordings.windows import Windows

__all__ = ["Settled", "ratio_of_motion", "settle_answer", "settle_step"]

TOLERABLE = 1.0
"""Of the noise: with a larger error of the time step the finer simulation is the one that is used."""
SLIGHT = 0.1
"""Of the noise: with a larger one finer steps of Runge and Kutta are, beside those of semi-implicit Euler."""
INVISIBLE = 0.2
"""Of the noise of an average over all rows: a smaller error changes no posterior."""
SURE = 0.25
"""Of s that is uncertain at least, for what interpolation does not hold."""
BEYOND = 3.0
"""Standard deviations by which s may be found below 0 or above 1, or longer than positions and velocities tell."""
PASSES, STILL = 4, 0.1
"""Times at most that the steps' effect is computed anew where a fit to recordings without it has ended, and of the
standard deviation of s by how little it has to move for the last of them."""
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
    moved: tuple[float, float] = (RATIO.a, RATIO.b)
    """s as positions and velocities tell it, mean and standard deviation (`ratio_of_motion`)."""
    told: bool = True
    """Whether positions and velocities tell s, or it does not matter; else the fit does, which takes it for physics."""


def settle_step(
    key: Array,
    model: CaseModel,
    windows: Windows,
    *,
    tolerance: float | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Settled:
    """Fit a case and the time step of what was recorded, with a finer simulation where the model's is too coarse.

    The finer simulation is used where the error is not small against the sensors' noise, unless the recordings are
    explained less well by it, or derivatives are differences: these cost too much of it. A fit may take s for physics
    that are missing; where it finds no step that there could be, or positions and velocities tell of a shorter one,
    these are believed (`ratio_of_motion`). What they tell may be too long: velocities are often late themselves, by the
    filter that they come from.

    A model that takes steps of Runge and Kutta may be believed of what took those of semi-implicit Euler, whose
    positions are ahead by h/2 of their motion. Where velocities are measured these tell (`late`); else s is fitted,
    between none for Runge and Kutta's steps and one for Euler's of the model's own length.

    `tolerance` is the solver's.
    """
    margins = model.margins + Margins.create(["time step"], [RATIO])
    shots = model.shots(windows)
    mixed = _is_mixed(model)
    nodes = (0.0, 1.0, 1 / REFINED) if mixed else (1.0, 1 / REFINED)
    predict = Stepped(predictor(model), nodes)
    first = _with_runs(shots, np.zeros((len(shots.y), len(nodes), *shots.y.shape[1:])))
    how = {"tolerance": tolerance, "say": say}
    fit = fit_direct(key, predict, first, margins.size, step=model.step, **how)
    if isinstance(model.system, Restarted):
        return Settled(model, fit, predict, first, margins, np.zeros(shots.y.shape))
    finer = case_model(model.case, engine=model.engine_name, before=model.before, refined=REFINED)
    error = StepError((model, finer), fit.z[:-1])
    runs = error.runs(shots, 1, fit.delta)
    limit = interpolate(error.nodes, 0.0, runs)
    size, counts = _size(shots, fit, limit)
    visible = size * np.sqrt(counts) >= INVISIBLE
    h = model.system.dt / model.system.substeps
    remark = f"time step {h / REFINED:g} s instead of {h:g} s: the integration error is {size:.1f} times the noise"
    if mixed:
        exact = finer if size > SLIGHT and not model.step else model
        error = StepError((exact, *map(with_euler_steps, (model, finer))), fit.z[:-1])
        runs = error.runs(shots, exact.refined, fit.delta)
        most, counts = _size(shots, fit, interpolate(error.nodes, 1.0, runs))
        visible = visible or most * np.sqrt(counts) >= INVISIBLE
    if not visible:
        return Settled(model, fit, predict, first, margins, SURE * limit)
    moved = (0.0, RATIO.b) if mixed else ratio_of_motion(model, windows)

    def refit(base: CaseModel, predict: Predict, error: StepError, runs: np.ndarray) -> Settled:
        found = fit
        for turn in range(PASSES):
            calm = tame(runs, shots)
            seen = _with_runs(shots, calm)
            found = fit_direct(key, predict, seen, margins.size, start=found, step=base.step, **how)
            ratio = float(RATIO.value(found.z[-1]))
            here = dataclasses.replace(error, z=found.z[:-1]).runs(shots, base.refined, found.delta)
            change, counts = _size(shots, found, interpolate(error.nodes, ratio, tame(here, shots) - calm))
            if turn + 1 == PASSES or change * np.sqrt(counts) < INVISIBLE:
                break
            runs = here
        sd = RATIO.b * float(np.sqrt(np.linalg.inv(np.asarray(found.precision))[-1, -1]))
        if _is_shorter(moved, ratio, sd) or not -BEYOND * sd <= ratio <= 1.0 + BEYOND * sd:
            ratio, sd = moved
        ratio = float(np.clip(ratio, 0.0, 1.0))
        wild = np.where(calm.any(1), 0.0, np.abs(runs).max(1))
        base = dataclasses.replace(base, step_error=dataclasses.replace(error, z=found.z[:-1], ratio=ratio))
        least = SURE * ratio if mixed else SURE  # of steps of Runge and Kutta there is nothing to interpolate
        uncertain = max(sd, least) * _along(error.nodes, ratio, calm) + wild
        return Settled(base, found, predict, seen, margins, uncertain, moved, told=moved[1] < RATIO.b)

    def told(found: Settled) -> Settled:
        say(remark)
        return dataclasses.replace(
            found, model=dataclasses.replace(found.model, remarks=(*found.model.remarks, remark))
        )

    if mixed:
        found = refit(exact, Stepped(predictor(exact), error.nodes), error, runs)
        return found if exact is model else told(found)
    if size > TOLERABLE and not model.step:
        finest = case_model(model.case, engine=model.engine_name, before=model.before, refined=REFINED**2)
        wide = StepError((model, finer, finest), fit.z[:-1])
        again = refit(finer, Stepped(predictor(finer), wide.nodes), wide, wide.runs(shots, REFINED, fit.delta))
        if float((np.log(np.asarray(fit.sigma) / np.asarray(again.fit.sigma))).mean()) > -0.01:
            return told(again)
    return refit(model, predict, error, runs)


def _is_mixed(model: CaseModel) -> bool:
    """Whether a model takes steps of Runge and Kutta, and no velocities tell whether what was recorded did."""
    shown = any(r.qvel_measured.any() for r in model.case.recordings)
    return not isinstance(model.system, Restarted) and is_runge_kutta(model.compiled) and not shown


def settle_answer(
    model: CaseModel, windows: Windows, bench: Bench, entries: Sequence[Entry], moved: tuple[float, float]
) -> tuple[CaseModel, Bench]:
    """What the time step does, computed anew with the first entry's effects and numbers, and s inferred with them.

    A simulator without what is missing makes other errors, and finds another s. Each entry is fitted to what is left,
    and what it says of its numbers is wide by what is not known of s, which positions and velocities bound, `moved`.
    """
    error, first = model.step_error, entries[0]
    if error is None:
        return model, bench
    candidate, fit, ratio = first.candidate, first.fit, error.ratio
    shots = dataclasses.replace(model, step_error=None).shots(windows)
    floor = noise_floor(shots)

    def settle(candidate: Candidate, fit: Fit) -> Fit:
        sigma = estimate_noise(bench.shots, fit, floor, bench.used(candidate))
        return bench.fit(candidate, fit.z, fit.delta, sigma, damping=fit.damping)

    about = RATIO.a, RATIO.b
    for _ in range(PASSES):
        error = dataclasses.replace(error, z=fit.z[: bench.used(candidate)], ratio=ratio, answer=(bench, candidate))
        calm = tame(error.runs(shots, model.refined, fit.delta), shots)
        bench = bench.on(dataclasses.replace(shots, y=shots.y - interpolate(error.nodes, ratio, calm)))
        fit, along = settle(candidate, fit), _along(error.nodes, ratio, calm)
        mean, sd, wide = _infer_ratio(bench, candidate, fit, along, ratio, about)
        if _is_shorter(moved, mean, sd):
            about = moved
            mean, sd, wide = _infer_ratio(bench, candidate, fit, along, ratio, about)
        last, ratio = ratio, float(np.clip(mean, 0.0, 1.0))
        if abs(ratio - last) < STILL * sd:
            break
    first.fit = wide
    for entry in entries[1:]:
        found = settle(entry.candidate, entry.fit)
        entry.fit = _infer_ratio(bench, entry.candidate, found, along, ratio, about)[2]
    return dataclasses.replace(model, step_error=error), bench


def _is_shorter(moved: tuple[float, float], ratio: float, sd: float) -> bool:
    """Whether positions and velocities tell of a shorter step than a fit, beyond doubt."""
    return moved[0] < ratio - BEYOND * np.hypot(sd, moved[1])


def _infer_ratio(
    bench: Bench,
    candidate: Candidate,
    fit: Fit,
    along: Float[np.ndarray, "windows rows obs"],
    ratio: float,
    about: tuple[float, float],
) -> tuple[float, float, Fit]:
    """Mean and standard deviation of s, and the fit with what is not known of it: one Gauss-Newton step on (z, s).

    `along` is how fast predictions change with s, `ratio` the s that was fitted with, `about` what is believed of it.
    """
    own, (mean, sd), k = bench.setup(candidate), about, fit.z.size
    column = np.where(own.measured, along * sd / np.asarray(fit.sigma), 0.0).reshape(len(along), 1, -1)
    slopes = np.insert(np.asarray(fit.slopes), [k], column, axis=1)
    z = np.append(np.asarray(fit.z), (ratio - mean) / sd)
    r, scaled = np.asarray(fit.r).reshape(len(along), -1), np.asarray(fit.delta) / np.asarray(own.spread)
    precision, pulls, move, width = _step_all(r, slopes, z, scaled)
    wide = dataclasses.replace(fit, z=z, slopes=slopes, precision=precision, pulls=pulls).marginal(k)
    return float(mean + sd * (z[k] + move[k])), float(sd * width[k]), wide


def _step_all(
    r: np.ndarray, slopes: np.ndarray, z: np.ndarray, scaled: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Precision of all of z and every window's pull on it, a Gauss-Newton step, and its standard deviations."""
    c = normal_equations(r, slopes, z, scaled)
    precision, gradient, _, shift = eliminate(c)
    covariance = np.linalg.inv(precision)
    return precision, own_pulls(c, shift), covariance @ gradient, np.sqrt(covariance.diagonal())


def _along(
    nodes: Sequence[float], ratio: float, runs: Float[np.ndarray, "windows nodes rows obs"]
) -> Float[np.ndarray, "windows rows obs"]:
    """How fast predictions change with s."""
    ahead, behind = (interpolate(nodes, ratio + step, runs) for step in (1e-3, -1e-3))
    return (ahead - behind) / 2e-3


def ratio_of_motion(model: CaseModel, windows: Windows) -> tuple[float, float]:
    """Mean and standard deviation of s as positions and velocities tell it, whatever moves the machine.

    Semi-implicit Euler adds to a position its velocity at the end of each step: over a piece of a recording

        Δq − ∫ v dt = s h/2 Δv

    which `measure_lag` tells, together with `RATIO`; that alone where joints' velocities are not measured, or are late
    by more than a step could do, or where the integrator is another one.
    """
    m = model.compiled
    found: list[tuple[float, float]] = [(RATIO.a, RATIO.b)]
    if not is_runge_kutta(m):
        for _, q, v in model.case.layout.single:
            there = windows.qpos_measured[:, :, q] & windows.qvel_measured[:, :, v]
            lags = measure_lag(windows.time, windows.qpos[:, :, q], windows.qvel[:, :, v], there)
            told = ((2.0 * lag / m.opt.timestep, np.hypot(2.0 * sd / m.opt.timestep, BLUR)) for lag, sd in lags)
            found += [(s, sd) for s, sd in told if -BEYOND * sd < s < 1.0 + BEYOND * sd]
    weights = np.array([1.0 / sd**2 for _, sd in found])
    return float(weights @ [mean for mean, _ in found] / weights.sum()), float(weights.sum() ** -0.5)


def _with_runs(shots: Shots, runs: Float[np.ndarray, "windows nodes rows obs"]) -> Shots:
    """Windows beside what the time step does to them, of z with that of s, which has no ends."""
    bounded = jax.device_put(np.append(np.asarray(shots.bounded), False))
    return dataclasses.replace(shots, inputs=Seen(shots.inputs, jax.device_put(runs)), bounded=bounded)


def _size(shots: Shots, fit: Fit, error: Float[np.ndarray, "windows rows obs"]) -> tuple[float, int]:
    """An error against the noise, in the channel where it is largest, and the numbers measured."""
    measured = np.asarray(shots.measured)
    noise = difference_noise(np.nan_to_num(fit.misses), measured)
    usual = np.sqrt((error**2).sum((0, 1)) / np.maximum(measured.sum((0, 1)), 1))
    return float((usual / np.maximum(noise, np.asarray(noise_floor(shots)))).max()), int(measured.sum())
