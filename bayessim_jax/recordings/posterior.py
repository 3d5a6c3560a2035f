"""`posterior.nc`: draws and observations as netCDF groups that xarray and ArviZ read, named and with units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from bayessim_jax.contracts import Box, Discrete
from bayessim_jax.recordings.files import replace_file
from bayessim_jax.recordings.history import History

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

__all__ = ["ENGINE", "Draws", "read_draws", "read_group", "read_history", "variable", "write_posterior"]

ENGINE = "h5netcdf"


def write_posterior(
    path: Path,
    history: History,
    parameters: Box,
    observations: Box,
    actions: Box | Discrete,
    prior: Float[np.ndarray, "draw d"],
    seeds: Sequence[int],
    truths: Float[np.ndarray, "seed d"],
    attributes: Mapping[str, Any],
) -> None:
    """Write the groups `prior`, `posterior` (last round), `posterior_rounds` and `observed_data` in one step.

    Draws have the dimensions (chain, draw), as ArviZ wants them, then `seed` where several seeds were run; a variable
    for each parameter, each sensor channel and each action channel, with its unit as an attribute; `base.x` holds the
    channel `base/x`. A parameter carries its prior's bounds and, where it is known, the truth (one for each seed).
    """
    several = len(seeds) > 1
    seed_dim = ("seed",) if several else ()
    coordinates = {"seed": list(seeds)} if several else {}
    rounds = np.arange(1, history.rounds + 1)
    squeeze = lambda x: x if several else x[:, 0]  # noqa: E731

    def named(x: np.ndarray, dims: tuple[str, ...], box: Box | Discrete, prefix: str = "") -> dict[str, Any]:
        units = zip(box.names, box.units, strict=True)
        return {
            variable(prefix + name): (dims, x[..., i], {"units": unit, "long_name": prefix + name})
            for i, (name, unit) in enumerate(units)
        }

    def marked(variables: dict[str, Any]) -> dict[str, Any]:
        low, high = np.asarray(parameters.low, float), np.asarray(parameters.high, float)
        for i, name in enumerate(variables):
            variables[name][2].update(prior_low=low[i], prior_high=high[i])
            if np.isfinite(truths).all():
                variables[name][2]["truth"] = squeeze(truths[None].astype(float))[0, ..., i]
        return variables

    draws = np.moveaxis(history.draws, 1, 2) if several else history.draws[:, 0]
    by_round = named(draws[:, None], ("round", "chain", "draw", *seed_dim), parameters)
    last = named(draws[-1][None], ("chain", "draw", *seed_dim), parameters)
    seen = named(squeeze(history.observations), ("round", *seed_dim, "recording", "row"), observations)
    seen |= named(squeeze(history.actions), ("round", *seed_dim, "recording", "step"), actions, "action_")
    seen["time"] = (("round", *seed_dim, "recording", "row"), squeeze(history.times), {"units": "s"})
    seen["reward"] = (("round", *seed_dim, "recording", "step"), squeeze(history.rewards), {"units": ""})
    seen["valid"] = (("round", *seed_dim, "recording", "step"), squeeze(history.valid).astype(np.int8), {"units": ""})
    groups = {
        "prior": xr.Dataset(marked(named(prior[None], ("chain", "draw"), parameters))),
        "posterior": xr.Dataset(marked(last), coordinates),
        "posterior_rounds": xr.Dataset(marked(by_round), coordinates | {"round": rounds}),
        "observed_data": xr.Dataset(seen, coordinates | {"round": rounds}),
    }
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=dict(attributes)), **groups})
    replace_file(path, lambda temporary: tree.to_netcdf(temporary, engine=ENGINE))


@dataclass(frozen=True)
class Draws:
    """The posterior of every round, as the file holds it."""

    draws: Float[np.ndarray, "round seed draw d"]
    names: list[str]
    units: list[str]
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]
    truths: Float[np.ndarray, "seed d"] | None


def read_draws(path: Path) -> Draws:
    """The group `posterior_rounds`; raises `ValueError` where the file is missing or damaged."""
    data = read_group(path, "posterior_rounds")
    variables = list(data.data_vars.values())
    draws = np.stack([v.values[:, 0] for v in variables], axis=-1)
    marks = [v.attrs for v in variables]
    known = all("truth" in mark for mark in marks)
    return Draws(
        draws=np.moveaxis(draws, 2, 1) if "seed" in data.dims else draws[:, None],
        names=[str(v.attrs.get("long_name", name)) for name, v in data.data_vars.items()],
        units=[mark["units"] for mark in marks],
        low=np.array([mark["prior_low"] for mark in marks]),
        high=np.array([mark["prior_high"] for mark in marks]),
        truths=np.stack([np.atleast_1d(mark["truth"]) for mark in marks], axis=-1) if known else None,
    )


def read_history(path: Path, observations: Box, actions: Box | Discrete) -> History:
    """Read back what `write_posterior` wrote; raises `ValueError` where the file is missing or damaged."""
    seen = read_group(path, "observed_data")
    widen = lambda x: x if "seed" in seen.dims else x[:, None]  # noqa: E731

    def stacked(names: Sequence[str], prefix: str = "") -> np.ndarray:
        return widen(np.stack([seen[variable(prefix + name)].values for name in names], axis=-1))

    return History(
        draws=read_draws(path).draws,
        times=widen(seen["time"].values),
        observations=stacked(observations.names),
        actions=stacked(actions.names, "action_"),
        rewards=widen(seen["reward"].values),
        valid=widen(seen["valid"].values.astype(bool)),
    )


def variable(name: str) -> str:
    """The name of a channel's variable, in which xarray allows no slash."""
    return name.replace("/", ".")


def read_group(path: Path, group: str) -> xr.Dataset:
    """One group of the file, in memory; raises `ValueError` where the file is missing or damaged."""
    try:
        with xr.open_dataset(path, group=group, engine=ENGINE) as data:
            return data.load()
    except (OSError, KeyError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{path} is missing or damaged ({reason}); restore it or start again with another --out."
        ) from error
