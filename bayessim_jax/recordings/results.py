"""What an inference on a case leaves behind: `inference.json`, `posterior.nc`, the model with the posterior's mean."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from bayessim_jax import __version__
from bayessim_jax.diagnosis.belief import covariance_of
from bayessim_jax.effects import write_mjcf
from bayessim_jax.recordings.evaluation import write_state
from bayessim_jax.recordings.experiments import write_experiment
from bayessim_jax.recordings.files import replace_file, to_json, write_text
from bayessim_jax.recordings.loading import LoadedCase, load_case
from bayessim_jax.recordings.mjcf import referenced_files
from bayessim_jax.recordings.posterior import ENGINE, read_group, variable
from bayessim_jax.recordings.run_folder import RunFolder

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bayessim_jax.recordings.diagnosing import CaseDiagnosis
    from bayessim_jax.recordings.identification import CaseInference

__all__ = ["sample_models", "write_diagnosis", "write_inference", "write_model"]

PRIOR_DRAWS = 2000


def write_inference(folder: RunFolder, result: CaseInference, seed: int) -> None:
    """Write everything but the report into a run folder."""
    write_text(folder.path / "inference.json", to_json(result.table(), indent=2) + "\n")
    _write_posterior(folder.path / "posterior.nc", result, seed)
    means = dict(zip(result.model.margins.names, np.asarray(result.posterior.draws).mean(0).tolist(), strict=True))
    if result.model.case.model is not None:
        write_model(folder.path / "model_posterior.xml", result.model.case, means)


def write_model(
    path: Path,
    case: LoadedCase,
    values: Mapping[str, float],
    effects: Sequence[tuple[Any, str, Mapping[str, float]]] = (),
) -> bool:
    """Write a case's model with values and effects put in, and the files that it refers to beside it.

    Nothing is written, and False returned, where MJCF cannot say one of the effects.
    """
    spec, _ = case.augmented(values)
    if not all(write_mjcf(spec, effect, place, own) for effect, place, own in effects):
        return False
    source = case.case.folder / case.case.model
    for file in referenced_files(source, case.case.folder):
        if file.suffix.lower() not in (".xml", ".mjcf"):
            place = path.parent / file.resolve().relative_to(source.parent.resolve())
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)
    write_text(path, spec.to_xml())
    return True


def write_diagnosis(folder: RunFolder, diagnosis: CaseDiagnosis, seed: int) -> None:
    """Write `diagnosis.json`, `posterior.nc`, `simulators.json` and, where MJCF can say it, `model_augmented.xml`.

    `next_experiment.csv` too, where one would tell the members of the confusion set apart.
    """
    write_text(folder.path / "diagnosis.json", to_json(diagnosis.table(), indent=2) + "\n")
    write_state(folder, diagnosis)
    if diagnosis.experiment is not None:
        write_experiment(folder.path / "next_experiment.csv", diagnosis.model, diagnosis.experiment)
    _write_laplace(folder.path / "posterior.nc", diagnosis, seed)
    theta, _ = diagnosis.theta["augmented"]
    values = dict(zip(diagnosis.model.margins.names, theta.tolist(), strict=True))
    if diagnosis.result.verdict != "unexplained" and diagnosis.model.case.model is not None:
        effects = _found(diagnosis) if diagnosis.result.confusion else []
        write_model(folder.path / "model_augmented.xml", diagnosis.model.case, values, effects)


def _found(diagnosis: CaseDiagnosis) -> list[tuple[Any, str, dict[str, float]]]:
    """The effects of a diagnosis with their parameters' means."""
    bench, entry = diagnosis.bench, diagnosis.result.best
    values = iter(bench.values(entry.candidate, entry.fit.z).values())
    found = []
    for k in entry.candidate.effects:
        effect, place = bench.pairs[k]
        names = [p.name for p in bench.parameters[bench.first[k] : bench.first[k + 1]]]
        found.append((effect, place, {name: next(values) for name in names}))
    return found


