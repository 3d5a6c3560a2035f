"""From a case to windows that a simulator can be compared with: the system, its predictions, and what is held out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from bayessim_jax.beliefs.margins import Margin, Margins, log_normal, normal, uniform
from bayessim_jax.contracts import Box
from bayessim_jax.inference.replay import Inputs, Replay, Restarted
from bayessim_jax.inference.scores import predict_windows
from bayessim_jax.inference.shooting import Predict, Shots
from bayessim_jax.recordings.late import is_runge_kutta
from bayessim_jax.recordings.priors import LogNormal, Normal, Prior
from bayessim_jax.recordings.recording import CaseRecording, resample
from bayessim_jax.recordings.smoothing import smooth_recordings
from bayessim_jax.recordings.splitting import choose_held_out, describe_inputs
from bayessim_jax.recordings.unreached import drop_unreached
from bayessim_jax.recordings.windows import Windows, stack_windows
from bayessim_jax.systems.mjcf import MjcfSystem, Unknown, mjcf_system

if TYPE_CHECKING:
    from bayessim_jax.diagnosis.bench import Bench, Candidate
    from bayessim_jax.recordings.loading import LoadedCase

__all__ = [
    "REFINED",
    "CaseModel",
    "StepError",
    "case_model",
    "interpolate",
    "lagrange",
    "margin_of",
    "margins_of",
    "predictor",
    "split_numbers",
    "split_windows",
    "take",
    "tame",
    "with_euler_steps",
]

REFINED = 4
"""Time steps of a finer simulation in one of the model's own."""
WILD = 0.1
"""Of a channel's spread: a larger error of the time step is not one that can be interpolated."""
JITTER = 0.02
"""Share of a step by which rows may lie off a uniform grid before a recording is put on one."""


def margins_of(case: LoadedCase) -> Margins:
    """The case's priors."""
    each = [margin_of(p.prior) for p in case.parameters]
    return Margins.create([p.name for p in case.parameters], each, [p.unit for p in case.parameters])


def margin_of(prior: Prior) -> Margin:
    """The same belief as a map from a standard normal variable."""
    if isinstance(prior, LogNormal):
        return log_normal(prior.log_mean, prior.log_sd)
    if isinstance(prior, Normal):
        return normal(prior.loc, prior.scale, prior.low, prior.high)
    return uniform(prior.low, prior.high)


