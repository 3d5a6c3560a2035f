"""The diagnosis of a case: from its recordings to verdict, place, effect, parameters and predictions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayessim_jax.diagnosis.absorbed import find_absorbed
from bayessim_jax.diagnosis.belief import moments_of_effects, moments_of_theta
from bayessim_jax.diagnosis.bench import Bench, Candidate
from bayessim_jax.diagnosis.experiment import Experiment
from bayessim_jax.diagnosis.flexible import FEATURES, FLEXIBLE, UNITS, features
from bayessim_jax.diagnosis.locate import Location, find_regime, find_windows_of, shares_from_left
from bayessim_jax.diagnosis.problem import Problem
from bayessim_jax.diagnosis.procedure import detect, is_hidden, is_mismatch, name_effects
from bayessim_jax.diagnosis.response import Motion
from bayessim_jax.diagnosis.screen import Screened
from bayessim_jax.diagnosis.simulated_scene import SimulatedScene
from bayessim_jax.diagnosis.verdict import (
    Diagnosis,
    Entry,
    Thresholds,
    error_of_sum,
    is_refuted,
    share_left,
)
from bayessim_jax.effects import EFFECTS, Scales, commanded_scales, effect_places, open_form, recorded_scales
from bayessim_jax.inference.replay import Restarted
from bayessim_jax.inference.scores import Score, compare, error_spread, score
from bayessim_jax.inference.shooting import ROUGH, Shots
from bayessim_jax.recordings.experiments import advise, next_experiment
from bayessim_jax.recordings.identification import channel_scale, start_spread
from bayessim_jax.recordings.shots import CaseModel, interpolate, split_numbers, take
from bayessim_jax.recordings.stepping import RATIO, Settled, settle_answer, settle_step
from bayessim_jax.recordings.windows import Windows, cut_windows

__all__ = ["CaseDiagnosis", "diagnose_case"]

MOST_FITTED, MOST_HELD = 44, 20
"""Windows that choose and windows that judge; of longer recordings they are spread evenly."""
SMALLEST = 0.02
"""Share of the misfit below which a place is not listed."""
LONG = 15
"""Steps of the solver for a force with many weights."""
RATIOS, SAME_STEP = np.linspace(0.0, 1.0, 5), 0.05
"""Time steps, of the model's own, that the best candidate is fitted with, and by how much one has to be another."""
TAKEN = 0.1
"""Share of what that candidate leaves which another time step has to take."""
PIECE, LEAST = 0.16, 16
"""s and rows: naming is done with pieces of windows of about this length, and of longer ones where noise hides what is
missing in them. Stick-slip makes long ones chaotic."""
MISTIMED = 0.1
"""Share of the misfit that commands a row earlier leave at most where they are recorded too late."""
LEAD = 0.2
"""s at the beginning of a recording that are left out where motors move a machine: what they were told before is not
known, and late or slow ones remember it."""


