"""A case to start from: a model's joints and actuators as channels, and its likely unknowns with wide priors."""

from __future__ import annotations

import re
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.recordings.case import FILE, NAME, SCHEMA
from bayessim_jax.recordings.files import write_text
from bayessim_jax.recordings.layout import FREE, HINGE, SLIDE, Layout, layout_of_model
from bayessim_jax.recordings.mjcf import import_mujoco, referenced_files
from bayessim_jax.recordings.naming import read_named
from bayessim_jax.recordings.paths import Target, element_names, nominal
from bayessim_jax.recordings.wording import CaseError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

__all__ = ["candidates", "copy_model", "label_target", "parameter_text", "start_case", "toml_string"]

HEAD = """\
# What to simulate, what is unknown in it, and where the recordings are. Keep the parameters that are really unknown.
schema = {schema}
name = {name}
model = {model}
recordings = "recordings/*.csv"   # also .parquet, .npz, .mcap
horizon = 0.5                     # s; predictions are scored on windows of this length

# Columns of a recording:
{columns}
# A column under another name or in another unit:
# [channels.{example}]
# column = "angle_deg"
# scale = 0.017453292519943295
"""


def start_case(folder: Path, model: Path) -> tuple[Path, list[str]]:
    """Make a case folder with the model, what it refers to, and `case.toml`; returns that file and remarks.

    Raises `CaseError` where there is a case already, where the model does not compile or refers to files outside of its
    folder, and where a file that would be copied is there with another content.
    """
    path = folder / FILE
    if path.exists():
        raise CaseError(str(path), "is there already", "choose another folder, or remove it")
    inside = model.resolve().is_relative_to(folder.resolve())
    with read_named(model, folder if inside else model.parent, rename=not inside) as (source, _, compiled, told):
        layout = layout_of_model(compiled)
        name = copy_model(folder, source)
        _written(folder, lambda: write_text(path, case_text(folder.resolve().name, name, compiled, layout)))
    remarks = [told] if told else []
    remarks += [f"{name}: {one} has no name; name it, so that recordings can refer to it" for one in layout.unnamed]
    return path, [f"{remark}." for remark in remarks]


def copy_model(folder: Path, model: Path) -> str:
    """Make a case folder with room for recordings and copy a model into it, with what that refers to.

    Returns where the model is, from the folder; a model that is in the folder already stays there. Raises `CaseError`
    where it refers to files outside of its own folder, and where a file is there with another content.
    """
    root = folder if model.resolve().is_relative_to(folder.resolve()) else model.parent
    files = referenced_files(model, root)
    copies = [] if root == folder else [(file, folder / file.resolve().relative_to(root.resolve())) for file in files]
    for source, place in copies:
        if place.exists() and place.read_bytes() != source.read_bytes():
            raise CaseError(str(place), "is there already and differs", "choose another folder, or remove it")

    def copy() -> None:
        (folder / "recordings").mkdir(parents=True, exist_ok=True)
        for source, place in copies:
            place.parent.mkdir(parents=True, exist_ok=True)
            if not place.exists():
                shutil.copyfile(source, place)

    _written(folder, copy)
    return str(model.resolve().relative_to(root.resolve()).as_posix())


def _written(folder: Path, write: Callable[[], None]) -> None:
    try:
        write()
    except OSError as error:
        raise CaseError(str(folder), f"cannot be written ({error.strerror})", "choose another folder") from error


def case_text(name: str, file: str, model: Any, layout: Layout) -> str:
    """The text of a starting `case.toml`."""
    channels = [("time", "s"), *((c, layout.units[c]) for c in layout.channels)]
    columns = "".join(
        f"#   {toml_string(c)[1:-1]:<36} {_note(c, u, layout)}".rstrip() + "\n" for c, u in channels if "/#" not in c
    )
    example = toml_string(next(iter(layout.qpos), "time"))
    text = HEAD.format(schema=SCHEMA, name=toml_string(name), model=toml_string(file), columns=columns, example=example)
    taken: set[str] = set()
    for target, low, high, likely in candidates(model):
        mark = "" if likely else "# "
        lines = parameter_text(target, label_target(target, taken), low, high, model, layout).splitlines()
        text += "\n" + "".join(f"{mark}{line}\n" for line in lines)
    return text


