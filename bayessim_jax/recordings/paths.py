"""Paths to a model's parameters, `kind/name/field[/index]`: checked, and read from a compiled model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_jax.recordings.wording import hint, quote

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["FIELDS", "Field", "Target", "element_names", "find_target", "nominal"]


@dataclass(frozen=True)
class Field:
    """One number of a model's element.

    `read(model, i)` gives it for element `i` of a compiled model, as an array where it has several entries. `low` is
    its smallest physical value, `open_low` says that it lies above that, `unit` is empty where it depends on the joint.
    """

    read: Callable[[Any, int], Any]
    size: int = 0
    low: float = -np.inf
    open_low: bool = False
    unit: str = ""


def _of_joint(name: str) -> Callable[[Any, int], Any]:
    return lambda m, i: getattr(m, name)[m.jnt_dofadr[i]]


FIELDS: dict[str, dict[str, Field]] = {
    "body": {
        "mass": Field(lambda m, i: m.body_mass[i], low=0, open_low=True, unit="kg"),
        "ipos": Field(lambda m, i: m.body_ipos[i], size=3, unit="m"),
    },
    "joint": {
        "damping": Field(_of_joint("dof_damping"), low=0),
        "armature": Field(_of_joint("dof_armature"), low=0),
        "stiffness": Field(lambda m, i: m.jnt_stiffness[i], low=0),
        "springref": Field(lambda m, i: m.qpos_spring[m.jnt_qposadr[i]]),
        "frictionloss": Field(_of_joint("dof_frictionloss"), low=0),
    },
    "geom": {
        "friction": Field(lambda m, i: m.geom_friction[i], size=3, low=0),
        "size": Field(lambda m, i: m.geom_size[i], size=3, low=0, open_low=True, unit="m"),
    },
    "actuator": {
        "gear": Field(lambda m, i: m.actuator_gear[i], size=6),
        "gain": Field(lambda m, i: m.actuator_gainprm[i][0]),
        "ctrlrange": Field(lambda m, i: m.actuator_ctrlrange[i], size=2),
    },
    "option": {"gravity": Field(lambda m, i: m.opt.gravity, size=3, unit="m/s^2")},
}
WHOLE = {"gear": 0, "ctrlrange": 1}
"""Fields that may be named without an index, and the entry that then stands for them."""


@dataclass(frozen=True)
class Target:
    """A place in the model that a parameter's value is written to: `body/bob/mass` is kind, name, field."""

    kind: str
    name: str
    field: str
    index: int | None = None

    def __str__(self) -> str:
        parts = [self.kind, self.name, self.field] if self.name else [self.kind, self.field]
        return "/".join(parts + ([] if self.index is None else [str(self.index)]))

    @property
    def about(self) -> Field:
        """What is known of the field."""
        return FIELDS[self.kind][self.field]

    def id(self, model: Any) -> int:
        """The element's index in a compiled model."""
        return element_names(model, self.kind).get(self.name, 0)


def element_names(model: Any, kind: str) -> dict[str, int]:
    """Names of a model's elements of one kind and their indices; what has no name cannot be addressed."""
    if kind == "option":
        return {"": 0}
    count = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "actuator": "nu", "sensor": "nsensor"}[kind]
    access = getattr(model, kind)
    names = ((access(i).name, i) for i in range(getattr(model, count)))
    return {name: i for name, i in names if name and not (kind == "body" and i == 0)}


def find_target(path: str, model: Any) -> Target:
    """The target that a path names in a compiled model; raises `ValueError` with the near misses."""
    kind, _, rest = path.partition("/")
    if kind not in FIELDS:
        raise ValueError(f"unknown path {quote(path)}; {hint(path, _paths(model)) if path else hint('', FIELDS)}")
    names = element_names(model, kind)
    if kind == "option":
        name, tail = "", rest
    else:
        fitting = [n for n in names if rest == n or rest.startswith(n + "/")]
        if not fitting:
            every = _paths(model, kind)
            raise ValueError(f"unknown path {quote(path)}: the model has no such {kind}; {hint(path, every)}")
        name = max(fitting, key=len)
        tail = rest[len(name) + 1 :]
    word, _, index = tail.partition("/")
    known = FIELDS[kind]
    if word not in known:
        prefix = f"{kind}/{name}/" if name else f"{kind}/"
        raise ValueError(f"unknown path {quote(path)}; {hint(prefix + word, [prefix + f for f in known], 1)}")
    target = Target(kind, name, word, _index(path, word, index, known[word].size))
    _applicable(target, model)
    return target


def nominal(target: Target, model: Any) -> float:
    """The value that a compiled model has at a target, in SI units (a spring's reference in rad)."""
    value = target.about.read(model, target.id(model))
    if not target.about.size:
        return float(value)
    return float(value[WHOLE[target.field] if target.index is None else target.index])


def _index(path: str, word: str, index: str, size: int) -> int | None:
    if not size:
        if index:
            raise ValueError(f"unknown path {quote(path)}: {word} is one number; leave out '/{quote(index)[1:-1]}'")
        return None
    if not index and word in WHOLE:
        return None
    if not (index.isascii() and index.isdigit() and int(index) < size):
        raise ValueError(f"unknown path {quote(path)}: {word} needs an index, {word}/0 to {word}/{size - 1}")
    return int(index)


def _applicable(target: Target, model: Any) -> None:
    i = target.id(model)
    joint_type = int(model.jnt_type[i]) if target.kind == "joint" else None
    if target.field == "springref" and joint_type not in (2, 3):
        raise ValueError(f"path {quote(target)}: only hinge and slide joints have a springref; remove it")
    if target.field == "ctrlrange" and target.index is None and not model.actuator_ctrlrange[i][1] > 0:
        raise ValueError(
            f"path {quote(target)}: the actuator has no ctrlrange above 0 to scale; give it one in the model, "
            "or name the end, ctrlrange/0 or ctrlrange/1"
        )
    if target.field == "size":
        sizes = {2: 1, 3: 2, 4: 3, 5: 2, 6: 3}.get(
            int(model.geom_type[i]), 0
        )  # sphere, capsule, ellipsoid, cylinder, box
        if not (target.index or 0) < sizes:
            raise ValueError(
                f"path {quote(target)}: a geom of its type has {sizes or 'no'} sizes that can be set; remove it"
            )
    if target.field in ("mass", "ipos") and not model.body_mass[i] > 0:
        raise ValueError(f"path {quote(target)}: the body has no mass in the model; give it one")


def _paths(model: Any, *kinds: str) -> list[str]:
    """Every path that the model has, with the first index where one is needed."""
    paths = []
    for kind in kinds or FIELDS:
        for name in element_names(model, kind):
            for word, field in FIELDS[kind].items():
                ends = range(field.size) if field.size and word not in WHOLE else [None]
                paths += [str(Target(kind, name, word, end)) for end in ends]
    return paths