@dataclass(frozen=True)
class CaseDiagnosis:
    """What was found in a case, and everything that the report shows of it."""

    model: CaseModel
    bench: Bench
    windows: Windows
    """Those that choose and those that judge, each as long as the horizon."""
    chosen: Bool[np.ndarray, " windows"]
    shots: Shots
    """The same as the solver takes them."""
    pieces: Windows
    """What the entries' misfits are of: pieces of the windows that choose, or these themselves."""
    result: Diagnosis
    flexible: Screened | None
    flexible_bench: Bench | None
    locations: list[Location]
    forces: dict[str, tuple[np.ndarray, ...]]
    """The force without a name at every joint, position, velocity and drive there, and the time, along the motion."""
    scores: dict[str, Score]
    """`baseline`, `augmented`, `flexible`, on windows that nothing was fitted to."""
    spreads: dict[str, Float[np.ndarray, "bins obs"]]
    predictions: dict[str, Float[np.ndarray, "windows rows obs"]]
    scale: Float[np.ndarray, " obs"]
    noise_floor: float
    theta: dict[str, tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]]
    """Mean and standard deviation of the parameters, `baseline` and `augmented`."""
    experiment: Experiment | None
    """What would tell the members of the confusion set apart."""
    absorbed: list[str]
    """Effects whose place the parameters can take, of a system that is simulated from the start."""

    @property
    def shares_left(self) -> list[float]:
        """Share of the misfit that every finalist leaves."""
        return [share_left(entry.misfit, self.result.baseline.misfit) for entry in self.result.entries]

    @property
    def held_out(self) -> list[str]:
        """Recordings that neither a fit nor the choice has seen."""
        return sorted({self.model.recordings[i].name for i in self.windows.recording[~self.chosen]})

    @property
    def augmented(self) -> str:
        """Whose scores are the augmented simulator's: where nothing is named, those of the simulator as it is."""
        return "augmented" if self.result.names_something else "baseline"

    def table(self) -> dict[str, Any]:
        """What `diagnosis.json` holds."""
        result, best = self.result, self.result.best
        named = result.names_something
        return {
            "schema": 1,
            "case": self.model.case.case.name,
            "verdict": result.verdict,
            "misfit": {"p_value": result.baseline.misfit.p_value, "false_alarm_rate": 0.05},
            "locations": [
                {
                    "at": place.at,
                    "share": place.share,
                    "regime": place.regime,
                    "windows": [list(w) for w in place.windows],
                }
                for place in self.locations
            ],
            "effects": self._effects(best) if named else [],
            "absorbed": [name for name in self.absorbed if not (named and name in best.names)],
            "confusion_set": [entry.names for entry in result.confusion] if result.verdict == "ambiguous" else [],
            "fit": {
                "horizon": self.model.case.case.horizon,
                "held_out": self.held_out,
                "baseline": self.scores["baseline"].as_table(),
                "augmented": self.scores[self.augmented].as_table(),
                **(
                    {"flexible": {k: v for k, v in self.scores["flexible"].as_table().items() if k != "per_channel"}}
                    if "flexible" in self.scores
                    else {}
                ),
                "noise_floor": self.noise_floor,
            },
            "parameters": {
                name: {
                    **{
                        which: {"mean": float(self.theta[which][0][k]), "sd": float(self.theta[which][1][k])}
                        for which in ("baseline", "augmented")
                    },
                    "unit": self.model.margins.units[k],
                }
                for k, name in enumerate(self.model.margins.names)
            },
            "next_experiment": advise(self.result, self.experiment),
            "screened": [{"effect": name, "gain": gain} for name, gain in result.screened],
            "finalists": self._finalists(),
        }

    def _finalists(self) -> list[dict[str, Any]]:
        """What was simulated: scores on windows that fits have not seen, in nats, with standard errors over windows.

        `gain` is over the simulator without effects, `behind` what the first has more.
        """
        result, found = self.result, []
        for entry, left in zip(result.entries, self.shares_left, strict=True):
            gain, behind = entry.scores - result.baseline.scores, result.entries[0].scores - entry.scores
            named = [p for other, p in zip(result.confusion, result.probabilities, strict=True) if other is entry]
            found.append(
                {
                    "effects": entry.names,
                    "gain": float(gain.sum()),
                    "gain_se": error_of_sum(gain),
                    "behind": float(behind.sum()),
                    "behind_se": error_of_sum(behind),
                    "misfit_left": left,
                    "error_ahead_left": entry.ahead,
                    "probability": named[0] if named else None,
                }
            )
        return found

    def _effects(self, entry: Entry) -> list[dict[str, Any]]:
        means, sds = moments_of_effects(self.bench, entry)
        found = []
        for k in entry.told:
            effect, _, place = self.bench.name(k).partition("@")
            own = self.bench.parameters[self.bench.first[k] : self.bench.first[k + 1]]
            keys = [f"{self.bench.label(k)}/{p.name}" for p in own]
            found.append(
                {
                    "effect": effect,
                    "at": place,
                    "probability": self.result.probabilities[0],
                    "parameters": {
                        p.name: {"mean": means[key], "sd": sds[key], "unit": p.unit}
                        for key, p in zip(keys, own, strict=True)
                    },
                }
            )
        return found


