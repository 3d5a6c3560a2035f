"""A model with θ written in: everything that is the same at every step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.tree.constraints import Constraint, find_constraints, inverse_weights
from bayessim_jax.engines.tree.dynamics import mass_matrix, place_links
from bayessim_jax.engines.tree.folding import Folded, Vector, fold, vector
from bayessim_jax.engines.tree.links import Link, Numbers, build_links, read_numbers
from bayessim_jax.engines.tree.solve import add_to_diagonal

__all__ = ["Tree", "prepare"]


class Tree(NamedTuple):
    """Links, gravity, armatures and constraints, with θ in them."""

    model: mujoco.MjModel
    numbers: Numbers
    links: list[Link]
    gravity: Vector
    armature: list[Folded]
    constraints: list[Constraint]
    weights: list[Folded]
    """(M⁻¹)ᵢᵢ at the reference position, where there are constraints."""


def prepare(model: mujoco.MjModel, writes: Sequence[Write], theta: Sequence[Scalar]) -> Tree:
    """Write θ into a model; done once for a simulation, outside of its loop."""
    numbers = read_numbers(model, writes, theta)
    links = build_links(model, numbers)
    weightless = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    gravity = vector([0.0 if weightless else numbers("gravity", k) for k in range(3)])
    armature = [numbers("dof_armature", j) for j in range(len(links))]
    constraints = find_constraints(model, [w.index[0] for w in writes if w.field == "dof_frictionloss"])
    weights: list[Folded] = []
    if constraints:
        at_reference = place_links(links, [fold(link.reference) for link in links])
        weights = inverse_weights(add_to_diagonal(mass_matrix(links, at_reference), armature))
    return Tree(model, numbers, links, gravity, armature, constraints, weights)
