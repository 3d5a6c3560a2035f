"""What a diagnosis leaves behind to be judged later: its simulators, as numbers, and their scores on new recordings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from glob import glob
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_jax.diagnosis.flexible import FLEXIBLE
from bayessim_jax.effects import Scales, lookup_effect, open_form, with_effects
from bayessim_jax.inference.replay import replay_window
from bayessim_jax.inference.scores import compare, score
from bayessim_jax.recordings.assemble import read_recording
from bayessim_jax.recordings.diagnosing import CaseDiagnosis
from bayessim_jax.recordings.files import to_json, write_text
from bayessim_jax.recordings.late import without_velocities
from bayessim_jax.recordings.loading import LoadedCase, judge_holes, load_case
from bayessim_jax.recordings.readers import SUFFIXES
from bayessim_jax.recordings.run_folder import RunFolder
from bayessim_jax.recordings.shots import CaseModel, case_model
from bayessim_jax.recordings.wording import CaseError, merge

__all__ = ["STATE", "evaluate_run", "read_table", "simulator_of", "write_state"]

STATE = "simulators.json"


def write_state(folder: RunFolder, diagnosis: CaseDiagnosis) -> None:
    """Write `simulators.json`: parameters, effects and spreads of errors of every simulator of a diagnosis."""
    bench, entries = diagnosis.bench, {}
    named = {"baseline": diagnosis.result.baseline, "augmented": diagnosis.result.answer}
    for name in diagnosis.scores:
        if name == "flexible":
            assert diagnosis.flexible is not None and diagnosis.flexible_bench is not None
            own, candidate, last = diagnosis.flexible_bench, diagnosis.flexible.candidate, diagnosis.flexible.p
        else:
            entry = named[name]
            own, candidate, last = bench, entry.candidate, entry.fit.z
        x: Any = np.asarray(last)
        entries[name] = {
            "effects": [[effect.name, place] for effect, place in (own.pairs[k] for k in candidate.effects)],
            "rounded": [getattr(own.pairs[k][0], "rounded", False) for k in candidate.effects],
            "theta": own.margins.theta(x[: own.d]).tolist(),
            "values": list(own.values(candidate, x).values()),
            "spread": diagnosis.spreads[diagnosis.augmented if name == "augmented" else name].tolist(),
        }
    for name, entry in named.items():
        entries[name]["noise"] = entry.misfit.noise.tolist()
    state = {
        "schema": 1,
        "channels": list(bench.channels),
        "scale": diagnosis.scale.tolist(),
        "refined": diagnosis.model.refined,
        "nearest": diagnosis.model.nearest,
        "noise_floor": diagnosis.noise_floor,
        "scales": {place: dataclasses.asdict(s) for place, s in bench.scales.items()},
        "simulators": entries,
    }
    write_text(folder.path / STATE, to_json(state) + "\n")


def simulator_of(model: CaseModel, state: dict[str, Any], name: str) -> tuple[Any, Any]:
    """One of a diagnosis' simulators and the θ' that it is run with.

    Raises `ValueError` for an effect unknown here, and for numbers that another version wrote.
    """
    entry = state["simulators"][name]
    scales = {place: Scales(**table) for place, table in state["scales"].items()}
    pairs, sharp = [], [False] * len(entry["effects"])
    for (name, place), rounded in zip(entry["effects"], entry.get("rounded", sharp), strict=True):
        effect = FLEXIBLE if name == FLEXIBLE.name else lookup_effect(name)
        pairs.append((open_form(effect) if rounded else effect, place))
    plain: Any = model.system
    system = with_effects(plain, pairs, scales) if pairs else plain
    theta = [*entry["theta"], *entry["values"]]
    if len(theta) != system.parameters.size:
        raise ValueError(
            f"the {name} simulator takes {system.parameters.size} numbers, not {len(theta)}; diagnose anew."
        )
    return system, jnp.asarray(theta, float)


def evaluate_run(run: RunFolder, pattern: str, tell: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Score a diagnosis' simulators on recordings given later: what `evaluation.json` holds.

    What is odd about the recordings is told; where numbers are missing nothing is compared.

    Raises `ValueError` where a file cannot be read or no recording holds a window.
    """
    state = read_table(run.path / STATE)
    case = load_case(Path(run.read_config()["case"]), mask=True).check()
    case = with_recordings(case, pattern)
    for finding in case.findings:
        tell(f"{finding.severity}: {finding}")
    model = case_model(case, refined=int(state["nearest"]), before=BEFORE)
    windows = model.windows(range(len(model.recordings)))
    shots = model.shots(windows)
    places = [state["channels"].index(c) for c in model.channels if c in state["channels"]]
    if len(places) < len(model.channels):
        raise ValueError(f"the recordings have channels that the diagnosis had not: {', '.join(model.channels)}.")
    scale = np.asarray(state["scale"])[places]
    fit: dict[str, Any] = {
        "horizon": case.case.horizon,
        "held_out": [r.name for r in model.recordings],
    }
    y, measured = np.asarray(shots.y), np.asarray(shots.measured)
    own = np.array([max(float(y[..., k][measured[..., k]].std()), 1e-12) for k in range(len(model.channels))])
    for name, entry in state["simulators"].items():
        system, theta = simulator_of(model, state, name)
        still = jnp.zeros(shots.spread.size)

        def one(window: Any, system: Any = system, theta: Any = theta, still: Any = still) -> Any:
            return replay_window(system, theta, still, window)

        predicted = np.asarray(jax.jit(jax.vmap(one))(shots.inputs))
        spread = np.asarray(entry["spread"])[:, places] * scale / own
        fit[name] = score(compare(predicted, y, measured), spread, own, model.channels).as_table()
    fit["noise_floor"] = state["noise_floor"]
    return {"schema": 1, "fit": fit}


