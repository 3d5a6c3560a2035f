"""The next experiment of a diagnosis that found several answers: a sentence, and a file of commands to play."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayessim_jax.diagnosis.bench import Bench
from bayessim_jax.diagnosis.experiment import Experiment, Motions, commands, design
from bayessim_jax.diagnosis.verdict import Diagnosis
from bayessim_jax.inference.replay import Restarted
from bayessim_jax.inference.shooting import Shots
from bayessim_jax.recordings.files import write_text
from bayessim_jax.recordings.shots import CaseModel

__all__ = ["advise", "next_experiment", "write_experiment"]

LENGTHS, LEAST, MOST = 4.0, 1.0, 8.0
"""Horizons that an experiment lasts, and s that it lasts at least and at most."""
MEMBERS = 4
"""Sets of a confusion set that an experiment is to separate, the most probable ones."""
HINTS = {
    frozenset({"actuator_delay", "sensor_delay"}): "a recording of the motor's current, or of another joint that "
    "feels it: from command and position of one joint alone the two delays cannot be told apart",
    frozenset({"actuator_bias", "sensor_offset"}): "the joint held at several known angles",
    frozenset({"viscous_friction", "back_emf"}): "motion with the motor off (open circuit)",
    frozenset(
        {"actuator_gain"}
    ): "what one of the actuators gives for a known command: a weaker one beside another is a "
    "stronger one beside that, with other parameters",
    frozenset({"actuator_gain", "armature"}): "a known load held still, and then fast motion",
}
"""What to measure where no command of the library helps."""


def next_experiment(model: CaseModel, bench: Bench, result: Diagnosis, shots: Shots) -> Experiment | None:
    """Design an experiment for a confusion set; None where there is none, or where no motion of the library helps."""
    if result.verdict != "ambiguous":
        return None
    ranked = sorted(zip(result.probabilities, result.confusion, strict=True), key=lambda item: -item[0])
    members = [entry for _, entry in ranked[:MEMBERS]]
    return design(bench, members, _library(model), shots, model.system.dt)


def _library(model: CaseModel) -> Motions:
    """Commands from where a recording began, and releases at rest where there are joints."""
    dt, layout = model.system.dt, model.case.layout
    rows = round(float(np.clip(LENGTHS * model.case.case.horizon, LEAST, MOST)) / dt)
    recorded = np.concatenate([r.ctrl for r in model.recordings])
    first = model.recordings[0]
    if isinstance(model.system, Restarted):
        names, signals = zip(*commands(recorded, layout.ctrl, rows, dt), strict=True)
        still = np.zeros((len(names), 0))
        return Motions(list(names), np.stack(signals), np.tile(first.sensors[0], (len(names), 1)), still)
    qpos, qvel = (np.concatenate([getattr(r, n) for r in model.recordings]) for n in ("qpos", "qvel"))
    library, starts = [], []
    for name, signal in commands(recorded, layout.ctrl, rows, dt):
        if signal.size and np.ptp(signal) > 0:
            library.append((name, signal))
            starts.append((first.qpos[0], first.qvel[0]))
            continue
        still = np.argsort(np.abs(qvel).sum(1))[: max(len(qvel) // 20, 1)]
        for row in _extremes(qpos[still]):
            at = ", ".join(f"{joint} = {qpos[still][row, q]:.2g}" for joint, q, _ in layout.single)
            library.append((f"{name}, let go at rest at {at}", signal))
            starts.append((qpos[still][row], np.zeros_like(qvel[0])))
    return Motions(
        [name for name, _ in library],
        np.stack([signal for _, signal in library]),
        *(np.stack([start[i] for start in starts]) for i in range(2)),
    )


def _extremes(qpos: Float[np.ndarray, "rows nq"]) -> list[int]:
    """Rows with the smallest and largest value of every position."""
    return sorted({int(row) for q in qpos.T for row in (np.argmin(q), np.argmax(q))})


def advise(result: Diagnosis, experiment: Experiment | None) -> str:
    """The same in a sentence; empty where nothing is to be told apart."""
    if result.verdict == "unexplained" and result.sooner is not None:
        return "look at when commands are recorded, and when they begin to act"
    if result.verdict != "ambiguous":
        return ""
    first, second = experiment.pair if experiment else (entry.names for entry in result.confusion[:2])
    between = f"it separates {' + '.join(first)} from {' + '.join(second)}"
    kinds = frozenset(name.partition("@")[0] for name in {*first} ^ {*second})
    if experiment is None:
        return f"{HINTS.get(kinds, 'larger and faster motion, and motion with the motors off')}: {between}"
    return (
        f"{experiment.name}, {len(experiment.ctrl) * experiment.dt:.2g} s (next_experiment.csv): {between} by about "
        f"{experiment.nats:.0f} nats"
    )


def write_experiment(path: Path, model: CaseModel, experiment: Experiment) -> None:
    """Write the commands as a recording without measurements: `time` and one column for each actuator."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["time", *model.case.layout.ctrl])
    for row, ctrl in enumerate(experiment.ctrl):
        table.writerow([f"{row * experiment.dt:.9g}", *(f"{value:.9g}" for value in ctrl)])
    write_text(path, text.getvalue())
