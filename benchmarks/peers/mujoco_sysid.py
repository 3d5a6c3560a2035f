"""The peer's side: least squares of `mujoco.sysid` on the same windows, from the prior's mean, in its support."""

from __future__ import annotations

import contextlib
import io
import math
from typing import TYPE_CHECKING, Any

import absl.logging
import numpy as np
from mujoco import sysid

from bayessim_jax.recordings.priors import Uniform
from benchmarks.peers import CORES
from benchmarks.timing import now

if TYPE_CHECKING:
    from bayessim_jax.recordings.paths import Target
    from bayessim_jax.recordings.priors import Prior
    from bayessim_jax.recordings.shots import CaseModel
    from bayessim_jax.recordings.windows import Windows

__all__ = ["identify"]

WIDTH = 4.0
"""Standard deviations to each side of a prior's mean that the search is bounded to where the prior is not."""
SIGNALS = {"qpos": sysid.SignalType.MjStateQPos, "qvel": sysid.SignalType.MjStateQVel}


def identify(model: CaseModel, windows: Windows) -> tuple[np.ndarray, float]:
    """Estimate a case's parameters, which have to be masses; returns them in the case's order, and the seconds.

    Each window is a sequence of its own, begun from the recorded state, on the model's own time step. Commands are
    given on that step, held as the recording holds them, because the peer interpolates them linearly. Residuals are
    normalized, and the optimizer is set, as the peer does by default.
    """
    start = now()
    spec = model.case.spec.copy()
    spec.option.timestep = model.compiled.opt.timestep
    parameters = sysid.ParameterDict()
    for p in model.case.parameters:
        parameters.add(sysid.Parameter(p.name, p.prior.mean, *_bounds(p.prior), modifier=_modifier(spec, p.targets)))
    level = absl.logging.get_verbosity()
    absl.logging.set_verbosity(absl.logging.ERROR)  # one warning a window that the model has no sensors
    try:
        sequences = _sequences(spec, model, windows)
        residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=CORES)
        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = sysid.optimize(parameters, residual, optimizer="mujoco", verbose=False)
    finally:
        absl.logging.set_verbosity(level)
    return found.as_vector(), now() - start


def _bounds(prior: Prior) -> tuple[float, float]:
    """Ends of a prior, or of what is likely under it; above 0 as masses are."""
    if isinstance(prior, Uniform):
        return prior.low, prior.high
    low, high = prior.mean - WIDTH * prior.sd, prior.mean + WIDTH * prior.sd
    return max(low, prior.low, 1e-3 * prior.mean), min(high, prior.high)


def _modifier(spec: Any, targets: tuple[Target | str, ...]) -> Any:
    """What writes a mass into the model, the body's inertia in proportion."""
    if any(isinstance(t, str) or t.field != "mass" for t in targets):
        raise ValueError(f"{', '.join(map(str, targets))}: the comparison with mujoco.sysid is of masses; name masses.")
    compiled = spec.compile()
    bodies = [(t.name, compiled.body(t.name)) for t in targets if not isinstance(t, str)]
    known = [(name, float(body.mass[0]), body.inertia.copy()) for name, body in bodies]

    def write(spec: Any, parameter: Any) -> None:
        for name, mass, inertia in known:
            body = spec.body(name)
            body.mass = parameter.value[0]
            body.inertia = inertia * parameter.value[0] / mass

    return write


def _sequences(spec: Any, model: CaseModel, windows: Windows) -> Any:
    """The windows as the peer takes them."""
    compiled = spec.compile()
    substeps, h = model.system.substeps, float(compiled.opt.timestep)
    signals = [_signal(channel) for channel in model.channels]
    shots = model.shots(windows)
    y, measured = np.asarray(shots.y), np.asarray(shots.measured)
    states, controls, sensors = [], [], []
    for w in range(len(windows)):
        steps = int(windows.valid[w].sum())
        if not measured[w, : steps + 1].all():
            raise ValueError("the comparison with mujoco.sysid needs every channel in every row.")
        ctrl = np.repeat(windows.ctrl[w, :steps], substeps, axis=0)
        ctrl = np.concatenate([ctrl, ctrl[-1:]])  # the peer leaves out the last
        grid = np.concatenate([[0.0], np.cumsum(np.full(steps * substeps, h))])  # as the simulation adds time up
        even = np.linspace(0.0, math.nextafter(steps * substeps * h, 0.0), len(ctrl))  # not to be rounded up by a step
        states.append(sysid.create_initial_state(compiled, windows.qpos[w, 0], windows.qvel[w, 0]))
        controls.append(sysid.TimeSeries.from_control_names(even, ctrl, compiled))
        sensors.append(sysid.TimeSeries.from_names(grid[::substeps], y[w, : steps + 1], compiled, signals))
    names = [f"window {w}" for w in range(len(windows))]
    return sysid.ModelSequences("case", spec, names, states, controls, sensors, allow_missing_sensors=True)


def _signal(channel: str) -> tuple[str, Any]:
    """Joint and kind of a measured channel `joint/NAME/qpos` or `joint/NAME/qvel`."""
    kind, _, rest = channel.partition("/")
    name, _, word = rest.rpartition("/")
    if kind != "joint" or word not in SIGNALS:
        raise ValueError(f"{channel}: the comparison with mujoco.sysid is of joints' positions and velocities.")
    return name, SIGNALS[word]