def _thin(numbers: Int[np.ndarray, " n"], most: int) -> Int[np.ndarray, " m"]:
    """At most so many, spread evenly."""
    count = len(numbers)
    return numbers if count <= most else numbers[np.unique(np.linspace(0, count - 1, most).astype(int))]


@dataclass(frozen=True)
class _Taken:
    """A case as the diagnosis takes it."""

    model: CaseModel
    windows: Windows
    chosen: Bool[np.ndarray, " windows"]
    fitting: Int[np.ndarray, " chosen"]
    """Which of all the case's windows choose."""
    pieces: Windows
    whole: Problem
    """Windows as long as the horizon, by which a mismatch is detected."""
    problem: Problem
    """Pieces of them, by which it is named."""
    settled: Settled
    detected: Entry | None = None
    """The simulator as it is on whole windows, where it misses something."""


def _take_case(key: Array, model: CaseModel, effects: Sequence[Any], say: Callable[[str], None]) -> _Taken:
    """Windows, smoothed motion, every effect at every place, and the fit without effects."""
    every = _every_window(model)
    fitting, judging = (_thin(n, m) for n, m in zip(split_numbers(model, every), (MOST_FITTED, MOST_HELD), strict=True))
    fitted, held = take(every, fitting), take(every, judging)
    # what is missing of a machine may bend the valley that fits follow: where they creep they end
    settled = settle_step(key, model, fitted, tolerance=ROUGH, say=say)
    model = settled.model
    windows = join(fitted, held)
    system: Any = model.system
    pairs = tuple((effect, place) for effect in map(open_form, effects) for place in effect_places(effect, system))
    joints = [f"joint/{name}" for name, *_ in model.case.layout.single]
    whole = Problem(
        system=system,
        margins=model.margins,
        pairs=pairs,
        scales=_scales(model, [*(place for _, place in pairs), *joints]),
        shots=model.shots(fitted),
        group=fitted.recording,
        motion=None,
        step=model.step,
    )
    pieces, problem = (
        (fitted, whole)
        if isinstance(system, Restarted)
        else _cut(model, whole, fitted, fitting, len(windows), max(round(PIECE / system.dt), LEAST))
    )
    return _Taken(model, windows, np.arange(len(windows)) < len(fitted), fitting, pieces, whole, problem, settled)


def _lengthen(key: Array, taken: _Taken, none: Entry) -> _Taken:
    """The case in longer pieces, where noise hides in its own what whole windows show to be missing."""
    if isinstance(taken.model.system, Restarted):
        return taken
    fitted = take(taken.windows, taken.chosen)
    while (rows := taken.pieces.valid.shape[1]) < fitted.valid.shape[1] and is_hidden(key, taken.problem, none):
        cut = _cut(taken.model, taken.whole, fitted, taken.fitting, len(taken.windows), 2 * rows)
        taken = dataclasses.replace(taken, pieces=cut[0], problem=cut[1])
    return taken


