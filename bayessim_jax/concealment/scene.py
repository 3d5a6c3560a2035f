"""A machine with its motions, and how large things are in them: where laws are concealed, and how strong they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.concealment.drive import find_drive
from bayessim_jax.concealment.law import Spot
from bayessim_jax.concealment.masses import link_axes
from bayessim_jax.concealment.motions import draw_motions
from bayessim_jax.concealment.places import driven_joint, find_joint, nearest_joint
from bayessim_jax.concealment.world import Track, build, count_substeps, simulate
from bayessim_jax.mechanics import free_inertia

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bayessim_jax.concealment.drive import Drive
    from bayessim_jax.concealment.law import Law
    from bayessim_jax.concealment.motions import Motion

__all__ = ["Scene", "StillError", "make_scene"]

SAMPLES = 4000
"""At most so many rows are looked at where forces are measured."""

LEAST = 1e-9
"""N or N m; a joint on which less acts is moved by nothing."""

Forces = Float[np.ndarray, "samples nv"]


class StillError(ValueError):
    """A place that nothing moves."""


@dataclass(frozen=True)
class Scene:
    """The machine as it is believed to be, with the true parameters, and what it did with nothing concealed in it."""

    model: mujoco.MjModel
    drive: Drive
    motions: tuple[Motion, ...]
    clean: tuple[Track, ...]

    def play(self, laws: Sequence[Law]) -> tuple[Track, ...]:
        """The same motions with laws; raises `RunawayError`."""
        machine = build(self.model, laws)
        return tuple(simulate(machine, laws, self.drive, motion) for motion in self.motions)

    def spot(self, place: str) -> Spot:
        """A place, and how large things are there."""
        m = self.model
        kind, _, name = place.partition("#")[0].partition("/")
        joint = other = actuator = body = geom = -1
        if kind == "joint":
            joint, second = find_joint(m, place), place.partition("#")[2].partition("/")[2]
            other = find_joint(m, second) if second else -1
        elif kind == "actuator":
            actuator = int(m.actuator(name).id)
            joint = driven_joint(m, actuator)
        elif kind == "body":
            body = int(m.body(name).id)
            joint = nearest_joint(m, body)
        elif kind == "geom":
            geom = int(m.geom(name).id)
            joint = nearest_joint(m, int(m.geom_bodyid[geom]))
        h = float(m.opt.timestep) / count_substeps(m.opt.timestep)
        size = {"h": h, "duration": self.motions[0].steps * h}
        if body > 0:
            anchor, along, _ = link_axes(m, body)
            reach = abs(float((m.body_ipos[body] - anchor) @ along))
            gyration = float(np.sqrt(m.body_inertia[body].max() / m.body_mass[body]))
            size |= {"mass": float(m.body_mass[body]), "length": max(reach, gyration)}
        if actuator >= 0:
            size["command"] = max(float(np.abs(np.concatenate([t.ctrl[:, actuator] for t in self.clean])).max()), 1e-9)
        if other >= 0:
            far = self._sizes(other)
            size |= {"other_force": far["motors"], "other_speed": far["speed"], "other_reach": far["reach"]}
        if joint >= 0:
            near = self._sizes(joint)
            del near["motors"]
            size |= near
        slides = joint >= 0 and m.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        q, v = (int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])) if joint >= 0 else (0, 0)
        return Spot(place, joint, q, v, other=other, actuator=actuator, body=body, geom=geom, slides=slides, **size)

    def strength(self, spot: Spot, tracks: Sequence[Track]) -> float:
        """Root mean square of what the model lacks at a spot's joint over that of what motors and gravity exert there.

        What it lacks is the force that would take the model, under the recorded commands, from one row of the motion to
        the next as the encoders show it, on average over that time. Of a spot without a joint, it is that of the joint
        where it is most.
        """
        missing, applied, _ = _forces(self.model, tracks)
        rms = [np.sqrt(np.mean(x**2, axis=0)) for x in (missing, applied)]
        ratio = rms[0] / np.maximum(rms[1], 1e-12)
        return float(ratio[spot.v] if spot.joint >= 0 else ratio[rms[1] > LEAST].max(initial=0.0))

    def lack(self, model: mujoco.MjModel, tracks: Sequence[Track], samples: int = SAMPLES) -> Forces:
        """What a model with other parameters lacks, in units of the root mean square that acts on every joint."""
        missing, applied, _ = _forces(model, tracks, samples)
        return missing / np.maximum(np.sqrt(np.mean(applied**2, axis=0)), LEAST)

    def _sizes(self, joint: int) -> dict[str, float]:
        q, v = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
        qpos = np.concatenate([t.qpos[:, q] for t in self.clean])
        speeds = np.abs(np.concatenate([t.qvel[:, v] for t in self.clean]))
        _, applied, motors = _forces(self.model, self.clean)
        centre = float(np.mean(qpos))
        force = float(np.sqrt(np.mean(applied[:, v] ** 2)))
        if force < 1e-9 or speeds.max() < 1e-6:
            name = self.model.joint(joint).name
            raise StillError(f"joint/{name}: nothing moves it in these motions; choose another place or other motions.")
        return {
            "force": force,
            "motors": float(np.sqrt(np.mean(motors[:, v] ** 2))),
            "speed": float(np.quantile(speeds, 0.95)),
            "reach": float(np.quantile(np.abs(qpos - centre), 0.95)),
            "centre": centre,
            "inertia": _least_inertia(self.model, self.clean, v),
        }


def make_scene(
    model: mujoco.MjModel,
    rng: np.random.Generator,
    *,
    kind: str,
    recordings: int,
    seconds: float,
    stride: int,
    jitter: float,
) -> Scene:
    """Motions of a kind for a model with the true parameters; a row of a recording every `stride` of its time steps."""
    h = float(model.opt.timestep)
    drive = find_drive(model, kind, stride)
    rows = round(seconds / (stride * h))
    motions = draw_motions(rng, drive, kind, recordings, rows, stride, h, jitter)
    machine = build(model, ())
    return Scene(model, drive, tuple(motions), tuple(simulate(machine, (), drive, motion) for motion in motions))


def _forces(model: mujoco.MjModel, tracks: Sequence[Track], samples: int = SAMPLES) -> tuple[Forces, Forces, Forces]:
    """What the model lacks, what motors and gravity exert together, and the motors alone, from row to row.

    The first is M (v' − v̂')/Δt with v' the velocity at the next row and v̂' what the model makes of this one.
    """
    plain = build(model, ())
    data, mass = mujoco.MjData(plain), np.zeros((model.nv, model.nv))
    every = max(1, sum(len(track.rows) for track in tracks) // samples)
    missing, applied, motors = [], [], []
    for track in tracks:
        qvel, h = _velocities(model, track), float(track.time[1] - track.time[0])
        for row in range(0, len(track.rows) - 1, every):
            first, last = int(track.rows[row]), int(track.rows[row + 1])
            data.qpos[:], data.qvel[:], data.ctrl[:] = track.shown[first], 0.0, track.ctrl[row]
            mujoco.mj_fwdPosition(plain, data)
            mujoco.mj_fwdVelocity(plain, data)
            weight = data.qfrc_bias.copy()
            data.qvel[:], data.qacc_warmstart[:] = qvel[first], 0.0
            mujoco.mj_fwdVelocity(plain, data)
            _settle(plain, data)
            mujoco.mj_fwdActuation(plain, data)
            motors.append(data.qfrc_actuator.copy())
            applied.append(motors[-1] - weight)
            mujoco.mj_fullM(plain, data, mass)
            mujoco.mj_step(plain, data, last - first)
            missing.append(mass @ (qvel[last] - data.qvel) / ((last - first) * h))
    return np.array(missing), np.array(applied), np.array(motors)


def _velocities(model: mujoco.MjModel, track: Track) -> np.ndarray:
    """Velocities of the motion as it is shown."""
    h, qvel = float(track.time[1] - track.time[0]), track.qvel.copy()
    for j in range(model.njnt):
        q, v = model.jnt_qposadr[j], model.jnt_dofadr[j]
        error = track.shown[:, q] - track.qpos[:, q]
        if error.any():
            qvel[:, v] += np.gradient(error, h)
    return qvel


def _settle(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """States of actuators as after their command has been held for long."""
    for i in range(model.nu):
        if model.actuator_actadr[i] >= 0:
            data.act[model.actuator_actadr[i]] = data.ctrl[i]


def _least_inertia(model: mujoco.MjModel, tracks: Sequence[Track], v: int) -> float:
    """The least of 1/(M⁻¹)ⱼⱼ along the motion."""
    data = mujoco.MjData(model)
    some = (track.qpos[k] for track in tracks for k in track.rows[:: max(1, len(track.rows) // 40)])
    return 0.8 * min(float(free_inertia(model, data, qpos)[v]) for qpos in some)
