"""From a MuJoCo model to a tree of links with one joint each, θ written in where it belongs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bayessim_jax.contracts import Scalar
from bayessim_jax.engines.fields import Write
from bayessim_jax.engines.tree.folding import Folded, Matrix, Vector, add, dot, fold, multiply, rotate, scale, vector

__all__ = ["Inertia", "Link", "Numbers", "build_links", "read_numbers"]

Numbers = Callable[..., Folded]
"""`numbers(field, *index)`: one number of the model, with θ in it."""


class Inertia(NamedTuple):
    """Mass m, first moment h = m c, and rotational inertia about the origin of the frame."""

    mass: Folded
    moment: Vector
    rotational: Matrix


class Link(NamedTuple):
    """What moves with one joint; its frame has its origin on the joint and, at reference, the rotation `rotation`."""

    parent: int
    """Index of the link it hangs on; −1 is the world."""
    rotation: Matrix
    """From its frame to the parent's, at q = q_ref."""
    offset: Vector
    """Its origin in the parent's frame, at q = q_ref."""
    slides: bool
    axis: int
    """Coordinate axis of its frame along which it slides or about which it turns."""
    sign: float
    reference: float
    inertia: Inertia


def read_numbers(model: mujoco.MjModel, writes: Sequence[Write], theta: Sequence[Scalar]) -> Numbers:
    """The model's numbers, those that θ writes traced and all others Python floats."""
    traced = {(w.field, w.index): fold(theta[w.parameter]) * w.factor for w in writes}

    def numbers(field: str, *index: int) -> Folded:
        if (field, index) in traced:
            return traced[field, index]
        array = model.opt.gravity if field == "gravity" else getattr(model, field)
        return fold(float(array[index]))

    return numbers


def build_links(model: mujoco.MjModel, numbers: Numbers) -> list[Link]:
    """One link for each joint, in MuJoCo's order; bodies without joints are part of what they are fixed to."""
    links: list[Link] = []
    frames: list[tuple[int, Matrix, Vector]] = [(-1, _identity(), vector((0.0, 0.0, 0.0)))]
    for body in range(1, model.nbody):
        link, frame, origin = frames[model.body_parentid[body]]
        origin = add(origin, rotate(frame, _read_vector(numbers, "body_pos", body)))
        frame = multiply(frame, _from_quaternion(model.body_quat[body]))
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            anchor = vector((0.0, 0.0, 0.0)) if slides else vector(model.jnt_pos[joint])
            align, axis, sign = _align(model.jnt_axis[joint])
            links.append(
                Link(
                    parent=link,
                    rotation=multiply(frame, align),
                    offset=add(origin, rotate(frame, anchor)),
                    slides=slides,
                    axis=axis,
                    sign=sign,
                    reference=float(model.qpos0[model.jnt_qposadr[joint]]),
                    inertia=_no_inertia(),
                )
            )
            frame = _transpose(align)
            link, origin = len(links) - 1, scale(-1.0, rotate(frame, anchor))
        frames.append((link, frame, origin))
        if link >= 0:
            part = _body_inertia(model, numbers, body, frame, origin)
            links[link] = links[link]._replace(inertia=_sum(links[link].inertia, part))
    return links


def _body_inertia(model: mujoco.MjModel, numbers: Numbers, body: int, frame: Matrix, origin: Vector) -> Inertia:
    """Inertia of a body in its link's frame: I = R diag(I_c) Rᵀ + m (c·c 1 − c cᵀ)."""
    mass = numbers("body_mass", body)
    centre = add(origin, rotate(frame, _read_vector(numbers, "body_ipos", body)))
    principal = _read_vector(numbers, "body_inertia", body)
    turn = multiply(frame, _from_quaternion(model.body_iquat[body]))
    moment = scale(mass, centre)
    square = dot(centre, moment)

    def entry(i: int, j: int) -> Folded:
        about_centre = principal[0] * (turn[i][0] * turn[j][0])
        for k in (1, 2):
            about_centre = about_centre + principal[k] * (turn[i][k] * turn[j][k])
        shift = -(centre[i] * moment[j])
        return about_centre + (shift + square if i == j else shift)

    return Inertia(mass, moment, symmetric(entry))


def symmetric(entry: Callable[[int, int], Folded]) -> Matrix:
    """A symmetric matrix from its entries on and above the diagonal, each computed once."""
    a, b, c, d, e, f = (entry(i, j) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    return (a, b, c), (b, d, e), (c, e, f)


def _sum(a: Inertia, b: Inertia) -> Inertia:
    return Inertia(
        a.mass + b.mass,
        add(a.moment, b.moment),
        symmetric(lambda i, j: a.rotational[i][j] + b.rotational[i][j]),
    )


def _no_inertia() -> Inertia:
    zero = vector((0.0, 0.0, 0.0))
    return Inertia(fold(0.0), zero, (zero, zero, zero))


def _read_vector(numbers: Numbers, field: str, body: int) -> Vector:
    return numbers(field, body, 0), numbers(field, body, 1), numbers(field, body, 2)


def _identity() -> Matrix:
    return _matrix(np.eye(3))


def _matrix(values: np.ndarray) -> Matrix:
    x, y, z = (vector([float(v) for v in row]) for row in np.asarray(values).reshape(3, 3))
    return x, y, z


def _transpose(matrix: Matrix) -> Matrix:
    x, y, z = zip(*matrix, strict=True)
    return x, y, z


def _from_quaternion(quaternion: np.ndarray) -> Matrix:
    values = np.zeros(9)
    mujoco.mju_quat2Mat(values, quaternion)
    return _matrix(values)


def _align(axis: np.ndarray) -> tuple[Matrix, int, float]:
    """A rotation A, a coordinate axis k and a sign with A e_k sign = axis; A = 1 where the axis is one already."""
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) > 1.0 - 1e-15:
        return _identity(), largest, float(np.sign(axis[largest]))
    quaternion = np.zeros(4)
    mujoco.mju_quatZ2Vec(quaternion, axis)
    return _from_quaternion(quaternion), 2, 1.0