def _settle_with(taken: _Taken, bench: Bench, best: Entry, thresholds: Thresholds) -> _Taken | None:
    """The case with the time step that the best candidate finds, if the simulator without it had found another one.

    Where velocities are not measured a fit takes the time step for what is missing, and what was taken wrongly out of
    the recordings is missing then, too.
    """
    error = taken.model.step_error
    if error is None or taken.settled.told:
        return None
    error = dataclasses.replace(error, z=best.fit.z[: bench.d])
    began = best.candidate, best.fit.z, best.fit.delta, best.fit.sigma

    def cost(ratio: float) -> float:
        model = dataclasses.replace(taken.model, step_error=dataclasses.replace(error, ratio=ratio))
        there = dataclasses.replace(taken.problem, shots=model.shots(taken.pieces)).bench(taken.problem.pairs)
        return float(there.fit(*began).cost) + 0.5 * RATIO.standard(ratio) ** 2

    costs = np.array([cost(ratio) for ratio in RATIOS])
    ratio = _lowest(RATIOS, costs)
    measured = np.asarray(taken.problem.shots.measured)
    size = best.misfit.size(measured)
    left = 0.5 * measured.sum() * size / (1.0 + size)  # nats that the candidate's misfit has in its own noise
    if abs(ratio - error.ratio) < SAME_STEP or cost(error.ratio) - cost(ratio) < max(thresholds.least, TAKEN * left):
        return None
    model = dataclasses.replace(taken.model, step_error=dataclasses.replace(error, ratio=ratio))
    fitted, shots = take(taken.windows, taken.chosen), model.shots(taken.pieces)
    ahead = _ahead(model, fitted, len(taken.windows))
    whole = dataclasses.replace(taken.whole, shots=model.shots(fitted))
    problem = dataclasses.replace(taken.problem, shots=shots, ahead=ahead)
    settled = dataclasses.replace(taken.settled, told=True)
    return dataclasses.replace(taken, model=model, whole=whole, problem=problem, settled=settled)


def _settle_answer(taken: _Taken, result: Diagnosis) -> _Taken:
    """The case with what the time step does to the answer, whose entries are fitted to what is left."""
    named = result.names_something
    if not named and result.verdict != "no_mismatch":
        return taken
    pieces = taken.pieces if named else take(taken.windows, taken.chosen)
    entries = result.confusion if named else [result.baseline]
    model, result.bench = settle_answer(taken.model, pieces, result.bench, entries, taken.settled.moved)
    return dataclasses.replace(taken, model=model)


def _lowest(places: Float[np.ndarray, " n"], costs: Float[np.ndarray, " n"]) -> float:
    """Where a parabola through the lowest of costs at even places, and its neighbours, is lowest; within the places."""
    k = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    below, here, above = costs[k - 1 : k + 2]
    bend = below - 2.0 * here + above
    move = 0.5 * (below - above) / bend if bend > 0.0 else np.sign(below - above)
    step = places[1] - places[0]
    return float(np.clip(places[k] + step * np.clip(move, -1.0, 1.0), places[0], places[-1]))


def _every_window(model: CaseModel) -> Windows:
    """Of all recordings."""
    lead = 0.0 if isinstance(model.system, Restarted) or not model.compiled.nu else LEAD
    return model.windows(range(len(model.recordings)), lead=lead)


def _cut(
    model: CaseModel, whole: Problem, fitted: Windows, fitting: Int[np.ndarray, " windows"], most: int, rows: int
) -> tuple[Windows, Problem]:
    """Pieces of so many rows of windows along their smoothed motion, and `most` to predict ahead, some repeated."""
    pieces = cut_windows(fitted, rows)
    smooth = cut_windows(take(_every_window(model.smoothed), fitting), rows)
    problem = dataclasses.replace(
        whole,
        shots=model.shots(pieces),
        group=pieces.recording,
        motion=_motion(model, pieces, smooth),
        ahead=_ahead(model, fitted, most),
    )
    return pieces, problem


def _ahead(model: CaseModel, fitted: Windows, most: int) -> Shots:
    """Windows to predict ahead, as many as are predicted in the end, so that both are one program."""
    return model.shots(take(fitted, np.resize(np.arange(len(fitted)), most)))


def _motion(model: CaseModel, windows: Windows, smooth: Windows) -> Motion:
    """The smoothed motion in windows, with their commands."""
    inputs = model.inputs(windows)
    return Motion(
        jax.device_put(smooth.qpos), jax.device_put(smooth.qvel), inputs.ctrl, inputs.past, inputs.time, inputs.motion
    )