@dataclass(frozen=True, eq=False)
class CaseModel:
    """A case ready to be compared: its system, its recordings on the system's time grid, and its channels."""

    case: LoadedCase
    system: MjcfSystem | Restarted
    margins: Margins
    recordings: tuple[CaseRecording, ...]
    channels: tuple[str, ...]
    """Measured channels, in the order of the predictions."""
    remarks: tuple[str, ...] = ()
    before: float = 0.0
    """s of commands before a window that are kept."""
    refined: int = 1
    """Time steps of the simulation in one of the model's own."""
    step_error: StepError | None = None
    """What the time step does to predictions, of which recordings are freed."""

    @property
    def step(self) -> float:
        """Length of the differences that stand for derivatives where bodies collide; 0 where the engine is smooth."""
        return 1e-3 if self.engine_name == "mujoco" else 0.0

    @property
    def nearest(self) -> int:
        """Time steps in one of the model's own with which simulations come nearest to what was recorded."""
        if self.step_error is None or 0.0 in self.step_error.nodes:
            return self.refined
        ratio = self.step_error.ratio
        return min((1, REFINED), key=lambda refined: abs(1 / refined - ratio))

    @property
    def engine_name(self) -> str:
        """What steps the system."""
        return self.system.name if isinstance(self.system, Restarted) else self.system.engine.name

    @property
    def compiled(self) -> Any:
        """The `mujoco.MjModel` that is stepped; raises `ValueError` for a registered system."""
        if isinstance(self.system, Restarted):
            raise ValueError(f"system {self.case.case.system} is no MuJoCo model; give the model as MJCF.")
        return self.system.engine.model

    @cached_property
    def smoothed(self) -> CaseModel:
        """The same case with smoothed motion of hinges and slides."""
        joints = [(q, v) for _, q, v in self.case.layout.single]
        return dataclasses.replace(self, recordings=smooth_recordings(self.recordings, joints))

    def windows(
        self, which: Sequence[int], horizon: float | None = None, stride: float | None = None, lead: float = 0.0
    ) -> Windows:
        """Windows of some of the recordings; `recording` numbers them among all, `lead` is that of `find_windows`."""
        windows = stack_windows([self.recordings[i] for i in which], horizon or self.case.case.horizon, stride, lead)
        return dataclasses.replace(windows, recording=np.asarray(which)[windows.recording])

    def shots(self, windows: Windows) -> Shots:
        """Windows as the solver takes them."""
        shots = Shots(
            inputs=self.inputs(windows),
            y=jax.device_put(self._stack(windows.qpos, windows.qvel, windows.sensors)),
            measured=jax.device_put(
                self._stack(windows.qpos_measured, windows.qvel_measured, windows.sensors_measured).astype(bool)
                & _rows(windows)[..., None]
            ),
            spread=jax.device_put(self._spread()),
            bounded=jax.device_put(self.margins.bounded),
        )
        if self.step_error is None:
            return shots
        return dataclasses.replace(
            shots, y=jax.device_put(np.asarray(shots.y) - self.step_error.offset(shots, self.refined))
        )

    def inputs(self, windows: Windows) -> Inputs:
        """Initial states and commands; what came before, for effects that remember it, with smoothed motion.

        Effects with a time of their own count from a recording's first row, whatever its clock says there.
        """
        before = math.ceil(self.before / self.system.dt - 1e-9)
        shapes = (windows.ctrl, windows.qpos, windows.qvel)
        past, places, rates = (np.zeros((len(windows), before, x.shape[-1])) for x in shapes)
        unrecorded = np.zeros((len(windows), before), bool)
        for w in range(len(windows)):
            recording = self.recordings[windows.recording[w]]
            row = recording.row_at(windows.start[w])
            if before:
                rows, smooth = np.arange(row - before, row), self.smoothed.recordings[windows.recording[w]]
                unrecorded[w] = rows < 0
                early, rows = np.minimum(rows, 0) * self.system.dt, np.maximum(rows, 0)
                past[w], rates[w] = recording.ctrl[rows], smooth.qvel[rows]
                places[w] = _coast(self, smooth.qpos[rows], rates[w] * early[:, None])
        place = windows.sensors[:, 0] if isinstance(self.system, Restarted) else windows.qpos[:, 0]
        since = windows.start - np.array([self.recordings[k].time[0] for k in windows.recording])
        first = (place, windows.qvel[:, 0], windows.ctrl, past, since)
        motion = (jax.device_put(places), jax.device_put(rates))
        return Inputs(*map(jax.device_put, first), motion=motion, unrecorded=jax.device_put(unrecorded))

    def _stack(self, qpos: np.ndarray, qvel: np.ndarray, sensors: np.ndarray) -> np.ndarray:
        layout = self.case.layout
        names = (*layout.qpos, *layout.qvel, *layout.sensors)
        every = np.concatenate([qpos, qvel, sensors], axis=-1)
        return every[..., [names.index(name) for name in self.channels]]

    def _spread(self) -> np.ndarray:
        """How far initial states may be off: as far as the recordings move at all.

        Where commands before a window are kept, those before the recording may be off by as much as commands vary.
        """
        if isinstance(self.system, Restarted):
            names = ("sensors", "ctrl") if self.before else ("sensors",)
            columns = [np.concatenate([getattr(r, name) for r in self.recordings]) for name in names]
            return np.maximum(np.concatenate(columns, axis=1).std(0), 1e-3)
        nv = self.system.engine.model.nv
        qvel = np.concatenate([r.qvel for r in self.recordings])
        step = np.concatenate([_motions(self.system.engine.model, r.qpos) for r in self.recordings])
        place = np.maximum(np.abs(step).std(0) + np.abs(step).mean(0), 1e-3) if len(step) else np.ones(nv)
        return np.concatenate([place, np.maximum(qvel.std(0), 1e-2)])


