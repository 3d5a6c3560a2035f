"""The simulator that a diagnosis ended with, and what is known of it, out of the diagnosis' run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayessim_jax.contracts import Box
from bayessim_jax.effects.places import at
from bayessim_jax.recordings.evaluation import STATE, read_table, simulator_of
from bayessim_jax.recordings.loading import load_case
from bayessim_jax.recordings.repaired_system import RepairedSystem, Starts
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.recordings.shots import CaseModel, case_model
from bayessim_jax.spelling import near_miss
from bayessim_jax.systems import Hold

__all__ = ["Repaired", "load_repaired"]

REACH = 3.0
"""Standard deviations to either side of the mean that θ' may lie off."""
NARROWEST = 1e-3
"""Of a parameter's range: the box is never narrower to either side, which float32 would not bear."""
PERIOD = 0.02
"""s: the control period is the shortest multiple of the recordings' rows that is at least as long."""
SCATTER = 0.1
"""Of how far the recordings move: episodes begin so far beside a recorded state."""
STILL = 0.01
"""m, rad, or per s: what moved less than this in the recordings is judged as if it had moved so far."""
FAST = 0.95
"""Share of the recorded rows that were no faster than what counts as fast."""


@dataclass(frozen=True, eq=False)
class Repaired:
    """A diagnosis' simulator: with the effects that it named, or as it was where it named none."""

    name: str
    """Of the case."""
    verdict: str
    others: tuple[str, ...]
    """Other sets of effects that the recordings could not tell from those of the simulator."""
    model: CaseModel
    simulator: Any
    mean: Float[np.ndarray, " d"]
    """θ' of the diagnosis' posterior: the case's parameters, then those of the effects."""
    sd: Float[np.ndarray, " d"]
    noise: Float[np.ndarray, " obs"]
    """Standard deviation of the sensors' noise, in each channel's unit."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Of the simulator, such as `coulomb_friction@joint/hinge`."""
        return tuple(f"{w.effect.name}@{at(w.place)}" for w in getattr(self.simulator, "effects", ()))

    def posterior_box(self) -> Box:
        """The posterior's mean ± 3 standard deviations, cut to the priors' and the effects' ranges."""
        box = self.simulator.parameters
        low, high = np.asarray(box.low, float), np.asarray(box.high, float)
        least = NARROWEST * (high - low)
        mean = np.clip(self.mean, low + least, high - least)
        half = np.where(np.isfinite(self.sd), np.maximum(REACH * self.sd, least), high - low)
        bounds = np.maximum(mean - half, low).tolist(), np.minimum(mean + half, high).tolist()
        return Box.create(**dict(zip(box.names, zip(*bounds, box.units, strict=True), strict=True)))

    def system(self, *, noise: float = 0.0, **prior: tuple[float, float]) -> RepairedSystem:
        """The simulator as a system: θ' in the posterior's box, or in `prior` where that names a parameter.

        `noise` is added to that of the sensors, in each channel's unit.
        """
        box, shots = self.posterior_box(), self._shots
        axes = zip(box.names, box.low.tolist(), box.high.tolist(), box.units, strict=True)
        rows = max(int(np.ceil(PERIOD / self.simulator.dt * (1 - 1e-3))), 1)
        return RepairedSystem(
            parameters=Box.create(**{name: (*prior.get(name, (a, b)), unit) for name, a, b, unit in axes}),
            actions=self.actions,
            observations=self._observations(),
            noise=jnp.asarray(np.hypot(self.noise, noise), float),
            simulator=self.simulator,
            starts=Starts(shots.inputs.qpos, shots.inputs.qvel, shots.inputs.ctrl[:, 0], shots.inputs.time),
            scatter=SCATTER * shots.spread,
            rows=rows,
            dt=rows * self.simulator.dt,
        )

    def task(self, goal: Mapping[str, float]) -> Hold:
        """Hold each `joint/NAME` at its goal, or at the median of the positions recorded of it.

        Raises `ValueError` for a joint that the model does not have, and for a goal that its range forbids.
        """
        layout, names = self.model.case.layout, self.joints
        for name in goal:
            if name not in names:
                raise ValueError(f"goal: unknown joint {name!r}: {near_miss(name, names)}")
        places, rates = [q for _, q, _ in layout.single], [v for _, _, v in layout.single]
        low, high = self._span("qpos", places)
        usual = np.median(np.concatenate([r.qpos[:, places] for r in self.model.recordings]), axis=0)
        asked = np.array([goal.get(name, q) for name, q in zip(names, usual, strict=True)])
        assert layout.joint_range is not None
        least, most = layout.joint_range[places].T
        for k, name in enumerate(names):
            if not np.isfinite(asked[k]):
                raise ValueError(f"goal {name}={asked[k]:g} is not a pose; give a number.")
            if asked[k] < least[k] or asked[k] > most[k]:
                span = f"{least[k]:g} to {most[k]:g}"
                raise ValueError(f"goal {name}={asked[k]:g} lies outside the joint's range, {span}.")
        turns = np.array([(q, v) in layout.hinges for _, q, v in layout.single]) & np.isnan(least)
        speeds = np.abs(np.concatenate([r.qvel[:, rates] for r in self.model.recordings]))
        far = np.where(turns, np.minimum(high - low, 2 * np.pi), high - low)
        return Hold(
            system=self.simulator,
            actions=self.actions,
            goal=jnp.asarray(asked, float),
            far=jnp.asarray(np.maximum(far, STILL), float),
            fast=jnp.asarray(np.maximum(np.quantile(speeds, FAST, axis=0), STILL), float),
            places=tuple(places),
            rates=tuple(rates),
            turns=tuple(turns.tolist()),
        )

    @property
    def joints(self) -> list[str]:
        """The slides and hinges, `joint/NAME`."""
        return [f"joint/{name}" for name, _, _ in self.model.case.layout.single]

    @cached_property
    def actions(self) -> Box:
        """The actuators' ranges in the model; of one that has none, the range of its recorded commands."""
        layout, box = self.model.case.layout, self.simulator.actions
        assert layout.ctrl_range is not None
        low, high = self._span("ctrl", range(box.size))
        limits = np.where(np.isnan(layout.ctrl_range), np.stack([low, high], 1), layout.ctrl_range)
        for name, (a, b) in zip(layout.ctrl, limits, strict=True):
            if not a < b:
                raise ValueError(
                    f"{name} has no range in the model and one value in all recordings: set its ctrlrange."
                )
        axes = zip(box.names, limits.tolist(), box.units, strict=True)
        return Box.create(**{name: (a, b, unit) for name, (a, b), unit in axes})

    def sentences(self, task: Hold) -> tuple[str, ...]:
        """What is trained on, and for what, for a person to read."""
        named, what = " and ".join(self.effects), f"the simulator of {self.name}"
        if self.verdict == "ambiguous":
            first = f"{what} with {named}; its recordings cannot tell this from {' or '.join(self.others)}"
        elif named:
            first = f"{what} with {named}"
        else:
            lacks = {
                "no_mismatch": "nothing that its recordings show",
                "unexplained": "something that no effect explains",
            }
            first = f"{what} as it is, for its verdict is {self.verdict}: it lacks {lacks[self.verdict]}"
        units, goals = self.model.case.layout.units, task.goal.tolist()
        poses = [f"{j} at {g:.4g} {units[j + '/qpos']}" for j, g in zip(self.joints, goals, strict=True)]
        told = [first, f"goal: {', '.join(poses)}"]
        for name, g, turns, a, b in zip(self.joints, goals, task.turns, *self._span("qpos", task.places), strict=True):
            if not (turns or a <= g <= b):
                told.append(f"goal {name} lies outside of the recorded positions, {a:.4g} to {b:.4g}")
        return tuple(told)

    @cached_property
    def _shots(self) -> Any:
        """Every window of the recordings."""
        return self.model.shots(self.model.windows(range(len(self.model.recordings))))

    def _span(self, name: str, columns: Any) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest recorded value."""
        rows = np.concatenate([getattr(r, name) for r in self.model.recordings])[:, list(columns)]
        return rows.min(0), rows.max(0)

    def _observations(self) -> Box:
        """The channels with the range of what was measured, by which networks scale them."""
        box, shots = self.simulator.observations, self._shots
        y, measured = np.asarray(shots.y, float), np.asarray(shots.measured)
        low, high = (f(np.where(measured, y, fill), axis=(0, 1)) for f, fill in ((np.min, np.inf), (np.max, -np.inf)))
        middle, half = (low + high) / 2, np.maximum((high - low) / 2, STILL)
        bounds = (middle - half).tolist(), (middle + half).tolist()
        return Box.create(**dict(zip(box.names, zip(*bounds, box.units, strict=True), strict=True)))


def load_repaired(path: Path) -> Repaired:
    """Read what `bayessim diagnose` left in a folder, and make its simulator of the case again.

    Raises `ValueError` where the folder is no such run, where it or its case is damaged, and where there is nothing to
    train: a registered system, no actuator, no slide or hinge, no parameter.
    """
    folder = RunFolder.open(path)
    config = folder.read_config()
    if config.get("command") != "diagnose":
        other = config.get("command", "online")
        raise ValueError(f"{path} holds a run of bayessim {other}; give a folder that bayessim diagnose wrote.")
    table, state = (read_table(folder.path / name) for name in ("diagnosis.json", STATE))
    try:
        case = load_case(Path(config["case"]), mask=True).check()
        if case.model is None:
            name = case.case.system
            raise ValueError(f"{path} is of the registered system {name}; train on that: bayessim online {name}.")
        verdict = str(table["verdict"])
        which = "augmented" if verdict in ("explained", "ambiguous") else "baseline"
        # a controller may bring together what never touched in the recordings, or a joint to its limits
        model = case_model(case, engine=str(config["engine"]), refined=int(state["refined"]), whole=True)
        simulator, mean = simulator_of(model, state, which)
        sds = [entry[which]["sd"] for entry in table["parameters"].values()]
        sds += [p["sd"] for effect in table["effects"] for p in effect["parameters"].values()]
        noise = np.asarray(state["simulators"][which]["noise"], float)
        fits = list(model.channels) == state["channels"] and len(sds) == len(mean) == simulator.parameters.size
        if not fits:
            raise ValueError(f"{path} does not fit its case any more; run bayessim diagnose again.")
        others = tuple(" and ".join(names) for names in table["confusion_set"][1:])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} lacks {error}, as of an earlier version; run bayessim diagnose again.") from error
    lacks = {"actuator": simulator.actions.size, "slide or hinge": len(model.case.layout.single), "parameter": len(sds)}
    for what, count in lacks.items():
        if not count:
            raise ValueError(f"{path}: there is nothing to train, for its simulator has no {what}.")
    sd = np.array([np.nan if x is None else x for x in sds], float)
    return Repaired(str(table["case"]), verdict, others, model, simulator, np.asarray(mean, float), sd, noise)
