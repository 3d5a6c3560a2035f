"""Equations of motion of a tree of links: M(q) q̈ + b(q, q̇) = τ, each joint one degree of freedom.

Everything is written in the links' own frames, with the acceleration of the world that stands for gravity.

Source: Featherstone 2008, ch. 5 and 6
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from bayessim_jax.engines.tree.folding import (
    Folded,
    Matrix,
    Vector,
    add,
    cross,
    dot,
    fold,
    rotate,
    rotate_back,
    scale,
    settle_vectors,
    vector,
)
from bayessim_jax.engines.tree.links import Inertia, Link, symmetric
from bayessim_jax.trigonometry import sincos

__all__ = ["LONG", "Pose", "bias_forces", "mass_matrix", "place_links"]

LONG = 3
"""Trees of more links than this have what links hand on to each other computed once, which costs memory traffic."""


class Pose(NamedTuple):
    """Where a link is in its parent's frame: rotation R to the parent's frame, and origin r."""

    rotation: Matrix
    origin: Vector


class _Motion(NamedTuple):
    """Angular velocity ω, angular acceleration ω̇, acceleration a of the origin, and S, in the link's frame."""

    spin: Vector
    turn: Vector
    lift: Vector
    swirl: Matrix


def place_links(links: Sequence[Link], q: Sequence[Folded], one: Folded | None = None) -> list[Pose]:
    """The pose of every link at joint positions q, m or rad; with an `unknown_one` each computed once."""
    poses = [_place(link, x - link.reference) for link, x in zip(links, q, strict=True)]
    return poses if one is None else [_settle_pose(pose, one) for pose in poses]


def _settle_pose(pose: Pose, one: Folded) -> Pose:
    x, y, z, origin = settle_vectors(*pose.rotation, pose.origin, by=one)
    return Pose((x, y, z), origin)


def _place(link: Link, moved: Folded) -> Pose:
    columns = tuple(zip(*link.rotation, strict=True))
    if link.slides:
        return Pose(link.rotation, add(link.offset, scale(moved * link.sign, columns[link.axis])))
    if moved.known:
        sine, cosine = fold(math.sin(moved.value)), fold(math.cos(moved.value))
    else:
        sine, cosine = (fold(x) for x in sincos(moved.value))
    s = sine * link.sign
    j, k = (link.axis + 1) % 3, (link.axis + 2) % 3
    turned = list(columns)
    turned[j] = add(scale(cosine, columns[j]), scale(s, columns[k]))
    turned[k] = add(scale(cosine, columns[k]), scale(-s, columns[j]))
    x, y, z = zip(*turned, strict=True)
    return Pose((x, y, z), link.offset)


def bias_forces(
    links: Sequence[Link], poses: Sequence[Pose], gravity: Vector, v: Sequence[Folded], one: Folded | None = None
) -> list[Folded]:
    """b(q, q̇): what the joints carry at q̈ = 0, by one sweep outwards and one back (recursive Newton-Euler).

    With angular velocity ω, angular acceleration ω̇, acceleration a of the origin and S = [ω̇]× + [ω]×², a link asks
    for the force m a + S h and the moment I ω̇ + ω × I ω + h × a.
    """
    zero = vector((0.0, 0.0, 0.0))
    still = _Motion(zero, zero, scale(-1.0, gravity), (zero, zero, zero))
    motions: list[_Motion] = []
    forces: list[Vector] = []
    moments: list[Vector] = []
    for link, pose, rate in zip(links, poses, v, strict=True):
        before = still if link.parent < 0 else motions[link.parent]
        spin, turn = rotate_back(pose.rotation, before.spin), rotate_back(pose.rotation, before.turn)
        lift = rotate_back(pose.rotation, add(before.lift, rotate(before.swirl, pose.origin)))
        along = _along(link, rate)
        if link.slides:
            lift = add(lift, scale(2.0, cross(spin, along)))
        else:
            turn = add(turn, cross(spin, along))
            spin = add(spin, along)
        if one is not None:
            spin, turn, lift = settle_vectors(spin, turn, lift, by=one)
        swirl = _swirl(spin, turn)
        motions.append(_Motion(spin, turn, lift, swirl))
        mass, moment, rotational = link.inertia
        force = add(scale(mass, lift), rotate(swirl, moment))
        gyroscopic = cross(spin, rotate(rotational, spin))
        torque = add(add(rotate(rotational, turn), gyroscopic), cross(moment, lift))
        if one is not None:
            force, torque = settle_vectors(force, torque, by=one)
        forces.append(force)
        moments.append(torque)
    torques = [fold(0.0)] * len(links)
    for i in reversed(range(len(links))):
        link, pose = links[i], poses[i]
        torques[i] = (forces[i] if link.slides else moments[i])[link.axis] * link.sign
        if link.parent >= 0:
            force = rotate(pose.rotation, forces[i])
            moment = add(rotate(pose.rotation, moments[i]), cross(pose.origin, force))
            force, moment = add(forces[link.parent], force), add(moments[link.parent], moment)
            if one is not None:
                force, moment = settle_vectors(force, moment, by=one)
            forces[link.parent], moments[link.parent] = force, moment
    return torques