def parameter_text(target: Target, label: str, low: float, high: float, model: Any, layout: Layout) -> str:
    """One `[[parameters]]` of a `case.toml`, with a uniform prior."""
    lines = [
        "[[parameters]]",
        f"name = {toml_string(label)}",
        *([f"unit = {toml_string(_unit(target, layout))}"] if _unit(target, layout) else []),
        f"targets = [{toml_string(str(target))}]   # {nominal(target, model):.6g} in the model",
        f'prior = {{ distribution = "uniform", low = {low:.4g}, high = {high:.4g} }}',
    ]
    return "\n".join(lines) + "\n"


def candidates(model: Any) -> Iterator[tuple[Target, float, float, bool]]:
    """Targets that are often wrong, with a range around the model's value, and whether to begin with them.

    Masses go from half to twice their value. Damping, friction and armature that the model leaves out go from zero to
    what would stop the joint, moving at 1 rad/s or 1 m/s, within half a second, from its inertia at the model's pose.
    """
    inertia = _inertia(model)
    bodies, joints = element_names(model, "body"), element_names(model, "joint")
    for name, i in bodies.items():
        if model.body_weldid[i] and model.body_mass[i] > 0:
            mass = float(model.body_mass[i])
            yield Target("body", name, "mass"), mass / 2, mass * 2, True
    for name, i in joints.items():
        if model.jnt_type[i] == FREE:
            continue
        stop = 2 * float(inertia[model.jnt_dofadr[i]])
        for word, most, likely in (
            ("damping", stop, True),
            ("frictionloss", stop, False),
            ("armature", stop / 4, False),
        ):
            target = Target("joint", name, word)
            value = nominal(target, model)
            yield target, 0.0, 3 * value if value > 0 else most, likely
    for name, i in element_names(model, "actuator").items():
        word = "gain" if model.actuator_biastype[i] else "gear"
        target = Target("actuator", name, word)
        value = nominal(target, model)
        if value:
            yield target, min(value / 2, value * 2), max(value / 2, value * 2), False
    for name, i in bodies.items():
        if model.body_weldid[i] and model.body_mass[i] > 0:
            axis = int(np.abs(model.body_ipos[i]).argmax())
            value = float(model.body_ipos[i][axis])
            if abs(value) > 1e-6:
                yield (
                    Target("body", name, "ipos", axis),
                    min(value / 2, value * 1.5),
                    max(value / 2, value * 1.5),
                    False,
                )
    for name, i in element_names(model, "geom").items():
        if (model.geom_contype[i] or model.geom_conaffinity[i]) and model.geom_friction[i][0] > 0:
            value = float(model.geom_friction[i][0])
            yield Target("geom", name, "friction", 0), value / 3, value * 2, False


def _inertia(model: Any) -> np.ndarray:
    """Diagonal of the mass matrix in the model's own pose."""
    mujoco = import_mujoco()
    data, out, diagonal = mujoco.MjData(model), np.zeros(model.nv), np.zeros(model.nv)
    mujoco.mj_forward(model, data)
    for k, unit in enumerate(np.eye(model.nv)):
        mujoco.mj_mulM(model, data, out, unit)
        diagonal[k] = out[k]
    return diagonal


def label_target(target: Target, taken: set[str]) -> str:
    """A name for a parameter that is not taken yet; it then is."""
    axis = "xyz"[target.index] if target.field == "ipos" and target.index is not None else ""
    words = {"mass": "mass", "ipos": f"com_{axis}", "frictionloss": "friction"}
    stem = re.sub(r"\W", "_", f"{target.name}_{words.get(target.field, target.field)}", flags=re.ASCII)
    stem = stem if NAME.fullmatch(stem) else f"p{stem}"
    label, count = stem, 2
    while label in taken:
        label, count = f"{stem}_{count}", count + 1
    taken.add(label)
    return label


def _unit(target: Target, layout: Layout) -> str:
    kinds = {name: kind for name, kind, _, _ in layout.joints}
    units = {
        SLIDE: {"damping": "N s/m", "frictionloss": "N", "armature": "kg"},
        HINGE: {"damping": "N m s/rad", "frictionloss": "N m", "armature": "kg m^2"},
    }
    return target.about.unit or (
        units.get(kinds.get(target.name, HINGE), units[HINGE]).get(target.field, "") if target.kind == "joint" else ""
    )


def _note(channel: str, unit: str, layout: Layout) -> str:
    if channel in layout.ctrl:
        return "as commanded"
    return f"{unit}; estimated where it is not measured" if channel in layout.qvel else unit


def toml_string(text: str) -> str:
    """A TOML string."""
    escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in text)
    return f'"{escaped}"'