@dataclass(frozen=True, eq=False)
class StepError:
    """What the time step of a simulation does to predictions, at one z: simulations of several steps, interpolated.

    With steps s_k h and predictions y_k, that of a step s h is y(s) = Σ_k L_k(s) y_k, L_k Lagrange's polynomials.
    Beside those of semi-implicit Euler a step of Runge and Kutta is as good as none, s = 0.
    """

    models: tuple[CaseModel, ...]
    z: Float[Array, " d"]
    ratio: float = 0.0
    """The s of what was recorded: 0 for a machine."""
    answer: tuple[Bench, Candidate] | None = None
    """Effects that are simulated, too, and their bench; z has their numbers then."""

    @property
    def nodes(self) -> tuple[float, ...]:
        """Each s_k."""
        none = [is_runge_kutta(model.compiled) for model in self.models]
        mixed = any(none) and not all(none)
        return tuple(0.0 if mixed and own else 1 / m.refined for own, m in zip(none, self.models, strict=True))

    def runs(
        self, shots: Shots, refined: int, delta: Float[Array, "windows n"] | None = None
    ) -> Float[np.ndarray, "windows nodes rows obs"]:
        """Predictions y_k less those of the first model with h / `refined`; zero where nothing was measured."""
        predicts: list[Predict] = [predictor(m) for m in self.models]
        if self.answer is not None:
            bench, candidate = self.answer
            shots = bench.setup(candidate, shots)
            simulator = bench.simulator(candidate)
            predicts = [dataclasses.replace(simulator, system=m.system) for m in self.models]
        each = [predict_windows(predict, shots, self.z, delta) for predict in predicts]
        base = each[[model.refined for model in self.models].index(refined)]
        found = np.stack([y - base for y in each], axis=1)
        there = np.asarray(shots.measured) & np.isfinite(found).all(1)
        return np.where(there[:, None], found, 0.0)

    def offset(self, shots: Shots, refined: int) -> Float[np.ndarray, "windows rows obs"]:
        """What has to be added to predictions of a simulation with h / `refined`."""
        return interpolate(self.nodes, self.ratio, tame(self.runs(shots, refined), shots))


def with_euler_steps(model: CaseModel) -> CaseModel:
    """The same case, simulated with steps of semi-implicit Euler."""
    case = dataclasses.replace(model.case, lateness=dataclasses.replace(model.case.lateness, stepped=True))
    return case_model(case, engine=model.engine_name, before=model.before, refined=model.refined)


def interpolate(
    nodes: Sequence[float], ratio: float, runs: Float[np.ndarray, "windows nodes rows obs"]
) -> Float[np.ndarray, "windows rows obs"]:
    """Predictions with a step s h, from those with the steps of some nodes."""
    return np.einsum("k,wkro->wro", lagrange(nodes, ratio), runs)


def tame(
    runs: Float[np.ndarray, "windows nodes rows obs"], shots: Shots
) -> Float[np.ndarray, "windows nodes rows obs"]:
    """The same with zero for windows and channels in which errors are too large to be interpolated."""
    measured = np.asarray(shots.measured)
    spread = np.nanstd(np.where(measured, np.asarray(shots.y), np.nan), axis=(0, 1))
    size = np.sqrt((runs**2).mean(2, keepdims=True)).max(1, keepdims=True)
    return np.where(size <= WILD * np.nan_to_num(spread), runs, 0.0)


def lagrange(nodes: Sequence[float], at: Any) -> Any:
    """Lagrange's polynomials of some nodes, at one place, which may be traced."""
    parts = [math.prod((at - b) / (a - b) for b in nodes if b != a) for a in nodes]
    return jnp.stack(parts) if isinstance(at, jax.Array) else np.array(parts)


