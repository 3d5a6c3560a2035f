"""Directions in a model: the axes of its joints and links, and gravity turned about one of them."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.contracts import Scalar
from bayessim_jax.effects.contract import Number, Numbers
from bayessim_jax.effects.places import detail, find_site

__all__ = ["link_axes", "tilt_axes", "tilt_places", "turn_gravity", "turned_components"]

Axis = Float[np.ndarray, "3"]


def tilt_places(model: mujoco.MjModel) -> list[str]:
    """`world#joint/hinge` for a model that moves in the plane of that hinge, else `world`."""
    data, axes = mujoco.MjData(model), []
    mujoco.mj_forward(model, data)
    gravity = np.array(model.opt.gravity)
    if not gravity.any():
        return []
    down = gravity / np.linalg.norm(gravity)
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            axes.append((joint, data.xaxis[joint].copy()))
        elif model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE:
            return ["world"]
    if not axes or not model.joint(axes[0][0]).name:
        return ["world"]
    first = axes[0][1]
    together = all(abs(abs(axis @ first) - 1.0) < 1e-6 for _, axis in axes)
    return [f"world#joint/{model.joint(axes[0][0]).name}"] if together and abs(first @ down) < 0.5 else ["world"]


def tilt_axes(model: mujoco.MjModel, place: str) -> list[Axis]:
    """The axes about which gravity turns: the place's joint, or two across gravity (y and x where that is along z)."""
    if detail(place):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return [_clean(data.xaxis[find_site(model, detail(place)).joint])]
    down = np.array(model.opt.gravity) / np.linalg.norm(model.opt.gravity)
    across = np.eye(3)[int(np.argmin(np.abs(down)))]
    one = np.cross(across, down)
    return [_clean(-one / np.linalg.norm(one)), _clean(across - (across @ down) * down)]


def turned_components(model: mujoco.MjModel, place: str) -> list[int]:
    """Which components of gravity change as it turns."""
    axes, moved = tilt_axes(model, place), np.array(model.opt.gravity) != 0.0
    for axis in axes:
        across = np.abs(np.cross(np.eye(3), axis)).T @ moved > 1e-12
        moved = moved | across
    return [k for k in range(3) if moved[k]]


def turn_gravity(numbers: Numbers, axes: list[Axis], angles: list[Scalar]) -> list[Number]:
    """Gravity turned about one axis after the other: g cos α + (n × g) sin α + n (n · g) (1 − cos α)."""
    g: list[Any] = [numbers("gravity", k) for k in range(3)]
    for axis, angle in zip(axes, angles, strict=True):
        n = [float(x) for x in axis]
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        along = sum(x * y for x, y in zip(n, g, strict=True)) * (1.0 - cosine)
        cross = [n[1] * g[2] - n[2] * g[1], n[2] * g[0] - n[0] * g[2], n[0] * g[1] - n[1] * g[0]]
        g = [g[k] * cosine + cross[k] * sine + n[k] * along for k in range(3)]
    return g


def link_axes(model: mujoco.MjModel, body: int) -> tuple[Axis, Axis, Axis]:
    """In the body's frame: where its joint is, the axis from there to its centre of mass, and the axis across.

    The one across lies in the plane in which the joint moves the body. A balanced body has its own x axis (or the next
    that the joint does not turn about) for a link.
    """
    anchor, turns = np.zeros(3), None
    if model.body_jntnum[body]:
        joint = int(model.body_jntadr[body] + model.body_jntnum[body] - 1)
        anchor = np.array(model.jnt_pos[joint])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            turns = np.array(model.jnt_axis[joint])
    along = np.array(model.body_ipos[body]) - anchor
    if turns is not None:
        along = along - (along @ turns) * turns
    if np.linalg.norm(along) < 1e-9:
        along = np.eye(3)[0] if turns is None else np.eye(3)[int(np.argmin(np.abs(turns)))]
        along = along if turns is None else along - (along @ turns) * turns
    along = _clean(along / np.linalg.norm(along))
    if turns is None:
        turns = np.eye(3)[int(np.argmin(np.abs(along)))]
    across = np.cross(turns, along)
    return anchor, along, _clean(across / np.linalg.norm(across))


def _clean(axis: Axis) -> Axis:
    """Without the rounding of rotations by right angles, and of length 1."""
    axis = np.where(np.abs(axis) < 1e-12, 0.0, axis)
    return axis / np.linalg.norm(axis)
