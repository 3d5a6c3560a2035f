"""`load_case`: the folder, the model, the unknowns and the recordings, with everything that was noticed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_jax.recordings.assemble import read_recording
from bayessim_jax.recordings.augment import write_values
from bayessim_jax.recordings.case import FILE, Case, read_case
from bayessim_jax.recordings.late import Lateness, find_late, without_velocities
from bayessim_jax.recordings.layout import Layout, layout_of_model, layout_of_system
from bayessim_jax.recordings.mjcf import compile_spec, read_spec
from bayessim_jax.recordings.parameters import Parameter, resolve_parameters
from bayessim_jax.recordings.windows import Windows, find_windows, stack_windows
from bayessim_jax.recordings.wording import CaseError, Finding, hint, merge, quote

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bayessim_jax.recordings.recording import CaseRecording

__all__ = ["LoadedCase", "judge_holes", "load_case"]


@dataclass(frozen=True)
class LoadedCase:
    """A case that was read; it may be used where `check()` does not raise."""

    case: Case
    layout: Layout
    parameters: tuple[Parameter, ...]
    recordings: tuple[CaseRecording, ...]
    """Those without errors, in the order of their names."""
    findings: tuple[Finding, ...]
    model: Any = None
    """The compiled `mujoco.MjModel` at its own values; None for a registered system."""
    spec: Any = field(default=None, repr=False)
    """The `mujoco.MjSpec` that it was compiled from."""
    lateness: Lateness = Lateness()
    """Velocities that are later than the positions."""

    @property
    def errors(self) -> list[Finding]:
        """What stops the case from being used."""
        return [finding for finding in self.findings if finding.severity == "error"]

    def check(self) -> LoadedCase:
        """The case itself, or a `CaseError` with its first error where it has one."""
        errors = self.errors
        if errors:
            first, others = errors[0], len(errors) - 1
            more = f" ({others} more: bayessim check {self.case.folder})" if others else ""
            raise CaseError(first.file, first.what, first.remedy + more, first.row)
        return self

    def windows(self, stride: float | None = None) -> Windows:
        """Every window of the case's horizon, stacked over the recordings."""
        return stack_windows(self.recordings, self.case.horizon, stride)

    def augmented(self, values: Mapping[str, float]) -> tuple[Any, Any]:
        """The specification and the compiled model with values put in, by parameter; raises `ValueError`."""
        if self.spec is None:
            raise ValueError(f"system {self.case.system} has no MJCF to write values into.")
        known = {parameter.name: parameter for parameter in self.parameters}
        for name in values:
            if name not in known:
                raise ValueError(f"unknown parameter {quote(name)}; {hint(name, known)}")
        spec = self.spec.copy()
        places = {target: value for name, value in values.items() for target in known[name].targets}
        return spec, write_values(spec, places)  # type: ignore[arg-type]


def load_case(folder: str | Path, *, mask: bool = False) -> LoadedCase:
    """Read a case folder and check all of it.

    Numbers that are missing, and gaps longer than a window, are errors, unless to `mask` them is asked for.
    Raises `CaseError` where `case.toml` or the model cannot be read, because nothing more can be said then; what is
    wrong with parameters and recordings is among the findings.
    """
    case = read_case(Path(folder))
    spec = model = None
    names: tuple[str, ...] = ()
    if case.model:
        path = case.folder / case.model
        spec = read_spec(path, case.folder)
        model = compile_spec(spec, path)
        layout = layout_of_model(model)
    else:
        from bayessim_jax.systems import SYSTEMS

        if case.system not in SYSTEMS:
            raise CaseError(FILE, f"unknown system {quote(case.system)}", hint(case.system, SYSTEMS))
        system = SYSTEMS[case.system].system()
        layout, names = layout_of_system(system), system.parameters.names
    parameters, found = resolve_parameters(case.parameters, model, names)
    if not case.parameters:
        found.append(Finding("warning", FILE, "names no parameters", "add [[parameters]] for what is unknown"))
    found += _channels(case, layout) + _unnamed(case, layout)
    if spec is not None and not any(f.severity == "error" for f in found):
        found += _possible(case, spec, parameters)
    recordings: Sequence[CaseRecording] = []
    if not _unnamed(case, layout):
        recordings, more = _recordings(case, layout)
        found += more
    lateness = Lateness()
    if model is not None and recordings:
        lateness, more = find_late(recordings, layout, model, case.horizon)
        recordings = without_velocities(recordings, layout, lateness.channels)
        found += more
    findings = tuple(judge_holes(merge(found), mask))
    return LoadedCase(case, layout, parameters, tuple(recordings), findings, model, spec, lateness)


def judge_holes(findings: list[Finding], mask: bool) -> list[Finding]:
    """Holes as what they are to the one who asks: masked and told, or errors until they are."""

    def judge(hole: Finding) -> Finding:
        if mask:
            return replace(hole, severity="warning")
        return replace(hole, severity="error", remedy=f"{hole.remedy.rpartition('; ')[2]}, or give --mask")

    return [judge(finding) if finding.severity == "hole" else finding for finding in findings]


def _channels(case: Case, layout: Layout) -> list[Finding]:
    known = ("time", *layout.channels)
    return [
        Finding("error", FILE, f"[channels]: unknown channel {quote(name)}", hint(name, known))
        for name in case.channels
        if name not in known
    ]


def _unnamed(case: Case, layout: Layout) -> list[Finding]:
    return [
        Finding("error", case.model, f"{element} has no name", "name it, so that recordings can refer to it")
        for element in layout.unnamed
    ]


def _possible(case: Case, spec: Any, parameters: tuple[Parameter, ...]) -> list[Finding]:
    """An error where the model cannot be compiled with the prior's means put in."""
    values = {target: parameter.prior.mean for parameter in parameters for target in parameter.targets}
    try:
        write_values(spec.copy(), values)  # type: ignore[arg-type]
    except ValueError as error:
        what = f"the model cannot have the prior's means ({' '.join(str(error).split()).rstrip('.')})"
        return [Finding("error", case.model, what, "correct the targets or the priors")]
    return []


def _recordings(case: Case, layout: Layout) -> tuple[list[CaseRecording], list[Finding]]:
    try:
        files = case.files
    except CaseError as error:
        return [], [error.finding]
    found: list[Finding] = []
    recordings: list[CaseRecording] = []
    counts = []
    for path in files:
        recording, more = read_recording(path, layout, case.channels, case.horizon)
        found += more
        if recording is not None:
            recordings.append(recording)
            counts.append(len(find_windows(recording, case.horizon)))
            if not counts[-1]:
                what = f"holds no window of {case.horizon:g} s without a gap"
                found.append(
                    Finding("warning", path.name, what, "its predictions are not scored; choose a shorter horizon")
                )
    if counts and not any(counts):
        what = f"no recording holds a window of horizon = {case.horizon:g} s"
        found.append(Finding("error", FILE, what, "choose a shorter horizon"))
    return recordings, found