def _coast(model: CaseModel, qpos: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Positions moved along hinges and slides."""
    found = qpos.copy()
    for _, q, v in model.case.layout.single:
        found[:, q] += moves[:, v]
    return found


def _motions(model: Any, qpos: np.ndarray) -> np.ndarray:
    """Moves along every degree of freedom from the middle of a recording."""
    out = np.zeros((len(qpos), model.nv))
    for row in range(0, len(qpos), max(len(qpos) // 200, 1)):
        mujoco.mj_differentiatePos(model, out[row], 1.0, qpos[len(qpos) // 2], qpos[row])
    return out[:: max(len(qpos) // 200, 1)]


def _rows(windows: Windows) -> Bool[np.ndarray, "windows rows"]:
    """Rows that a window has."""
    first = np.ones((len(windows), 1), bool)
    return np.concatenate([first, windows.valid], axis=1)


def case_model(
    case: LoadedCase, *, engine: str = "auto", before: float = 0.0, refined: int = 1, whole: bool = False
) -> CaseModel:
    """Make a case's system, on a time step that its recordings' rows are a whole number of steps apart.

    With `refined` the simulation takes so many steps for one of the model's. Recordings whose rows are not evenly
    spaced, or at another rate than the others, are put on a uniform grid. Contacts are left out where the tree engine
    takes the model without them and nothing touches in the recordings, and limits that these do not come near, unless
    the `whole` model is asked for. Raises `ValueError` for what the engine does not take.
    """
    restarted = _restarted(case) if case.model is None else None
    dt = restarted.dt if restarted else float(np.median([r.step for r in case.recordings]))
    remarks, recordings = [], []
    for recording in case.recordings:
        steps = np.diff(recording.time)[recording.valid]
        if np.abs(steps / dt - 1).max() > JITTER:
            recordings.append(resample(recording, dt))
            remarks.append(f"{recording.name} is put on a grid of {dt:g} s")
        else:
            recordings.append(recording)
    if restarted:
        channels = tuple(
            c for i, c in enumerate(case.layout.sensors) if any(r.sensors_measured[:, i].any() for r in recordings)
        )
        return CaseModel(case, restarted, margins_of(case), tuple(recordings), channels, tuple(remarks), before)
    spec = case.spec.copy()
    substeps = max(round(dt / spec.option.timestep), 1)
    if abs(substeps * spec.option.timestep / dt - 1) > 1e-3:
        substeps = max(int(np.ceil(dt / spec.option.timestep * (1 - 1e-3))), 1)
        remarks.append(f"time step {dt / substeps:g} s instead of {spec.option.timestep:g} s, {substeps} to a row")
    substeps *= refined
    spec.option.timestep = dt / substeps
    if case.lateness.stepped:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        remarks.append("semi-implicit Euler instead of Runge-Kutta: velocities are late as by its steps")
    layout = case.layout
    measured = {
        name
        for names, mask in (
            (layout.qpos, "qpos_measured"),
            (layout.qvel, "qvel_measured"),
            (layout.sensors, "sensors_measured"),
        )
        for i, name in enumerate(names)
        if any(getattr(r, mask)[:, i].any() for r in recordings)
    }
    channels = tuple(c for c in (*layout.qpos, *layout.qvel, *layout.sensors) if c in measured)
    if engine in ("auto", "tree") and not whole:
        remarks += drop_unreached(spec, case.recordings)
    unknowns = [Unknown(p.name, tuple(str(t) for t in p.targets), *_bounds(p.prior), p.unit) for p in case.parameters]
    system = mjcf_system(spec, unknowns, observe=channels, substeps=substeps, engine=engine)
    return CaseModel(case, system, margins_of(case), tuple(recordings), channels, tuple(remarks), before, refined)


def _restarted(case: LoadedCase) -> Restarted:
    """A registered system, its parameters that the case does not name in the middle of their box."""
    from bayessim_jax.systems import lookup

    system: Any = lookup(case.case.system).system()
    if not hasattr(system, "restart"):
        raise ValueError(f"system {case.case.system} cannot be restarted from recordings; give the model as MJCF.")
    box = system.parameters
    index = tuple(box.names.index(str(p.targets[0])) for p in case.parameters)
    parameters = Box.create(**{p.name: (*_bounds(p.prior), p.unit) for p in case.parameters})
    return Restarted(system, parameters, jnp.asarray((box.low + box.high) / 2, float), index)


def _bounds(prior: Prior) -> tuple[float, float]:
    low = prior.low if np.isfinite(prior.low) else prior.mean - 5 * prior.sd
    high = prior.high if np.isfinite(prior.high) else prior.mean + 5 * prior.sd
    return float(low), float(high)


def predictor(model: CaseModel) -> Replay:
    """`predict(z, δ, window)` of a case: what its sensors show in every row of a window."""
    return Replay(model.system, model.margins)


def split_windows(model: CaseModel, lead: float = 0.0) -> tuple[Windows, Windows]:
    """Windows to fit and windows to judge by, without the first `lead` seconds of each recording (`find_windows`)."""
    every = model.windows(range(len(model.recordings)), lead=lead)
    fitted, held = split_numbers(model, every)
    return take(every, fitted), take(every, held)


def split_numbers(model: CaseModel, every: Windows) -> tuple[Int[np.ndarray, " fitted"], Int[np.ndarray, " held"]]:
    """Which windows are to fit and which to judge by: of whole recordings left out, or every fourth window of the one.

    About a quarter of the recordings is left out, whose commands are like those of the others (`choose_held_out`);
    those without a window count for neither. One window alone is for both.
    """
    present = np.unique(every.recording)
    if len(present) > 1:
        chosen = choose_held_out(describe_inputs([model.recordings[i] for i in present]))
        held = np.isin(every.recording, present[chosen])
    elif len(every) < 2:
        return np.arange(len(every)), np.arange(len(every))
    else:
        held = choose_held_out(np.zeros((len(every), 0)))
    return np.flatnonzero(~held), np.flatnonzero(held)


def take(windows: Windows, which: Any) -> Windows:
    """Some of the windows."""
    return Windows(**{f.name: getattr(windows, f.name)[which] for f in dataclasses.fields(windows)})
