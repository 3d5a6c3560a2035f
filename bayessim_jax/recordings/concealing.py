"""`conceal`: a case whose recordings come from a machine with something in it that its model lacks."""

from __future__ import annotations

import copy
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.optimize import least_squares

from bayessim_jax.concealment import (
    KINDS,
    ModelLaw,
    RunawayError,
    StillError,
    choose_place,
    hide,
    lookup_law,
    make_scene,
)
from bayessim_jax.recordings.augment import write_values
from bayessim_jax.recordings.case import FILE, SCHEMA
from bayessim_jax.recordings.files import to_json, write_text
from bayessim_jax.recordings.layout import HINGE, SLIDE, Layout, layout_of_model
from bayessim_jax.recordings.naming import read_named
from bayessim_jax.recordings.paths import Target, find_target, nominal
from bayessim_jax.recordings.starter import candidates, copy_model, label_target, parameter_text, toml_string
from bayessim_jax.recordings.wording import CaseError
from bayessim_jax.spelling import near_miss

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from pathlib import Path

    from bayessim_jax.concealment import Hidden, Scene, Track

__all__ = ["NOTHING", "SEALED", "AbsorbedError", "conceal"]

SEALED = "sealed.json"
"""The file of a case that says what is concealed in it; nothing that diagnoses reads it."""
NOISE = {HINGE: 1e-3, SLIDE: 2e-4}
"""Standard deviation of the noise of positions, rad and m; of velocities ten times as much for a second."""
TRIES, FEW = 20, 400
"""Steps, at most, in which the parameters are sought that make up for most of what is concealed, and rows looked at."""
DRAWS = 50
"""Places that are drawn, at most, until one is found that something moves."""
NOTHING = 0.01
"""Strength, below which what a model lacks is nothing."""
MIDDLE = 0.7
"""Hidden parameters lie in this much of their prior, in the middle."""
HEAD = """\
# Recordings of a simulated machine; what may be concealed in it is sealed in {sealed}.
schema = {schema}
name = {name}
model = {model}
recordings = "recordings/*.csv"
horizon = {horizon:g}
"""


class AbsorbedError(ValueError):
    """An effect that changes nothing but what is unknown: the model with other values lacks nothing."""


