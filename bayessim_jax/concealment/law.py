"""What every concealed law promises: one number says how strong it is, and at zero it changes nothing.

A law is an object made for one place of one model (`make`); its fields are its parameters in SI units, what it
remembers is set anew at the beginning of every recording (`begin`). It acts at one of four ports: `model` (numbers of
the model), `act` (what becomes of a command), `force` (a generalized force), `sense` (what an encoder shows). The laws
are written apart from the effects with which the package explains recordings, and differ from them in form.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
from jaxtyping import Float

from bayessim_jax.concealment.places import driven_joint, joints

if TYPE_CHECKING:
    from bayessim_jax.concealment.world import World

__all__ = ["ActLaw", "ForceLaw", "Law", "ModelLaw", "SenseLaw", "Spot"]


@dataclass(frozen=True)
class Spot:
    """A place, and how large things are there in the motion of the machine without anything concealed in it."""

    place: str
    joint: int = -1
    """The joint at the place: that of an actuator, that which moves a body; −1 for the world."""
    q: int = 0
    v: int = 0
    """Its places in `qpos` and `qvel`."""
    other: int = -1
    """The second joint of a place that has two."""
    actuator: int = -1
    body: int = -1
    geom: int = -1
    slides: bool = False
    force: float = 1.0
    """Root mean square of what motors and gravity exert on the joint, N or N m."""
    speed: float = 1.0
    """What 95 % of the speeds stay below, m/s or rad/s."""
    reach: float = 1.0
    """What 95 % of the distances from `centre` stay below, m or rad."""
    centre: float = 0.0
    inertia: float = 1.0
    """The least that the joint feels, 1/(M⁻¹)ⱼⱼ, kg or kg m²."""
    command: float = 1.0
    """The largest command of the actuator."""
    mass: float = 1.0
    length: float = 1.0
    """Of the body: kg, and the distance from its joint to its centre of mass, m."""
    other_force: float = 1.0
    other_speed: float = 1.0
    other_reach: float = 1.0
    """Motors' force, speed and reach of the second joint."""
    duration: float = 1.0
    """Of a recording, s."""
    h: float = 0.0005
    """A step of the world, s."""

    @property
    def detail(self) -> str:
        """What stands after the `#`."""
        return self.place.partition("#")[2]


@dataclass
class Law(ABC):
    """A law at a place."""

    name: ClassVar[str]
    port: ClassVar[str]

    spot: Spot

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Where in a model it can act."""
        return joints(model)

    @classmethod
    @abstractmethod
    def make(cls, spot: Spot, amplitude: float, rng: np.random.Generator) -> Any:
        """The law of this amplitude, 0 for none, about 1 for all that the joint feels; the rest is drawn."""

    def begin(self, world: World, rng: np.random.Generator) -> None:  # noqa: B027 - most laws remember nothing
        """Forget everything: a recording begins; the first command is in `world.data.ctrl`."""

    def parameters(self) -> dict[str, float]:
        """Its parameters by name, in SI units."""
        return {name: float(value) for name, value in asdict(self).items() if name != "spot"}


class ModelLaw(Law):
    """Numbers of the model that are others."""

    port = "model"

    @abstractmethod
    def edit(self, model: mujoco.MjModel) -> None:
        """Change the model in place; what derives from its numbers is computed anew afterwards."""


class ActLaw(Law):
    """What an actuator makes of a command."""

    port = "act"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """Every actuator with a name that drives a hinge or slide."""
        named = [i for i in range(model.nu) if model.actuator(i).name and driven_joint(model, i) >= 0]
        return [f"actuator/{model.actuator(i).name}" for i in named]

    @abstractmethod
    def command(self, world: World, u: float) -> float:
        """What arrives in place of a command during the next step."""


class ForceLaw(Law):
    """A generalized force at a joint."""

    port = "force"

    @abstractmethod
    def force(self, world: World, q: float, v: float) -> float:
        """The force during the next step, N or N m, at the joint's position and velocity."""


class SenseLaw(Law):
    """What the encoder of a joint shows; measured velocities come from another sensor."""

    port = "sense"

    @classmethod
    def places(cls, model: mujoco.MjModel) -> list[str]:
        """The positions of hinges and slides."""
        return [f"{joint}/qpos" for joint in joints(model)]

    @abstractmethod
    def read(
        self, time: Float[np.ndarray, " steps"], q: Float[np.ndarray, " steps"], rng: np.random.Generator
    ) -> Float[np.ndarray, " steps"]:
        """What is shown at every step of the world, from some time before the recording begins (time 0)."""