def _scales(model: CaseModel, places: Sequence[str]) -> dict[str, Scales]:
    """How large things are at every place, over all recordings."""
    qpos, qvel, sensors, ctrl = (
        np.concatenate([getattr(r, n) for r in model.recordings]) for n in ("qpos", "qvel", "sensors", "ctrl")
    )
    duration = max(float(r.time[-1] - r.time[0]) for r in model.recordings)
    places, dt = list(dict.fromkeys(places)), model.system.dt
    plain: Any = model.system
    if isinstance(model.system, Restarted):
        return {place: commanded_scales(plain, place, sensors, ctrl, dt, duration) for place in places}
    m = model.compiled
    found = {place: recorded_scales(m, place, qpos, qvel, ctrl, dt, duration) for place in places}
    # what a finer simulation predicts is brought to the step of what was recorded, which may be the model's own
    return {place: dataclasses.replace(own, shift=own.shift * model.refined) for place, own in found.items()}


def join(first: Windows, second: Windows) -> Windows:
    """Windows one after the other, padded to the longer."""
    parts = {}
    for f in dataclasses.fields(first):
        a, b = getattr(first, f.name), getattr(second, f.name)
        if a.ndim > 1 and a.shape[1] != b.shape[1]:
            rows = max(a.shape[1], b.shape[1])
            a, b = (np.pad(x, [(0, 0), (0, rows - x.shape[1])] + [(0, 0)] * (x.ndim - 2)) for x in (a, b))
        parts[f.name] = np.concatenate([a, b])
    return Windows(**parts)


