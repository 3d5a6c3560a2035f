"""All laws by name, and where in a model they can act."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayessim_jax.concealment import commands, elastic, friction, masses, readings, transmission, unknown
from bayessim_jax.concealment.law import Law
from bayessim_jax.concealment.places import find
from bayessim_jax.spelling import find_named

if TYPE_CHECKING:
    import mujoco

__all__ = ["LAWS", "UNKNOWN", "choose_place", "lookup_law"]

UNKNOWN = "unknown:"
"""What the names of laws begin with that are in no library."""


def _laws(*modules: object) -> dict[str, type[Law]]:
    found = [getattr(module, name) for module in modules for name in getattr(module, "__all__", ())]
    return {law.name: law for law in found if isinstance(law, type) and issubclass(law, Law)}


LAWS: dict[str, type[Law]] = _laws(friction, elastic, transmission, masses, commands, readings) | {
    UNKNOWN + name: law for name, law in _laws(unknown).items()
}


def lookup_law(name: str) -> type[Law]:
    """The law of a name, or `ValueError` with the near miss."""
    return find_named(name, LAWS, "unknown effect")


def choose_place(model: mujoco.MjModel, name: str, place: str | None, rng: np.random.Generator) -> str:
    """One of the places where a law can act in a model: the one named, or one that is drawn; raises `ValueError`.

    A place may be named without what follows its `#`.
    """
    known = lookup_law(name).places(model)
    if not known:
        raise ValueError(f"effect {name!r}: the model has no place for it; choose another effect.")
    fitting = known if place is None else find(place, known)
    return str(fitting[int(rng.integers(len(fitting)))])