def mass_matrix(links: Sequence[Link], poses: Sequence[Pose], one: Folded | None = None) -> list[list[Folded]]:
    """M(q), symmetric, by the composite-rigid-body algorithm; entries between branches are zero while tracing."""
    composite = [link.inertia for link in links]
    for i in reversed(range(len(links))):
        if links[i].parent >= 0:
            joined = _join(composite[links[i].parent], composite[i], poses[i])
            composite[links[i].parent] = _settle(joined, one) if len(links) > LONG else joined
    size = len(links)
    matrix = [[fold(0.0)] * size for _ in range(size)]
    for i, link in enumerate(links):
        mass, moment, rotational = composite[i]
        unit = _along(link, fold(1.0))
        force, torque = cross(unit, moment), rotate(rotational, unit)
        if link.slides:
            force, torque = scale(mass, unit), cross(moment, unit)
        j = i
        while True:
            entry = (force if links[j].slides else torque)[links[j].axis] * links[j].sign
            matrix[i][j] = matrix[j][i] = entry
            if links[j].parent < 0:
                break
            force = rotate(poses[j].rotation, force)
            torque = add(rotate(poses[j].rotation, torque), cross(poses[j].origin, force))
            j = links[j].parent
    return matrix


def _along(link: Link, rate: Folded) -> Vector:
    """The joint's axis times a number, in the link's frame."""
    x, y, z = (rate * link.sign if k == link.axis else fold(0.0) for k in range(3))
    return x, y, z


def _swirl(spin: Vector, turn: Vector) -> Matrix:
    """S = [ω̇]× + ω ωᵀ − ω·ω 1."""
    x, y, z = spin
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (
        (-(yy + zz), xy - turn[2], xz + turn[1]),
        (xy + turn[2], -(xx + zz), yz - turn[0]),
        (xz - turn[1], yz + turn[0], -(xx + yy)),
    )


def _join(a: Inertia, b: Inertia, pose: Pose) -> Inertia:
    """Inertia of a link and of what hangs on it at `pose`, in the link's frame.

    I = I_a + R I_b Rᵀ + m (r·r 1 − r rᵀ) + 2 (r·h) 1 − r hᵀ − h rᵀ, with h = R h_b.
    """
    r = pose.origin
    rows = tuple(rotate(b.rotational, row) for row in pose.rotation)
    moment = rotate(pose.rotation, b.moment)
    shifted = add(moment, scale(b.mass, r))
    trace = dot(r, add(moment, shifted))

    def entry(i: int, j: int) -> Folded:
        off = a.rotational[i][j] + dot(rows[i], pose.rotation[j]) - r[i] * shifted[j] - moment[i] * r[j]
        return off + trace if i == j else off

    return Inertia(a.mass + b.mass, add(a.moment, shifted), symmetric(entry))


def _settle(inertia: Inertia, one: Folded | None) -> Inertia:
    (a, b, c), (_, d, e), (_, _, f) = inertia.rotational
    moment, (a, b, c), (d, e, f) = settle_vectors(inertia.moment, (a, b, c), (d, e, f), by=one)
    return Inertia(inertia.mass, moment, ((a, b, c), (b, d, e), (c, e, f)))