def diagnose_case(
    key: Array,
    model: CaseModel,
    *,
    effects: Sequence[Any] | None = None,
    thresholds: Thresholds | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> CaseDiagnosis:
    """Diagnose a case; raises `ValueError` where nothing can be simulated.

    `effects` are those that may be missing, all registered ones if left out.
    """
    fit_key, key = jax.random.split(key)
    thresholds = thresholds or Thresholds()
    say("fitting the simulator as it is")
    taken = _take_case(fit_key, model, list(EFFECTS.values()) if effects is None else effects, say)
    say(f"{int(taken.chosen.sum())} windows choose, {int((~taken.chosen).sum())} judge")
    explained, result, residual = _explain(key, taken, thresholds, say)
    taken = _settle_answer(explained, result)
    model, windows, chosen = taken.model, taken.windows, taken.chosen
    none, bench, shots = result.baseline, result.bench, model.shots(windows)
    scale = channel_scale(shots)
    entries = {"baseline": result.baseline, "augmented": result.best}
    predictions = {which: bench.replay(entry.candidate, entry.fit.z, shots) for which, entry in entries.items()}
    if residual is not None:
        predictions["flexible"] = residual.bench.replay(residual.found.candidate, residual.found.p, shots)
    scores, spreads, judging = {}, {}, {}
    y, measured = np.asarray(shots.y), np.asarray(shots.measured)
    for which, predicted in predictions.items():
        spreads[which] = error_spread(compare(predicted[chosen], y[chosen], measured[chosen]), scale)
        judging[which] = compare(predicted[~chosen], y[~chosen], measured[~chosen])
        scores[which] = score(judging[which], spreads[which], scale, bench.channels)
    variance = _variance(bench, result.best, model, shots)
    floor = _floor(variance, scale, shots)
    if result.confusion:
        excused = _floor(variance + np.square(_beside(model, shots)), scale, shots)
        if is_refuted(judging, excused, scale, thresholds, result.beside_a_rest):
            result.take_back()
    if result.verdict == "unexplained":
        result.sooner = _test_sooner(key, explained, thresholds)
    located = result.verdict != "no_mismatch"
    return CaseDiagnosis(
        model=model,
        bench=bench,
        windows=windows,
        chosen=chosen,
        shots=shots,
        pieces=taken.pieces if residual else take(windows, chosen),
        result=result,
        flexible=residual.found if residual else None,
        flexible_bench=residual.bench if residual else None,
        locations=_locations(taken, result, residual) if located else [],
        forces=residual.forces if residual else {},
        scores=scores,
        spreads=spreads,
        predictions=predictions,
        scale=scale,
        noise_floor=floor,
        theta={
            "baseline": moments_of_theta(bench, [result.baseline], [1.0]),
            "augmented": moments_of_theta(bench, result.confusion or [result.baseline], result.probabilities or [1.0]),
        },
        experiment=next_experiment(model, bench, result, shots),
        absorbed=_absorbed(taken.problem, none),
    )


def _explain(
    key: Array, taken: _Taken, thresholds: Thresholds, say: Callable[[str], None]
) -> tuple[_Taken, Diagnosis, _Residual | None]:
    """Detect a mismatch, name what is missing, and fit a force without a name beside that.

    Once more, where what is missing had been taken for the time step: returns the case with the one that was found.
    """
    start = taken.settled.fit.marginal(taken.model.margins.size)
    plain, none = detect(key, taken.whole, start, taken.settled.error)
    say(f"no mismatch has p = {none.misfit.p_value:.3f}")
    if not is_mismatch(taken.whole, none, thresholds):
        return taken, Diagnosis("no_mismatch", plain, none, []), None
    taken = dataclasses.replace(_lengthen(key, taken, none), detected=none)
    again: _Taken | None = None

    def go_on(bench: Bench, best: Entry) -> bool:
        nonlocal again
        again = _settle_with(taken, bench, best, thresholds)
        return again is None

    with ThreadPoolExecutor(1) as pool:
        # beside the search for a name, of which it needs nothing
        fitting = pool.submit(_fit_residual_force, key, taken, none)
        result = name_effects(key, taken.problem, none, thresholds=thresholds, say=say, go_on=go_on)
        if again is None:
            say("fitting a residual force without a name")
            return taken, result, fitting.result()
    say("the time step of what was recorded is another one, by what was found: once more with it")
    return _explain(key, again, thresholds, say)


def _test_sooner(key: Array, taken: _Taken, thresholds: Thresholds) -> float | None:
    """p-value of no mismatch where every command acts a row earlier than recorded, if that explains the recordings."""
    model, none = taken.model, taken.detected
    if isinstance(model.system, Restarted) or not model.compiled.nu or none is None:
        return None
    windows = take(taken.windows, taken.chosen)
    ctrl = np.array(windows.ctrl)
    for w, (k, start) in enumerate(zip(windows.recording, windows.start, strict=True)):
        recording = model.recordings[k]
        first = recording.row_at(start) + 1
        ctrl[w] = recording.ctrl[np.minimum(first + np.arange(ctrl.shape[1]), len(recording.ctrl) - 1)]
    problem = dataclasses.replace(taken.whole, shots=model.shots(dataclasses.replace(windows, ctrl=ctrl)))
    _, found = detect(key, problem, none.fit.marginal(model.margins.size), taken.settled.error)
    if is_mismatch(problem, found, thresholds) or share_left(found.misfit, none.misfit) > MISTIMED:
        return None
    return found.misfit.p_value


def _absorbed(problem: Problem, none: Entry) -> list[str]:
    """What the parameters can take the place of, where candidates are simulated and not held against a motion."""
    scene = problem.every.scene if isinstance(problem.system, Restarted) and problem.pairs else None
    return find_absorbed(scene, none.fit.z, none.fit.sigma) if isinstance(scene, SimulatedScene) else []


def _beside(model: CaseModel, shots: Shots) -> Float[np.ndarray, "windows rows obs"] | float:
    """What the time step does to predictions, of the answer if there is one.

    Where that is large, motion is so sensitive that in a simulator which moves otherwise it is something else.
    """
    error = model.step_error
    return 0.0 if error is None else interpolate(error.nodes, error.ratio, error.runs(shots, model.refined))


def _variance(bench: Bench, entry: Entry, model: CaseModel, shots: Shots) -> Float[np.ndarray, "windows rows obs"]:
    """That of predictions of the best model: of the sensors, and of the recorded initial states, propagated."""
    noise = entry.misfit.noise
    start = start_spread(model, dataclasses.replace(entry.fit, sigma=jnp.asarray(noise)))
    here = bench.replay(entry.candidate, entry.fit.z, shots)
    return noise**2 + bench.scatter(entry.candidate, entry.fit.z, shots, start, here)


def _floor(variance: Float[np.ndarray, "windows rows obs"], scale: np.ndarray, shots: Shots) -> float:
    """The nrmse of predictions with this variance."""
    mask = np.asarray(shots.measured) & np.isfinite(variance)
    mask[:, 0] = False
    counts = mask.sum((0, 1))
    mean = np.where(mask, variance, 0.0).sum((0, 1)) / np.maximum(counts, 1)
    return float((np.sqrt(mean) / scale)[counts > 0].mean())


@dataclass(frozen=True)
class _Residual:
    """A force without a name at every joint."""

    found: Screened
    bench: Bench
    places: list[str]
    shares: Float[np.ndarray, " places"]
    forces: dict[str, tuple[np.ndarray, ...]]
    """Force, position, velocity, drive and time along the motion."""


def _fit_residual_force(key: Array, taken: _Taken, none: Entry) -> _Residual | None:
    """A flexible force at all joints, what each joint alone explains, and the forces along the recordings."""
    model, problem = taken.model, taken.problem
    joints, motion = model.case.layout.single, problem.motion
    if not joints or motion is None:
        return None
    places = [f"joint/{name}" for name, _, _ in joints]
    scales = {p: problem.scales[p] for p in places}
    pairs = [(FLEXIBLE, place) for place in places]
    slots = (FEATURES + len(UNITS)) * len(places)
    screen = problem.screen(pairs, slots)
    nothing = screen.begin(none.fit.z[: screen.d], none.fit.sigma)
    every = Candidate(tuple(range(len(pairs))))
    found = screen.settle(every, nothing.p, nothing.delta, nothing.sigma, iterations=LONG)
    if found is None:
        return None
    # a screen with room for one of them is as many times faster
    screen = screen if len(places) == 1 else problem.screen(pairs, FEATURES + len(UNITS))
    nothing = dataclasses.replace(nothing, p=nothing.p[: screen.d + screen.slots])
    before, left = screen.misfit(key, nothing), []
    for k in range(len(places)):
        alone = screen.settle(Candidate((k,)), nothing.p, nothing.delta, nothing.sigma, iterations=LONG)
        left.append(1.0 if alone is None else share_left(screen.misfit(key, alone), before))
    bench = problem.bench(pairs, slots)
    weights = bench.each[0].value(np.asarray(found.p)[bench.d :].reshape(len(places), -1)[:, :FEATURES])
    gears, forces = _gears(model), {}
    rows = taken.pieces.valid
    time = (taken.pieces.start[:, None] + taken.pieces.time[:, :-1])[rows]
    for k, (place, (_, q, v)) in enumerate(zip(places, joints, strict=True)):
        position, velocity = (np.asarray(x)[rows] for x in (motion.qpos[:, :-1, q], motion.qvel[:, :-1, v]))
        drive = (np.asarray(motion.ctrl) @ gears[:, v])[rows] if motion.ctrl.shape[-1] else np.zeros(rows.sum())
        units = {name: getattr(scales[place], name) for name in UNITS}
        phi = np.asarray(_features(position, velocity, drive, units))
        forces[place] = (scales[place].force * (phi @ weights[k]), position, velocity, drive, time)
    return _Residual(found, bench, places, shares_from_left(left), forces)


_features = jax.jit(features)


def _gears(model: CaseModel) -> Float[np.ndarray, "nu nv"]:
    """Torque on every joint for a command of one."""
    m = model.compiled
    gears = np.zeros((m.nu, m.nv))
    for i in range(m.nu):
        joint = int(m.actuator_trnid[i, 0])
        if 0 <= joint < m.njnt:
            gears[i, m.jnt_dofadr[joint]] = m.actuator_gear[i, 0] * m.actuator_gainprm[i, 0]
    return gears


def _locations(taken: _Taken, result: Diagnosis, residual: _Residual | None) -> list[Location]:
    """Joints and channels by their share of the misfit: those of the effects that explain it, or else of any force."""
    model, pieces = taken.model, taken.pieces
    every = np.maximum(result.baseline.misfit.excess, 0.0)
    names = [model.recordings[i].name for i in pieces.recording]
    when = find_windows_of(every.sum(1), names, pieces.start, float(pieces.time.max()))
    shares = _shares_of_effects(model, result)
    if residual is None:
        if not shares:
            return _by_channel(model, every.sum(0), when)
        return [Location(place, share, "everywhere", when) for place, share in _largest(shares)]
    if not all(_joint_of(model, place) in residual.forces for place in shares) or not shares:
        shares = dict(zip(residual.places, residual.shares.tolist(), strict=True))
    found = []
    for place, share in _largest(shares):
        joint = _joint_of(model, place)
        force, position, velocity, drive, time = residual.forces[joint]
        regime = find_regime(force, position, velocity, drive, time, result.bench.scales[joint])
        found.append(Location(place, share, regime, when))
    return found


def _largest(shares: dict[str, float]) -> list[tuple[str, float]]:
    """Places and their shares, largest first, without the small ones; what is left sums to one."""
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    kept = [item for k, item in enumerate(ranked) if k == 0 or item[1] >= SMALLEST]
    total = max(sum(share for _, share in kept), 1e-12)
    return [(place, round(share / total, 4)) for place, share in kept]


def _shares_of_effects(model: CaseModel, result: Diagnosis) -> dict[str, float]:
    """What of the misfit the effects at every joint or channel explain: what is left without them."""
    if not result.confusion:
        return {}
    names = result.best.names
    alone = {tuple(e.names): share_left(e.misfit, result.baseline.misfit) for e in result.entries}
    shares: dict[str, float] = {}
    for name in names:
        place = name.partition("@")[2]
        place = place if place in model.channels else _joint_of(model, place)
        rest = tuple(other for other in names if other != name)
        shares[place] = shares.get(place, 0.0) + alone.get(rest, 1.0)
    return shares


def _by_channel(
    model: CaseModel, excess: Float[np.ndarray, " obs"], when: list[tuple[str, float, float]]
) -> list[Location]:
    """Shares of joints and sensors in the misfit of their channels, where no joint takes a residual force."""
    shares: dict[str, float] = {}
    for channel, part in zip(model.channels, excess / max(excess.sum(), 1e-12), strict=True):
        kind, _, rest = channel.partition("/")
        place = f"joint/{rest.split('/qpos')[0].split('/qvel')[0]}" if kind == "joint" else channel
        shares[place] = shares.get(place, 0.0) + float(part)
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    return [Location(place, round(share, 4), "everywhere", when) for place, share in ranked]


def _joint_of(model: CaseModel, place: str) -> str:
    """The joint at which an effect's place is felt; the place itself where there is none."""
    kind, _, rest = place.partition("/")
    if isinstance(model.system, Restarted):
        return place
    m = model.compiled
    if kind == "actuator":
        joint = int(m.actuator(rest).trnid[0])
        return f"joint/{m.joint(joint).name}" if 0 <= joint < m.njnt else place
    if kind == "joint":
        return f"joint/{rest.removesuffix('/qpos').removesuffix('/qvel')}"
    if kind in ("body", "geom"):
        body = int(m.body(rest).id) if kind == "body" else int(m.geom_bodyid[m.geom(rest).id])
        while body and not m.body_jntnum[body]:
            body = int(m.body_parentid[body])
        return f"joint/{m.joint(int(m.body_jntadr[body])).name}" if body else place
    return place