def _write_laplace(path: Path, diagnosis: CaseDiagnosis, seed: int) -> None:
    """Groups `prior` and `posterior`: the case's parameters and those of the effects found, by Laplace."""
    bench, entry, margins = diagnosis.bench, diagnosis.result.answer, diagnosis.model.margins
    rng = np.random.default_rng(seed)
    columns = bench.columns(entry.candidate)
    size = bench.d + len(columns)
    z = rng.multivariate_normal(np.asarray(entry.fit.z)[:size], covariance_of(bench, entry), PRIOR_DRAWS)
    names = [*margins.names, *(variable(name) for name in bench.values(entry.candidate, entry.fit.z))]
    units = [*margins.units, *(bench.parameters[i].unit for i in columns)]
    each = [*margins.each, *(bench.each[i] for i in columns)]

    def group(z: np.ndarray) -> xr.Dataset:
        draws = {
            name: (("chain", "draw"), margin.value(z[:, k])[None], {"units": unit})
            for k, (name, unit, margin) in enumerate(zip(names, units, each, strict=True))
        }
        return xr.Dataset(draws)

    attributes = {
        "title": f"Diagnosis of {diagnosis.model.case.case.name}: {diagnosis.result.verdict}",
        "inference_library": "bayessim_jax",
        "inference_library_version": __version__,
    }
    groups = {"prior": group(rng.standard_normal((PRIOR_DRAWS, size))), "posterior": group(z)}
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=attributes), **groups})
    replace_file(path, lambda temporary: tree.to_netcdf(temporary, engine=ENGINE))


def _write_posterior(path: Path, result: CaseInference, seed: int) -> None:
    """Groups `prior`, `posterior`, and of held-out windows `observed_data` and `posterior_predictive`, as in ArviZ."""
    model = result.model
    margins, channels = model.margins, model.channels
    rng = np.random.default_rng(seed)
    prior = np.stack([p.prior.quantile(rng.uniform(size=PRIOR_DRAWS)) for p in model.case.parameters], axis=-1)

    def named(x: Float[np.ndarray, "draw d"]) -> dict[str, Any]:
        facts = zip(margins.names, margins.units, model.case.parameters, strict=True)
        return {
            name: (("chain", "draw"), x[None, :, k], {"units": unit, "prior": str(p.prior), **_bounds(p.prior)})
            for k, (name, unit, p) in enumerate(facts)
        }

    windows, units = result.held_out, model.case.layout.units
    y = np.asarray(model.shots(windows).y)
    measured = np.asarray(model.shots(windows).measured)
    seen = np.where(measured, y, np.nan)
    rows = ("window", "row")
    dotted = [variable(c) for c in channels]
    observed: dict[str, Any] = {dotted[k]: (rows, seen[..., k], {"units": units[c]}) for k, c in enumerate(channels)}
    observed["time"] = (rows, windows.start[:, None] + windows.time, {"units": "s"})
    observed["recording"] = (("window",), [model.recordings[i].name for i in windows.recording])
    predicted = {
        dotted[k]: (("chain", "draw", *rows), result.band[None, ..., k], {"units": units[c]})
        for k, c in enumerate(channels)
    }
    groups = {
        "prior": xr.Dataset(named(prior)),
        "posterior": xr.Dataset(named(np.asarray(result.posterior.draws))),
        "posterior_predictive": xr.Dataset(predicted),
        "observed_data": xr.Dataset(observed),
    }
    attributes = {
        "title": f"Parameters of {model.case.case.name}",
        "inference_library": "bayessim_jax",
        "inference_library_version": __version__,
    }
    tree = xr.DataTree.from_dict({"/": xr.Dataset(attrs=attributes), **groups})
    replace_file(path, lambda temporary: tree.to_netcdf(temporary, engine=ENGINE))


def _bounds(prior: Any) -> dict[str, float]:
    return {"prior_low": float(prior.low), "prior_high": float(prior.high)}


def sample_models(run: str | Path, n: int, *, seed: int = 0) -> list[Any]:
    """Draw `n` MuJoCo models from a run's posterior, for domain randomization elsewhere.

    `run` is a folder that `bayessim infer` wrote; its case has to be where it was. Returns compiled `mujoco.MjModel`,
    derived quantities included. Raises `ValueError` where a file is missing or damaged.
    """
    folder = RunFolder.open(Path(run))
    case = load_case(Path(folder.read_config()["case"]), mask=True).check()
    group = read_group(folder.path / "posterior.nc", "posterior")
    names = [p.name for p in case.parameters]
    draws = np.stack([group[name].values.reshape(-1) for name in names], axis=-1)
    picks = np.random.default_rng(seed).choice(len(draws), n, replace=n > len(draws))
    return [case.augmented(dict(zip(names, row.tolist(), strict=True)))[1] for row in draws[picks]]
