"""Numbers of the model that are not what they are believed to be: inertias, gravity's direction, contacts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.concealment.law import ModelLaw, Spot
from bayessim_jax.concealment.places import bodies, dry_geoms, find_joint, level_places, touched, turns

__all__ = ["Armature", "BaseTilt", "ContactFriction", "GroundSlope", "LinkOffset", "Payload", "link_axes"]

Vector = Float[np.ndarray, "3"]


@dataclass
class Armature(ModelLaw):
    """(M + J) q̈ = …: a rotor that turns with the joint and with nothing else."""

    name = "armature"
    inertia: float

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Armature:
        """J in units of what the joint feels."""
        return cls(spot, amplitude * spot.inertia)

    def edit(self, model: mujoco.MjModel) -> None:
        """Added to what the model has."""
        model.dof_armature[self.spot.v] += self.inertia


@dataclass
class Payload(ModelLaw):
    """A point mass m at a distance x from the joint, on the line through the centre of mass.

    Mass, centre of mass and the whole inertia tensor follow, I + M (|a|² 1 − a aᵀ) + m (|b|² 1 − b bᵀ) with a and b
    from the new centre of mass to the old one and to the point, and its principal axes.
    """

    name = "payload"
    mass: float
    position: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every body that a joint moves."""
        return bodies(model)

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Payload:
        """M in units of the body's mass, 0.6 to 1.8 times as far from the joint as its centre of mass."""
        return cls(spot, amplitude * spot.mass, rng.uniform(0.6, 1.8) * spot.length)

    def edit(self, model: mujoco.MjModel) -> None:
        """With the point."""
        if self.mass == 0.0:
            return
        body, turn = self.spot.body, np.zeros(9)
        anchor, along, _ = link_axes(model, body)
        mass, centre = float(model.body_mass[body]), np.array(model.body_ipos[body])
        point = anchor + self.position * along
        new = (mass * centre + self.mass * point) / (mass + self.mass)
        mujoco.mju_quat2Mat(turn, model.body_iquat[body])
        axes = turn.reshape(3, 3)
        tensor = axes @ np.diag(model.body_inertia[body]) @ axes.T
        tensor = tensor + mass * _about(centre - new) + self.mass * _about(point - new)
        moments, axes = np.linalg.eigh(tensor)
        axes[:, 2] *= np.linalg.det(axes)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, axes.ravel())
        model.body_mass[body] = mass + self.mass
        model.body_ipos[body], model.body_inertia[body], model.body_iquat[body] = new, moments, quaternion
        model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


@dataclass
class LinkOffset(ModelLaw):
    """A centre of mass that lies x farther along the link, or with `#across` beside it in the plane of its motion."""

    name = "link_offset"
    offset: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every body that a hinge turns, in both directions."""
        turned = [place for place in bodies(model) if turns(model, int(model.body(place.removeprefix("body/")).id))]
        return [place + way for place in turned for way in ("", "#across")]

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> LinkOffset:
        """X of either sign, in units of the distance of the centre of mass."""
        return cls(spot, rng.choice([-1.0, 1.0]) * amplitude * spot.length)

    def edit(self, model: mujoco.MjModel) -> None:
        """Shifted."""
        if self.offset == 0.0:
            return
        _, along, across = link_axes(model, self.spot.body)
        model.body_sameframe[self.spot.body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.body_ipos[self.spot.body] += self.offset * (across if self.spot.detail else along)


@dataclass
class BaseTilt(ModelLaw):
    """Gravity as a base sees it that is tilted by an angle about an axis across gravity.

    The axis is that of the hinge for a mechanism that moves in a plane, else (cos d, sin d) in the level plane.
    """

    name = "base_tilt"
    angle: float
    direction: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """The world, where there is gravity."""
        return level_places(model)

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> BaseTilt:
        """An angle of either sign below 1.4 rad."""
        return cls(spot, rng.choice([-1.0, 1.0]) * 1.4 * math.tanh(amplitude / 1.4), rng.uniform(0.0, 2.0 * math.pi))

    def edit(self, model: mujoco.MjModel) -> None:
        """Gravity, turned (Rodrigues' formula)."""
        if self.angle == 0.0:
            return
        gravity = np.array(model.opt.gravity)
        if self.spot.detail:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            axis = np.array(data.xaxis[find_joint(model, self.spot.detail)])
        else:
            down = gravity / np.linalg.norm(gravity)
            first = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
            first = first / np.linalg.norm(first)
            axis = math.cos(self.direction) * first + math.sin(self.direction) * np.cross(down, first)
        along = axis * (axis @ gravity)
        model.opt.gravity[:] = (
            along + (gravity - along) * math.cos(self.angle) + np.cross(axis, gravity) * math.sin(self.angle)
        )


@dataclass
class GroundSlope(BaseTilt):
    """Gravity as it is seen on a slope: the ground is where it was, and the machine stands on it."""

    name = "ground_slope"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """The world, where it has a plane or a height field for ground."""
        kinds = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        fixed = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] == 0]
        return level_places(model) if any(model.geom_type[g] in kinds for g in fixed) else []

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> GroundSlope:
        """About the first axis across gravity where the machine does not move in a plane."""
        return cls(spot, rng.choice([-1.0, 1.0]) * 1.4 * math.tanh(amplitude / 1.4), 0.0)


@dataclass
class ContactFriction(ModelLaw):
    """Another coefficient of sliding friction between a geom that moves and what is fixed to the world.

    Of two geoms MuJoCo takes the larger coefficient, so what it touches gets at most this one.
    """

    name = "contact_friction"
    factor: float

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every geom with a name that a joint moves and that can touch something."""
        return dry_geoms(model)

    @classmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> ContactFriction:
        """More or less slippery by e to the power of the amplitude."""
        return cls(spot, math.exp(rng.choice([-1.0, 1.0]) * min(amplitude, 20.0)))

    def edit(self, model: mujoco.MjModel) -> None:
        """The coefficient of the pair, times the factor."""
        if self.factor == 1.0:
            return
        geom, fixed = self.spot.geom, touched(model, self.spot.geom)
        coefficient = self.factor * max(float(model.geom_friction[g, 0]) for g in (geom, *fixed))
        model.geom_friction[geom, 0] = coefficient
        for g in fixed:
            model.geom_friction[g, 0] = min(model.geom_friction[g, 0], coefficient)


def link_axes(model: mujoco.MjModel, body: int) -> tuple[Vector, Vector, Vector]:
    """In the body's frame: where its joint is, from there to its centre of mass, and the axis across."""
    anchor, axis = np.zeros(3), np.zeros(3)
    if model.body_jntnum[body]:
        joint = int(model.body_jntadr[body] + model.body_jntnum[body] - 1)
        anchor = np.array(model.jnt_pos[joint])
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            axis = np.array(model.jnt_axis[joint])
    along = np.array(model.body_ipos[body]) - anchor
    along = along - (along @ axis) * axis
    if np.linalg.norm(along) < 1e-9:
        along = np.eye(3)[int(np.argmin(np.abs(axis)))]
        along = along - (along @ axis) * axis
    along = along / np.linalg.norm(along)
    if not axis.any():
        axis = np.eye(3)[int(np.argmin(np.abs(along)))]
    across = np.cross(axis, along)
    return anchor, along, across / np.linalg.norm(across)


def _about(x: Vector) -> Float[np.ndarray, "3 3"]:
    """|x|² 1 − x xᵀ."""
    return np.eye(3) * (x @ x) - np.outer(x, x)