BEFORE = 1.0
"""s of commands before a window, which actuators may not have forgotten."""


def with_recordings(case: LoadedCase, pattern: str) -> LoadedCase:
    """The same case with recordings from elsewhere, and findings of these; `CaseError` for one that cannot be used."""
    names = glob(pattern, recursive=True)  # noqa: PTH207 - the pattern may be absolute
    files = sorted(Path(name) for name in names if Path(name).is_file())
    if not files:
        ends = ", ".join(SUFFIXES)
        raise CaseError("--recordings", f"no file matches {pattern!r}", f"correct the pattern; files end in {ends}")
    recordings, findings = [], []
    for path in files:
        recording, found = read_recording(path, case.layout, case.case.channels)
        errors = [f for f in found if f.severity == "error"]
        if errors or recording is None:
            first = errors[0]
            raise CaseError(first.file, first.what, first.remedy, first.row)
        recordings.append(recording)
        findings += found
    return dataclasses.replace(
        case,
        recordings=without_velocities(recordings, case.layout, case.lateness.channels),
        findings=tuple(judge_holes(merge(findings), mask=True)),
    )


def read_table(path: Path) -> dict[str, Any]:
    """A table that a diagnosis wrote; raises `ValueError` where the file is missing, damaged or of another schema."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        if table.get("schema") != 1:
            raise ValueError("another schema")
        return table
    except (OSError, ValueError, AttributeError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise ValueError(f"{path} is missing or damaged ({reason}); run bayessim diagnose again.") from error


def summary_lines(fit: dict[str, Any], names: Sequence[str] = ("baseline", "augmented", "flexible")) -> list[str]:
    """The scores in lines for a person."""
    lines = [f"predictions {fit['horizon']:g} s ahead on {len(fit['held_out'])} recordings"]
    for name in names:
        if name in fit:
            lines.append(f"{name:<10} nrmse {fit[name]['nrmse']:.4f}   log score {fit[name]['log_score']:.3f}")
    return [*lines, f"noise      nrmse {fit['noise_floor']:.4f} at least"]
