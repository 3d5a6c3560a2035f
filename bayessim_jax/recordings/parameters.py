"""The unknowns of a case, checked against the model that they are in."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.recordings.case import FILE, ParameterSpec
from bayessim_jax.recordings.paths import Field, Target, find_target, nominal
from bayessim_jax.recordings.priors import LogNormal, Normal, Prior
from bayessim_jax.recordings.wording import Finding, hint, quote

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Parameter", "resolve_parameters"]

OUTSIDE = 0.1
"""Share of a normal prior that may lie outside of the physical range and is cut off, before it is refused."""


@dataclass(frozen=True)
class Parameter:
    """An unknown with its place in the model. `nominal` is the model's own value, None where targets differ."""

    name: str
    unit: str
    prior: Prior
    targets: tuple[Target, ...] | tuple[str, ...]
    """Places in an MJCF, or the name of a registered system's parameter."""
    nominal: float | None = None


def resolve_parameters(
    specs: Sequence[ParameterSpec], model: Any, names: Sequence[str] = ()
) -> tuple[tuple[Parameter, ...], list[Finding]]:
    """Find every target in a compiled model, or among the `names` of a registered system's parameters."""
    parameters, found = [], []
    for spec in specs:
        targets: list[Any] = []
        for path in spec.targets:
            try:
                targets.append(_system_target(path, names) if model is None else find_target(path, model))
            except ValueError as error:
                what, _, remedy = str(error).partition("; ")
                found.append(Finding("error", FILE, f"parameter {spec.name}: {what}", remedy))
        if len(targets) < len(spec.targets):
            continue
        if model is None:
            parameters.append(Parameter(spec.name, spec.unit, spec.prior, tuple(targets)))
            continue
        prior, more = _physical(spec, targets)
        values = {nominal(target, model) for target in targets}
        value = values.pop() if len(values) == 1 else None
        found += more + _believable(spec, prior, value)
        unit = spec.unit or targets[0].about.unit
        parameters.append(Parameter(spec.name, unit, prior, tuple(targets), value))
    return tuple(parameters), found


def _system_target(path: str, names: Sequence[str]) -> str:
    if path not in names:
        raise ValueError(f"unknown path {quote(path)}; {hint(path, names)}")
    return path


def _physical(spec: ParameterSpec, targets: Sequence[Target]) -> tuple[Prior, list[Finding]]:
    """The prior within what is physically possible, or an error where too much of it lies outside."""
    prior, found = spec.prior, []
    for target in targets:
        about = target.about
        if target.field == "ctrlrange" and target.index is None:
            about = dataclasses.replace(about, low=0.0, open_low=True)
        if not _below(prior, about):
            continue
        bound = f"{'above' if about.open_low else 'at least'} {about.low:g}"
        what = f"parameter {spec.name}: the prior reaches down to {prior.low:g}, but {target} has to be {bound}"
        if isinstance(prior, Normal) and np.isneginf(prior.low):
            share = prior.probability_below(about.low)
            below = f"{share:.2g} of the prior lies below {about.low:g}"
            what = f"parameter {spec.name}: {below}, but {target} has to be {bound}"
            if share <= OUTSIDE:
                prior = dataclasses.replace(prior, low=about.low + about.open_low * 1e-3 * prior.loc)
                found.append(Finding("warning", FILE, what, f"it is cut off at {prior.low:g}"))
                continue
            found.append(Finding("error", FILE, what, "use a lognormal or truncated normal prior"))
        else:
            found.append(Finding("error", FILE, what, "raise 'low'"))
    return prior, found


def _below(prior: Prior, about: Field) -> bool:
    if isinstance(prior, LogNormal):
        return False
    return prior.low < about.low or (about.open_low and prior.low <= about.low)


def _believable(spec: ParameterSpec, prior: Prior, value: float | None) -> list[Finding]:
    if value is None or prior.low <= value <= prior.high:
        return []
    what = f"parameter {spec.name}: the model's own value {value:g} lies outside of the prior ({prior})"
    return [Finding("suspicion", FILE, what, f"check the unit of the prior of {spec.name} and the model")]