def conceal(
    folder: Path,
    model: Path,
    effect: str | Sequence[str] | None = None,
    *,
    at: str | Sequence[str | None] | None = None,
    strength: float | Sequence[float] = 0.3,
    parameters: Sequence[str] | None = None,
    motions: str = "mixed",
    recordings: int = 6,
    seconds: float = 4.0,
    rate: float | None = None,
    noise: float = 1.0,
    velocities: bool = True,
    quantize: float | None = None,
    jitter: float = 0.0,
    horizon: float = 0.5,
    seed: int = 0,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Write a case in which effects are concealed (none: a clean one), and return what is sealed in it.

    `strength` is the root mean square of the force that the model lacks over that of what motors and gravity exert on
    the same joint; `at` a place, without it one that is drawn. Unknown are the `parameters` (paths to numbers of the
    model; by default the masses of what moves, or centres of mass where no motor drives anything), with values drawn
    from the middle of wide priors. A row is measured `rate` times a second (every other time step), with `noise` times
    1e-3 rad or 2e-4 m on positions, positions rounded to `quantize` counts for a turn or a metre, times scattered by
    `jitter` times the distance of rows. What has no name in the model gets one in the case (`read_named`), which `say`
    is told.

    Raises `ValueError` with one line for what cannot be done; then nothing is written.
    """
    names = [] if effect is None else [effect] if isinstance(effect, str) else list(effect)
    places, strengths = _each(at, len(names), "at"), _each(strength, len(names), "strength")
    for name in names:
        lookup_law(name)
    _check(motions, recordings, seconds, horizon, noise, quantize, jitter, strengths)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaseError(str(folder), "is there already", "choose another folder, or remove it")
    with read_named(model, model.parent) as (model, spec, believed, told):
        if told:
            say(told)
        layout = layout_of_model(believed)
        _check_model(believed, layout, model)
        stride = _stride(rate, float(believed.opt.timestep))
        rng = np.random.default_rng(seed)
        priors = _priors(believed, parameters)
        truth = {
            t: float(low + (high - low) * (0.5 + MIDDLE * rng.uniform(-0.5, 0.5))) for t, (low, high) in priors.items()
        }
        machine = _machine(spec, truth)
        try:
            scene = make_scene(
                machine, rng, kind=motions, recordings=recordings, seconds=seconds, stride=stride, jitter=jitter
            )
            hidden = [_hide(scene, *one, rng, seed) for one in zip(names, places, strengths, strict=True)]
            _check_hidden(spec, machine, hidden, truth)
            tracks = scene.play([h.law for h in hidden]) if hidden else scene.clean
            lacks = _lacks(spec, priors, truth, scene, tracks) if hidden else {"with_truth": 0.0, "with_best": 0.0}
        except RunawayError as error:
            raise ValueError(f"{model.name}: {error}; choose other motions, or less strength.") from error
        taken: set[str] = set()
        labels = {target: label_target(target, taken) for target in priors}
        sealed = {
            "schema": SCHEMA,
            "effects": [_describe(machine, h, asked) for h, asked in zip(hidden, strengths, strict=True)],
            "lacks": lacks,
            "parameters": {labels[target]: value for target, value in truth.items()},
            "motions": motions,
            "noise": noise,
            "velocities": velocities,
            "quantize": quantize,
            "jitter": jitter,
            "seed": seed,
        }
        file = copy_model(folder, model)
        about = {"name": toml_string(folder.resolve().name), "model": toml_string(file)}
        text = HEAD.format(sealed=SEALED, schema=SCHEMA, horizon=horizon, **about)
        for target, (low, high) in priors.items():
            text += "\n" + parameter_text(target, labels[target], low, high, believed, layout)
        try:
            for k, track in enumerate(tracks):
                header, table = _measure(layout, track, rng, noise, velocities, quantize)
                path = folder / "recordings" / f"run{k + 1:0{len(str(recordings))}d}.csv"
                np.savetxt(path, table, delimiter=",", header=",".join(header), comments="", fmt="%.9g")
            write_text(folder / SEALED, to_json(sealed, indent=2) + "\n")
            write_text(folder / FILE, text)
        except OSError as error:
            raise CaseError(str(folder), f"cannot be written ({error.strerror})", "choose another folder") from error
    return sealed


def _each(value: Any, count: int, name: str) -> list[Any]:
    """One value for each effect."""
    if value is None or isinstance(value, (str, float, int)):
        return [value] * count
    if len(value) != count:
        raise ValueError(f"{name} has {len(value)} values for {count} effects; give one for each, or one for all.")
    return list(value)


def _check(
    motions: str,
    recordings: int,
    seconds: float,
    horizon: float,
    noise: float,
    quantize: float | None,
    jitter: float,
    strengths: Sequence[float],
) -> None:
    if motions not in KINDS:
        raise ValueError(f"unknown motions {motions!r}: {near_miss(motions, KINDS)}")
    wrong = {
        f"recordings is {recordings}; give 1 or more.": recordings < 1,
        f"seconds is {seconds:g}; give more than the horizon of {horizon:g} s.": not horizon < seconds < np.inf,
        f"horizon is {horizon:g}; give a time above 0 s.": not horizon > 0,
        f"noise is {noise:g}; give 0 or more.": not 0 <= noise < np.inf,
        f"quantize is {quantize}; give the counts for a turn or a metre.": quantize is not None and not quantize > 0,
        f"jitter is {jitter:g}; give 0 to 0.5 of the distance of rows.": not 0 <= jitter <= 0.5,
    } | {f"strength is {s:g}; give a ratio of forces above 0.": not 0 < s < np.inf for s in strengths}
    for told, is_wrong in wrong.items():
        if is_wrong:
            raise ValueError(told)


def _check_model(model: Any, layout: Layout, path: Path) -> None:
    if layout.unnamed:
        raise CaseError(path.name, f"{layout.unnamed[0]} has no name", "name it, so that recordings can refer to it")
    if not any(kind in NOISE for _, kind, _, _ in layout.joints):
        raise CaseError(path.name, "has no hinge and no slide", "choose a model that has some")


def _stride(rate: float | None, h: float) -> int:
    """Time steps of the model between rows."""
    stride = 2 if rate is None else round(1.0 / (rate * h)) if 0 < rate < np.inf else 0
    if stride < 1:
        raise ValueError(f"rate is {rate:g}; give what the model's time step of {h:g} s allows, up to {1 / h:g} Hz.")
    return stride


def _priors(model: Any, parameters: Sequence[str] | None) -> dict[Target, tuple[float, float]]:
    """What is unknown, and its range."""
    every = {target: (low, high) for target, low, high, _ in candidates(model)}
    if parameters is None:
        what = "mass" if model.nu else "ipos"
        return {target: ends for target, ends in every.items() if target.field == what}
    chosen = [find_target(path, model) for path in parameters]
    for target in chosen:
        if target not in every:
            told = near_miss(str(target), [str(t) for t in every])
            raise ValueError(f"parameter {str(target)!r}: it has no range to be drawn from; {told}")
    return {target: every[target] for target in chosen}


def _hide(scene: Scene, name: str, place: str | None, strength: float, rng: np.random.Generator, seed: int) -> Hidden:
    """An effect at a place, or at one that is drawn from those that something moves."""
    draw = lambda: hide(scene, name, choose_place(scene.model, name, place, rng), strength, seed)  # noqa: E731
    for _ in range(DRAWS - 1 if place is None else 0):
        with suppress(StillError):
            return draw()
    return draw()


def _check_hidden(spec: Any, machine: Any, hidden: Sequence[Hidden], unknown: Collection[Target]) -> None:
    """Raise `AbsorbedError` where one of the effects is the model with other values of what is unknown."""
    for one in hidden:
        if not isinstance(one.law, ModelLaw):
            continue
        edited = copy.copy(machine)
        one.law.edit(edited)
        other = write_values(spec.copy(), {target: nominal(target, edited) for target in unknown})
        for model in (edited, other):
            mujoco.mj_setConst(model, mujoco.MjData(model))
        if _are_alike(edited, other) and _are_alike(edited.opt, other.opt):
            told = ", ".join(map(str, unknown))
            raise AbsorbedError(
                f"effect {one.name!r} at {one.law.spot.place!r}: it only moves {told}, unknown in the case; "
                "choose another place, or other parameters."
            )


def _lacks(
    spec: Any,
    priors: dict[Target, tuple[float, float]],
    truth: dict[Target, float],
    scene: Scene,
    tracks: Sequence[Track],
) -> dict[str, float]:
    """What the model lacks at the joint where it is most: with the true parameters, and with those that leave least.

    As a ratio of forces, like a strength; the other parameters lie in their ranges. Where they leave nothing, no
    recording of these motions tells the effect from other values of what is unknown.
    """
    low, high = np.array(list(priors.values())).reshape(-1, 2).T

    def model(share: np.ndarray) -> Any:
        return _machine(spec.copy(), dict(zip(priors, (low + share * (high - low)).tolist(), strict=True)))

    def lack(share: np.ndarray) -> np.ndarray:
        return scene.lack(model(share), tracks, FEW).ravel()

    def size(share: np.ndarray) -> float:
        missing = scene.lack(model(share), tracks)
        return round(float(np.sqrt(np.mean(missing**2, axis=0)).max(initial=0.0)), 6)

    begun = (np.array([truth[target] for target in priors]) - low) / (high - low)
    found = least_squares(lack, begun, bounds=(0.0, 1.0), max_nfev=TRIES).x if priors else begun
    return {"with_truth": size(begun), "with_best": size(found)}


def _are_alike(one: Any, other: Any) -> bool:
    """Whether all arrays of real numbers are the same."""
    named = ((getattr(one, name), getattr(other, name)) for name in dir(one) if not name.startswith("_"))
    arrays = (pair for pair in named if isinstance(pair[0], np.ndarray) and pair[0].dtype.kind == "f")
    return all(np.allclose(*pair, rtol=1e-9, atol=1e-12) for pair in arrays)


def _machine(spec: Any, truth: dict[Target, float]) -> Any:
    """The model with the true parameters, its bodies free to get other masses."""
    write_values(spec, truth)
    for body in spec.bodies[1:]:
        body.simple = 0
    return spec.compile()


def _measure(
    layout: Layout, track: Track, rng: np.random.Generator, noise: float, velocities: bool, quantize: float | None
) -> tuple[list[str], np.ndarray]:
    """Header and rows of a recording."""
    spread = np.zeros(track.qpos.shape[1]), np.zeros(track.qvel.shape[1])
    turn = np.ones(track.qpos.shape[1])
    for _, kind, q, v in layout.joints:
        if kind in NOISE:
            spread[0][q], spread[1][v] = noise * NOISE[kind], 10 * noise * NOISE[kind]
            turn[q] = 2 * np.pi if kind == HINGE else 1.0
    shown, moving = (x[track.rows] for x in (track.shown, track.qvel))
    qpos = shown + spread[0] * rng.standard_normal(shown.shape)
    qvel = moving + spread[1] * rng.standard_normal(moving.shape)
    if quantize is not None:
        counts = np.array([q for _, kind, q, _ in layout.joints if kind in NOISE])
        step = turn[counts] / quantize
        qpos[:, counts] = np.round(qpos[:, counts] / step) * step
    header = ["time", *layout.qpos, *(layout.qvel if velocities else ()), *layout.ctrl]
    return header, np.column_stack([track.time[track.rows], qpos, *([qvel] if velocities else []), track.ctrl])


def _describe(model: Any, hidden: Hidden, asked: float) -> dict[str, Any]:
    """What is sealed of one effect."""
    spot = hidden.law.spot
    return {
        "effect": hidden.name,
        "at": spot.place,
        "joint": f"joint/{model.joint(spot.joint).name}" if spot.joint >= 0 else None,
        "strength": {"asked": asked, "measured": round(hidden.strength, 4)},
        "parameters": hidden.law.parameters(),
    }
