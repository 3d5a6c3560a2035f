"""What was found, as curves: what an effect exerts or lets through, over the state on which it depends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayessim_jax.diagnosis.belief import covariance_of
from bayessim_jax.effects.contract import Moment
from bayessim_jax.report.style import BLUE, GREY, draw_svg

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bayessim_jax.recordings.diagnosing import CaseDiagnosis

__all__ = ["laws_plot", "state_plot"]

OVER = {
    "viscous_friction": "velocity",
    "coulomb_friction": "velocity",
    "stribeck_friction": "velocity",
    "asymmetric_friction": "velocity",
    "load_dependent_friction": "velocity",
    "quadratic_drag": "velocity",
    "joint_spring": "position",
    "soft_stop": "position",
    "torque_ripple": "position",
    "disturbance_event": "time",
    "actuator_gain": "command",
    "actuator_bias": "command",
    "actuator_saturation": "command",
    "actuator_deadband": "command",
}
"""What the effects without a memory are curves over."""
POINTS, DRAWS, BINS = 201, 200, 24
COLUMNS = 3
"""Axes side by side."""
INSTANT = 1e-4
"""s: a time step in which what holds a joint acts with its level at every speed that is shown."""


def laws_plot(diagnosis: CaseDiagnosis) -> str:
    """A curve for every effect of the first set that has one, at its mean and from 5 % to 95 %; empty if none has."""
    bench, best = diagnosis.bench, diagnosis.result.best
    shown = [k for k in best.told if bench.pairs[k][0].name in OVER]
    if not shown:
        return ""
    draws = _draw(diagnosis)

    def draw(figure: Figure) -> None:
        for ax, k in zip(_grid(figure, len(shown)), shown, strict=True):
            effect, place = bench.pairs[k]
            x, unit = _axis(diagnosis, k)
            curves = _curves(diagnosis, k, {name: values[:, None] for name, values in draws[k].items()}, x)
            low, high = np.quantile(curves[1:], [0.05, 0.95], axis=0)
            ax.fill_between(x, low, high, color=BLUE, alpha=0.25, linewidth=0)
            ax.plot(x, curves[0], color=BLUE, linewidth=1.6)
            ax.axhline(0.0, color=GREY, linewidth=0.7)
            if OVER[effect.name] == "command":
                ax.plot(x, x, color=GREY, linewidth=1.0, linestyle=":")
            ax.set_xlabel(f"{OVER[effect.name]} [{unit}]" if unit else OVER[effect.name])
            through = OVER[effect.name] == "command"
            ax.set_ylabel("what arrives" if through else f"force [{bench.scales[place].force_unit}]")
            ax.set_title(f"{effect.name}\n{place}")

    return draw_svg(*_size(len(shown)), draw, "laws")


def _draw(diagnosis: CaseDiagnosis) -> dict[int, dict[str, Float[np.ndarray, " draws"]]]:
    """The numbers of every effect: the means first, then draws of their posterior."""
    bench, best = diagnosis.bench, diagnosis.result.best
    columns = bench.columns(best.candidate)
    mean = np.asarray(best.fit.z)[bench.d : bench.d + len(columns)]
    covariance = np.atleast_2d(covariance_of(bench, best))[bench.d :, bench.d :]
    z = np.random.default_rng(0).multivariate_normal(mean, covariance, DRAWS, method="eigh")
    every = np.concatenate([mean[None], z])
    found: dict[int, dict[str, Any]] = {}
    for k in best.candidate.effects:
        for i in range(bench.first[k], bench.first[k + 1]):
            values = [float(bench.each[i].value(x)) for x in every[:, columns.index(i)].tolist()]
            found.setdefault(k, {})[bench.parameters[i].name] = np.array(values)
    return found


def _axis(diagnosis: CaseDiagnosis, k: int) -> tuple[Float[np.ndarray, " points"], str]:
    """As far as was recorded, and the unit."""
    effect, place = diagnosis.bench.pairs[k]
    scales = diagnosis.bench.scales[place]
    ends, unit = {
        "velocity": ((-scales.speed, scales.speed), f"{scales.unit}/s"),
        "position": ((scales.centre - scales.position, scales.centre + scales.position), scales.unit),
        "time": ((0.0, scales.duration), "s"),
        "command": ((-scales.command, scales.command), ""),
    }[OVER[effect.name]]
    return np.linspace(*ends, POINTS), unit


def _curves(
    diagnosis: CaseDiagnosis,
    k: int,
    values: Mapping[str, Float[np.ndarray, "draws 1"]],
    x: Float[np.ndarray, " points"],
) -> Float[np.ndarray, "draws points"]:
    """The effect's own law, for a joint that is in the middle of its motion but for what the curve is over."""
    effect, place = diagnosis.bench.pairs[k]
    scales, over = diagnosis.bench.scales[place], OVER[effect.name]
    state: dict[str, Any] = {
        "time": jnp.zeros(()),
        "h": INSTANT,
        "position": scales.centre,
        "inertia": scales.inertia,
        "drive": 0.5 * scales.force,
        "detail": place.partition("#")[2],
    }

    @jax.jit  # one program, not one for every operation
    def law(values: Mapping[str, Array], x: Array) -> Array:
        if over == "command":
            return effect.command(values, (), x, Moment(**state))[0]
        at: dict[str, Any] = {**state, over: x}
        return effect.force(values, (), Moment(**at))[0]

    found = law(dict(values), jnp.asarray(x))
    return np.broadcast_to(np.asarray(found), (DRAWS + 1, len(x)))


def state_plot(forces: Mapping[str, tuple[np.ndarray, ...]], units: Mapping[str, tuple[str, str]]) -> str:
    """How large a force without a name is over position and velocity, for every joint; `units` of joints and forces."""

    def draw(figure: Figure) -> None:
        for ax, (place, (force, position, velocity, *_)) in zip(
            _grid(figure, len(forces)), forces.items(), strict=True
        ):
            known = np.isfinite(force) & np.isfinite(position) & np.isfinite(velocity)
            columns = position[known], velocity[known]
            counts, *edges = np.histogram2d(*columns, bins=BINS)
            total = np.histogram2d(*columns, bins=edges, weights=np.abs(force[known]))[0]
            with np.errstate(invalid="ignore"):
                mean = np.where(counts > 0, total / counts, np.nan)
            unit, force_unit = units[place]
            image = ax.pcolormesh(edges[0], edges[1], mean.T, cmap="magma_r", vmin=0.0)
            figure.colorbar(image, ax=ax, label=f"force [{force_unit}]")
            ax.set_xlabel(f"position [{unit}]")
            ax.set_ylabel(f"velocity [{unit}/s]")
            ax.set_title(place)

    return draw_svg(*_size(len(forces)), draw, "state")


def _size(count: int) -> tuple[float, float]:
    """Inches of a figure with so many axes."""
    return 4.2 * min(count, COLUMNS), 3.2 * -(-count // COLUMNS)


def _grid(figure: Figure, count: int) -> list[Axes]:
    """So many axes of a figure, row by row."""
    columns = min(count, COLUMNS)
    return [figure.add_subplot(-(-count // columns), columns, k + 1) for k in range(count)]
